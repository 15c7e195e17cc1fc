"""Limits of machine and probe on the speed of a path, apart from its dynamic error.

Each limit compares one quantity of the path with its allowed value. The speed factor k is that at
which both are equal; velocities grow with k, accelerations with k² and jerks with k³. Limits that
are not declared are reported as not evaluated.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.kinematics.scan_path import ScanPath, content_frequency, steepest
from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.lti.recursion import through
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.quantities import CheckedRecord, Quantity
from omsm_ros.units import MICROMETRE_M, RPM_RAD_S

FASTEST = 100.0
"""Largest speed factor that is searched; the least one is its inverse."""

# Relative precision of the speed factor.
_PRECISION = 1e-4
# Least ratio of a value to its limit, because zero has no logarithm.
_TINY = 1e-12

# Plausible ranges: a value in another unit, as 100 for micrometres, is refused.
_FREQUENCY = Quantity("limit", "Hz", 1e-3, 1e6, "give it in hertz")
_LENGTH = Quantity("limit", "m", 1e-10, 1.0, "give it in metres")
_SPEED = Quantity("limit", "rpm", 1e-3, 1e6, "give it in turns a minute")
_ACCELERATION = Quantity("limit", "m/s²", 1e-9, 1e5, "give it in m/s²")
_JERK = Quantity("limit", "m/s³", 1e-9, 1e9, "give it in m/s³")
_TIME = Quantity("limit", "s", 1e-15, 10.0, "give it in seconds")


@dataclass(frozen=True, kw_only=True)
class MachineLimits(CheckedRecord):
    """Limits of machine and probe; None if not declared.

    servo_frequency: natural frequency of the Z servo, taken as critically damped [Hz]; typical
        of a slow tool servo, and that of the paper, are 50 Hz
    probe_range: over which the probe reads [m];  spindle_speed_rpm: [1/min], the paper's model
        holds below 120;  motion_frequency: highest content of the Z motion [Hz], the paper's 50
    z_acceleration: [m/s²];  z_jerk: [m/s³];  point_spacing: along the path [m]
    exposure: of one reading [s];  timing: standard uncertainty of a trigger [s]
    x_beyond: travel of X on the other side of the spindle axis [m], for planned scans alone
    """

    servo_frequency: float | None = _FREQUENCY.of_field(50.0)
    probe_range: float | None = _LENGTH.of_field(100 * MICROMETRE_M)
    spindle_speed_rpm: float | None = _SPEED.of_field(120.0)
    motion_frequency: float | None = _FREQUENCY.of_field(50.0)
    z_acceleration: float | None = _ACCELERATION.of_field(None)
    z_jerk: float | None = _JERK.of_field(None)
    point_spacing: float | None = _LENGTH.of_field(None)
    exposure: float | None = _TIME.of_field(None)
    timing: float | None = _TIME.of_field(None)
    x_beyond: float | None = Quantity("limit", "m", 0.0, 1.0, "give it in metres").of_field(None)


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """One limit of a path.

    value: of the path;  allowed: largest value, in the same ``unit``
    speed_factor: at which the limit is reached, 0 if it is exceeded at any speed
    """

    name: str
    value: float
    allowed: float
    unit: str
    speed_factor: float


def highest_factor(
    value_at: Callable[[float], float], allowed: float, now: float | None = None
) -> float:
    """Return the largest factor at which the increasing ``value_at(factor)`` is ``allowed``.

    now: ``value_at(1)``, if known already

    The factor lies between 1 / FASTEST and FASTEST and is never too large; 0 if none is allowed.
    It is found by Brent's method on logarithms, where a power of the factor is a straight line.
    """
    from scipy.optimize import brentq

    @cache  # both ends are asked for twice
    def excess(logarithm: float) -> float:
        value = now if logarithm == 0 and now is not None else value_at(float(np.exp(logarithm)))
        return float(np.log(max(value / allowed, _TINY)))

    end = float(np.log(FASTEST))
    low, high = (0.0, end) if excess(0.0) <= 0 else (-end, 0.0)
    if excess(high) <= 0:
        return FASTEST
    if excess(low) > 0:
        return 0.0
    # The root is off by the precision at most.
    return float(np.exp(max(brentq(excess, low, high, xtol=_PRECISION / 2) - _PRECISION / 2, low)))


def speed_limits(
    path: ScanPath,
    limits: MachineLimits,
    valid_up_to: float,
    budget: float,
    dynamics: TransferFunction | None = None,
) -> tuple[list[SpeedLimit], list[str]]:
    """Return the limits that can be evaluated, and the names of those that cannot.

    valid_up_to: frequency to which the calibration is valid [Hz]
    dynamics: from encoder to probe, which adds to the following error of the servo
    budget: allowed error of a height, k = 2 [m], for exposure and timing
    """
    content = content_frequency(path.z, path.sample_period)
    velocity, acceleration, jerk = steepest(path.z, path.sample_period, content)
    exposed = None if limits.exposure is None else limits.exposure**2 / 24 * acceleration
    late = None if limits.timing is None else limits.timing * velocity
    duration = (len(path.z) - 1) * path.sample_period
    rpm = None if path.c is None else float(abs(path.c[-1] - path.c[0])) / duration / RPM_RAD_S
    every = (
        _power("calibrated band", content, valid_up_to, "Hz", 1),
        _power("motion frequency", content, limits.motion_frequency, "Hz", 1),
        _following(path, limits, dynamics),
        _power("Z acceleration", acceleration, limits.z_acceleration, "m/s²", 2),
        _power("Z jerk", jerk, limits.z_jerk, "m/s³", 3),
        _power("spindle speed", rpm, limits.spindle_speed_rpm, "rpm", 1),
        _power("spacing at the rim", _spacing(path), limits.point_spacing, "m", 1),
        _power("path within one exposure", exposed, budget / 2, "m", 2),
        _power("timing of the trigger", late, budget / 2, "m", 1),
    )
    return (
        [limit for limit in every if isinstance(limit, SpeedLimit)],
        [limit for limit in every if isinstance(limit, str)],
    )


def _power(
    name: str, value: float | None, allowed: float | None, unit: str, power: int
) -> SpeedLimit | str:
    """Return the limit of a quantity that grows with a power of the speed, or its name."""
    if value is None or allowed is None:
        return name
    factor = FASTEST if value == 0 else min((allowed / value) ** (1 / power), FASTEST)
    return SpeedLimit(name, value, allowed, unit, float(factor))


def following_error(
    z: FloatArray,
    sample_period: float,
    servo_frequency: float,
    factor: float = 1.0,
    dynamics: TransferFunction | None = None,
) -> float:
    """Return the largest deviation [m] of the probe from the path at a speed ``factor``.

    The servo is 1 / (1 + s/ω)²; ``dynamics`` is from encoder to probe.
    """
    omega = 2 * np.pi * servo_frequency
    motion = TransferFunction(np.ones(1), np.array([1.0, 2 / omega, 1 / omega**2]))
    if dynamics is not None:
        both = np.asarray(np.convolve(motion.denominator, dynamics.denominator), np.float64)
        motion = TransferFunction(dynamics.numerator, both, dynamics.delay)
    moved = through(discretise(motion, sample_period / factor), z)
    # The motion before the first sample is unknown; its response ends after ten time constants.
    settling = min(int(10 / omega / (sample_period / factor)), len(z) // 2)
    return float(np.max(np.abs(z - moved)[settling:]))


def _following(
    path: ScanPath, limits: MachineLimits, dynamics: TransferFunction | None
) -> SpeedLimit | str:
    name = "probe range against following error"
    if limits.probe_range is None or limits.servo_frequency is None:
        return name
    servo = limits.servo_frequency

    def excursion(factor: float) -> float:
        return following_error(path.z, path.sample_period, servo, factor, dynamics)

    now, taken, share = excursion(1.0), 0.0, 1.0
    if path.distance is not None and np.any(np.isfinite(path.distance)):
        span = float(np.nanmax(path.distance) - np.nanmin(path.distance)) / 2
        # An excess over the servo's error is shape, tilt and set-up, independent of the speed; a
        # smaller excursion shows a servo that is better than declared.
        taken, share = max(span - now, 0.0), min(span / now, 1.0) if now else 1.0
    value, allowed = share * now + taken, limits.probe_range / 2
    factor = highest_factor(lambda k: share * excursion(k) + taken, allowed, value)
    return SpeedLimit(name, value, allowed, "m", factor)


def _spacing(path: ScanPath) -> float | None:
    """Return the largest distance between neighbouring points in the plane of the chuck [m]."""
    if path.x is None or path.c is None:
        return None
    radius = 0.5 * np.abs(path.x[1:] + path.x[:-1])
    return float(np.max(np.hypot(np.diff(path.x), radius * np.diff(path.c))))


# A scan keeps three things apart: harmonics of Z and modes of the machine; aliases of known
# vibrations and modes, or one phase in each turn, where they look like form; marks and a feed that
# is nearly a multiple of their pitch, whose image is long.
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
