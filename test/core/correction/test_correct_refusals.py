"""Input that the correction refuses, with messages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.errors import CalibrationError, ConfigurationError
from omsm_ros.twin.cell import Recording

from .corrected_runs import CALIBRATION, calibration, run

# Refusals.


def other_rate(block: AxisBlock | DistanceBlock, period: float) -> AxisBlock | DistanceBlock:
    return replace(block, sample_period=period)


@pytest.mark.parametrize("push", [Corrector.push_axes, Corrector.push_distance])
def test_another_rate_than_the_calibrations_is_refused(
    scan: Recording, push: Callable[[Corrector, object], None]
) -> None:
    block = scan.axes if push is Corrector.push_axes else scan.distance
    with pytest.raises(CalibrationError, match=r"0\.0005 s.*0\.001 s"):
        push(Corrector(CALIBRATION), other_rate(block, 0.5e-3))


def test_another_rate_may_be_accepted(scan: Recording) -> None:
    axes, distance = other_rate(scan.axes, 0.5e-3), other_rate(scan.distance, 0.5e-3)
    points, _ = run([axes], [distance], CorrectionOptions(accept_other_rate=True))
    # The same samples in half the time: twice the speed, twice the lag's error.
    usual, _ = run([scan.axes], [scan.distance])
    common = np.intersect1d(points.sample, usual.sample)
    ours = points.dynamic_error[np.isin(points.sample, common)]
    theirs = usual.dynamic_error[np.isin(usual.sample, common)]
    assert np.ptp(ours) == pytest.approx(2 * np.ptp(theirs), rel=0.01)


def test_one_stream_may_not_change_its_rate(scan: Recording) -> None:
    corrector = Corrector(CALIBRATION, CorrectionOptions(accept_other_rate=True))
    corrector.push_axes(scan.axes)
    with pytest.raises(CalibrationError, match="both streams"):
        corrector.push_distance(replace(scan.distance, sample_period=0.5e-3))


@pytest.mark.parametrize(
    "wrong",
    [{"polarity": 0}, {"max_pending": 0.0}, {"probe_latency": -1e-3}],
    ids=lambda wrong: next(iter(wrong)),
)
def test_senseless_options_are_named(wrong: dict[str, float]) -> None:
    (name,) = wrong
    with pytest.raises(ConfigurationError, match=name):
        CorrectionOptions(**wrong)  # type: ignore[arg-type]


def test_a_certificate_with_a_senseless_noise_is_refused() -> None:
    with pytest.raises(CalibrationError, match="noise_m is 'low'"):
        Corrector(calibration(certificate=certified_by({"noise_m": "low"})))


def test_joining_nothing_gives_no_points() -> None:
    assert len(join_points([None, None])) == 0
