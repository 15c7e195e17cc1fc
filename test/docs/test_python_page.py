"""The Python on the page runs from top to bottom, and its numbers are those of the twin."""

import re

import pytest

from omsm_ros.twin.plant import PAPER_DYNAMICS

from .pages import ROOT

BLOCKS = re.findall(
    r"^```python\n(.*?)^```", (ROOT / "docs" / "python.md").read_text(), re.M | re.S
)


@pytest.mark.timeout(120)
def test_the_page_runs_from_top_to_bottom(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    assert len(BLOCKS) >= 6
    for block in BLOCKS:
        exec(block, names)
    calibration = names["calibration"]
    truth = PAPER_DYNAMICS.low_frequency_delay
    assert abs(calibration.lag - truth) < 3 * calibration.lag_uncertainty
    assert names["same"].core.id == calibration.core.id
    assert names["again"].lag == pytest.approx(calibration.lag, rel=0.05)
    assert names["agree"]
    assert 0 < names["value"] < 10e-9
    assert names["figure"].axes
