"""Scans written down in plain numpy, line by line, with the truth of each line beside them.

Nothing is taken from the ripple guard's own model: heights are sums of sines over time, path,
radius and turns, sampled where the spindle of each scan happens to be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NM, UM, MM = 1e-9, 1e-6, 1e-3
PART, VIBRATION, SPINDLE = "part", "vibration", "spindle"


@dataclass(frozen=True)
class TrueLine:
    """``amplitude · sin(2π frequency u + phase)``, u one of "t", "s", "r", "c"."""

    what: str
    over: str
    frequency: float
    amplitude: float


@dataclass(frozen=True, eq=False)
class MadeScan:
    """Samples of a scan, each (n,); and an accelerometer along Z, None for none."""

    name: str
    rate: float
    sample: np.ndarray
    height: np.ndarray
    radius: np.ndarray
    angle: np.ndarray
    place: dict[str, np.ndarray]
    acceleration: np.ndarray | None
    acceleration_rate: float


@dataclass(frozen=True)
class Mixture:
    """Lines and the scans that see them."""

    lines: list[TrueLine]
    scans: list[MadeScan]


def mixture(seed: int) -> Mixture:
    """Two or three scans of one part on one machine, everything drawn at random."""
    rng = np.random.default_rng(seed)
    circles = rng.uniform() < 0.3
    count, rates = int(rng.integers(2, 4)), [1000.0] * 3
    with_accelerometer = rng.uniform() < 0.5
    if not with_accelerometer:
        rates[1] = float(rng.choice([800.0, 900.0, 950.0, 1250.0]))
    lines = _lines(rng, circles)
    speeds = rng.permutation([24.0, 30.0, 37.0, 45.0, 52.0])
    if circles:  # the slowest resolves what the others fold
        speeds = np.r_[rng.uniform(0.15, 0.3), rng.uniform(1.0, 2.0), 15.0]
    radius = float(rng.uniform(10, 13)) * MM
    feeds = rng.permutation([60.0, 75.0, 90.0, 110.0, 130.0]) * UM
    scans = [
        _scan(rng, f"S{k}", lines, rates[k], speeds[k], 0.0 if circles else feeds[k], radius,
              with_accelerometer)
        for k in range(count)
    ]  # fmt: skip
    return Mixture(lines, scans)


def _lines(rng: np.random.Generator, circles: bool) -> list[TrueLine]:
    def size() -> float:
        return float(rng.uniform(1.5, 10)) * NM

    pitch = float(rng.uniform(8, 40)) * UM
    over = "s" if circles else "r"
    marks = size()
    lines = [
        TrueLine(PART, over, (n + 1) / pitch, marks / (n + 1) ** 2)
        for n in range(int(rng.integers(1, 4)))
    ]
    if not circles and rng.uniform() < 0.5:
        lines.append(TrueLine(PART, "s", 1 / (rng.uniform(100, 300) * UM), size()))
    for _ in range(int(rng.integers(1, 4))):
        lines.append(TrueLine(VIBRATION, "t", float(rng.uniform(12, 390)), size()))
    for _ in range(int(rng.integers(1, 3))):
        lines.append(TrueLine(VIBRATION, "t", float(rng.uniform(640, 1900)), size()))
    if rng.uniform() < 0.3:  # aliased to the frequencies of drift
        lines.append(TrueLine(VIBRATION, "t", 1000 + float(rng.uniform(0.6, 3)), size()))
    if rng.uniform() < 0.3:  # two lines close together
        near = lines[-1]
        lines.append(TrueLine(VIBRATION, "t", near.frequency + 0.2, near.amplitude))
    if not circles:
        for order in rng.choice(np.arange(2, 60), int(rng.integers(0, 3)), replace=False):
            lines.append(TrueLine(SPINDLE, "c", float(order), size()))
    return lines


def _scan(
    rng: np.random.Generator,
    name: str,
    lines: list[TrueLine],
    rate: float,
    rpm: float,
    feed: float,
    radius: float,
    with_accelerometer: bool,
) -> MadeScan:
    seconds = float(rng.uniform(18, 30))
    n = int(seconds * rate)
    time = np.arange(n) / rate
    turn = rpm / 60 * time
    if rng.uniform() < 0.4:  # the spindle's speed wanders by a few parts in a thousand
        smooth = np.convolve(rng.normal(size=n), np.ones(300) / 300**0.5, "same")
        turn = turn + rpm / 60 * rng.uniform(1e-4, 3e-3) * np.cumsum(smooth) / rate
    r = radius - feed * turn
    s = np.r_[0.0, np.cumsum(np.pi * (r[1:] + r[:-1]) * np.diff(turn))]
    place = {"t": time, "s": s, "r": r, "c": turn}
    height = rng.normal(0, rng.uniform(3, 10) * NM, n)
    for line in lines:
        phase = rng.uniform(0, 2 * np.pi)
        height = height + line.amplitude * np.sin(
            2 * np.pi * line.frequency * place[line.over] + phase
        )
    height = height + 300 * NM * (r / radius) ** 2 * np.cos(4 * np.pi * turn)  # astigmatism
    height = height + 50 * NM * time / seconds  # drift
    kept = rng.uniform(size=n) > rng.choice([0.0, 0.02, 0.1])
    if rng.uniform() < 0.3:
        gap = int(rng.uniform(0.2, 0.7) * n)
        kept[gap : gap + n // 15] = False
    acceleration, fast = None, 5000.0
    if with_accelerometer:
        fine = np.arange(int(seconds * fast)) / fast
        acceleration = rng.normal(0, 6e-4, len(fine))
        for line in lines:
            if line.what == VIBRATION:
                omega = 2 * np.pi * line.frequency
                acceleration += line.amplitude * omega**2 * np.sin(omega * fine)
    return MadeScan(name, rate, np.flatnonzero(kept), height[kept], r, 2 * np.pi * turn, place,
                    acceleration, fast)  # fmt: skip
