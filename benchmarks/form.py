"""Compare fitted pose and Zernike terms with the true ones and with other programs.

The twin's own model of a posed part (fixed-point iteration) makes the points; noise is 10 nm, the
scan the paper's spiral. The peer for Zernike terms is a least-squares fit with the whole design
matrix, as prysm's ``lstsq`` solves it, and prysm itself in the environment of the peers.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from benchmarks.row import Row, at_least, at_most, not_compared, shown
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.form.analyse import FormResult, analyse_form
from omsm_ros.core.form.deviation_map import DeviationMap, GridCells
from omsm_ros.core.form.part_figures import SECOND_ORDER, SmoothTerms
from omsm_ros.core.form.texture import bands_of, power_density, texture
from omsm_ros.core.form.zernike_fit import fit_zernikes
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.aspheres import Asphere, Sphere, Toroid
from omsm_ros.core.surface.height_grid import as_grid
from omsm_ros.core.surface.nominal import (
    PAPER_MIRROR,
    PAPER_MIRROR_RADIUS_M,
    Flat,
    XYPolynomial,
    XYTerm,
    ZernikeSurface,
)
from omsm_ros.core.surface.posed import Pose, Sum
from omsm_ros.core.surface.zernike_terms import first_terms, zernike_values
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.io.results import PlyWriter
from omsm_ros.twin.part import PartPose, mounted_surface
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M, NANOMETRE_M

RADIUS, NOISE = PAPER_MIRROR_RADIUS_M, 10 * NANOMETRE_M
POINTS, PAPER_POINTS = 60_000, 254_000
ASTIGMATISM, COMA = 50 * NANOMETRE_M, 15 * NANOMETRE_M
DUST, DUST_SHARE = 5e-6, 1e-3
POSE_PARAMETERS = ("x", "y", "piston", "tip", "tilt", "clocking")
SHIFT, TURN = 0.5 * MILLIMETRE_M, 0.5 * DEGREE_RAD
ROOT = Path(__file__).parents[1]
MAPS = ROOT.parent / "shared" / "data" / "surfaces"


@dataclass(frozen=True)
class Part:
    """A nominal surface and its form error."""

    nominal: Surface
    error: Surface

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height [m]."""
        return self.nominal.height(x, y) + self.error.height(x, y)


def spiral(points: int) -> tuple[FloatArray, FloatArray]:
    """Return points of the paper's spiral, 127 turns from the rim to the centre."""
    r, angle = np.linspace(RADIUS, 0, points), np.linspace(0, 254 * np.pi, points)
    return r * np.cos(angle), r * np.sin(angle)


def measured(
    part: Surface, pose: Pose, seed: int, dust: float = 0.0, points: int = POINTS
) -> PointBatch:
    """Return points of a part in a pose."""
    x, y = spiral(points)
    rng = np.random.default_rng(seed)
    sits = PartPose(
        x_m=pose.x, y_m=pose.y, z_m=pose.piston,
        tilt_x_rad=pose.tip, tilt_y_rad=pose.tilt, clocking_rad=pose.clocking,
    )  # fmt: skip
    height = mounted_surface(part, sits).height(x, y) + rng.normal(0, NOISE, points)
    height = height + DUST * (rng.random(points) < dust)
    return PointBatch(x, y, height, np.empty((0, points)))


def judged(nominal: Surface, portion: PointBatch, *asked: str) -> FormResult:
    """Return the form of these points."""
    return analyse_form(nominal, lambda: [portion], asked or ("auto",), aperture=Aperture(RADIUS))


def poses(seed: int) -> Iterator[Pose]:
    """Yield poses of 0.5 mm, of 0.5°, and of all six at once, with random signs and sizes."""
    sign = np.random.default_rng(seed).uniform(-1, 1, 6)
    yield Pose(x=SHIFT * sign[0], y=SHIFT * sign[1])
    yield Pose(tip=TURN * sign[3], tilt=TURN * sign[4])
    sizes = np.repeat([SHIFT, TURN], 3) * sign
    yield Pose(**dict(zip(POSE_PARAMETERS, map(float, sizes), strict=True)))


def low_order_error(seed: int) -> ZernikeSurface:
    """A known astigmatism and coma, each in a direction by chance."""
    a, b = np.random.default_rng(seed).uniform(0, 2 * np.pi, 2)
    sizes = (ASTIGMATISM * np.cos(a), ASTIGMATISM * np.sin(a), COMA * np.cos(b), COMA * np.sin(b))
    return ZernikeSurface(RADIUS, (0.0, 0.0, 0.0, 0.0, *map(float, sizes)))


def rows(full: bool) -> list[Row]:
    """Poses, terms, dust, other surfaces, a measured map, and speed."""
    runs = 34 if full else 2
    table = [*_poses(runs), *_terms(3 * runs), *_dust(3 * runs), *_surfaces(), *_map(), *_peers()]
    return [*table, *_zernike_speed(), *_whole_process(full)]


def _poses(runs: int) -> list[Row]:
    """On a part without errors of its own: any deviation that is found is added."""
    held, added = [], []
    for seed in range(runs):
        straight = judged(
            PAPER_MIRROR, measured(PAPER_MIRROR, Pose(), seed, points=PAPER_POINTS)
        ).zernike
        for pose in poses(seed):
            portion = measured(PAPER_MIRROR, pose, seed, points=PAPER_POINTS)
            found = judged(PAPER_MIRROR, portion)
            registration = found.registration
            for name in POSE_PARAMETERS:
                spread = registration.spread.get(name)
                off = registration.placement.value(name) - getattr(pose, name)
                held.append(spread is not None and abs(off) <= 2 * spread)
            # Compared with the same noise on a part in the nominal pose.
            place = found.map.x, found.map.y
            there, height = straight.height(*place), found.zernike.height(*place)
            added.append(float(np.ptp(height - there)))
    total = 3 * runs
    return [
        at_least("pose parameters within k = 2", 100 * np.mean(held), "%", 93.0, runs=total),
        at_most(
            "form added by pose errors, PV", np.max(added) / NANOMETRE_M, "nm", 5.0, runs=total
        ),
    ]


def _smooth_extent(found: FormResult) -> float:
    height = found.zernike.height(found.map.x, found.map.y)
    return float(np.ptp(height))


def _terms(runs: int) -> list[Row]:
    held: dict[str, list[bool]] = {"piston, tip, tilt": [], "auto": []}
    errors: dict[str, list[float]] = {name: [] for name in held}
    for seed in range(runs):
        error = low_order_error(seed)
        pose = Pose(piston=1e-4, tip=1e-3, tilt=-2e-3)
        portion = measured(Part(PAPER_MIRROR, error), pose, seed)
        known = dict(zip(first_terms(8), error.coefficients, strict=True))
        for name in held:
            found = judged(PAPER_MIRROR, portion, *name.split(", "))
            fit = found.zernike
            off = [c - known.get(t, 0.0) for c, t in zip(fit.coefficients, fit.terms, strict=True)]
            # The terms are of heights along z, the deviation is along the normal.
            lean = [0.015 * abs(known.get(t, 0.0)) for t in fit.terms]
            held[name] += list(np.abs(off) <= 2 * fit.uncertainty + lean)
            map_ = found.map
            true = error.height(map_.x, map_.y)
            left = fit.height(map_.x, map_.y) - true
            errors[name].append(float(np.sqrt(np.average(left**2, weights=map_.area))))
    table = []
    for name in held:
        label = f"fit of {name}"
        table += [
            at_least(f"37 terms within k = 2, {label}", 100 * np.mean(held[name]), "%", 93.0,
                     runs=runs),
            (at_most if name != "auto" else _compared_with)(
                f"map of 37 terms against the truth, rms, {label}",
                np.median(errors[name]) / NANOMETRE_M, "nm", 3.0, runs=runs),
        ]  # fmt: skip
    return table


def _compared_with(name: str, value: float, unit: str, limit: float, runs: int) -> Row:
    """Show the form that a free pose absorbs, without a limit: it is not identifiable."""
    del limit
    return shown(name, value, unit, runs=runs)


def _dust(runs: int) -> list[Row]:
    worst = 0.0
    for seed in range(runs):
        part = Part(PAPER_MIRROR, low_order_error(seed))
        clean, dusty = (
            judged(
                PAPER_MIRROR, measured(part, Pose(tip=1e-3), seed, dust), "piston", "tip", "tilt"
            )
            for dust in (0.0, DUST_SHARE)
        )
        change = np.abs(clean.zernike.coefficients - dusty.zernike.coefficients)
        worst = max(worst, float(np.max(change / clean.zernike.uncertainty)))
    return [at_most("dust moves a term by, in its uncertainty", worst, "1", 1.0, runs=runs)]


def _surfaces() -> list[Row]:
    """Return how often the program finds the undetermined degrees of freedom of a surface."""
    freeform = ZernikeSurface(RADIUS, (0, 0, 0, 0, 1e-5, 0, 4e-6, 0, 0, 3e-6))
    polynomial = XYPolynomial(RADIUS, (XYTerm(3, 0, 2e-5), XYTerm(1, 2, -3e-5)))
    known = {
        "toroid": (Toroid(0.1, 0.06), {"x"}),
        "Zernike freeform": (Sum((Sphere(0.1), freeform)), set()),
        "XY polynomial": (Sum((Sphere(0.1), polynomial)), set()),
        "asphere": (Asphere(0.08, -1.2, (0.0, 20.0)), {"clocking"}),
        "sphere": (Sphere(-0.1), {"x", "y", "clocking"}),
        "flat": (Flat(), {"x", "y", "clocking"}),
        "off-axis paraboloid": (PAPER_MIRROR, {"clocking"}),
    }
    right, added = [], []
    pose = Pose(piston=1e-4, tip=2e-3, tilt=-3e-3)
    for surface, refused in known.values():
        found = judged(surface, measured(surface, pose, 1))
        right.append(set(found.registration.dofs.refused) == refused)
        added.append(_smooth_extent(found))
    return [
        at_least("surfaces with correct undetermined DOFs", sum(right), "1", len(known)),
        at_most("form added on any of them, PV", max(added) / NANOMETRE_M, "nm", 5.0),
    ]


def _map() -> list[Row]:
    file = MAPS / "zeiss_19-0057_vfm.asc"
    name = "Zeiss map without its second order, rms"
    if not file.is_file():
        return [not_compared(name, "nm", "1.52", "the measured map is not here")]
    points = read_points(file)
    portion = PointBatch(points.x, points.y, points.height, np.empty((0, len(points))))
    found = analyse_form(Flat(), lambda: [portion], ("piston", "tip", "tilt"), even=True)
    smooth, table = SmoothTerms.of(found.map, found.registration.disc, SECOND_ORDER), []
    rest = smooth.without(SECOND_ORDER).deviation
    for figure, value, bar in (("peak to valley", 8.95, 0.01), ("rms", 1.52, 0.01)):
        mine = float(np.ptp(rest) if figure == "peak to valley" else np.std(rest))
        off = abs(mine / NANOMETRE_M - value)
        name = f"Zeiss map without second order, {figure} off {value} nm by"
        table.append(at_most(name, off, "nm", bar))
    return table


# Python of the environment of the peers, which `make bench` makes.
PEERS = Path(os.environ.get("OMSM_SURFACE_PEERS", ROOT / ".venv/peers/bin/python"))


def _made_maps() -> dict[str, tuple[FloatArray, float, float]]:
    """Return maps (r, c) [m] with their spacings along x and y [m]: measured, and made ones."""
    random, made = np.random.default_rng(4), {}
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(300, 0.1e-3), np.fft.fftfreq(300, 0.1e-3)))
    for name, slope, corner in (("1/f2 of 300", 1.0, 400.0), ("1/f3 of 300", 1.5, 150.0)):
        white = np.fft.fft2(random.normal(size=(300, 300)))
        z = np.fft.ifft2(white / (1 + (f / corner) ** 2) ** slope * np.exp(-((f / 1500) ** 4))).real
        made[name] = np.asarray(1e-8 * (z - z.mean()) / z.std()), 0.1e-3, 0.1e-3
    y, x = np.mgrid[:200, :400] * 0.05e-3
    made["waves"] = 1e-8 * np.sin(2 * np.pi * x / 2e-3 + y / 1e-3) * np.cos(y / 3e-4), 5e-5, 5e-5
    file = MAPS / "zeiss_19-0057_vfm.asc"
    if file.is_file() and (grid := as_grid(read_points(file))) is not None:
        y, x = np.mgrid[-1 : 1 : grid.height.shape[0] * 1j, -1 : 1 : grid.height.shape[1] * 1j]
        columns = np.stack([one.ravel() for one in (x**0, x, y, x * x, x * y, y * y)], axis=1)
        fit = np.linalg.lstsq(columns, grid.height.ravel(), rcond=None)[0]
        rest = grid.height.ravel() - columns @ fit
        made["Zeiss"] = rest.reshape(grid.height.shape), grid.dx, grid.dy
    return made


def _peers() -> list[Row]:
    """Compare texture, slopes and densities with those of three other programs."""
    if not PEERS.is_file():
        name = "texture off prysm, SurfaceTopography and surfalize by"
        return [not_compared(name, "%", "<= 1", f"no environment of peers at {PEERS}")]
    table = []
    for name, (z, dx, dy) in _made_maps().items():
        step = 1 / (min(z.shape) * max(dx, dy))
        band = 3.5 * step, 12.5 * step
        across = (np.linspace(-1, 1, size + 2)[1:-1] for size in z.shape)
        away = np.hypot(*np.meshgrid(*across, indexing="ij"))
        window = np.cos(np.pi / 2 * np.minimum(away, 1.0)) ** 2
        found_by_peers = _by_peers(z=z, dx=dx, dy=dy, band=band, window=window)
        y, x = np.indices(z.shape) * np.reshape([dy, dx], (2, 1, 1))
        many, none = np.ones(z.size), np.empty((0, z.size))
        map_ = DeviationMap(
            x=x.ravel(), y=y.ravel(), deviation=z.ravel(), area=many, effects=none, noise=0.0
        )
        cells = GridCells.of(map_, even=True)
        mine = texture(cells, cells, bands_of(cells, None, 1e3))
        ours = {n: mine[n].value for n in ("Sa", "Sq", "Sz", "Sdq")}
        density = power_density(cells)
        f = np.hypot(density.x[np.newaxis], density.y[:, np.newaxis])
        inside = (f >= band[0]) & (f <= band[1])
        ours["in_band"] = float(np.sum(density.areal[inside])) / (z.size * dx * dy)
        for peer, found in found_by_peers.items():
            for figure, value in found.items():
                label = f"{name}: {figure} off {peer} by"
                if figure == "error":
                    table.append(not_compared(label, "%", "", str(value)))
                    continue
                off = 100 * abs((ours[figure] or 0.0) / value - 1)
                # SurfaceTopography leaves out the differences in the last row and column.
                rim = (peer, figure) == ("topography", "Sdq")
                bar = 100 / min(z.shape) if rim else 0.01
                table.append(at_most(label, off, "%", bar, peer))
        # Planes tell the slope of the surface, not of its points: less where texture is fine.
        ratio = (mine["slope_rms"].value or 0.0) / (ours["Sdq"] or np.inf)
        spacing = max(dx, dy) / MILLIMETRE_M
        table.append(shown(f"{name}: slope_rms over Sdq of {spacing:.3g} mm", ratio, "1"))
    return table


def _by_peers(**content: Any) -> dict[str, Any]:
    """Return what the program for the peers prints about the ``content``, in their environment."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "content.npz"
        np.savez(file, **content)
        command = [str(PEERS), str(Path(__file__).with_name("surface_peers.py")), str(file)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _zernike_speed() -> list[Row]:
    """Return processor times on one core, which other load does not affect."""
    x, y = spiral(PAPER_POINTS)
    value = low_order_error(1).height(x, y) + np.random.default_rng(1).normal(0, NOISE, len(x))
    terms, disc = first_terms(37), Aperture(RADIUS)

    def ours() -> FloatArray:
        return fit_zernikes(x, y, value, terms, disc).coefficients

    def plain() -> FloatArray:
        design = zernike_values(x / RADIUS, y / RADIUS, terms).T
        return np.linalg.lstsq(design, value, rcond=None)[0]

    times = {}
    for work in (ours, plain):
        spent = []
        for _ in range(3):
            begin = process_time()
            found = work()
            spent.append(process_time() - begin)
        times[work.__name__] = (min(spent), found)
    off = float(np.max(np.abs(times["ours"][1] - times["plain"][1]))) / np.ptp(value)
    ratio = times["plain"][0] / times["ours"][0]
    return [
        at_least("37 terms with covariance, times as fast as lstsq", ratio, "1", 2.0, "lstsq"),
        at_most("37 terms of 254 000 points off lstsq, of the PV", off, "1", 1e-9),
        shown("37 terms of 254 000 points, processor time", times["ours"][0], "s"),
        _prysm(x, y, value, times["ours"][0]),
    ]


def _prysm(x: FloatArray, y: FloatArray, value: FloatArray, mine: float) -> Row:
    name, terms = "37 terms with covariance, times as fast as prysm", first_terms(37)
    if not PEERS.is_file():
        return not_compared(name, "1", ">= 2", f"no environment of peers at {PEERS}")
    found = _by_peers(x=x / RADIUS, y=y / RADIUS, value=value, terms=terms)
    return at_least(name, found["time"] / mine, "1", 2.0, "prysm")


def _whole_process(full: bool) -> list[Row]:
    """``omsm form`` as a user runs it: processor time and memory of the process."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "mirror.yaml").write_text(
            "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
        )
        one = _process(folder, 290_000)
        table = [at_most("omsm form of 290 000 points, processor time", one[0], "s", 8.0)]
        few, many = (1_000_000, 20_000_000) if full else (500_000, 2_000_000)
        short, long = _process(folder, few), _process(folder, many)
        label = f"omsm form of {many / 1e6:g} million points, memory"
        table.append(at_most(label, long[1], "GiB", 2.0))
        ratio = (long[0] / short[0]) / (many / few)
        table.append(at_most("its time over that of proportion", ratio, "1", 1.1))
        return table


def _process(folder: Path, points: int) -> tuple[float, float]:
    """Return processor time [s] and largest memory [GiB] of one run."""
    cloud = folder / "cloud.ply"
    with PlyWriter(cloud) as ply:
        x, y = spiral(points)
        for begin in range(0, points, 1_000_000):
            chunk = slice(begin, begin + 1_000_000)
            ply.write(_cloud(x[chunk], y[chunk], begin))
    words = ["form", str(cloud), "--nominal", str(folder / "mirror.yaml"), "--json"]
    words += ["--out", str(folder / "out")]
    script = (
        "import json, resource, sys; from omsm_ros.cli import main; "
        "status = main(sys.argv[1:]); used = resource.getrusage(resource.RUSAGE_SELF); "
        "print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20]), "
        "file=sys.stderr); sys.exit(status)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, *words], capture_output=True, text=True, check=True
    )
    used: list[Any] = json.loads(done.stderr.splitlines()[-1])
    return float(used[0]), float(used[1])


def _cloud(x: FloatArray, y: FloatArray, first: int) -> SurfacePoints:
    rng, nothing = np.random.default_rng(first), np.zeros(len(x))
    near = tuple(np.float64(np.float32(v)) for v in (x, y))
    return SurfacePoints(
        sample=first + np.arange(len(x)), x=near[0], y=near[1],
        height=Part(PAPER_MIRROR, low_order_error(1)).height(*near) + rng.normal(0, NOISE, len(x)),
        dynamic_error=nothing, uncertainty=nothing, intensity=nothing.astype(np.float32),
    )  # fmt: skip
