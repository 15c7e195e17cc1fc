"""Test that model files of version 1 are read, with the response, band and run of old.

``models_version_1.json`` holds two files that omsm_ros wrote before version 2, with what it
computed from them then.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation.sampled_model import free_run
from omsm_ros.errors import CalibrationError
from omsm_ros.pipelines.identify import load_model, save_model

OLD = json.loads((Path(__file__).parent / "models_version_1.json").read_text())
ZERO_ORDER, BAND_LIMITED = "zero-order", "band-limited"


@pytest.fixture
def loaded(tmp_path):
    def load(content):
        path = tmp_path / "m.json"
        path.write_text(json.dumps(content))
        return load_model(path)

    return load


@pytest.mark.parametrize("hold", OLD)
def test_response_and_band_are_those_of_then(hold, loaded):
    then = OLD[hold]
    model = loaded(then["model"])
    found = model.sections.response(np.array(then["lines"]))[0]
    np.testing.assert_allclose(found, np.array(then["real"]) + 1j * np.array(then["imag"]), 1e-9)
    band = model.sections.band(np.array(then["lines"]))
    np.testing.assert_allclose(band.gain, then["gain"], 1e-6)
    np.testing.assert_allclose(band.phase, then["phase"], 1e-6)
    assert model.valid == [(then["model"]["valid_from"], then["model"]["valid_up_to"])]
    assert model.certificate == then["model"]["certificate"]


def test_a_free_run_is_the_recursion_of_its_polynomials(loaded):
    then = OLD[ZERO_ORDER]["model"]
    mean_input, mean_output = then["working_point"]
    part, inputs = then["discrete"], np.random.default_rng(3).normal(size=300)
    late = np.concatenate([np.zeros(part["delay_samples"]), part["numerator"]])
    output = mean_output + signal.lfilter(late, part["denominator"], inputs)
    run = free_run(loaded(then), mean_input + inputs, output)
    assert np.max(abs(run.residual)) < 1e-9


@pytest.mark.parametrize("hold", OLD)
def test_it_is_saved_as_version_2(hold, loaded, tmp_path):
    model = loaded(OLD[hold]["model"])
    save_model(tmp_path / "new.json", model)
    assert load_model(tmp_path / "new.json").content() == model.content()


@pytest.mark.parametrize("seed", range(20))
def test_random_identified_ratios(seed, loaded):
    """Poles of H(z), some on the axis, some negative; the covariance is that of least squares."""
    rng = np.random.default_rng(seed)
    pairs, single = int(rng.integers(0, 3)), [-0.5, 0.3, 0.9][: int(rng.integers(1, 4))]
    upper = rng.uniform(0.6, 0.98, pairs) * np.exp(1j * np.pi * (np.arange(pairs) + 0.5) / 2)
    down = np.poly(np.concatenate([upper, upper.conj(), single])).real
    up = rng.normal(size=len(down) + int(rng.integers(-2, 2)))
    lines = np.linspace(0.1, 24.9, 200)
    q = np.exp(-2j * np.pi * lines * 0.02)[:, np.newaxis]
    top, bottom = q ** np.arange(len(up)) @ up, q ** np.arange(len(down)) @ down
    truth = top / bottom * q[:, 0] ** 2
    columns = np.hstack([q ** np.arange(len(up)) / top[:, None],
                         -(q ** np.arange(1, len(down))) / bottom[:, None]])  # fmt: skip
    information = (columns.conj().T @ (columns * abs(truth[:, None]) ** 2)).real
    covariance = 1e-4 * np.linalg.inv(information)
    sections = loaded(old_of(up, down, covariance)).sections
    assert np.max(abs(sections.response(lines)[0] - truth)) < 1e-6 * np.max(abs(truth))
    band = sections.band(lines)
    for part, found in ((columns.real, band.gain), (columns.imag, band.phase)):
        expected = np.sqrt(np.einsum("kp,pq,kq->k", part, covariance, part))
        np.testing.assert_allclose(found, expected, 0.02, 1e-5)


def test_uncertainties_that_rounding_would_change_are_left_out(loaded):
    """Neighbouring poles in two sections: their uncertainties are large and cancel."""
    down, covariance = np.poly([0.8, 0.79, 0.78, 0.77, 0.76, 0.75]), 1e-12 * np.eye(13)
    assert loaded(old_of(np.ones(7), down, covariance)).sections.covariance is None


def test_two_equal_poles(loaded):
    sections = loaded(old_of([0.0, 0.0, 0.04], np.poly([0.8, 0.8]), np.zeros((5, 5)))).sections
    lines = np.linspace(0.1, 24.9, 9)
    q = np.exp(-2j * np.pi * lines * 0.02)
    expected = 0.04 * q**4 / (1 - 0.8 * q) ** 2
    np.testing.assert_allclose(sections.response(lines)[0], expected, 1e-6)


def old_of(up, down, covariance):
    discrete = {
        "numerator": list(up), "denominator": list(down), "delay_samples": 2,
        "covariance": np.ravel(covariance).tolist(),
    }  # fmt: skip
    return OLD[ZERO_ORDER]["model"] | {"discrete": discrete}


@pytest.mark.parametrize(
    ("hold", "part", "name", "value", "says"),
    [
        (ZERO_ORDER, "discrete", None, None, "no polynomials with a covariance"),
        (BAND_LIMITED, "continuous", "covariance", None, "no polynomials with a covariance"),
        (ZERO_ORDER, "discrete", "denominator", [1.0, -2.5, 1.0], "no stable response"),
        (ZERO_ORDER, "discrete", "denominator", [2.0, -1.2, 0.5], "no stable response"),
        (ZERO_ORDER, "discrete", "denominator", [1.0] * 22, "denominator"),
        (ZERO_ORDER, "discrete", "denominator", [], "denominator"),
        (ZERO_ORDER, "discrete", "numerator", [1.0] * 9, "expected 121"),
        (ZERO_ORDER, "discrete", "numerator", [1e300] * 3, "scale it"),
        (ZERO_ORDER, "discrete", "delay_samples", -1, "0 to 10000 samples"),
        (ZERO_ORDER, "discrete", "covariance", [1.0, 2.0], "2 numbers, expected 25"),
        (ZERO_ORDER, "discrete", "covariance", [-1.0] * 25, "negative variance"),
        (BAND_LIMITED, "continuous", "delay", 1001.0, "0 to 10000 samples"),
        (BAND_LIMITED, "continuous", "denominator", [1.0, -1e-9, 0.02, 1e-6], "no stable response"),
        (
            BAND_LIMITED,
            "continuous",
            "denominator",
            [1.0, 1e300, 1e-300, 1e-300],
            "identify it again",
        ),
        (BAND_LIMITED, "continuous", "numerator", [1.0] * 9, "identify it again"),
    ],
)
def test_what_cannot_be_used_is_refused(hold, part, name, value, says, loaded):
    content = json.loads(json.dumps(OLD[hold]["model"]))
    if name is None:
        content[part] = value
    else:
        content[part][name] = value
    with pytest.raises(CalibrationError, match=says):
        loaded(content)


def test_a_long_pulse_response_has_no_sections(loaded):
    content = old_of(np.ones(12), [1.0, -0.5], np.eye(13))
    with pytest.raises(CalibrationError, match="no accurate sum of sections"):
        loaded(content)
