"""A model comes back as it went, and nothing else is taken for one."""

import json
from dataclasses import replace

import numpy as np
import pytest
from sections_of_polynomials import from_polynomials

from omsm_ros.core.estimation.sampled_model import SampledModel
from omsm_ros.errors import CalibrationError
from omsm_ros.pipelines.identify import load_model, save_model

LINES = np.array([0.1, 1.0, 4.0])
B, A = np.array([0.0, 0.3, 0.1]), np.array([1.0, -1.2, 0.5])
N, D = np.array([1.3, 0.02]), np.array([1.0, 0.16, 0.02])


def held(**changes):
    parts = {
        "sections": replace(
            from_polynomials("zero-order", 0.1, B, A, 0.2),
            covariance=np.diag([1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 0.0]),
        ),
        "valid": [(0.01, 4.0)],
        "working_point": [4.0, 30.0],
        "certificate": {"verdict": "accepted from 0.01 Hz to 4 Hz", "order": 2},
    }
    return SampledModel(**(parts | changes))


SMOOTH = held(sections=from_polynomials("band-limited", 0.1, N, D, 0.05))
BOTH = held(
    sections=replace(
        held().sections,
        numerators=np.ones((2, 1, 2)),
        direct=np.ones(2),
        delays=np.array([0.0, 0.3]),
        covariance=None,
    ),
    valid=[(0.01, 4.0), (0.1, 2.0)],
    working_point=[1.0, 2.0, 3.0],
)


@pytest.mark.parametrize("model", [held(), SMOOTH, BOTH])
def test_what_was_saved_is_loaded(model, tmp_path):
    save_model(tmp_path / "m.json", model)
    loaded = load_model(tmp_path / "m.json")
    assert loaded.content() == model.content()
    if model.sections.covariance is not None:
        band = loaded.sections.band(LINES)
        assert band.gain == pytest.approx(model.sections.band(LINES).gain)
        assert np.all(band.gain > 0)


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        (("schema",), "omsm-calibration/1", "schema"),
        (("hold",), "third-order", "hold"),
        (("denominators",), [[-0.1, 0.01]], "no stable response"),
        (("denominators",), [[0.0, 0.01]], "no stable response"),
        (("denominators",), [[1e300, 0.01]], "denominators"),
        (("denominators",), [[0.1, 0.01, 0.1]], "denominators"),
        (("numerators",), [[[1.0, 0.1], [1.0, 0.1]]], "are not those of one model"),
        (("numerators",), [], "numerators"),
        (("direct",), [1.0, 2.0], "are not those of one model"),
        (("delays",), [1001.0], "0 to 10000 samples"),
        (("delays",), [0.25], "whole ones of a held input"),
        (("delays",), [-0.1], "0 to 10000 samples"),
        (("covariance",), [1.0, 2.0], "covariance has 2 numbers, expected 36"),
        (("covariance",), [-1.0] * 36, "negative variance"),
        (("sample_period",), 1e-15, "sample period"),
        (("valid", 0, 1), -1.0, "frequency"),
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
