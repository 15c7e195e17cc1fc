"""A model comes back as it went, and nothing else is taken for one."""

import json

import numpy as np
import pytest

from omsm_ros.core.estimation.sampled_model import Discrete, SampledModel
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import CalibrationError
from omsm_ros.pipelines.identify import load_model, save_model

LINES = np.array([0.1, 1.0, 4.0])
DISCRETE = Discrete(
    numerator=np.array([0.0, 0.3, 0.1]),
    denominator=np.array([1.0, -1.2, 0.5]),
    delay=2,
    covariance=np.diag([1e-6, 2e-6, 3e-6, 4e-6, 5e-6]),
)
CONTINUOUS = TransferFunction.from_ascending([1.3, 0.02], [1.0, 0.16, 0.02], 0.05)


def held(**changes):
    parts = {
        "hold": "zero-order",
        "sample_period": 0.1,
        "discrete": DISCRETE,
        "continuous": CONTINUOUS,
        "covariance": None,
        "valid_from": 0.01,
        "valid_up_to": 4.0,
        "working_point": (4.0, 30.0),
        "certificate": {"verdict": "accepted from 0.01 Hz to 4 Hz", "order": 2},
    }
    return SampledModel(**(parts | changes))


SMOOTH = held(hold="band-limited", discrete=None, covariance=1e-6 * np.eye(5))


@pytest.mark.parametrize("model", [held(), held(continuous=None), SMOOTH])
def test_what_was_saved_is_loaded(model, tmp_path):
    save_model(tmp_path / "m.json", model)
    loaded = load_model(tmp_path / "m.json")
    assert loaded.content() == model.content()
    if model.discrete:
        band = loaded.discrete.band(LINES, 0.1)
        assert band.gain == pytest.approx(model.discrete.band(LINES, 0.1).gain)
        assert np.all(band.gain > 0)


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        (("schema",), "omsm-calibration/1", "schema"),
        (("hold",), "third-order", "hold"),
        (("hold",), "band-limited", "band-limited one a continuous one with its covariance"),
        (("discrete",), None, "held input needs a discrete model"),
        (("discrete", "denominator"), [1.0, -2.5, 1.0], "no stable one"),
        (("discrete", "denominator"), [2.0, -1.2, 0.5], "begins with 1"),
        (("discrete", "denominator"), [1.0] * 22, "22 values"),
        (("discrete", "delay_samples"), 51, "longest delay"),
        (("discrete", "delay_samples"), -1, "longest delay"),
        (("discrete", "covariance"), [1.0, 2.0], "covariance has 2 numbers, expected 25"),
        (("discrete", "covariance"), [-1.0] * 25, "negative variance"),
        (("discrete", "numerator"), [1e200], "numerator"),
        (("continuous", "delay"), 1001.0, "at most 10000 samples"),
        (("continuous", "delay"), -1.0, "delay"),
        (("continuous", "denominator"), [2.0], "expected 1"),
        (("continuous", "denominator"), [1.0, 1e300, 1e-300], "cannot be computed"),
        (("sample_period",), 1e-15, "sample period"),
        (("valid_up_to",), -1.0, "frequency"),
        (("working_point",), [1.0], "working_point"),
        (("working_point",), [1e200, 0.0], "signal"),
        (("certificate",), [], "certificate"),
        (("more",), 1, "'more' is unknown"),
    ],
)
def test_what_is_no_model_is_refused_by_name(place, value, says, tmp_path):
    content = held().content()
    inner = content
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = value
    path = tmp_path / "m.json"
    path.write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match=says) as refusal:
        load_model(path)
    assert str(path) in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("denominator", [1.0, -1e-9, 0.02]),
        ("denominator", [1.0, 0.0, 0.02]),
        ("numerator", [0.0, 0.0]),
    ],
)
def test_a_smooth_model_that_cannot_run_is_refused(name, value, tmp_path):
    """Its output would grow without end, or it has none."""
    content = SMOOTH.content()
    content["continuous"][name] = value
    path = tmp_path / "m.json"
    path.write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match="no stable response, or is zero"):
        load_model(path)
