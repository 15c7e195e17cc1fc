"""What a calibration explains of the recording it came from, and what it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.frequency_response import FrequencyResponse, frequency_response
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.output_error import Problem
from omsm_ros.core.fitting.periodic_input import motion_spectrum
from omsm_ros.core.fitting.preparation import Prepared, prepare
from omsm_ros.core.fitting.steps import Edge
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.motion_record import MotionRecord

# Resolves 1 Hz; a step test has a few edges in each segment.
_SEGMENT_S = 1.0
_LEAST_SEGMENT = 16


@dataclass(frozen=True, eq=False, kw_only=True)
class Explained:
    """A recording beside its model, each array of shape (n,) on the recording's grid.

    carriage: motion of the axis about its mean [m]
    seen: the same motion as the probe saw it, offset, drift and backlash taken out [m];
        NaN where nothing is compared
    modelled: carriage through G_m [m]
    residual: of the probe's reading, after the model [m]; NaN where nothing is compared
    edges: moves from rest to rest
    measured: response of ``seen`` to ``carriage`` without a model, or None if too short
    """

    sample_period: float
    carriage: FloatArray
    seen: FloatArray
    modelled: FloatArray
    residual: FloatArray
    edges: Sequence[Edge]
    measured: FrequencyResponse | None

    @property
    def time(self) -> FloatArray:
        """Since the first sample [s]."""
        return np.asarray(self.sample_period * np.arange(len(self.carriage)), np.float64)


def explain(record: MotionRecord, calibration: Calibration, source: str = "encoder") -> Explained:
    """Compare ``record`` with the response of ``calibration``; its gain and background are fitted.

    source: "encoder" or "reference", the motion that was identified from

    Raises what an identification of ``record`` would raise before any model exists.
    """
    prepared = prepare(record, source)
    problem = prepared.problem
    modelled = _through(calibration.dynamics, problem)
    columns = np.column_stack([modelled, problem.background])
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    used = problem.used
    linear = np.linalg.lstsq(columns[used] / scale, problem.seen[used], rcond=None)[0] / scale
    residual = np.where(used, problem.seen - columns @ linear, np.nan)
    return Explained(
        sample_period=problem.period,
        carriage=problem.motion,
        seen=np.asarray(modelled + residual / linear[0], np.float64),
        modelled=modelled,
        residual=residual,
        edges=prepared.steps.edges,
        measured=_measured(prepared, modelled, residual / linear[0]),
    )


def _through(dynamics: TransferFunction, problem: Problem) -> FloatArray:
    """G_m applied to the motion as the fit applies it: by its spectrum, closed to a period."""
    spectrum = motion_spectrum(problem.motion, problem.period, problem.noise)
    length = problem.closed_length
    frequency = fft.rfftfreq(length, problem.period)[: len(spectrum)]
    answered = fft.irfft(spectrum * dynamics.response(frequency), length)
    return np.asarray(answered[: len(problem.motion)], np.float64)


def _measured(
    prepared: Prepared, modelled: FloatArray, left: FloatArray
) -> FrequencyResponse | None:
    problem = prepared.problem
    segment = round(_SEGMENT_S / problem.period)
    if not _LEAST_SEGMENT <= segment <= len(left) // 2:
        return None
    seen = modelled + np.where(np.isfinite(left), left, 0.0)
    return frequency_response(problem.motion, seen, problem.period, segment)


def autocorrelation(residual: FloatArray, lags: int) -> FloatArray:
    """Correlation of ``residual`` (n,), NaN left out, with itself 1 to ``lags`` samples later."""
    known = np.isfinite(residual)
    values = np.where(known, residual, 0.0)
    power = float(np.sum(values**2)) / max(int(np.sum(known)), 1)
    if power == 0:
        return np.zeros(lags)
    return np.asarray(
        [
            float(values[lag:] @ values[:-lag])
            / (max(int(np.sum(known[lag:] & known[:-lag])), 1) * power)
            for lag in range(1, lags + 1)
        ]
    )


@dataclass(frozen=True, eq=False)
class EdgeMean:
    """Motion seen less modelled, all edges on top of each other, downward ones turned over.

    time: since the middle of the edge [s];  mean: [m], both (k,);  edges: how many
    """

    time: FloatArray
    mean: FloatArray
    edges: int


def mean_at_edges(explained: Explained, before: float, after: float) -> EdgeMean | None:
    """Mean of what is left around the middle of an edge; None without edges.

    before, after: how far to go on either side [s]
    What the model misses at every edge stays, noise falls with the root of their number.
    """
    period, left = explained.sample_period, explained.seen - explained.modelled
    offsets = np.arange(-round(before / period), round(after / period) + 1)
    found = []
    for edge in explained.edges:
        index = _middle(explained.carriage, edge) + offsets
        if index[0] >= 0 and index[-1] < len(left):
            found.append(np.sign(edge.height) * left[index])
    if not found:
        return None
    stacked = np.asarray(found)
    known = np.isfinite(stacked)
    total = np.sum(np.where(known, stacked, 0.0), axis=0)
    mean = np.asarray(total / np.maximum(np.sum(known, axis=0), 1), np.float64)
    return EdgeMean(np.asarray(offsets * period, np.float64), mean, len(found))


def _middle(carriage: FloatArray, edge: Edge) -> int:
    travelled = np.abs(carriage[edge.start : edge.stop] - carriage[edge.start])
    return edge.start + int(np.argmax(travelled > 0.5 * abs(edge.height)))
