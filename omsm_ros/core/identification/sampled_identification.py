"""Identify a model between any sampled quantities, in any units, from one or more records.

``hold`` is the behaviour of the inputs between samples:

| hold | the input | the model |
|---|---|---|
| band-limited | smooth, as a measured quantity | G(s) with a delay |
| zero-order | constant from sample to sample, as a command | H(z), and its equivalent G(s) |
| first-order | linear from sample to sample | the same H(z), another G(s) |

The response is valid where the inputs excite it and the data support it. They do where a response
without a model agrees with it, or does not contradict a narrow band of the model: within blocks of
neighbouring lines, the residual is fitted by the inputs and the transient of the record (local
polynomial method, Pintelon et al. 2010). Lines of a periodic input also count one by one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, signal, special

from omsm_ros.core.calibration.certificate import REJECTED
from omsm_ros.core.estimation.impulse_response import impulse_response
from omsm_ros.core.estimation.parallel_sections import HOLDS, ParallelSections
from omsm_ros.core.estimation.sampled_choice import SampledCandidate, SampledChoice, choose_sampled
from omsm_ros.core.estimation.sampled_fit import SampledRecord
from omsm_ros.core.estimation.sampled_model import (
    SampledModel,
    check_inputs,
    check_varies,
    stationary_output,
)
from omsm_ros.core.estimation.steps import LEAST_SAMPLES
from omsm_ros.core.identification.residual_tests import independence, whiteness
from omsm_ros.core.lti.frequency_response import COVERAGE_FACTOR, GRID_POINTS, Band, ResponseLimits
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.model_errors.residual_diagnostics import FALSE_ALARM
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.errors import ConfigurationError, IdentificationError, Notice
from omsm_ros.linear_algebra import ROUNDING, one_blas_thread

# Limits of the band, a tenth of gain and of a radian: for a process, not a measuring machine.
SAMPLED_LIMITS = ResponseLimits(gain=0.1, phase=0.1)
_LIMIT = min(SAMPLED_LIMITS.gain, SAMPLED_LIMITS.phase)
# Least share of the variance of held-out parts that free runs predict.
_LEAST_PREDICTED = 0.5
# Number of lines in a block, added number for each input, largest ratio of its frequencies.
_LINES, _LINES_PER_INPUT, _BLOCK_RATIO = 12, 8, 1.5
# Power of a line over the largest nearby, and over the largest of all, below which it is left out.
_NEARBY, _LEAST_POWER = 1e-3, 1e-8
# Part of a record that is tapered, and the least share of the power of neighbouring lines that
# remains where they are excited.
_TAPER, _LEAKED = 0.2, 0.1
# Power of a line over the largest of its block from which it counts for the range of the block.
_STRONG = 0.1
# Standard uncertainties beyond which a difference is not chance, and the largest share of blocks
# near a frequency that may differ.
_SIGNIFICANT, MAY_DIFFER = 3.0, 0.1
# Half the width of what is near a frequency [octaves].
_NEAR_OCTAVES = 1 / 6


@one_blas_thread()
def identify_samples(
    records: Sequence[SampledRecord],
    period: float,
    *,
    hold: str = "zero-order",
    order: int = 0,
    max_delay: int = 3,
) -> SampledModel:
    """Return the one model by which the outputs of ``records`` follow their inputs.

    period: from sample to sample [s];  hold: of the inputs between samples, one of HOLDS
    order: number of poles, 0 to choose it
    max_delay: of a held input, whole samples to try; of a band-limited one the delay is free

    Raises IdentificationError for records that determine no model, ConfigurationError for another
    hold.
    """
    if hold not in HOLDS:
        raise ConfigurationError("estimation.unknown_hold", hold=hold, known=HOLDS)
    records = [_checked(record) for record in records]
    choice = choose_sampled(records, hold, order=order, max_delay=max_delay)
    fitted = choice.chosen.fit
    sections = fitted.model(period, fitted.problem.covariance(fitted, period))
    longest = max(len(record) for record in records)
    # From the lowest line to the last below half the sampling rate, where a pole may change the
    # response that no line shows.
    frequency = np.geomspace(1, longest / 2 - 1, GRID_POINTS) / (longest * period)
    sections, factor = _inflated(sections, choice, frequency)
    blocks = _blocks(choice.chosen, period)
    missed, follows = _missed(choice.chosen, frequency * period)
    corrected = sections.response(frequency) + missed
    others = [other.response(frequency * period) for other in choice.alternatives]
    others_of = np.array([corrected, *others], np.complex128).transpose(1, 0, 2)
    valid = [valid_range(sections, blocks, frequency, i, each) for i, each in enumerate(others_of)]
    first = records[0]
    steady = stationary_output(sections, first.inputs, first.output, first.used)
    return SampledModel(
        sections=sections,
        valid=valid,
        working_point=(*np.mean(first.inputs, axis=0).tolist(), steady),
        certificate=_certificate(choice, sections, valid, factor, follows),
    )


def _independence(chosen: SampledCandidate) -> float:
    """Return the p-value of a residual that is independent of changes of the inputs."""
    drives = [
        np.gradient(np.sum(r.record.inputs / np.std(r.record.inputs, axis=0), axis=1))[r.places]
        for r in chosen.fit.problem.spectra
    ]
    return independence(chosen.fit.residual, np.concatenate(drives))


def _missed(chosen: SampledCandidate, cycles: FloatArray) -> tuple[ComplexArray, float]:
    """Return what the model misses at ``cycles`` (f,) a sample, (m, f): the residual without model.

    An impulse response from the inputs to the residual of the first record resolves modes that are
    narrower than a block of lines. The second value is the rms of its output over the model's.
    """
    one, grid = chosen.fit.problem.spectra[0], chosen.fit.on_grids()[0]
    inputs = one.record.inputs - np.mean(one.record.inputs, axis=0)
    taps = impulse_response(inputs, grid, one.record.used)
    if taps is None:
        return np.zeros((inputs.shape[1], len(cycles)), np.complex128), 0.0
    answer = np.sum(signal.fftconvolve(inputs.T, taps, axes=1), axis=0)[one.places]
    modelled = max(float(np.std(one.output - grid[one.places])), np.finfo(float).tiny)
    turned = np.exp(-2j * np.pi * np.outer(np.arange(taps.shape[1]), cycles))
    return np.asarray(taps @ turned, np.complex128), float(np.std(answer)) / modelled


def _checked(record: SampledRecord) -> SampledRecord:
    used = record.used & np.isfinite(record.output)
    samples = int(np.sum(used))
    if samples < LEAST_SAMPLES:
        raise IdentificationError("estimation.short_record", samples=samples, least=LEAST_SAMPLES)
    check_inputs(record.inputs)
    check_varies(record.output[used], "output")
    return replace(record, used=used)


def _inflated(
    sections: ParallelSections, choice: SampledChoice, lines: FloatArray
) -> tuple[ParallelSections, float]:
    """Return ``sections`` with the uncertainty that the choice of the order adds, and its factor.

    The squares of the differences of all orders, weighted by their evidence (Burnham and Anderson
    2002, ch. 4), add to the variance: by one factor, their geometric mean over the known lines.
    """
    responses = np.array([other.response(lines * sections.period) for other in choice.others])
    own = [other.order for other in choice.others].index(choice.chosen.fit.order)
    # The lowest line of the part of the record on which orders were compared.
    lowest, parts = lines[0] / np.sum(choice.evidence), [np.zeros(1)]
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.log(responses / responses[own])
        for input in range(sections.inputs):
            band = sections.band(lines, input)
            low, high = _widest(lines, _narrow(band))
            known = (lines >= max(low, lowest)) & (lines <= high)
            for off, spread in ((apart.real, band.gain), (apart.imag, band.phase)):
                ratio = choice.evidence @ off[:, input] ** 2 / spread**2
                parts.append(np.log1p(ratio[known & np.isfinite(ratio)]))
    factor = float(np.exp(0.5 * np.mean(np.concatenate(parts))))
    return replace(sections, covariance=factor**2 * np.asarray(sections.covariance)), factor


def _narrow(band: Band, apart: FloatArray | float = 0.0) -> BoolArray:
    return np.asarray(COVERAGE_FACTOR * np.maximum(band.gain, band.phase) + apart <= _LIMIT)


@dataclass(frozen=True, eq=False)
class _Block:
    """Neighbouring lines, and the response of the residual to each input there.

    frequency: lowest and highest at which they have power [Hz]
    size: of the response of the model, rms over the power of the lines, (m,)
    difference, uncertainty: of the response from the model, relative to that, (m,)
    off: share of lines that differ beyond limit and noise, (m,); NaN where none shows the noise
    """

    frequency: tuple[float, float]
    size: FloatArray
    difference: FloatArray
    uncertainty: FloatArray
    off: FloatArray


def _blocks(candidate: SampledCandidate, period: float) -> list[_Block]:
    """Return the differences of the responses of all records from the model, without a model."""
    model, found = candidate.fit.model(), []
    for one, grid in zip(candidate.fit.problem.spectra, candidate.fit.on_grids(), strict=True):
        record = one.record
        centred = record.inputs - np.mean(record.inputs, axis=0)
        spectra = np.asarray(np.fft.rfft(centred, axis=0).T, np.complex128)
        frequency = np.asarray(np.fft.rfftfreq(len(record)), np.float64)
        # Zero where nothing is compared, as the residual is: lost samples do not agree.
        answer = np.fft.irfft(spectra * model.response(frequency), len(record))
        answer[:, np.setdiff1d(np.arange(len(record)), one.places)] = 0.0
        driven = np.asarray(np.fft.rfft(answer), np.complex128)
        powers = np.abs(spectra) ** 2
        powers[:, 0] = 0.0
        power = np.sum(powers, axis=0)
        nearby = ndimage.maximum_filter1d(power, _LINES)
        excited = (power > _NEARBY * nearby) & (power > _LEAST_POWER * power.max())
        # A taper removes the leakage of other lines from the ends of the record.
        taper = signal.windows.tukey(len(record), _TAPER)
        kept = np.sum(np.abs(np.fft.rfft(centred * taper[:, np.newaxis], axis=0)) ** 2, axis=1)
        kept, whole = (ndimage.uniform_filter1d(each, _LINES) for each in (kept, power))
        excited &= kept > _LEAKED * whole
        powers *= excited
        # Lines near an excited one show the noise.
        lines = np.flatnonzero(ndimage.binary_dilation(excited, iterations=_LINES // 2))
        residual = np.asarray(np.fft.rfft(grid), np.complex128)
        for part in _neighbours(lines, _LINES + _LINES_PER_INPUT * len(spectra)):
            at = frequency[part] / period
            found.append(_compared(at, driven[:, part], residual[part], powers[:, part]))
    return sorted(found, key=lambda block: block.frequency)


def _neighbours(lines: IntArray, size: int) -> list[IntArray]:
    """Return ``lines`` in blocks of ``size``; none spans more than a ratio of frequencies."""
    blocks, place = [], 0
    while place < len(lines):
        near = lines[place : place + size] < _BLOCK_RATIO * lines[place] + size / 2
        end = place + max(int(np.sum(near)), 1)
        if 2 * (end - place) >= size:
            blocks.append(lines[place:end])
        place = end
    return blocks


def _compared(
    frequency: FloatArray, driven: ComplexArray, residual: ComplexArray, powers: FloatArray
) -> _Block:
    """Fit the residual of one block by the responses ``driven`` (m, k) and a transient.

    powers: of the inputs, (m, k), 0 where they are not excited

    Beyond the noise of lines that are not excited, the residual of each other one is distortion, or
    dynamics narrower than the block. It may be of all inputs: each is taken to differ least.
    """
    place = np.linspace(-1.0, 1.0, len(residual))
    columns = np.concatenate([driven, [np.ones(len(place)), place]]).T
    scale = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    columns /= scale
    turned, sizes, directions = np.linalg.svd(columns, full_matrices=False)
    inverse = directions.conj().T / np.where(sizes > ROUNDING, sizes, np.inf) @ turned.conj().T
    solved = inverse @ residual
    left = residual - columns @ solved
    variance = float(np.sum(np.abs(left) ** 2)) / max(len(residual) - columns.shape[1], 1)
    spread = np.sqrt(variance * np.sum(np.abs(inverse) ** 2, axis=1)) / scale
    if sizes[-1] <= ROUNDING:
        spread[:] = np.inf
    inputs, power = len(driven), np.sum(powers, axis=0)
    strong = frequency[power > _STRONG * np.max(power)]
    ends = float(strong[0]), float(strong[-1])
    off, apart, quiet = np.full(inputs, np.nan), np.abs(residual), power == 0
    if np.sum(quiet) > columns.shape[1]:
        beyond = np.abs(driven) * apart > _LIMIT * np.sum(np.abs(driven) ** 2, axis=0)
        beyond &= apart > _SIGNIFICANT * np.sqrt(np.mean(apart[quiet] ** 2))
        off = np.mean(beyond[:, ~quiet], axis=1)
    size = scale[:inputs] / np.sqrt(np.maximum(np.sum(powers, axis=1), np.finfo(float).tiny))
    return _Block(ends, size, np.abs(solved / scale)[:inputs], spread[:inputs], off)


def valid_range(
    sections: ParallelSections,
    blocks: Sequence[_Block],
    frequency: FloatArray,
    input: int,
    others: ComplexArray,
) -> tuple[float, float]:
    """Return the widest range [Hz], in octaves, that the data support for one input.

    others: responses (a, k) of models that predict about as well, and without a model; the largest
        difference adds to the uncertainty of the model
    Both ends are the lowest of ``frequency`` if there is no such range.
    """
    lowest, highest = np.reshape([block.frequency for block in blocks], (-1, 2)).T
    difference = np.array([block.difference[input] for block in blocks])
    spread = np.array([block.uncertainty[input] for block in blocks])
    lines, near_ratio = frequency[:, np.newaxis], 2**_NEAR_OCTAVES
    near = ((lines >= lowest / near_ratio) & (lines <= highest * near_ratio)).astype(np.float64)
    count = np.maximum(np.sum(near, axis=1), 1.0)
    off = np.array([block.off[input] for block in blocks])
    lined = near * np.isfinite(off)
    differs = lined @ np.nan_to_num(off) > MAY_DIFFER * np.sum(lined, axis=1)
    # One difference over a wide block does not show modes inside it.
    close = near * (highest <= _BLOCK_RATIO * lowest)
    # It is that of the stronger lines, and as large in a zero among them.
    response = sections.response(frequency)[input]
    level = np.array([block.size[input] for block in blocks]) / np.abs(response)[:, np.newaxis]
    within = np.maximum(level, 1.0) * (difference + COVERAGE_FACTOR * spread) <= _LIMIT
    agrees = np.any(close * within, axis=1)
    agrees &= np.sum(close * ~within, axis=1) <= MAY_DIFFER * np.sum(close, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        shown = near @ (1 / spread**2) >= (COVERAGE_FACTOR / _LIMIT) ** 2
        apart = np.max(np.abs(others / response - 1), axis=0, initial=0.0)
        excess = near @ np.nan_to_num((difference / spread) ** 2)
    shown &= np.any(lines >= lowest, axis=1) & np.any(lines <= highest, axis=1)
    excited = np.logical_or.accumulate(shown) & np.logical_or.accumulate(shown[::-1])[::-1]
    # The narrow band of a model of too few poles is contradicted by differences beyond chance.
    upheld = special.gammaincc(count, excess) > np.exp(-(_SIGNIFICANT**2))
    upheld |= np.sum(near * ~within, axis=1) <= MAY_DIFFER * count
    inside = (_narrow(sections.band(frequency, input), apart) & upheld) | agrees
    # A mode that rings may be between excited lines, and narrower than a block.
    poles = sections.poles()
    modes = np.abs(poles[np.abs(poles.imag) > -poles.real]) / (2 * np.pi)
    uncertain = np.searchsorted(frequency, modes[~_narrow(sections.band(modes, input))])
    inside[uncertain[uncertain < len(frequency)]] = False
    return _widest(frequency, inside & excited & ~differs)


def _widest(frequency: FloatArray, inside: BoolArray) -> tuple[float, float]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int8), [0]])))
    starts, stops = np.append(edges[::2], 0), np.append(edges[1::2] - 1, 0)
    widest = int(np.argmax(frequency[stops] / frequency[starts]))
    return float(frequency[starts[widest]]), float(frequency[stops[widest]])


def _certificate(
    choice: SampledChoice,
    sections: ParallelSections,
    valid: Sequence[tuple[float, float]],
    widened: float,
    follows: float,
) -> dict[str, object]:
    """Return JSON values, ending with ``reasons``, ``warnings`` and ``verdict``.

    valid: range [Hz] within the limits, for each input
    widened: factor on the uncertainties, for the choice of the order
    follows: part of the residual that an impulse response makes of the inputs, over the model
    "predicted" is the share of the variance of held-out parts that free runs explain.
    """
    chosen, limits = choice.chosen, {"gain": SAMPLED_LIMITS.gain, "phase_rad": SAMPLED_LIMITS.phase}
    problem, residual = chosen.fit.problem, chosen.fit.residual
    variance = float(np.mean(np.concatenate([one.output for one in problem.spectra]) ** 2)) or 1.0
    predicted, independent = 1 - float(np.mean(chosen.held_out)), _independence(chosen)
    order, free_order = chosen.fit.order, choice.free.fit.order
    reasons, warnings = _reasons(choice, predicted, valid), []
    low, high = max(v[0] for v in valid), min(v[1] for v in valid)
    accepted = Notice("estimation.accepted", low=low, high=high)
    if not high > low:
        accepted = Notice("estimation.accepted_apart")
    if independent < FALSE_ALARM and follows > _LIMIT:
        # Blocks take it for noise, and a sweep or lost readings spread it over all lines.
        reasons.append(Notice("estimation.missed_response", share=follows, limit=_LIMIT))
    elif independent < FALSE_ALARM:
        warnings.append(Notice("estimation.residual_follows_input", p=independent))
    if order != free_order:
        warnings.append(
            Notice("estimation.order_differs", order=order, free=free_order, factor=widened)
        )
    return {
        "order": order,
        "free_order": free_order,
        "delay_samples": (sections.delays / sections.period).tolist(),
        "residual_rms": float(np.sqrt(np.mean(residual**2))),
        "explained": 1 - float(np.mean(residual**2)) / variance,
        "predicted": predicted,
        "impulse_response": choice.impulse_response,
        "whiteness_p": whiteness(residual),
        "independence_p": independent,
        "poles": _poles(sections, valid),
        "continuous_error": _continuous_error(sections, valid[0]),
        "samples": {"received": sum(len(r) for r in problem.records), "compared": len(residual)},
        "limits": limits | {"predicted_least": _LEAST_PREDICTED},
        "warnings": [str(warning) for warning in warnings],
        "reasons": [str(reason) for reason in reasons],
        "verdict": REJECTED if reasons else str(accepted),
    }


def _reasons(
    choice: SampledChoice, predicted: float, valid: Sequence[tuple[float, float]]
) -> list[Notice]:
    limits, reasons = SAMPLED_LIMITS, []
    if not predicted >= _LEAST_PREDICTED:
        reasons.append(
            Notice("estimation.poor_prediction", predicted=predicted, least=_LEAST_PREDICTED)
        )
    if choice.worse:
        reasons.append(Notice("estimation.worse_than_impulse_response", **choice.impulse_response))
    if not all(high > low for low, high in valid):
        reasons.append(Notice("estimation.unknown_response", gain=limits.gain, phase=limits.phase))
    return reasons


def _poles(
    sections: ParallelSections, valid: Sequence[tuple[float, float]]
) -> list[dict[str, float]]:
    """Return frequency [Hz] and damping of each pole that the data resolve, else a bound."""
    low, high = min(v[0] for v in valid), max(v[1] for v in valid)
    found: list[dict[str, float]] = []
    for pole in sections.poles():
        frequency = float(abs(pole)) / (2 * np.pi)
        if pole.imag < 0:
            continue
        if not frequency <= high:
            found.append({"faster_than_hz": high})
        elif frequency < low:
            found.append({"slower_than_hz": low})
        else:
            found.append({"frequency_hz": frequency, "damping": float(-pole.real / abs(pole))})
    return sorted(found, key=lambda entry: next(iter(entry.values())))


def _continuous_error(sections: ParallelSections, valid: tuple[float, float]) -> float | None:
    """Return the largest relative error of G(s) as polynomials in its valid range."""
    equivalent = sections.equivalent()
    if equivalent is None or not valid[1] > valid[0]:
        return None
    lines = np.geomspace(*valid, GRID_POINTS)
    with np.errstate(all="ignore"):
        ratio = equivalent.transfer_function().response(lines) / equivalent.response(lines)[0]
    error = float(np.max(np.abs(ratio - 1)))
    return error if np.isfinite(error) else None
