"""Choose speed, feed and sampling rate so that motion, modes, lines and marks stay apart.

Three things are to be avoided: a harmonic of the Z motion on a mode of the machine; the alias of a
known vibration on a mode, or with the same phase in each turn, where it looks like form; and marks
whose image from turn to turn is long, because the feed is nearly a multiple of their pitch.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray

# Harmonics of a turn with less amplitude excite no mode beyond a nanometre at a gain of 100 [m].
_LEAST_HARMONIC_M = 1e-11
_PLACES, _RINGS, _MOST_ORDERS = 512, 8, 64
# Distances that suffice: of a frequency from a mode in half-widths; of the phase from turn to turn,
# and of feed over pitch, from a whole number. Then an image repeats after four turns at most.
ENOUGH_HALF_WIDTHS, ENOUGH_OF_A_TURN = 5.0, 0.25
# Relative range and step of the search about speed and feed; the feed is not widened.
_RANGE, _STEP = 0.2, 1e-3
# Half-width of a mode of unknown or tiny damping, relative.
_LEAST_WIDTH = 0.01


@dataclass(frozen=True, kw_only=True)
class KnownOfMachine:
    """Known modes (frequency [Hz], damping ratio), vibrations [Hz] and pitches of marks [m]."""

    modes: Sequence[tuple[float, float]] = ()
    lines: Sequence[float] = ()
    marks: Sequence[float] = ()


@dataclass(frozen=True, kw_only=True)
class MotionMargins:
    """Speed [rpm], feed [m] and rate [Hz] of a scan, and how far it keeps all apart.

    harmonic: least distance of a harmonic of Z from a mode [half-widths]
    image: least distance of the alias of a vibration from a mode [half-widths]
    phase: least distance of a vibration's waves a turn from a whole number [turn]
    pitch: least distance of feed over pitch of marks from a whole number [1]
    Each is infinite where nothing is known.
    """

    rpm: float
    feed: float
    rate: float
    harmonic: float
    image: float
    phase: float
    pitch: float

    @property
    def score(self) -> float:
        """Least margin over what suffices, 1 at most."""
        modal = min(self.harmonic, self.image) / ENOUGH_HALF_WIDTHS
        return float(min(modal, self.phase / ENOUGH_OF_A_TURN, self.pitch / ENOUGH_OF_A_TURN, 1.0))


def harmonic_orders(nominal: Surface, radius: float) -> FloatArray:
    """Return the orders of a turn that Z needs to follow ``nominal`` out to ``radius`` [m]."""
    angle = 2 * np.pi * np.arange(_PLACES) / _PLACES
    r = radius * np.arange(1, _RINGS + 1)[:, np.newaxis] / _RINGS
    z = nominal.height(r * np.cos(angle), -r * np.sin(angle))
    size = np.max(2 * np.abs(np.fft.rfft(z, axis=1)) / _PLACES, axis=0)[: _MOST_ORDERS + 1]
    orders = np.flatnonzero(size > _LEAST_HARMONIC_M)
    return np.asarray(orders[orders > 0], np.float64)


def margins(
    rpm: float, feed: float, rate: float, orders: FloatArray, known: KnownOfMachine
) -> MotionMargins:
    """Return how far a scan keeps harmonics, aliases and images apart."""
    turn = abs(rpm) / 60
    image = [abs(line - rate * np.floor(line / rate + 0.5)) for line in known.lines]
    return MotionMargins(
        rpm=rpm,
        feed=feed,
        rate=rate,
        harmonic=_from_modes(orders * turn, known),
        image=_from_modes(np.array(image), known),
        phase=_from_whole(np.array(image) / turn),
        pitch=_from_whole(feed / np.asarray(known.marks, np.float64)),
    )


def _from_modes(frequency: FloatArray, known: KnownOfMachine) -> float:
    return min(
        (float(np.min(np.abs(frequency - mode), initial=np.inf)) / (mode * max(width, _LEAST_WIDTH))
         for mode, width in known.modes),
        default=np.inf,
    )  # fmt: skip


def _from_whole(values: FloatArray) -> float:
    return float(np.min(np.abs(values - np.round(values)), initial=np.inf))


def choose_motion(
    rpm: float, feed: float, rates: Sequence[float], orders: FloatArray, known: KnownOfMachine
) -> MotionMargins:
    """Return the motion with the largest margin, of these the nearest to ``rpm`` and ``feed`` [m].

    Speeds within 20 % are tried, feeds down to 20 % less, and each of ``rates`` [Hz], first first.
    """
    change = np.arange(0.0, _RANGE + _STEP / 2, _STEP)
    speeds = rpm * (1 + np.concatenate([change, -change[1:]]))
    # Speed and feed do not interact, so each is searched alone.
    turned = [margins(float(n), feed, rate, orders, known) for rate, n in product(rates, speeds)]
    fed = [margins(rpm, float(q), rates[0], orders, known) for q in feed * (1 - change)]
    best = max(turned, key=lambda m: (_rounded(min(m.harmonic, m.image) / ENOUGH_HALF_WIDTHS,
                                               m.phase / ENOUGH_OF_A_TURN),
                                      -rates.index(m.rate), -abs(m.rpm - rpm)))  # fmt: skip
    narrow = max(fed, key=lambda m: (_rounded(m.pitch / ENOUGH_OF_A_TURN), m.feed))
    return margins(best.rpm, narrow.feed, best.rate, orders, known)


def _rounded(*shares: float) -> float:
    """Return the least share, 1 at most, coarsely, so that equal ones are chosen by nearness."""
    return round(min(*shares, 1.0), 2)
