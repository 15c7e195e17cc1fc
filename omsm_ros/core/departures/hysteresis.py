"""What depends on where a motion turned last: backlash (a gap), and friction before it slides.

Both depend on reversals only, not on time. A reversal counts once the motion has gone back by a
few times its noise; so noise at rest changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray

# What noise does beyond is far less than any gap looked for; a wider one would lose reversals.
_NOISE_HALF_GAP = 2.0


def without_noise(motion: FloatArray, noise: float) -> FloatArray:
    """Return ``motion`` (n,) [m] without the reversals of ``noise`` [m], its deviation."""
    return through_gap(motion, _NOISE_HALF_GAP * noise) if noise > 0 else motion


def through_gap(motion: FloatArray, half: float) -> FloatArray:
    """Return the output (n,) of a gap of ±``half`` [m] that ``motion`` (n,) drives."""
    change = np.diff(motion, prepend=motion[0])
    moved = np.flatnonzero(change)
    if len(moved) == 0:
        return motion.copy()
    # Along a run of one direction only its end counts.
    back = change[moved] < 0
    turns = moved[np.flatnonzero(back[1:] != back[:-1])]
    del change, moved  # of a long record, memory for what follows
    ends = np.append(turns, len(motion) - 1)
    state, states = float(motion[0]), []
    for end in motion[ends].tolist():
        states.append(state)
        state = min(max(state, end - half), end + half)
    held = np.repeat(states, np.diff(ends, prepend=-1))
    near = motion - half
    np.maximum(held, near, out=held)
    near += 2 * half
    return np.asarray(np.minimum(held, near, out=held))


def lost_in_gaps(motion: FloatArray, gaps: Sequence[float]) -> Iterator[FloatArray]:
    """Yield the lead of ``motion`` (n,) over half of each gap [m], -1 to 1, and its start column.

    Until the whole gap is crossed, what is ahead depends on where in it the motion began.
    """
    crossed = np.maximum.accumulate(motion) - np.minimum.accumulate(motion)
    for gap in gaps:
        yield (motion - through_gap(motion, 0.5 * gap)) / (0.5 * gap)
        yield np.clip(1.0 - crossed / gap, 0.0, 1.0)


def dahl(motion: FloatArray, travel: float) -> tuple[FloatArray, FloatArray]:
    """Return the friction force along ``motion`` (n,), -1 to 1, and the decay of its start value.

    dF/dx = (1 - F sgn v) / travel (Dahl 1968).
    """
    change = np.diff(motion, prepend=motion[0])
    kept, direction = np.exp(-np.abs(change) / travel), np.sign(change)
    moved = change != 0
    value, values = 0.0, []
    for way, part in zip(direction[moved].tolist(), kept[moved].tolist(), strict=True):
        value = way + (value - way) * part
        values.append(value)
    force = np.zeros(len(motion))
    force[moved] = values
    last = np.maximum.accumulate(np.where(moved, np.arange(len(motion)), 0))
    return force[last], np.cumprod(kept)
