"""The budget: no source is missing, and each height is that of its field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.calibration.calibration import Calibration, with_latency
from omsm_ros.core.calibration.latency import declared_latency
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.machine_sources import (
    NAMES,
    NOTHING_STATED,
    MachineSources,
    ScanBudget,
    StatedSource,
    declared_sources,
    scan_budget,
)
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.correction.systematic import (
    DECLARED,
    EVALUATED,
    MOST_TRACED,
    NOT_EVALUATED,
    ScanTrace,
)
from omsm_ros.core.correction.uncertainty import SCAN_SCATTER, ErrorSources
from omsm_ros.core.kinematics.kinematics import Geometry, WorkpiecePoints
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Recording

from .systematic_scan import spiral_points

NO_ERRORS = ErrorSources()


def stated(source: str, value: float, **more: object) -> StatedSource:
    return StatedSource(source=source, value=value, reason="as said here", **more)  # type: ignore[arg-type]


def budget(
    calibration: Calibration,
    sources: MachineSources = NOTHING_STATED,
    points: ErrorSources = NO_ERRORS,
    random: dict[str, float] | None = None,
) -> ScanBudget:
    trace = spiral_points()
    return scan_budget(calibration, points, random or {}, Geometry(), sources, trace)


def not_evaluated(found: ScanBudget) -> set[str]:
    return {row.source for row in found.rows if row.status == NOT_EVALUATED}


def test_every_source_has_a_row_and_unknown_ones_are_said_to_be(
    true_calibration: Calibration,
) -> None:
    found = budget(true_calibration)
    assert sorted(row.source for row in found.rows) == sorted([*NAMES, SCAN_SCATTER])
    assert {row.status for row in found.rows} == {NOT_EVALUATED}
    assert all(row.height is None and row.standard_uncertainty is None for row in found.rows)
    assert not_evaluated(found) == {*NAMES, SCAN_SCATTER}


def test_a_source_that_is_declared_zero_is_declared_and_not_unknown(
    true_calibration: Calibration,
) -> None:
    found = budget(true_calibration, MachineSources((stated("squareness", 0.0),)))
    row = next(row for row in found.rows if row.source == "squareness")
    assert (row.status, row.standard_uncertainty, row.height) == (DECLARED, 0.0, 0.0)


def test_heights_add_in_squares_and_a_piston_is_none(true_calibration: Calibration) -> None:
    said = MachineSources((stated("squareness", 1e-6), stated("drift_rate", 1e-10)))
    found = budget(true_calibration, said)
    trace = spiral_points()
    expected = {
        "squareness": 1e-6 * np.std(trace.slide_x),
        "drift_rate": 1e-10 * np.std(trace.time),
    }
    assert found.heights == pytest.approx(expected)
    assert found.systematic == pytest.approx(np.hypot(*expected.values()))


def test_noise_at_rest_holds_what_it_is_made_of(true_calibration: Calibration) -> None:
    points = ErrorSources(probe_noise=1e-8)
    found = budget(true_calibration, NOTHING_STATED, points, {"probe_noise": 1e-8})
    rows = {row.source: row for row in found.rows}
    assert rows["probe_resolution"].status == EVALUATED
    assert "in probe_noise" in str(rows["encoder_noise"].reason)
    assert rows["discretisation"].status == NOT_EVALUATED
    assert found.random == pytest.approx(1e-8)
    # Stated by somebody, it may be the noise of the probe alone.
    said = budget(true_calibration, MachineSources((stated("probe_noise", 1e-8),)), points)
    assert "encoder_noise" in not_evaluated(said)


def test_what_a_step_test_could_not_show_is_a_row_of_its_own(true_calibration: Calibration) -> None:
    p = len(true_calibration.covariance)
    known = replace(true_calibration, covariance=np.diag([1.0] + [0.0] * (p - 1)) * 1e-8)
    certificate = certified_by({"noise_covariance": [0.0] * p**2}, known.certificate)
    known = replace(known, certificate=certified_by(certificate))
    trace = replace(
        spiral_points(),
        dynamics=np.stack([spiral_points().x, spiral_points().y]) * 1e-6,
        undetected=np.array([False, True]),
    )
    found = scan_budget(known, NO_ERRORS, {}, Geometry(), NOTHING_STATED, trace)
    assert found.heights == pytest.approx({"undetected_model_error": 1e-6 * np.std(trace.y)})
    assert "dynamics" in not_evaluated(found)


def test_an_open_lag_is_an_upper_bound_and_one_that_was_measured_is_not(
    true_calibration: Calibration,
) -> None:
    assert budget(true_calibration).bounds == ("undetected_model_error", "probe_latency")
    said = MachineSources((stated("probe_latency", 1e-6),))
    assert budget(true_calibration, said).bounds == ("undetected_model_error",)
    lag = true_calibration.dynamics.low_frequency_delay
    known = with_latency(true_calibration, declared_latency(lag, 0.0, 1e-6, "light switch"))
    assert budget(known).bounds == ("undetected_model_error",)


def test_several_statements_of_one_source_are_one_row(true_calibration: Calibration) -> None:
    each = [stated("spindle_axial", 3e-9, parameters={"per_turn": k}) for k in (1, 2)]
    found = budget(true_calibration, MachineSources(tuple(each)))
    row = next(row for row in found.rows if row.source == "spindle_axial")
    assert row.standard_uncertainty == pytest.approx(3e-9 * np.sqrt(2))
    assert row.height == pytest.approx(3e-9 * np.sqrt(2), rel=0.01)


def test_amplitudes_and_half_widths_become_standard_uncertainties() -> None:
    assert stated("tilt", 6e-6, distribution="uniform").standard_uncertainty == pytest.approx(
        6e-6 / np.sqrt(3)
    )
    wave = stated("spindle_axial", 2e-9, distribution="arcsine", parameters={"per_turn": 1})
    assert wave.systematic().standard_uncertainty == pytest.approx(2e-9 / np.sqrt(2))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"source": "dynamics", "value": 1.0, "reason": "r"}, "'dynamics' is unknown"),
        ({"source": "tilt", "value": 1.0, "reason": " "}, "tilt needs a reason"),
        ({"source": "tilt", "value": 1.0, "reason": "r", "how": "guessed"}, "how is 'guessed'"),
        (
            {"source": "tilt", "value": 1.0, "reason": "r", "distribution": "u"},
            "expected one of normal, uniform, arcsine",
        ),
        ({"source": "tilt", "value": 11.0, "reason": "r"}, "tilt is 11.0 rad"),
        (
            {"source": "probe_noise", "value": 1e-9, "reason": "r", "parameters": {"period": 1.0}},
            "probe_noise has no parameter",
        ),
    ],
)
def test_what_nobody_can_mean_is_refused(arguments: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        StatedSource(**arguments)  # type: ignore[arg-type]


def test_a_source_of_points_is_stated_once() -> None:
    twice = (stated("probe_noise", 1e-9), stated("probe_noise", 2e-9))
    with pytest.raises(ConfigurationError, match="probe_noise is stated 2 times"):
        MachineSources(twice)


def test_sizes_alone_are_declared() -> None:
    said = declared_sources({"encoder_noise": 4e-10, "tilt": 1e-6})
    assert said.point_uncertainties() == {"encoder_noise": 4e-10}
    assert [source.name for source in said.scan_sources()] == ["tilt"]
    with pytest.raises(ConfigurationError, match="'tlit' is unknown"):
        declared_sources({"tlit": 1e-6})
    with pytest.raises(ConfigurationError, match="needs per_turn"):
        declared_sources({"spindle_axial": 1e-9})


# Points that stand for a scan.


def corrected(
    calibration: Calibration, scan: Recording, options: CorrectionOptions
) -> tuple[Corrector, np.ndarray]:
    corrector = Corrector(calibration, options)
    corrector.push_axes(scan.axes)
    corrector.push_distance(scan.distance)
    return corrector, join_points([corrector.finish()]).uncertainty


def test_the_trace_is_the_scan_in_time_and_place(
    true_calibration: Calibration, small_scan: Recording
) -> None:
    corrector, _ = corrected(true_calibration, small_scan, CorrectionOptions())
    trace = corrector.trace.points()
    assert MOST_TRACED / 2 < len(trace) <= MOST_TRACED
    assert np.all(np.diff(trace.time) > 0)
    assert trace.time[0] == 0
    at = np.rint(trace.time / 1e-3).astype(np.int64)
    late = len(small_scan.axes) - corrector.trace.seen
    assert np.allclose(trace.slide_x, small_scan.axes.x[at + late], atol=1e-12)
    assert np.allclose(trace.slide_y, 0, atol=1e-12)
    speed = np.gradient(trace.z, trace.time)
    inner = slice(2, -2)
    # The rate of single samples has the encoder's noise, some micrometres a second.
    assert np.std((trace.z_rate - speed)[inner]) < 5e-6 < np.std(speed[inner]) / 2


def test_a_restarted_counter_goes_on_in_time() -> None:
    trace = ScanTrace()
    place = WorkpiecePoints(*(np.ones(3) for _ in range(3)))
    for session, first in ((0, 100.0), (1, 0.0)):
        time = first + np.arange(3.0)
        trace.add(session, time, place, np.zeros((2, 3)), np.ones((2, 3)), np.zeros(3))
    assert np.array_equal(trace.points().time, [0, 1, 2, 2, 3, 4])
    assert len(ScanTrace().points()) == 0


def test_a_declared_tilt_is_in_the_uncertainty_of_each_point(
    true_calibration: Calibration, small_scan: Recording
) -> None:
    said = MachineSources((stated("tilt", 1e-5), stated("decentre", 1e-6)))
    noise = ErrorSources(probe_noise=1.2e-8)
    options = CorrectionOptions(sources=noise, systematic=said.scan_sources())
    _, without = corrected(true_calibration, small_scan, CorrectionOptions(sources=noise))
    corrector, tilted = corrected(true_calibration, small_scan, options)
    radius = 1e-5 * np.hypot(*(getattr(corrector.trace.points(), name) for name in "xy"))
    added = np.sqrt(np.mean(tilted**2 - without**2))
    assert added == pytest.approx(np.sqrt(np.mean(radius**2)), rel=1e-3)
    # A lateral shift needs the slope at the point.
    assert "decentre" not in corrector.budget
    known = replace(options, surface=PAPER_MIRROR)
    corrector, both = corrected(true_calibration, small_scan, known)
    assert corrector.budget["decentre"] > 0
    assert np.all(both >= tilted)
