"""Simulate the motion: a servo axis that follows its command, and a probe that follows the axis.

``command → servo → X_d (encoder) → G(s) → true motion of the probe``
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg, signal

from omsm_ros.core.kinematics.trajectories import Motion
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import CheckedRecord
from omsm_ros.twin.record_checks import FREQUENCY

# Distance from the grid, in steps, that is rounding of k · period.
_ON_THE_GRID = 1e-7


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Signal with ``values`` (n,) at ``start`` [s] and every ``step`` [s] after it."""

    start: float
    step: float
    values: FloatArray

    @property
    def times(self) -> FloatArray:
        """Instants of the values [s], (n,)."""
        return self.start + np.arange(len(self.values), dtype=np.float64) * self.step

    def at(self, time: FloatArray) -> FloatArray:
        """Return the value at ``time`` [s], of its shape, by a cubic between the grid points.

        Raises ConfigurationError for a time before the start or after the end.
        """
        place = (time - self.start) / self.step
        nearest = np.rint(place)
        last = len(self.values) - 1
        if place.size and not -_ON_THE_GRID <= place.min() <= place.max() <= last + _ON_THE_GRID:
            raise ConfigurationError(
                f"twin: asked for {time.min():g} to {time.max():g} s, simulated are "
                f"{self.start:g} to {self.times[-1]:g} s; a clock cannot be off by so much"
            )
        if np.all(abs(place - nearest) < _ON_THE_GRID):
            return np.asarray(self.values[nearest.astype(np.int64)])
        return self._between(place)

    def _between(self, place: FloatArray) -> FloatArray:
        """Return Lagrange's cubic through two values before and two after ``place`` [steps]."""
        index = np.clip(np.floor(place).astype(np.int64), 1, len(self.values) - 3)
        u = place - index
        v, w, q = u + 1, u - 1, u - 2
        values = self.values
        return np.asarray(
            -u * w * q / 6 * values[index - 1]
            + v * w * q / 2 * values[index]
            - v * u * q / 2 * values[index + 1]
            + v * u * w / 6 * values[index + 2]
        )


PAPER_EQ_12 = TransferFunction.from_ascending(
    # The printed equation lacks the s after 1.22e8; without it the plant would be unstable.
    [1.26e12, -3.07e8, 1.29e5],
    [1.27e12, 1.22e8, 5.17e4, 1.0],
)
"""The paper's identified G_m (Eq. 12), DC gain 1.26/1.27 as printed."""

PAPER_STATIC_GAIN = PAPER_EQ_12.dc_gain
PAPER_DYNAMICS = PAPER_EQ_12.normalised()

# Duration of the lead-in over the slowest time constant: the transient decays below rounding.
_LEAD_IN_TIME_CONSTANTS = 40
# Samples at a time, to bound the memory of a long scan.
_CHUNK_SAMPLES = 50_000


@dataclass(frozen=True)
class Plant(CheckedRecord):
    """Critically damped servo of ``servo_bandwidth`` [Hz] and dynamics G(s) of the probe."""

    dynamics: TransferFunction = PAPER_DYNAMICS
    servo_bandwidth: float = FREQUENCY.of_field(200.0)

    def __post_init__(self) -> None:
        CheckedRecord.__post_init__(self)
        if not self.dynamics.is_stable:
            raise ConfigurationError(f"plant with poles {self.dynamics.poles()!r} is unstable")

    @property
    def servo(self) -> TransferFunction:
        """Transfer function 1 / (1 + s/ω)², ω = 2π · servo_bandwidth."""
        omega = 2 * np.pi * self.servo_bandwidth
        return TransferFunction.from_ascending([1.0], [1.0, 2 / omega, 1 / omega**2])

    def lead_in(self) -> float:
        """Return the time after which the start of the motion has decayed [s]."""
        slowest = min(-np.r_[self.servo.poles(), self.dynamics.poles()].real)
        return float(_LEAD_IN_TIME_CONSTANTS / slowest + self.dynamics.delay)


@dataclass(frozen=True, slots=True)
class TimeGrid:
    """Time steps of the simulation.

    lead, samples: sample periods before and after time 0
    sample_period: [s];  substeps: steps in a sample period;  every: steps between kept values
    """

    lead: int
    samples: int
    sample_period: float
    substeps: int
    every: int

    @property
    def step(self) -> float:
        """Step [s]."""
        return self.sample_period / self.substeps


def move(plant: Plant, motion: Motion, grid: TimeGrid) -> tuple[Trajectory, Trajectory]:
    """Return the motion of slide and probe [m], from ``grid.lead`` periods before time 0.

    In each substep the command is held at its value in the middle, which is exact for a step on the
    grid and of second order for a smooth motion. The delay shifts the time of the command; a step
    off the grid has an error of up to half a substep.
    """
    servo, multiply = plant.servo, np.polynomial.polynomial.polymul
    both = TransferFunction(
        np.asarray(multiply(servo.numerator, plant.dynamics.numerator), np.float64),
        np.asarray(multiply(servo.denominator, plant.dynamics.denominator), np.float64),
    )
    return (
        _through_system(servo, 0.0, motion, grid),
        _through_system(both, plant.dynamics.delay, motion, grid),
    )


def _through_system(
    system: TransferFunction, delay: float, motion: Motion, grid: TimeGrid
) -> Trajectory:
    step, period, substeps, every = grid.step, grid.sample_period, grid.substeps, grid.every
    sections = _zero_order_hold_sections(system, step)
    state = np.zeros((len(sections), 2))
    start = _command(motion, -grid.lead * period - delay, 1, step)[0]
    seen = []
    for first in range(0, grid.lead + grid.samples, _CHUNK_SAMPLES):
        count = min(_CHUNK_SAMPLES, grid.lead + grid.samples - first)
        begin = (first - grid.lead) * period - delay
        held = _command(motion, begin, count * substeps, step) - start
        moved, state = signal.sosfilt(sections, held, zi=state)
        seen.append(moved[every - 1 :: every])
    # Each value is reached at the end of its step.
    values = np.concatenate(seen) + system.dc_gain * start
    return Trajectory(every * step - grid.lead * period, every * step, values)


def _command(motion: Motion, begin: float, count: int, step: float) -> FloatArray:
    """Return the commanded Z in the middle of ``count`` steps [s] from ``begin`` [s]."""
    return motion.positions(begin + (np.arange(count, dtype=np.float64) + 0.5) * step).z


def _zero_order_hold_sections(system: TransferFunction, step: float) -> FloatArray:
    """Return second-order sections from the input held over a step to the output at its end.

    Poles are mapped exactly; zeros are those of the Rosenbrock pencil of the discrete system; the
    gain follows from G(0). A single polynomial would lose digits.
    """
    # Controllable canonical form, time in units of the step to keep its entries near 1.
    top, bottom = (p / step ** np.arange(len(p)) for p in (system.numerator, system.denominator))
    canonical = signal.tf2ss(top[::-1], bottom[::-1])
    a, b, c, d = signal.cont2discrete(canonical, 1.0, method="zoh")[:4]
    n = len(a)
    # y at the end of the step: C x[k+1] + D u[k] = C A x[k] + (C B + D) u[k].
    pencil = np.block([[a, b], [c @ a, c @ b + d]])
    mass = linalg.block_diag(np.eye(n), 0.0)
    zeros = linalg.eigvals(pencil, mass)
    zeros = zeros[np.isfinite(zeros) & (abs(zeros) < 1e6)]
    poles = np.exp(system.poles() * step)
    gain = system.dc_gain * np.real(complex(np.prod(1 - poles)) / complex(np.prod(1 - zeros)))
    return np.asarray(signal.zpk2sos(zeros, poles, gain))
