"""Lateral errors change heights by the slope of the surface, with and without a nominal one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.machine_sources import MachineSources, StatedSource
from omsm_ros.core.correction.systematic import ScanTrace
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io.results import CloudFile
from omsm_ros.pipelines.correct import add_lateral_errors, correct_bag
from omsm_ros.pipelines.measure import live_verdict, with_sources

from .test_corrected_scan import write

SHIFT = 1e-6
SAID = MachineSources(
    tuple(
        StatedSource(source=name, value=SHIFT, reason="dial gauge")
        for name in ("decentre", "centre_x")
    )
)


@pytest.fixture(scope="module")
def bag(tmp_path_factory, small_scan_blocks):
    return write(tmp_path_factory.mktemp("scan") / "scan.mcap", small_scan_blocks)


def corrected(bag, calibration, folder, surface):
    cloud = folder / f"{surface is None}.ply"
    options = with_sources(CorrectionOptions(), calibration, SAID, surface)
    return correct_bag(bag, calibration, cloud, options=options), CloudFile(cloud).read()


def test_slopes_of_the_points_serve_where_no_surface_is_given(bag, true_calibration, tmp_path):
    without, cloud = corrected(bag, true_calibration, tmp_path, None)
    given, expected = corrected(bag, true_calibration, tmp_path, PAPER_MIRROR)
    x, y = cloud["x"].astype(float), cloud["y"].astype(float)
    step = 1e-5
    slope = np.hypot(
        PAPER_MIRROR.height(x + step, y) - PAPER_MIRROR.height(x - step, y),
        PAPER_MIRROR.height(x, y + step) - PAPER_MIRROR.height(x, y - step),
    ) / (2 * step)
    steep = slope > 0.5 * slope.max()
    assert np.all(cloud["uncertainty"][steep] > 0.95 * SHIFT * slope[steep])
    ratio = cloud["uncertainty"][steep] / expected["uncertainty"][steep]
    assert np.all(abs(ratio - 1) < 0.05)
    for name in ("decentre", "centre_x"):
        assert without.budget[name] == pytest.approx(given.budget[name], rel=0.02)
    assert without.largest_uncertainty == pytest.approx(cloud["uncertainty"].max())
    assert np.array_equal(without.points, cloud)
    for name in ("x", "y", "height", "sample"):
        assert np.array_equal(cloud[name], expected[name])


def test_points_too_far_apart_for_the_turns_say_so(tmp_path, small_scan, true_calibration):
    options = with_sources(CorrectionOptions(), true_calibration, SAID, None)
    corrector = Corrector(true_calibration, options)
    corrector.push_axes(small_scan.axes)
    corrector.push_distance(small_scan.distance)
    points = corrector.finish()
    assert points is not None
    trace = ScanTrace(most=64)
    trace.add(
        0,
        points.sample * 1e-3,
        points,
        (small_scan.axes.b[points.sample], small_scan.axes.c[points.sample]),
        np.zeros((2, len(points))),
        np.zeros(len(points)),
    )
    corrector.trace = trace
    done = SimpleNamespace(corrector=corrector, options=options, budget={}, faults=())
    add_lateral_errors(done, tmp_path / "none.ply")
    assert not done.budget
    assert "centre_x" in done.faults[0]
    assert "--nominal" in done.faults[0]


def test_live_without_a_surface_the_verdict_says_what_is_not_in_the_points(
    small_scan, true_calibration
):
    for surface, reported in ((None, True), (PAPER_MIRROR, False)):
        options = with_sources(CorrectionOptions(), true_calibration, SAID, surface)
        corrector = Corrector(true_calibration, options)
        corrector.push_axes(small_scan.axes)
        corrector.push_distance(small_scan.distance)
        reasons = live_verdict(corrector, true_calibration, SAID, None)["reasons"]
        found = [r["text"] for r in reasons if "parameter 'nominal'" in r["text"]]
        assert bool(found) == reported
        assert all("centre_x, decentre" in text for text in found)
