"""The recording with the certified fit, as a certificate draws it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.estimation.steps import Edge
from omsm_ros.core.identification.identify import Identification
from omsm_ros.core.identification.residual_tests import LEAST_SEGMENT, SEGMENT_S
from omsm_ros.core.lti.frequency_response import FrequencyResponse, frequency_response
from omsm_ros.core.streams.blocks import FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedRecord:
    """Input, output and model on the recording's grid, each array of shape (n,).

    input: motion of the axis about its mean [m]
    output: the same motion as the probe saw it: its reading over the static gain, without
        offset, drift, backlash and initial-condition response [m]; NaN where nothing is compared
    modelled: input through G_m [m]
    residual: of the probe's reading [m], the one that the certificate speaks of; NaN where
        nothing is compared
    edges: moves from rest to rest
    measured: response of ``output`` to ``input`` without a model, or None if too short
    """

    sample_period: float
    input: FloatArray
    output: FloatArray
    modelled: FloatArray
    residual: FloatArray
    edges: Sequence[Edge]
    measured: FrequencyResponse | None

    @property
    def time(self) -> FloatArray:
        """Since the first sample [s]."""
        return np.asarray(self.sample_period * np.arange(len(self.input)), np.float64)


def fitted_record(identified: Identification) -> FittedRecord:
    """Return the recording of ``identified`` with its fit; nothing is fitted again."""
    problem, fit = identified.prepared.problem, identified.fit
    modelled = problem.response(fit)
    residual = problem.on_grid(fit.residual, np.nan)
    segment, measured = round(SEGMENT_S / problem.period), None
    if LEAST_SEGMENT <= segment <= len(residual) // 2:
        output = modelled + np.nan_to_num(residual / fit.gain)
        measured = frequency_response(problem.input, output, problem.period, segment)
    return FittedRecord(
        sample_period=problem.period,
        input=problem.input,
        output=np.asarray(modelled + residual / fit.gain, np.float64),
        modelled=modelled,
        residual=residual,
        edges=identified.prepared.steps.edges,
        measured=measured,
    )


def autocorrelation(residual: FloatArray, lags: int) -> FloatArray:
    """Return the correlation of ``residual`` (n,), without NaN, with itself 1 to ``lags`` later."""
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
    """Output less model, all edges superimposed, downward ones inverted.

    time: since the middle of the edge [s];  mean: [m], both (k,);  edges: how many
    """

    time: FloatArray
    mean: FloatArray
    edges: int


def mean_at_edges(fitted: FittedRecord, before: float, after: float) -> EdgeMean | None:
    """Return the mean of output less model around the middle of an edge; None without edges.

    before, after: how far to go on either side [s]
    What the model misses at every edge stays, noise falls with the root of their number.
    """
    period, missed = fitted.sample_period, fitted.output - fitted.modelled
    offsets = np.arange(-round(before / period), round(after / period) + 1)
    found = []
    for edge in fitted.edges:
        travelled = np.abs(fitted.input[edge.start : edge.stop] - fitted.input[edge.start])
        index = edge.start + np.argmax(travelled > 0.5 * abs(edge.height)) + offsets
        if index[0] >= 0 and index[-1] < len(missed):
            found.append(np.sign(edge.height) * missed[index])
    if not found:
        return None
    stacked = np.asarray(found)
    known = np.isfinite(stacked)
    total = np.sum(np.where(known, stacked, 0.0), axis=0)
    mean = np.asarray(total / np.maximum(np.sum(known, axis=0), 1), np.float64)
    return EdgeMean(np.asarray(offsets * period, np.float64), mean, len(found))
