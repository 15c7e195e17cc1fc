"""A part turned on the chuck has one x and y in all scans, and is no other surface."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.cli import main
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.surface.aperture import Aperture, BoundedSurface
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.io.results import CloudFile
from omsm_ros.pipelines.adjust import adjust_bags, write_adjustment
from omsm_ros.report.verdict import headline

from .test_corrected_scan import write

TURNED_RAD = 1.2


def on_chuck(blocks, angle):
    """Return ``blocks`` of the same part turned by ``angle`` from x towards y, C with it."""
    return [(replace(axes, c=axes.c - angle), distance) for axes, distance in blocks]


def written_to(folder, blocks):
    """Return two bags of ``blocks``, the part turned on the chuck for the second."""
    bags = []
    for k, angle in enumerate((0.0, TURNED_RAD)):
        # The same scan twice would verify itself: another nanometre of distance.
        again = [(axes, replace(d, distance=d.distance + 1e-9 * k)) for axes, d in blocks]
        bags.append(write(folder / f"{k}.mcap", on_chuck(again, angle)))
    return bags


@pytest.fixture(scope="module")
def adjusted_to(tmp_path_factory, small_scan_blocks, true_calibration):
    folder = tmp_path_factory.mktemp("turned")
    bags = written_to(folder, small_scan_blocks)

    def adjusted_to(nominal):
        return adjust_bags(
            bags, true_calibration, nominal=nominal, options=CorrectionOptions(),
            clockings=(0.0, TURNED_RAD),
        )  # fmt: skip

    return adjusted_to


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory, adjusted_to):
    folder = tmp_path_factory.mktemp("adjusted")
    found, scans = adjusted_to(PAPER_MIRROR)
    write_adjustment(folder, {}, found, scans, report=False)
    return found, scans, CloudFile(folder / "adjusted.ply").read()


def test_a_turned_part_is_of_the_nominal_surface(adjusted):
    _, scans, _ = adjusted
    assert [scan.doubts for scan in scans] == [scans[0].doubts] * 2
    assert not any("another surface" in doubt for doubt in scans[0].doubts)


def test_the_cloud_has_each_place_of_the_part_once(adjusted):
    _, scans, cloud = adjusted
    first = len(scans[0].points)
    for name in "xy":
        one, other = cloud[name][:first], cloud[name][first:]
        assert np.max(abs(one - other)) < 1e-8


def test_figures_are_of_the_aperture_of_the_nominal_surface(adjusted_to):
    """In the frame of the part, however it is turned on the chuck; the points are of all."""
    radius = 2e-3
    area = Aperture.of("ellipse", 0.7 * radius, 0.5 * radius, 0.2 * radius, 0.0)
    found, scans = adjusted_to(BoundedSurface(PAPER_MIRROR, area))
    inside = area.holds(found.form.x, found.form.y)
    assert np.all(inside | (found.form.area == 0))
    assert np.ptp(found.form.x) > 1.2 * radius
    assert np.max(np.hypot(scans[1].points.x, scans[1].points.y)) > 0.98 * radius


def dusty(blocks):
    """Return ``blocks`` with 300 to 500 nm of dust under a point of a tenth of them."""
    random = np.random.default_rng(4)
    chosen, made = random.choice(len(blocks), len(blocks) // 10, replace=False), []
    for number, (axes, distance) in enumerate(blocks):
        away = distance.distance.copy()
        if number in chosen:
            away[random.integers(len(away))] += random.uniform(300e-9, 500e-9)
        made.append((axes, replace(distance, distance=away)))
    return made


def test_dust_is_counted_and_is_no_culprit(
    tmp_path, capsys, small_scan_blocks, true_calibration, adjusted
):
    """By command: PV, and what is refuted, as without it; conformity is open, it may be defects."""
    save_calibration(tmp_path / "cal.json", true_calibration)
    mirror = "{shape: off_axis_paraboloid, parent_focal_length: 0.0254, off_axis_distance: 0.0508}"
    (tmp_path / "mirror.yaml").write_text(mirror)
    bags = written_to(tmp_path, dusty(small_scan_blocks))
    main(["adjust", *map(str, bags), "--calibration", str(tmp_path / "cal.json"),
          "--nominal", str(tmp_path / "mirror.yaml"), "--clocking", "0", str(TURNED_RAD),
          "--tolerance", "300e-9", "--json", "--no-report", "--out", str(tmp_path)])  # fmt: skip
    found, (clean, *_) = json.loads(capsys.readouterr().out), adjusted
    assert not len(clean.form.dust)
    left_out = found["figures"]["left_out"]
    dust = 2 * len(small_scan_blocks) // 10
    assert 0.95 * dust <= left_out["points"] <= dust
    assert 480e-9 < left_out["largest"] < 540e-9
    assert f"without {left_out['points']} points left out as dust" in headline(found)
    pv = found["figures"]["peak_to_valley"]["value"]
    assert abs(clean.form.pv.value - pv) < 2 * clean.form.pv.uncertainty
    refuted = {s["name"] for s in found["sources"] if s["refuted"]}
    assert refuted == {s.name for s in clean.sources if s.refuted}
    assert "dust" in found["conformity"]["reasons"][0]
