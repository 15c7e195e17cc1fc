"""Motion of the probe from the encoder's stream, sample by sample.

H runs over the encoder's stream alone. It starts in the steady state of the first samples and
restarts after every interruption: a gap in the trigger count or a lost position. The samples
within the settling time are marked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial import polynomial

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.calibration_set import CalibrationSet
from omsm_ros.core.correction.uncertainty import (
    covariance_parts,
    derivative_filter,
    past_degree,
    sensitivity_filters,
)
from omsm_ros.core.lti.discretisation import DEFAULT_ORDER, DigitalFilter, discretise
from omsm_ros.core.lti.recursion import POLYNOMIAL_DEGREE, START_SAMPLES, Recursion, past_motion
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import AngleUnwrapper, BoolArray, FloatArray, RejectionReason
from omsm_ros.core.streams.pairing import SampleRun

# Share of a wrong initial state that may remain in the first published point.
SETTLED = 1e-6
_X, _Y, _Z, _B, _C = range(5)
_AXES = "xyzbc"
_LATERAL = (_X, _Y, _B, _C)
# Rows of the output: x, y, b, c, z - H(z), H(z), rate of H(z), sensitivities.
ERROR, MOVED, RATE, SENSITIVITIES = 4, 5, 6, 7


@dataclass(frozen=True, eq=False)
class MotionFilters:
    """The filters that run over the axes.

    height: H on z;  rate: on z, the rate of H(z)
    dynamics: F_r on z, change of H(z) per standard uncertainty along each direction r of the
        calibration's covariance, those of noise first, then those of undetected model error
    lateral: delay of x, y, b, c by the latency; None without latency
    forgotten: samples after which a wrong initial state of G has decayed to ``SETTLED``
    undetected: number of the last of ``dynamics`` that are of undetected model error
    pasts: degree of the motion before the first samples that each of ``dynamics`` assumes
    further: of each further axis that moves the probe: its part of ``height``, and of ``rate``
    Each of ``dynamics`` has filters by the name of the axis.
    """

    height: DigitalFilter
    dynamics: list[dict[str, DigitalFilter]]
    rate: DigitalFilter
    lateral: DigitalFilter | None
    forgotten: int = 2**31
    undetected: int = 0
    pasts: tuple[int, ...] = ()
    further: Mapping[str, tuple[DigitalFilter, DigitalFilter]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        sample_period: float,
        probe_latency: float = 0.0,
        order: int = DEFAULT_ORDER,
    ) -> MotionFilters:
        """Return the filters of ``calibration`` at ``sample_period`` [s]; lags in seconds."""
        g = calibration.dynamics

        def response_of(numerator: FloatArray) -> DigitalFilter:
            return derivative_filter(numerator, g.denominator, g.delay, sample_period, g.poles())

        def rate_of(numerator: FloatArray) -> DigitalFilter:
            return response_of(np.append(0.0, numerator))

        delay = TransferFunction(np.ones(1), np.ones(1), probe_latency)
        noise, undetected = (
            [(f, past_degree(part)) for f in sensitivity_filters(part, sample_period)]
            for part in covariance_parts(calibration)
        )
        return cls(
            height=discretise(g, sample_period, order),
            dynamics=[f for f, _ in noise + undetected],
            rate=rate_of(g.numerator),
            lateral=discretise(delay, sample_period, order) if probe_latency > 0 else None,
            forgotten=forgetting_samples(g, sample_period),
            undetected=len(undetected),
            pasts=tuple(degree for _, degree in noise + undetected),
            further={
                axis: (response_of(numerator), rate_of(numerator))
                for axis, numerator in calibration.further.items()
            },
        )

    def settling_samples(self) -> int:
        """Return the samples after which a wrong initial state has decayed to ``SETTLED``."""
        settled = self.height.settling_samples(SETTLED)
        # A slow pole with a small share of the response needs less time than its full decay.
        settled = min(settled, self.forgotten + 2 * len(self.height.sections))
        return max([settled, *([self.lateral.settling_samples(SETTLED)] if self.lateral else [])])


def forgetting_samples(dynamics: TransferFunction, sample_period: float) -> int:
    """Return the samples after which a wrong initial state of G has decayed to ``SETTLED``.

    For a millimetre that is a nanometre, a tenth of the noise of a reading. Each pole p has the
    share N(p) / Π (1 - p/p_k) of the response and decays as exp(p t).
    """
    poles = dynamics.poles()
    if len(poles) == 0:
        return 0
    apart = 1 - poles[:, np.newaxis] / poles[np.newaxis]
    np.fill_diagonal(apart, 1.0)
    with np.errstate(divide="ignore"):
        share = np.abs(polynomial.polyval(poles, dynamics.numerator) / np.prod(apart, axis=1))
    if not np.all(np.isfinite(share)):
        return 2**31
    # The sum of n parts is below the limit if each part is below an n-th of it.
    excess = np.log(np.maximum(len(poles) * share / SETTLED, 1.0))
    return int(
        np.ceil(np.max(excess / -poles.real) / sample_period + dynamics.delay / sample_period)
    )


class _Bank:
    """The running filters of one calibration: of each output, the recursions of its axes."""

    def __init__(self, filters: MotionFilters) -> None:
        height = {"z": filters.height} | {a: pair[0] for a, pair in filters.further.items()}
        rate = {"z": filters.rate} | {a: pair[1] for a, pair in filters.further.items()}
        self._rows = [
            {_AXES.index(axis): Recursion(one) for axis, one in row.items()}
            for row in (height, rate, *filters.dynamics)
        ]
        pasts = filters.pasts or (POLYNOMIAL_DEGREE,) * len(filters.dynamics)
        self._pasts = (POLYNOMIAL_DEGREE, POLYNOMIAL_DEGREE, *pasts)

    def start(self, axes: FloatArray) -> None:
        for row, degree in zip(self._rows, self._pasts, strict=True):
            for axis, recursion in row.items():
                recursion.start(past_motion(axes[axis].copy(), degree))

    def run(self, axes: FloatArray, out: FloatArray) -> None:
        """Write H(z), its rate and its sensitivities into ``out`` (2 + r, n)."""
        for recursions, row in zip(self._rows, out, strict=True):
            z, *others = recursions.items()
            z[1].run(axes[z[0]], row)
            for axis, recursion in others:
                row += recursion.run(axes[axis])

    @property
    def outputs(self) -> int:
        return len(self._rows)


def _blended(weights: FloatArray, outputs: Sequence[FloatArray]) -> FloatArray:
    """Return the mixture of H(z), its rate and its sensitivities, (2 + r, n).

    The filter of each member runs over the whole stream, and the *outputs* are mixed by ``weights``
    (m, n) that are continuous in position, so that the result is continuous too. The errors of the
    members may be common, so their variances are mixed with the weights. Between two members a and
    b the response is uncertain by a uniform distribution, ``√(w(1-w)/3) (H_a - H_b)``.
    """
    moved = np.sum([w * out[:2] for w, out in zip(weights, outputs, strict=True)], axis=0)
    rows = [np.sqrt(w) * out[2:] for w, out in zip(weights, outputs, strict=True)]
    between = [
        np.sqrt(weights[k] * weights[k + 1] / 3) * (outputs[k][0] - outputs[k + 1][0])
        for k in range(len(outputs) - 1)
    ]
    return np.concatenate([moved, *rows, between])


class MotionFilter:
    """Filters runs of the axis channels x, y, z, b, c.

    The output rows are x, y, b, c, z - H(z), H(z), the rate of H(z), and the change of H(z) per
    standard uncertainty along each direction of the calibration's covariance.

    filters: of one calibration, or of each member of the set of which ``places`` mixes them
    """

    def __init__(self, *filters: MotionFilters, places: CalibrationSet | None = None) -> None:
        self._banks = [_Bank(each) for each in filters]
        self._places = places
        lateral = filters[0].lateral
        self._lateral = {axis: Recursion(lateral) for axis in _LATERAL} if lateral else {}
        turns = any("c" in each.further for each in filters)
        self._turned = AngleUnwrapper() if lateral or turns else None
        settling = max(each.settling_samples() for each in filters)
        self._start_samples = max(settling // 2, START_SAMPLES)
        self._settling = max(settling, self._start_samples)
        self._unsettled = self._settling
        self._next: tuple[int, int] | None = None
        self._waiting: list[SampleRun] = []

    @property
    def pending(self) -> int:
        """Number of samples that wait until there are enough to start the filter."""
        return sum(map(len, self._waiting))

    def push(self, run: SampleRun) -> list[SampleRun]:
        """Return the filtered runs after ``run``, which follows the last one or a gap."""
        done = [] if (run.session, run.first) == self._next else self.end()
        self._next = (run.session, run.end)
        finite: BoolArray = np.all(np.isfinite(run.values), axis=0)
        if finite.all():
            return done + self._push_finite(run)
        edges = np.flatnonzero(np.diff(finite)) + 1
        for start, stop in zip([0, *edges], [*edges, len(run)], strict=True):
            piece = run.part(int(start), int(stop))
            if finite[start]:
                done += self._push_finite(piece)
            else:
                done += [*self._break(), self._unfiltered(piece, RejectionReason.INVALID)]
        return done

    def end(self) -> list[SampleRun]:
        """End the stream; return runs that were too short to start the filter, as settling."""
        self._next = None
        return self._break()

    def _break(self) -> list[SampleRun]:
        short, self._waiting = self._waiting, []
        self._unsettled = self._settling
        return [self._unfiltered(run, RejectionReason.SETTLING) for run in short]

    def _unwrapped(self, run: SampleRun) -> SampleRun:
        """Return the run with C unwrapped, so that it can be delayed."""
        c = run.values[_C]
        if self._turned is None or (turned := self._turned.of(c)) is c:
            return run
        return replace(run, values=np.concatenate([run.values[:_C], turned[np.newaxis]]))

    def _push_finite(self, run: SampleRun) -> list[SampleRun]:
        run = self._unwrapped(run)
        if self._unsettled < self._settling:
            return [self._filtered(run)]
        self._waiting.append(run)
        if self.pending < self._start_samples:
            return []
        waiting, self._waiting = self._waiting, []
        first = np.concatenate([w.values for w in waiting], axis=1)[:, : self._start_samples]
        for bank in self._banks:
            bank.start(first)
        for axis, recursion in self._lateral.items():
            recursion.start(past_motion(first[axis].copy()))
        return [self._filtered(w) for w in waiting]

    def _filtered(self, run: SampleRun) -> SampleRun:
        out = np.empty((self._outputs, len(run)))
        self._moved(run.values, out[MOVED:])
        for row, axis in enumerate(_LATERAL):
            samples = run.values[axis]
            out[row] = self._lateral[axis].run(samples) if self._lateral else samples
        out[ERROR] = run.values[_Z] - out[MOVED]
        reasons = np.zeros(len(run), np.uint8)
        if self._places:
            position = run.values[_AXES.index(self._places.along)]
            reasons[~self._places.covered(position)] = RejectionReason.BEYOND
        reasons[: self._unsettled] = RejectionReason.SETTLING
        self._unsettled = max(self._unsettled - len(run), 0)
        return SampleRun(run.session, run.first, run.stamp_ns, run.period_ns, reasons, out)

    def _moved(self, axes: FloatArray, out: FloatArray) -> None:
        """Write H(z), its rate and its sensitivities into ``out`` (2 + r, n)."""
        if not self._places:
            return self._banks[0].run(axes, out)
        outputs = [np.empty((bank.outputs, axes.shape[1])) for bank in self._banks]
        for bank, rows in zip(self._banks, outputs, strict=True):
            bank.run(axes, rows)
        position = axes[_AXES.index(self._places.along)]
        out[:] = _blended(self._places.weights(position), outputs)

    @property
    def _outputs(self) -> int:
        between = len(self._banks) - 1
        return SENSITIVITIES + between + sum(bank.outputs - 2 for bank in self._banks)

    def _unfiltered(self, run: SampleRun, reason: RejectionReason) -> SampleRun:
        values = np.full((self._outputs, len(run)), np.nan)
        return replace(run, reasons=np.full(len(run), reason, np.uint8), values=values)
