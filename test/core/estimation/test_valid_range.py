"""Test the range in which a sampled model is valid, from blocks of lines."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal
from sections_of_polynomials import from_polynomials
from soaked import soaked

from omsm_ros.core.estimation.parallel_sections import ParallelSections
from omsm_ros.core.estimation.sampled_fit import SampledRecord
from omsm_ros.core.identification.sampled_identification import identify_samples, valid_range

LINES = np.geomspace(0.05, 10, 400)


def known(standard):
    """A model of a band of ``standard`` at 0.5 Hz."""
    sections = from_polynomials(
        "zero-order", 0.05, np.array([0.0, 0.1, 0.1]), np.array([1.0, -1.5, 0.7]), 0
    )
    every = replace(sections, covariance=np.eye(2 + 4 * len(sections.denominators)))
    band = every.band(np.array([0.5]))
    factor = standard / np.max([band.gain, band.phase])
    return replace(sections, covariance=factor**2 * np.asarray(every.covariance))


def block(low, high, difference, uncertainty=0.01, off=np.nan, size=0.0):
    arrays = (np.full(1, value) for value in (size, difference, uncertainty, off))
    names = ("size", "difference", "uncertainty", "off")
    return SimpleNamespace(frequency=(low, high), **dict(zip(names, arrays, strict=True)))


def validated(sections, blocks, apart=()):
    """Return whether the model is valid at 0.5 Hz, another one being off by a share ``apart``."""
    others = [(1 + a) * sections.response(LINES)[0] for a in apart]
    low, high = valid_range(sections, blocks, LINES, 0, np.reshape(others, (-1, len(LINES))))
    return low < 0.5 < high


@pytest.mark.parametrize(
    ("different", "ratio", "size", "valid"),
    [(1, 1.1, 0.1, True), (3, 1.1, 0.1, False), (0, 2.0, 0.1, False), (0, 1.1, 10, False)],
)
def test_most_narrow_blocks_must_agree_where_the_model_is_uncertain(different, ratio, size, valid):
    """Twenty blocks within a sixth of an octave; a wide one may hide a mode.

    The same error is ten times as large, relative to the response, in a zero beside a peak.
    """
    sections = known(0.2)
    size = size * np.abs(sections.response(np.array([0.5]))[0, 0])
    blocks = [block(0.49, 0.49 * ratio, 0.3 * (k < different), size=size) for k in range(20)]
    assert validated(sections, blocks) == valid


@pytest.mark.parametrize(
    ("difference", "spread", "off", "valid"),
    [
        (0.0, 0.01, 0.05, True),
        (0.0, 0.01, 0.2, False),  # distortion of single lines
        (0.09, 0.06, np.nan, True),  # chance, in each of two blocks
        (0.14, 0.05, np.nan, False),  # none is beyond chance, but both together are
        (0.02, 1e-4, np.nan, True),  # beyond chance, but within the limit
    ],
)
def test_a_narrow_band_of_the_model_counts_where_nothing_contradicts_it(
    difference, spread, off, valid
):
    blocks = [block(0.4, 0.6, difference, spread, off)] * 2
    assert validated(known(1e-10), blocks) == valid


@pytest.mark.parametrize(("apart", "valid"), [(0.02, True), (0.05, False)])
def test_the_difference_of_another_model_adds_to_the_uncertainty(apart, valid):
    assert validated(known(0.035), [block(0.4, 0.7, 0.0)], [apart]) == valid


def test_nothing_is_known_without_lines():
    assert not validated(known(1e-10), [])


def test_the_range_ends_with_the_lines_of_the_input():
    low, high = valid_range(known(1e-10), [block(0.4, 0.6, 0.0)], LINES, 0, np.zeros((0, 400)))
    assert 0.4 <= low < 0.42
    assert 0.58 < high <= 0.6


@pytest.mark.parametrize(("standard", "end"), [(1e-4, 4.0), (1.0, 1.0)])
def test_no_range_contains_a_mode_that_is_known_to_nothing(standard, end):
    """Narrower than the spacing of lines, between excited ones: no block shows it."""
    mode = ParallelSections(
        hold="band-limited",
        period=0.05,
        denominators=np.array([[2e-4 / (2 * np.pi), (2 * np.pi) ** -2]]),
        numerators=np.array([[[1e-3, 0.0]]]),
        direct=np.ones(1),
        delays=np.zeros(1),
        covariance=np.diag([0.0, (1e-3 * standard) ** 2, 0.0, 0.0, 0.0, 0.0]),
    )
    found = [block(low, 1.1 * low, 0.0) for low in np.geomspace(0.2, 4.0, 40)]
    _, high = valid_range(mode, found, LINES, 0, np.zeros((0, 400)))
    assert high == pytest.approx(end, rel=0.12)


@pytest.mark.parametrize("seed", [1, *soaked(2)])
def test_no_range_goes_beyond_the_excitation_where_the_ends_of_a_record_leak(seed):
    """The motion has nothing above 0.3 of the sampling rate, the machine a mode at 0.38."""
    rng, lines = np.random.default_rng(seed), np.fft.rfftfreq(8192)
    modes = [(1.0, 0.08), (0.5, 0.17), (0.3, 0.38)]
    truth = sum(a / (1 + 0.04j * lines / f - (lines / f) ** 2) for a, f in modes)
    spectrum = np.fft.rfft(rng.normal(size=8192)) * (lines < 0.3)
    motion, output = (np.fft.irfft(each)[:1200] for each in (spectrum, spectrum * truth))
    output += 1e-3 * np.std(output) * rng.normal(size=1200)
    record = SampledRecord(motion[:, np.newaxis], output, np.ones(1200, bool))
    model = identify_samples([record], 1.0, hold="band-limited", order=6, max_delay=0)
    assert model.certificate["verdict"].startswith("accepted")
    assert 0.25 < model.valid[0][1] < 0.31


@pytest.mark.parametrize("seed", [0, *soaked(3)])
def test_samples_that_are_lost_together_support_no_range(seed):
    """While they were lost, a sweep went from 0.12 to 0.17 of the sampling rate."""
    rng, used = np.random.default_rng(seed), np.ones(3000, bool)
    used[900:1300] = False
    sweep = signal.chirp(np.arange(3000), 0.001, 3000, 0.4)
    pair = np.poly(0.95 * np.exp(2j * np.pi * 0.15 * np.array([1, -1]))).real
    output = signal.lfilter([0, 0.1], [1, -0.9], sweep) + signal.lfilter([0.3], pair, sweep)
    output += 0.1 * np.std(output) * rng.normal(size=3000)
    model = identify_samples([SampledRecord(sweep[:, np.newaxis], output, used)], 1.0, max_delay=0)
    assert model.certificate["verdict"].startswith("accepted")
    assert model.valid[0][1] < 0.15


def test_a_model_of_too_few_poles_whose_residual_follows_the_input_is_rejected():
    """One of two modes is missing: a sweep shows it for a while, so most of the record is right."""
    rng, used = np.random.default_rng(1), np.ones(4000, bool)
    used[100:230] = False
    sweep = signal.chirp(np.arange(4000), 0.001, 4000, 0.48)
    output = np.zeros(4000)
    for cycles, damping, gain in ((0.03, 0.02, 1.5), (0.15, 0.03, 1.0)):
        pole = np.exp(2 * np.pi * cycles * (1j * np.sqrt(1 - damping**2) - damping))
        down = np.poly([pole, np.conj(pole)]).real
        output += gain * signal.lfilter([0.0, np.sum(down)], down, sweep)
    output += 0.1 * np.std(output) * rng.normal(size=4000)
    record = SampledRecord(sweep[:, np.newaxis], np.where(used, output, 0.0), used)
    certificate = identify_samples([record], 1.0, order=2, max_delay=0).certificate
    assert certificate["predicted"] > 0.75
    assert certificate["verdict"] == "rejected"
    assert "residual that follows" in certificate["reasons"][0]
