"""Test models of any sampled quantities: covariance, validity, verdict against truth."""

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal
from sections_of_polynomials import from_polynomials
from soaked import always, soaked

from omsm_ros.core.estimation import sampled_choice
from omsm_ros.core.estimation.parallel_sections import HOLDS, ParallelSections
from omsm_ros.core.estimation.sampled_choice import (
    SampledCandidate,
    choose_sampled,
    simplest_undominated,
)
from omsm_ros.core.estimation.sampled_fit import SampledRecord, SectionsProblem
from omsm_ros.core.estimation.sampled_model import free_run
from omsm_ros.core.identification import sampled_identification
from omsm_ros.core.identification.sampled_identification import identify_samples
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import ConfigurationError, IdentificationError
from omsm_ros.linear_algebra import inverse_gram

PERIOD = 0.05
TRUTH = TransferFunction.from_ascending([2.0, 0.05], [1.0, 0.05, 0.02])
METHODS = {"zero-order": "zoh", "first-order": "foh"}
LINES = np.array([0.05, 0.3, 1.0, 2.0])


def record(u, y):
    return SampledRecord(np.reshape(u, (len(y), -1)), y, np.ones(len(y), bool))


def identified(u, y, period=PERIOD, **options):
    return identify_samples([record(u, y)], period, **options)


def polynomials(hold):
    b, a, _ = signal.cont2discrete(
        (TRUTH.numerator[::-1], TRUTH.denominator[::-1]), PERIOD, METHODS[hold]
    )
    return np.ravel(b), a


def recorded(hold, noise=0.05, seed=1, samples=800):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 5), 5) + 4.0
    return u, signal.lfilter(*polynomials(hold), u) + 30.0 + rng.normal(0, noise, samples)


@pytest.mark.parametrize("hold", always("zero-order", of=METHODS))
def test_the_continuous_system_behind_the_hold_is_found(hold):
    model = identified(*recorded(hold), hold=hold)
    ratio = model.continuous.response(LINES) / TRUTH.response(LINES)
    assert np.max(np.abs(ratio - 1)) < 0.02
    assert model.certificate["verdict"].startswith("accepted")
    (low, high) = model.valid[0]
    assert low < 0.3
    assert high > 2.0
    input_there, output_there = model.working_point
    assert input_there == pytest.approx(4.0, abs=0.3)
    assert output_there == pytest.approx(30.0 + 2.0 * input_there, abs=0.05)


def test_the_wrong_hold_finds_another_system():
    model = identified(*recorded("zero-order"), hold="first-order", max_delay=0)
    ratio = model.continuous.response(LINES) / TRUTH.response(LINES)
    assert np.max(np.abs(ratio - 1)) > 0.1


@pytest.mark.parametrize("colour", [*soaked(0.0), 0.8])
def test_stated_uncertainties_hold_over_many_records(colour):
    """Errors of both responses over stated, of 40 pairs of records: their rms is about 1."""
    pulls = []
    b, a = polynomials("zero-order")
    true = signal.freqz(b, a, 2 * np.pi * LINES * PERIOD)[1]
    for seed in range(40):
        rng, records = np.random.default_rng(seed), []
        for _ in range(2):
            u = np.repeat(rng.choice([-1.0, 1.0], (60, 2)), 5, axis=0)
            noise = signal.lfilter([1.0], [1.0, -colour], rng.normal(0, 0.05, 300))
            y = signal.lfilter(b, a, u[:, 0]) + signal.lfilter(b, a, -u[:, 1]) + noise
            records.append(record(u, y))
        problem = SectionsProblem(records, "zero-order", np.zeros(2, int))
        roots = 2 * (np.roots(a) - 1) / (np.roots(a) + 1) / 0.5
        fitted = problem.fit(2, [problem.nonlinear_of(roots, np.zeros(2))])
        model = fitted.model(PERIOD, problem.covariance(fitted, PERIOD))
        for input, sign in ((0, 1), (1, -1)):
            error = np.log(sign * model.response(LINES)[input] / true)
            band = model.band(LINES, input)
            pulls.append(np.concatenate([error.real / band.gain, error.imag / band.phase]))
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.15)
    assert 0.92 < np.mean(np.abs(pulls) < 2) < 0.985


@pytest.mark.parametrize("fast", [[-400.0], [-90.0, -400.0], [-3 - 200j, -3 + 200j]])
def test_superfluous_poles_of_smooth_inputs_are_no_faster_than_the_samples_show(fast):
    rng = np.random.default_rng(4)
    u = signal.lfilter(*signal.butter(4, 0.7), rng.normal(size=1500))
    y = signal.lfilter([0.3, 0.5, 0.2], [1.0, -0.9], u) + rng.normal(0, 0.01, len(u))
    problem = SectionsProblem([record(u, y)], "band-limited", np.zeros(1, int))
    start = problem.nonlinear_of(np.array([-0.2, *fast]), np.zeros(1))
    fitted = problem.fit(1 + len(fast), [start])
    assert np.max(np.abs(fitted.model().poles())) < 2 * np.pi * (1 + 1e-9)
    assert np.std(fitted.residual) < 0.02 * np.std(y)


@pytest.mark.soak
def test_units_do_not_matter():
    u, y = recorded("zero-order")
    plain, scaled = (identified(1e-6 * f * u, 1e9 * f * y) for f in (1.0, 1e5))
    assert plain.certificate["order"] == scaled.certificate["order"]
    np.testing.assert_allclose(
        plain.sections.response(LINES), scaled.sections.response(LINES), rtol=1e-4
    )


def test_an_order_asked_for_is_known_no_better_than_the_free_choice_leaves_open():
    low = identified(*recorded("zero-order", noise=0.02), order=1)
    assert low.certificate["order"] == 1
    assert low.certificate["free_order"] == 2
    assert any("was asked for" in text for text in low.certificate["warnings"])


def test_another_order_adds_the_square_of_its_difference_by_its_evidence():
    """A gain known to 1 %, and another order that has 3 % more gain and half of the evidence."""
    gains = [
        ParallelSections(
            hold="band-limited", period=1.0, denominators=np.ones((order, 1)) * [1.0, 0.0],
            numerators=np.zeros((1, order, 2)), direct=np.array([gain]), delays=np.zeros(1),
            covariance=np.diag([1e-4, 0.0]) if order == 0 else None,
        )
        for order, gain in ((0, 1.0), (1, np.exp(0.03)))
    ]  # fmt: skip
    chosen = SimpleNamespace(fit=SimpleNamespace(order=0))
    choice = SimpleNamespace(chosen=chosen, others=gains, evidence=np.array([0.5, 0.5]))
    lines = np.geomspace(1e-3, 0.4, 400)
    widened, factor = sampled_identification._inflated(gains[0], choice, lines)
    assert factor == pytest.approx(np.sqrt(1 + 0.5 * 3**2), rel=5e-3)
    np.testing.assert_allclose(widened.band(lines).gain, 0.01 * factor)


@pytest.mark.parametrize("hold", ["band-limited", *soaked("zero-order")])
def test_what_does_not_follow_the_input_is_rejected(hold):
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=600), np.cumsum(rng.normal(size=600))
    assert identified(u, y, hold=hold, max_delay=0).certificate["verdict"] == "rejected"


def smooth_record(noise=1e-3, samples=6000):
    rng = np.random.default_rng(5)
    u = signal.lfilter(*signal.butter(4, 0.15), rng.normal(size=samples + 500))
    spectrum = np.fft.rfft(u) * TRUTH.response(np.fft.rfftfreq(len(u), PERIOD))
    y = np.fft.irfft(spectrum, len(u))
    return u[250:-250], y[250:-250] + rng.normal(0, noise, samples)


def test_a_smooth_input_is_taken_as_band_limited():
    """A part cut out of a longer motion; every other hold would be wrong for it."""
    model = identified(*smooth_record(samples=2500), hold="band-limited", max_delay=0)
    lines = np.array([0.1, 0.5, 1.0])
    ratio = model.continuous.response(lines) / TRUTH.response(lines)
    assert np.max(np.abs(ratio - 1)) < 0.01
    assert model.certificate["verdict"].startswith("accepted")
    # The input falls by 24 dB an octave beyond 1.5 Hz.
    assert 1.5 < model.valid[0][1] < 6
    lines = np.geomspace(*model.valid[0], 100)
    assert np.max(np.abs(model.sections.response(lines)[0] / TRUTH.response(lines) - 1)) < 0.12


@pytest.mark.soak
def test_the_pace_of_the_record_only_scales_the_model():
    u, y = smooth_record(samples=2000)
    fast, slow = (identified(u, y, period, hold="band-limited") for period in (1e-3, 10.0))
    np.testing.assert_allclose(
        slow.sections.response(LINES / 1e4), fast.sections.response(LINES), rtol=1e-6
    )
    assert slow.valid[0][1] == pytest.approx(fast.valid[0][1] / 1e4)


@pytest.mark.parametrize("hold", HOLDS)
def test_bad_records_are_one_clear_error(hold):
    with pytest.raises(IdentificationError, match="the input changes by 0 in all"):
        identified(np.ones(500), np.arange(500.0), hold=hold)
    with pytest.raises(IdentificationError):
        identified(np.arange(9.0), np.arange(9.0), hold=hold)
    with pytest.raises(IdentificationError):
        identified(np.full(500, np.nan), np.arange(500.0), hold=hold)


def test_another_hold_is_refused():
    with pytest.raises(ConfigurationError, match="'second-order'"):
        identified(*recorded("zero-order"), hold="second-order")


def test_gaps_and_several_records_give_the_model_of_one():
    """Each record has its own initial state and offset; spoiled samples do not count."""
    u, y = recorded("zero-order", noise=1e-3, samples=1600)
    y2 = y + np.where(np.arange(1600) < 800, 0.0, 500.0)
    spoiled = np.where(np.arange(1600) % 97 < 9, np.nan, y2)
    records = [record(u[:800], spoiled[:800]), record(u[800:], spoiled[800:])]
    model = identify_samples(records, PERIOD, max_delay=0)
    # In z: a pole that only follows noise may have no equivalent in s.
    truth = signal.freqz(*polynomials("zero-order"), LINES, fs=1 / PERIOD)[1]
    assert np.max(np.abs(model.sections.response(LINES)[0] / truth - 1)) < 1e-3
    assert model.certificate["samples"]["compared"] < 1600 - 9 * 16


@pytest.mark.soak
@pytest.mark.parametrize("modes", [6, 12])
def test_a_ladder_of_modes_is_found_and_its_band_is_true(modes):
    rng, tones = np.random.default_rng(8), np.linspace(0.01, 0.2, modes)
    poles = 2 * np.pi * tones * (-0.01 + 1j)
    u = rng.normal(size=4000)
    y = sum(
        signal.lfilter([0, 0.01 * 2 * f], np.poly(np.exp([p, p.conj()])).real, u)
        for f, p in zip(tones, poles, strict=True)
    )
    noisy = y + 0.01 * np.std(y) * rng.normal(size=4000)
    model = identified(u, noisy, 1.0)
    assert model.certificate["order"] >= 2 * modes
    assert model.certificate["predicted"] > 0.995
    assert np.all(model.sections.poles().real < 0)


def test_modes_that_the_order_asked_for_leaves_out_end_the_band():
    """Ten poles, eight asked for: of the accepted band, few lines are off by more than 10 %."""
    rng = np.random.default_rng(2)
    poles = np.exp(2j * np.pi * np.array([0.008, 0.014, 0.022, 0.1, 0.2]) * (1 + 0.02j))
    rise = (1 - np.abs(poles)) * rng.choice([-1, 1], 5)
    u = rng.normal(size=1500)
    up, down = signal.invresz(np.tile(rise, 2), np.concatenate([poles, poles.conj()]), [])
    y = signal.lfilter(up.real, down.real, u)
    y = y + 0.05 * np.std(y) * rng.normal(size=len(u))
    model = identify_samples([record(u, y)], 1.0, order=8, max_delay=0)
    low, high = model.valid[0]
    lines = np.linspace(low, high, 300)
    true = signal.freqz(up.real, down.real, 2 * np.pi * lines)[1]
    apart = np.abs(model.sections.response(lines)[0] / true - 1)
    assert high > low
    assert np.mean(apart > 0.1) < 0.1


def test_poles_beyond_the_data_are_bounds():
    u, y = smooth_record(samples=4000)
    poles = identified(u, y, hold="band-limited", order=6, max_delay=0).certificate["poles"]
    resolved = [p["frequency_hz"] for p in poles if "frequency_hz" in p]
    assert all(f < 4 for f in resolved)
    assert any(f == pytest.approx(1 / np.sqrt(0.02) / 2 / np.pi, rel=0.02) for f in resolved)
    assert any("faster_than_hz" in p for p in poles)


@pytest.fixture(scope="module")
def good():
    """The choice for a good record."""
    return choose_sampled([record(*recorded("zero-order"))], "zero-order", max_delay=3)


@pytest.fixture
def certified(monkeypatch, good):
    """The certificate of a good record, with one piece of evidence replaced."""

    def made(worse=False, held_out=None, **replaced):
        def chosen(*records, **options):
            found = good
            if held_out is not None:
                found = replace(found, chosen=replace(found.chosen, held_out=held_out))
            return replace(found, worse=worse)

        with monkeypatch.context() as patch:
            patch.setattr(sampled_identification, "choose_sampled", chosen)
            for name, value in replaced.items():
                patch.setattr(sampled_identification, name, lambda *_, value=value: value)
            return identified(*recorded("zero-order")).certificate

    return made


def test_good_evidence_is_accepted_within_its_range(certified):
    found = certified(valid_range=(0.1, 3.0), _independence=0.5)
    assert found["verdict"] == "accepted from 0.100 Hz to 3.00 Hz"
    assert found["warnings"] == []


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"worse": True}, "impulse response without a model for"),
        ({"valid_range": (0.1, 0.1)}, "known nowhere"),
        ({"held_out": np.array([0.6, 0.6])}, "free runs over held-out parts"),
    ],
)
def test_each_lack_of_evidence_is_a_reason(certified, changed, says):
    found = certified(**changed)
    assert found["verdict"] == "rejected"
    assert says in found["reasons"][0]


def test_a_residual_that_follows_the_input_is_a_warning_only(certified):
    found = certified(_independence=1e-9)
    assert "follows the input" in found["warnings"][0]
    assert found["verdict"].startswith("accepted")


def sines(frequencies, samples=4000):
    instants = np.arange(samples) * 1e-3
    return sum(np.sin(2 * np.pi * f * instants + f) for f in frequencies)


def second_order(u, noise=0.01):
    exact = signal.lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], u)
    return exact + np.random.default_rng(2).normal(0, noise, len(u))


def test_a_model_is_valid_between_the_frequencies_of_the_input():
    u = sines([5.0, 17.0, 60.0])
    low, high = identified(u, second_order(u), 1e-3, max_delay=0).valid[0]
    # A third of an octave around a line counts as excited.
    assert 5 / 1.3 < low < 5.3
    assert 57 < high < 60 * 1.3


def test_distortion_of_lines_is_separated_from_noise_by_those_between(monkeypatch):
    rng, period, lines = np.random.default_rng(4), 120, np.arange(1, 55)
    turned = np.exp(2j * np.pi * rng.random(len(lines)))
    distorted = lines > 30
    given = turned / (1 + 0.1j * lines) * (1 + 0.4 * distorted * turned**2)
    u, y = (
        np.tile(np.fft.irfft(np.concatenate([[0], values]), period), 3)
        for values in (turned, given)
    )
    found = []

    def keep(_, blocks, *__):
        found.extend(blocks)
        return 0.1, 0.2

    monkeypatch.setattr(sampled_identification, "valid_range", keep)
    identified(u, y + rng.normal(0, 0.01 * np.std(y), len(y)), 1.0, order=1, max_delay=0)
    assert np.mean([b.off[0] for b in found if b.frequency[0] * period > 30]) > 0.9
    assert np.mean([b.off[0] for b in found if b.frequency[1] * period < 30]) < 0.1


@pytest.mark.parametrize(("lines", "order"), [([16.0], 0), ([16.0, 40.0], 2)])
def test_more_poles_than_the_input_excites_are_refused_with_what_to_do(lines, order):
    u = sines(lines)
    excites = rf"excites {2 * len(lines)} parameters only.*steps, noise, or more"
    with pytest.raises(IdentificationError, match=excites):
        identified(u, second_order(u), 1e-3, order=order)


@pytest.mark.soak
def test_a_square_wave_that_follows_two_sines_is_known_at_those_at_most():
    """Its harmonics are none of any linear answer."""
    u = sines([16.0, 23.0])
    low, high = identified(u, np.sign(np.roll(u, 3)), 1e-3).valid[0]
    assert high <= low or (low >= 16 / 1.3 and high < 23 * 1.3)


def test_a_long_record_is_explored_on_a_part_and_fitted_on_all(monkeypatch):
    monkeypatch.setattr(sampled_choice, "EXPLORED_ON", 800)
    rng, samples = np.random.default_rng(2), 2000
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 4), 4)
    b, a = [0.0, 0.142, 0.135], [1.0, -1.584, 0.861]
    y = signal.lfilter(b, a, u) + rng.normal(0, 0.05, samples)
    model = identified(u, y, 1.0, max_delay=0)
    lines = np.geomspace(1e-3, 0.1, 12)
    off = np.log(model.sections.response(lines)[0] / signal.freqz(b, a, 2 * np.pi * lines)[1])
    band = model.sections.band(lines)
    assert np.max(np.abs(off.real) / band.gain) < 4
    assert np.max(np.abs(off.imag) / band.phase) < 4
    assert band.gain[0] < 4 * 0.05 / np.sqrt(samples)
    assert model.certificate["samples"]["compared"] > samples - 10


def test_a_change_of_the_plant_is_seen():
    """The first third follows the input, the rest does not: no free run predicts that."""
    rng = np.random.default_rng(6)
    u = np.repeat(rng.choice([-1.0, 1.0], 300), 4)
    y = signal.lfilter([0.0, 0.3], [1.0, -0.7], u)
    y[400:] = np.cumsum(rng.normal(0, 1, 800))
    assert identified(u, y, 1.0, max_delay=0).certificate["verdict"] == "rejected"


@pytest.mark.parametrize(("better", "order"), [(0.3, 3), (1e-4, 1)])
def test_the_simplest_of_equals_is_taken(better, order):
    rng = np.random.default_rng(1)
    problem = SectionsProblem([record(*recorded("zero-order"))], "zero-order", np.zeros(1, int))
    fits = {n: replace(problem.fit(0, [np.empty(0)]), order=n) for n in (1, 3)}
    small = SampledCandidate(fits[1], 1 + 0.05 * rng.normal(size=8))
    large = SampledCandidate(fits[3], small.held_out - better * (1 + rng.normal(size=8) / 3))
    large = replace(large, held_out=large.held_out + (better < 0.01) * 0.05 * rng.normal(size=8))
    assert simplest_undominated([small, large]).fit.order == order


def test_the_order_that_is_asked_for_is_kept():
    u, y = recorded("zero-order", samples=2000)
    choice = choose_sampled([record(u, y)], "zero-order", order=5)
    assert choice.chosen.fit.order == 5
    # In 9 of 16 seeds the free choice has more than the two poles of the plant.
    assert 2 <= choice.free.fit.order < 5
    assert np.mean(choice.free.held_out) <= 1.1 * np.mean(choice.chosen.held_out)


def test_polynomials_become_the_same_response():
    b, a = polynomials("first-order")
    sections = from_polynomials("first-order", PERIOD, b, a, 0.0)
    true = signal.freqz(b, a, 2 * np.pi * LINES * PERIOD)[1]
    np.testing.assert_allclose(sections.response(LINES)[0], true, rtol=1e-12)
    np.testing.assert_allclose(
        sections.equivalent().response(LINES)[0], TRUTH.response(LINES), rtol=1e-10
    )
    negative = from_polynomials("zero-order", 1.0, np.array([1.0, 0.1]), np.array([1.0, 0.5]), 0.0)
    assert negative.equivalent() is None


@pytest.mark.soak
def test_the_time_of_a_long_record_is_bounded(monkeypatch):
    """The search works on a part: with four times the record it takes less than four times."""
    monkeypatch.setattr(sampled_choice, "EXPLORED_ON", 1000)
    spent = []
    for samples in (1000, 8000):
        u, y = recorded("zero-order", samples=samples)
        start = time.process_time()
        identified(u, y)
        spent.append(time.process_time() - start)
    assert spent[1] < 6 * spent[0]


def test_a_mode_beyond_the_strong_band_of_the_input_is_found():
    rng, samples, poles = np.random.default_rng(3), 3000, []
    for cycles, damping in ((0.02, 0.05), (0.3, 0.01)):
        pole = np.exp(2 * np.pi * cycles * (1j - damping))
        poles.append(np.array([1.0, -2 * pole.real, abs(pole) ** 2]))
    strong = signal.lfilter(*signal.butter(6, 0.08), rng.normal(size=samples))
    u = strong + 3e-3 * rng.normal(size=samples)
    y = rng.normal(0, 1e-3, samples)
    for gain, each in zip((1.0, 31.0), poles, strict=True):
        y += gain * signal.lfilter([0.0, np.sum(each)], each, u)
    half = samples // 2
    model = identified(u[:half], y[:half], 1.0, order=4, max_delay=0)
    # Sampled for the strong band alone, the mode at 0.3 cycles would be lost.
    assert free_run(model, u[half:], y[half:]).explained > 0.999
    assert np.max(np.abs(model.sections.poles().imag)) == pytest.approx(2 * np.pi * 0.3, rel=1e-3)


@pytest.mark.parametrize("at", [0.5, *soaked(0.3, 0.6)])
def test_one_step_shows_a_lag_from_the_lowest_line_on(at):
    samples, period, lag = 2000, 0.01, 1.7
    rng, decay = np.random.default_rng(5), np.exp(-period / lag)
    u = np.where(np.arange(samples) < at * samples, 1.0, 1.2)
    # The filter starts at rest, so the record begins with its response to a first step.
    y = signal.lfilter([0.0, 1 - decay], [1.0, -decay], u) + rng.normal(0, 2e-3, samples)
    model = identified(u, y, period)
    assert model.certificate["verdict"].startswith("accepted")
    (low, high) = model.valid[0]
    assert low == pytest.approx(1 / (samples * period), rel=0.05)
    lines = np.geomspace(low, high, 50)
    truth = (1 - decay) / (np.exp(2j * np.pi * lines * period) - decay)
    assert np.max(np.abs(model.sections.response(lines)[0] / truth - 1)) < 0.05


def test_a_delay_that_a_few_poles_imitate_is_not_taken():
    poles = np.array([-0.081 + 0.749j, -0.008 + 0.083j])
    residues = np.array([0.048 + 0.246j, 0.021 + 0.012j])
    parts = [
        ([2 * r.real, -2 * (r * np.conj(p)).real], [1.0, -2 * p.real, abs(p) ** 2])
        for p, r in zip(poles, residues, strict=True)
    ]
    rng = np.random.default_rng(1)
    # The input ends at half the Nyquist frequency, so its first answers do not show a delay.
    u = signal.lfilter(*signal.butter(8, 0.5), rng.normal(size=2000))
    y = np.zeros(len(u))
    for up, down in [*parts, ([1.151], [1.0, 1.655])]:
        b, a, _ = signal.cont2discrete((up, down), 1.0, "foh")
        y += signal.lfilter(np.ravel(b), a, u)
    y += rng.normal(0, 0.01 * np.std(y), len(y))
    certificate = identified(u, y, 1.0, hold="first-order").certificate
    assert certificate["delay_samples"] == [0.0]
    assert certificate["order"] == 5


def test_a_column_that_rounding_leaves_less_than_nothing_is_ignored():
    gram = np.array([[4.0, 0.0], [0.0, -1e-30]])
    np.testing.assert_allclose(inverse_gram(gram), [[0.25, 0.0], [0.0, 0.0]])
