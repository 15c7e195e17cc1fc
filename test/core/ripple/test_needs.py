"""Measurements that would decide the source of a line are new ones."""

from types import SimpleNamespace

import pytest

from omsm_ros.core.ripple.ripple_guard import missing_evidence
from omsm_ros.core.ripple.scan_signal import PATH, TIME
from omsm_ros.core.ripple.source_hypotheses import PART

VIBRATION = "vibration"


def scan(pace, acceleration_lines=None):
    coordinates = {TIME: SimpleNamespace(pace=1.0), PATH: SimpleNamespace(pace=pace)}
    return SimpleNamespace(coordinates=coordinates, acceleration_lines=acceleration_lines)


LINE = SimpleNamespace(possible=(TIME, PATH))


@pytest.mark.parametrize("own", [0, 1])
@pytest.mark.parametrize(
    ("paces", "kinds", "first"),
    [
        ((0.04,), {PART, VIBRATION}, "a second scan of the part at another speed"),
        ((0.04, 0.0405), {PART, VIBRATION}, "a second scan of the part at another speed"),
        ((0.04, 0.08), {PART, VIBRATION}, "a further scan at yet another speed"),
        ((0.04, 0.08), {VIBRATION}, "a slower scan that resolves finer texture"),
    ],
)
def test_the_scan_that_is_asked_for_is_one_that_is_not_there(own, paces, kinds, first):
    scans = [scan(pace) for pace in paces]
    own = min(own, len(scans) - 1)
    said = str(missing_evidence(scans, own, LINE, kinds))
    assert said.startswith(f"needs {first}")
    assert said.endswith(" or an accelerometer in the bag")
    scans[own] = scan(paces[own], acceleration_lines=object())
    assert "accelerometer" not in str(missing_evidence(scans, own, LINE, kinds))
