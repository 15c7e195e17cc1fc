"""From a cloud on disk to ``form.json``."""

import json
import shutil

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.cli import main
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.correction.systematic import ScanFields
from omsm_ros.core.form.analyse import analyse_form
from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat, ZernikeSurface
from omsm_ros.io.files import CLOUD, SYSTEMATIC
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.io.results import CloudFile, PlyWriter, save_fields
from omsm_ros.readable import count
from omsm_ros.twin.part import PartPose, mounted_surface

RADIUS, POINTS = 12.7e-3, 40_000
ASTIGMATISM, COMA = 50e-9, 15e-9


class Mirror:
    """The paper's mirror with 50 nm of astigmatism and 15 nm of coma at the rim."""

    error = ZernikeSurface(RADIUS, (0, 0, 0, 0, 0, ASTIGMATISM, 0, COMA))

    def height(self, x, y):
        return PAPER_MIRROR.height(x, y) + self.error.height(x, y)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write a cloud with tip, tilt and piston of the part, noise of 10 nm, and dust."""
    folder = tmp_path_factory.mktemp("form")
    rng = np.random.default_rng(3)
    r, angle = np.linspace(RADIUS, 0, POINTS), np.linspace(0, 160 * np.pi, POINTS)
    x, y = (np.float64(np.float32(v)) for v in (r * np.cos(angle), r * np.sin(angle)))
    pose = PartPose(z_m=1e-4, tilt_x_rad=2e-3, tilt_y_rad=-1e-3)
    height = mounted_surface(Mirror(), pose).height(x, y) + rng.normal(0, 1e-8, POINTS)
    dust = rng.random(POINTS) < 1e-3
    nothing = np.zeros(POINTS)
    points = SurfacePoints(
        sample=np.arange(POINTS), x=x, y=y, height=height + 5e-6 * dust, dynamic_error=nothing,
        uncertainty=nothing, intensity=nothing.astype(np.float32),
    )  # fmt: skip
    with PlyWriter(folder / CLOUD) as cloud:
        cloud.write(points)
    (folder / "mirror.yaml").write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
    )
    (folder / "sphere.yaml").write_text("shape: sphere\nradius: 0.1\n")
    (folder / "dust").write_text(str(int(dust.sum())))
    return folder


def form(folder, out, *arguments, report=False):
    words = ["form", folder, "--nominal", folder / "mirror.yaml", "--out", out, *arguments]
    words += [] if report else ["--no-report"]
    status = main([str(word) for word in words])
    return status, out / "form.json"


@pytest.fixture(scope="module")
def held(folder, tmp_path_factory):
    """A result with piston, tip and tilt alone fitted, and a tolerance."""
    words = ("--fit", "piston,tip,tilt", "--aperture", RADIUS, "--tolerance", 1e-6)
    status, path = form(folder, tmp_path_factory.mktemp("held"), *words)
    assert status == 0
    return path


@pytest.fixture(scope="module")
def automatic(folder, tmp_path_factory):
    """A result with what the points show fitted."""
    words = ("--fit", "auto", "--aperture", f"{RADIUS},0,0")
    _, path = form(folder, tmp_path_factory.mktemp("auto"), *words)
    return json.loads(path.read_text())


def test_known_terms_are_reported_within_their_uncertainty(folder, held):
    found = json.loads(held.read_text())
    assert set(found) == {
        "pose",
        "shape",
        "deviation",
        "zernike",
        "removed",
        "aperture",
        "points",
        "left_out",
        "open",
        "conformity",
    }
    assert found["conformity"]["verdict"] == "cannot tell"
    assert "points left out as dust" in found["conformity"]["reasons"][0]
    terms = {(t["n"], t["m"]): t for t in found["zernike"]}
    assert len(terms) == 37
    # As heights along z; the deviation is along the normal.
    known = {(2, -2): ASTIGMATISM, (3, -1): COMA}
    for name, term in terms.items():
        off = abs(term["value"] - known.get(name, 0.0))
        assert off < 4 * term["uncertainty"] + 0.003 * known.get(name, 0.0)
        assert 1e-11 < term["uncertainty"] < 1e-9
    for name, value in {"piston": 1e-4, "tip": 2e-3, "tilt": -1e-3}.items():
        entry = found["pose"][name]
        assert abs(entry["value"] - value) < 3 * entry["uncertainty"]
    assert found["pose"]["x"] == {"value": 0.0, "uncertainty": None}
    points = found["points"]
    assert points["read"] == POINTS == sum(points.values()) - points["read"]
    assert points["outliers"] == pytest.approx(int((folder / "dust").read_text()), abs=2)
    figures = found["deviation"]
    true_rms = np.hypot(ASTIGMATISM / np.sqrt(6), COMA / np.sqrt(8))
    rms = figures["rms"]
    # Along z; the normal leans by up to 1.5 % at the rim.
    assert abs(rms["value"] - true_rms) < 3 * rms["uncertainty"] + 0.012 * true_rms
    assert figures["point_noise"]["value"] == pytest.approx(1e-8, rel=0.05)
    assert figures["rms_before_fit"]["value"] > 5e-6


def test_points_left_out_are_stated_without_a_tolerance_too(folder, tmp_path, capsys):
    """Excluded on request, they are a note; otherwise they may be defects."""
    assert form(folder, tmp_path, "--fit", "piston,tip,tilt")[0] == 0
    assert "points left out as dust, up to 5" in capsys.readouterr().out


def test_a_move_that_looks_like_form_is_held_and_terms_carry_what_it_may_do(automatic):
    """For an unmoved part the terms are the true ones within their stated uncertainty."""
    found = automatic
    assert found["removed"]["fitted"] == ["piston", "tip", "tilt"]
    assert set(found["removed"]["held"]) == {"x", "y"}
    assert "nm rms; the uncertainty of each figure" in found["removed"]["held"]["y"]
    assert "tip and y" in found["removed"]["not_determined"]["clocking"]
    for term in found["zernike"]:
        known = {(2, -2): ASTIGMATISM, (3, -1): COMA}.get((term["n"], term["m"]), 0.0)
        assert abs(term["value"] - known) < 1.5e-9
        if term["n"] == 2:
            assert term["uncertainty"] > 5e-9
    assert found["pose"]["x"]["value"] == 0
    assert found["pose"]["x"]["uncertainty"] > 1e-6
    assert any("--fit piston,tip,tilt" in note for note in found["removed"]["notes"])
    entry = found["pose"]["clocking"]
    assert entry["uncertainty"] == pytest.approx(np.pi / 180)


def test_what_no_move_explains_is_known_where_form_looks_like_a_move(automatic):
    """Compare with least squares by finite differences of the twin's part in six poses."""
    figures = automatic["deviation"]
    r, angle = RADIUS * np.sqrt(np.linspace(0, 1, 5000)), np.arange(5000) * 2.4
    x, y = r * np.cos(angle), r * np.sin(angle)
    small = {"x_m": 1e-6, "y_m": 1e-6, "tilt_x_rad": 1e-5, "tilt_y_rad": 1e-5, "z_m": 1e-6}
    there = PAPER_MIRROR.height(x, y)
    moves = [
        (mounted_surface(PAPER_MIRROR, PartPose(**{name: size})).height(x, y) - there) / size
        for name, size in small.items()
    ]
    design = np.stack(moves, axis=1) / np.linalg.norm(moves, axis=1)
    true = Mirror.error.height(x, y)
    rest = true - design @ np.linalg.lstsq(design, true, rcond=None)[0]
    rms, extent = figures["rms_best_fit"], figures["peak_to_valley_best_fit"]
    assert np.std(rest) < 0.5 * np.std(true)
    assert abs(rms["value"] - np.std(rest)) < 3 * rms["uncertainty"] + 0.015 * np.std(rest)
    assert abs(extent["value"] - np.ptp(rest)) < 3 * extent["uncertainty"]
    assert rms["uncertainty"] < 0.5e-9
    assert extent["uncertainty"] < 5e-9 < figures["peak_to_valley"]["uncertainty"]


def test_the_page_answers_first_and_has_every_figure(folder, tmp_path, capsys):
    words = ("--fit", "piston,tip,tilt", "--aperture", RADIUS, "--tolerance", 1e-6)
    words += ("--dust", "isolated")
    status, path = form(folder, tmp_path, *words, report=True)
    assert status == 0
    assert json.loads(path.read_text())["conformity"]["verdict"] == "holds"
    said = capsys.readouterr().out
    for text in (
        "holds",
        "peak to valley may be",
        "rms of points",
        "not evaluated",
        f"{count(POINTS)} read",
    ):
        assert text in said
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 8
    for text in (
        *(
            "Form of the part",
            "peak to valley may be",
            "Not verified",
            "Uncertainty budget incomplete",
            "Sku",
        ),
    ):
        assert text in page
    curves = json.loads((tmp_path / "curves.json").read_text())
    psd = curves["psd"]
    x, y, areal = (np.array(psd["areal"][name]) for name in ("x", "y", "value"))
    held = areal.sum() * (x[1] - x[0]) * (y[1] - y[0])
    assert held == pytest.approx(psd["mean_square"], rel=0.02, abs=0)
    f, s = (np.array(psd["radial"][name]) for name in ("position", "value"))
    inside = np.sum(2 * np.pi * f * s) * (f[1] - f[0])
    assert inside == pytest.approx(psd["mean_square_in_band"], rel=1e-9, abs=0)
    assert set(curves["profiles"]) == {"x", "y", "diagonal", "radius", "angle", "edge"}


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--fit", "roll"], "roll"),
        (["--fit", "piston,clocking", "--nominal", "{}/sphere.yaml"], "clocking cannot be fitted"),
        (["--aperture", "1,2"], "expected R, annulus"),
        (["--aperture", "-1"], "expected R, annulus"),
        (["--aperture", "0.001,0.05,0"], "0 points lie on"),
        (["--nominal", "{}/dust"], "dust"),
    ],
)
def test_bad_input_ends_in_one_line(folder, tmp_path, capsys, arguments, named):
    status, path = form(folder, tmp_path / "out", *(a.format(folder) for a in arguments))
    assert status == 2
    assert named in capsys.readouterr().err
    assert not path.exists()


def test_a_folder_without_a_cloud_is_named(tmp_path, folder, capsys):
    nominal = str(folder / "mirror.yaml")
    assert main(["form", str(tmp_path), "--nominal", nominal, "--out", str(tmp_path / "o")]) == 2
    assert "no cloud at" in capsys.readouterr().err


def test_a_systematic_error_of_the_scan_is_in_every_figure(folder, held, tmp_path):
    """Write 20 nm of possible astigmatism of the instrument into the systematic fields."""
    known = tmp_path / "known"
    shutil.copytree(folder, known)
    cloud = CloudFile(known / CLOUD).read()
    u, v = (np.float64(cloud[name][::10]) / RADIUS for name in ("x", "y"))
    save_fields(
        known / SYSTEMATIC,
        ScanFields(("spindle", "spindle"), 20e-9 * np.stack([u**2 - v**2, 3 * u / 20]), 10),
    )
    words = ("--fit", "piston,tip,tilt", "--aperture", RADIUS)
    plain = json.loads(held.read_text())
    reported = json.loads(form(known, tmp_path / "b", *words)[1].read_text())
    assert reported["removed"]["not_evaluated"] == []
    assert plain["removed"]["not_evaluated"]
    before, after = (
        {(t["n"], t["m"]): t["uncertainty"] for t in found["zernike"]}
        for found in (plain, reported)
    )
    assert after[2, 2] == pytest.approx(20e-9, rel=0.02)
    assert after[3, 3] == pytest.approx(before[3, 3], rel=0.5)
    # A tilt of the instrument affects the pose, not the form.
    spindle = reported["removed"]["pose_uncertainty"]["spindle"]
    assert spindle["tilt"] == pytest.approx(3e-9 / RADIUS, rel=0.02)
    for name in ("peak_to_valley", "robust_peak_to_valley", "rms"):
        assert reported["deviation"][name]["uncertainty"] > plain["deviation"][name]["uncertainty"]


@pytest.mark.soak
def test_an_open_latency_leaves_the_figures_those_of_the_points(folder, tmp_path):
    """A possible error does not change the figures, but increases their uncertainty."""
    cloud = CloudFile(folder / CLOUD).read()
    u, v = (np.float64(cloud[name][::10]) / RADIUS for name in ("x", "y"))
    fields = 80e-9 * (u**2 - v**2)[np.newaxis]
    found = {}
    for name, bounds in (("real", ()), ("bound", ("probe_latency",))):
        known = tmp_path / name
        shutil.copytree(folder, known)
        save_fields(known / SYSTEMATIC, ScanFields(("probe_latency",), fields, 10, bounds))
        words = ("--fit", "piston,tip,tilt", "--aperture", RADIUS)
        found[name] = json.loads(form(known, tmp_path / f"out_{name}", *words)[1].read_text())
    rms, pv = (found["bound"]["deviation"][name] for name in ("rms", "peak_to_valley"))
    assert rms["value"] == pytest.approx(np.hypot(ASTIGMATISM / 6**0.5, COMA / 8**0.5), rel=0.02)
    true = np.ptp(Mirror.error.height(u * RADIUS, v * RADIUS))
    assert pv["value"] == pytest.approx(true, rel=0.05)
    assert found["real"]["deviation"]["rms"]["value"] < 0.5 * rms["value"]
    for figure, size in ((rms, 80e-9 / np.sqrt(6)), (pv, 160e-9)):
        assert 0.4 * size < figure["uncertainty"] < 1.5 * size
    assert found["real"]["zernike"] == found["bound"]["zernike"]


def test_the_deviations_are_left_for_other_programs(held):
    """The deviation is written as a map over the part that the map reader accepts."""
    left = read_points(held.parent / "deviation.ply")
    assert len(left.x) == json.loads(held.read_text())["points"]["used"]
    off = left.height - Mirror.error.height(left.x, left.y)
    assert np.std(off) == pytest.approx(1e-8, rel=0.05)


def test_a_map_of_another_program_goes_the_same_way(folder, tmp_path):
    """Text in millimetres and nanometres; unknown systematic errors are not evaluated."""
    cloud = CloudFile(folder / CLOUD).read()[::4]
    text = np.stack([cloud["x"] * 1e3, cloud["y"] * 1e3, cloud["height"] * 1e9], axis=1)
    np.savetxt(tmp_path / "map.xyz", text, fmt="%.9g")
    words = ["form", tmp_path / "map.xyz", "--nominal", folder / "mirror.yaml", "--unit", "mm,nm"]
    words += ["--out", tmp_path / "out", "--fit", "piston,tip,tilt", "--no-report"]
    assert main([str(word) for word in words]) == 0
    found = json.loads((tmp_path / "out" / "form.json").read_text())
    assert found["points"]["read"] == len(cloud)
    assert found["pose"]["tip"]["value"] == pytest.approx(2e-3, abs=1e-7)


def test_a_scan_without_its_calibration_is_distinguished_from_a_map(folder, tmp_path, capsys):
    bag = tmp_path / "scan.mcap"
    bag.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    words = ["form", bag, "--nominal", folder / "mirror.yaml", "--out", tmp_path / "out"]
    assert main([str(word) for word in words]) == 2
    assert "is a bag, no map" in capsys.readouterr().err


@pytest.mark.soak
def test_a_fitted_move_that_masks_form_gives_a_warning(folder, tmp_path):
    """On a small disc a shift cannot be separated from astigmatism; held, the form is certain."""
    words = ("--aperture", RADIUS / 6)
    notes = {}
    for fit in ("auto", "piston,tip,tilt"):
        _, path = form(folder, tmp_path / fit, "--fit", fit, *words)
        reported = json.loads(path.read_text())
        notes[fit] = reported["removed"]["notes"]
    assert any("hold it: --fit piston,tip,tilt" in note for note in notes["auto"])
    assert not any("hold it" in note for note in notes["piston,tip,tilt"])


X, Y = (v.ravel() for v in np.meshgrid(*[np.linspace(-10e-3, 10e-3, 80)] * 2))


@pytest.mark.parametrize("given", [Aperture(10e-3), *soaked(None)])
@pytest.mark.parametrize(("sector", "expected"), [(0.6 * np.pi, 0.4), *soaked((np.pi, 0.0))])
def test_a_missing_sector_keeps_the_tolerance_open(given, sector, expected):
    rng = np.random.default_rng(1)
    chosen = (np.hypot(X, Y) <= 10e-3) & (np.abs(np.arctan2(Y, X)) <= sector)
    count = int(chosen.sum())
    batch = PointBatch(X[chosen], Y[chosen], rng.normal(0, 1e-9, count), np.empty((0, count)))
    found = analyse_form(Flat(), [batch].copy, ("piston", "tip", "tilt"), aperture=given)
    assert found.uncovered == pytest.approx(expected, abs=0.05 if given else 0.3)
    assert bool(found.doubts()) == (expected > 0)


@pytest.mark.soak
def test_a_whole_square_is_covered():
    rng = np.random.default_rng(1)
    square = PointBatch(X, Y, rng.normal(0, 1e-9, len(X)), np.empty((0, len(X))))
    assert analyse_form(Flat(), lambda: [square], ("piston",)).uncovered < 0.02
