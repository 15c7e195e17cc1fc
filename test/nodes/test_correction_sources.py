"""Stated uncertainties of the machine, and the verdict of the corrector."""

from __future__ import annotations

import pytest

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.errors import FileError
from omsm_ros.nodes.correction_parameters import PARAMETERS, accuracy_of, sources_of
from omsm_ros.pipelines.measure import live_verdict, with_sources
from omsm_ros.report.verdict import next_steps

DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}
FILE = """\
schema: omsm-sources/1
sources:
  - {source: drift_walk, value: 1.0e-9, unit: m/√s, how: evaluated, reason: four minutes on a flat}
  - {source: probe_noise, value: 5.0e-9, unit: m, how: declared, reason: data sheet}
"""


def values(tmp_path, **changes):
    path = tmp_path / "machine.yaml"
    path.write_text(FILE, encoding="utf-8")
    return DEFAULTS | {"sources_file": str(path)} | changes


def test_a_parameter_is_stated_before_the_file(tmp_path):
    assert sources_of(DEFAULTS).stated == ()
    assert sources_of(values(tmp_path)).point_uncertainties() == {"probe_noise": 5e-9}
    said = sources_of(values(tmp_path, **{"sources.probe_noise": 8e-9}))
    assert said.point_uncertainties() == {"probe_noise": 8e-9}
    assert [source.name for source in said.scan_sources()] == ["drift_walk"]
    with pytest.raises(FileError, match="no sources at"):
        sources_of(DEFAULTS | {"sources_file": str(tmp_path / "none.yaml")})


def test_the_verdict_follows_what_is_corrected(tmp_path, true_calibration, small_scan):
    reported = values(tmp_path, accuracy=1e-9)
    stated = sources_of(reported)
    corrector = Corrector(
        true_calibration, with_sources(CorrectionOptions(), true_calibration, stated, None)
    )
    before = live_verdict(corrector, true_calibration, stated, accuracy_of(DEFAULTS))
    assert before["code"] == "not_verified"
    corrector.push_axes(small_scan.axes)
    corrector.push_distance(small_scan.distance)
    after = live_verdict(corrector, true_calibration, stated, accuracy_of(reported))
    # A walk of 1 nm in a second is one of 6 nm in forty, and half of that on the mean.
    assert 5e-9 < after["uncertainty"] / 2 < 0.1e-6
    assert after["code"] != "verified"
    steps = "; ".join(next_steps(after))
    assert "larger than the accuracy of 1.0 nm asked for" in steps
    assert "scan the part again at twice the speed" in steps
