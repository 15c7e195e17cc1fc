"""Files that the pages name, made by the twin or a script when first needed."""

import functools
import re
import shutil

import numpy as np
import yaml

from omsm_ros import cli
from omsm_ros.core.kinematics.trajectories import Chirp, Spiral
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.pipelines.record_bags import write_nominal, write_recording
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.scenario import Scenario, on_a_flat, planned_test_of, scan_of

from .pages import BLOCKS, ROOT

TWIN = Scenario(start_radius=1.5e-3)
CONFIG = ROOT / "config"


def omsm(*words):
    assert cli.main([str(word) for word in words]) == 0


def yaml_on(page, holds):
    """Return the YAML block of a page that holds a key."""
    text = (ROOT / page).read_text(encoding="utf-8")
    (found,) = [b for kind, b in BLOCKS.findall(text) if kind == "yaml" and holds in b]
    return found


_MADE = ("path:=", "record:=", ">")


class Workshop:
    """Makes files by name in its own folder, and copies them where they are needed."""

    def __init__(self, folder, port):
        self.folder, self.port = folder, port

    def lay_out(self, text, where):
        """Copy to ``where`` the files that a text uses before it makes them."""
        for name in NAMES:
            named = re.search(rf"(\S*)(?<![\w./-]){re.escape(name)}(?![\w.-])", text)
            before = text[: named.start()].split() if named else []
            if not named or before[-1:] in (["--out"], ["--plot"]) or named[1] in _MADE:
                continue
            if f"--out {name.split('/')[0]}/" in text[: named.start()]:
                continue
            source = self.made(name)
            (where / name).parent.mkdir(parents=True, exist_ok=True)
            copy = shutil.copytree if source.is_dir() else shutil.copy
            copy(source, where / name, **({"dirs_exist_ok": True} if source.is_dir() else {}))

    @functools.cache  # noqa: B019 - one workshop a session
    def made(self, name):
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        NAMES[name](self, path)
        return path


def steps(seed):
    return lambda shop, path: write_recording(path, planned_test_of(Scenario(seed=seed)))


def scan(**other):
    scenario = Scenario(start_radius=1.5e-3, part_seed=1, **other)
    return lambda shop, path: write_recording(path, scan_of(scenario))


def chirp(shop, path):
    motion = Chirp()
    write_recording(path, on_a_flat(TWIN, motion))


def sphere(shop, path):
    motion = Spiral(Sphere(0.05), 2e-3, feed_per_turn=1e-4, spindle_speed=30.0)
    write_recording(path, record(Cell(seed=3), motion, Sphere(0.05)))


def calibration(bag):
    return lambda shop, path: omsm("identify", shop.made(bag), "--out", path)


def result(bag):
    def make(shop, path):
        cal, nominal = shop.made("cal.json"), shop.made("mirror.yaml")
        words = ("--calibration", cal, "--nominal", nominal, "--out", path)
        omsm("correct", shop.made(bag), *words)

    return make


def cloud(shop, path):
    shop.made("result")


def recordings(shop, path):
    path.mkdir()
    for name in ("scan.mcap", "fast.mcap"):
        shutil.copy(shop.made(name), path)


def datx(shop, path):
    """Write an interferometer's map of the middle of the mirror, in the published format."""
    import h5py

    side = np.arange(-40, 41) * 25e-6
    x, y = np.meshgrid(side, side)
    height = np.where(np.hypot(x, y) < 0.95e-3, PAPER_MIRROR.height(x, y) * 1e9, 1e300)
    kind = np.dtype([("Category", "S16"), ("BaseUnit", "S16"), ("Parameters", "<f8", (4,))])
    with h5py.File(path, "w") as content:
        surface = content.create_dataset("Data/Surface/{A-1}", data=height[::-1])
        surface.attrs["No Data"] = np.array([1e300])
        surface.attrs["Unit"] = np.array([b"NanoMeters"])
        for axis in "XY":
            entry = np.array([(b"LateralCat", b"Pixels", (0, 25e-6, 0, 0))], kind)
            surface.attrs[f"{axis} Converter"] = entry


def shop_log(shop, path):
    """Write a step test as a control logs it, for the map on the page of `omsm import`."""
    made = planned_test_of(Scenario(seed=5))
    lines = ["Maschine 7", "Schrittversuch", "n;X-axis;Z-axis;C-axis;probe;peak", ";mm;mm;deg;;%"]
    for i, (z, d) in enumerate(zip(made.axes.z, made.distance.distance, strict=True)):
        row = f"{i};0.0;{-z * 1e3:.9f};0.0;{round(-d / 1.5e-9)};80.0"
        lines.append(row.replace(".", ","))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def shop_map(shop, path):
    path.write_text(yaml_on("docs/import.md", "lines_before_names"), encoding="utf-8")


def columns(recording):
    """Return a function that writes a recording as CSV, for the first maps on that page."""

    def make(shop, path):
        made = recording()
        rows = ["t [ms];X [mm];Z [mm];C [deg];gap [µm]"]
        axes, distance = made.axes, made.distance.distance
        for i, (x, z, c, d) in enumerate(zip(axes.x, axes.z, axes.c, distance, strict=True)):
            turned = np.degrees(c) % 360
            row = f"{i}.0;{x * 1e3:.9f};{z * 1e3:.9f};{turned:.7f};{-d * 1e6:.6f}"
            rows.append(row.replace(".", ","))
        path.write_text("\n".join(rows) + "\n", encoding="utf-8")

    return make


def step_test_map(shop, path):
    path.write_text(yaml_on("docs/import.md", "# step_test.yaml"), encoding="utf-8")


def scan_map(shop, path):
    text = yaml_on("docs/import.md", "# step_test.yaml")
    text = text.replace("x: {constant: 0}", 'x: {name: "X [mm]", unit: mm}')
    text = text.replace("c: {constant: 0}", 'c: {name: "C [deg]", unit: deg}')
    path.write_text(text, encoding="utf-8")


def origin(shop, path):
    path.write_text(yaml_on("docs/import.md", "drawing: "), encoding="utf-8")


def log(shop, path):
    path.write_text("time [ms];gap [um]\n0,0;1,25\n1,0;1,50\n2,0;1,25\n", encoding="utf-8")


def sources(shop, path):
    path.write_text(yaml_on("docs/budget.md", "omsm-sources/1"), encoding="utf-8")


def motion_columns(shop, path):
    """Write input and output of a system with one pole, 20 rad/s, and a pseudo-random input."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice((-1.0, 1.0), 200), 20)
    y, pole = np.zeros(len(u)), np.exp(-20e-3)
    for k in range(1, len(u)):
        y[k] = pole * y[k - 1] + (1 - pole) * u[k - 1]
    rows = (f"{a},{b:.9f}" for a, b in zip(u, y + rng.normal(0, 1e-3, len(y)), strict=True))
    path.write_text("\n".join(["u,y", *rows]) + "\n", encoding="utf-8")


def model(shop, path):
    words = ("--input", "u", "--output", "y", "--period", "0.001", "--hold", "zero-order")
    omsm("identify", shop.made("record.csv"), *words, "--out", path)


def node_file(name):
    def make(shop, path):
        path.write_text(cell_config(name, shop.port), encoding="utf-8")

    return make


def cell_config(name, port):
    """Write the shipped file with the port of this cell and a time lapse of 20."""
    content = yaml.safe_load((CONFIG / f"{name}.yaml").read_text(encoding="utf-8"))
    parameters = content["/**"]["ros__parameters"]
    if name == "confocal_driver":
        parameters["port"] = str(port)
    if name == "calibrator":
        parameters["settings"] = '{"machine": "twin", "time_lapse": 20.0}'
    if name == "viewer":
        parameters["port"] = 0
    return yaml.safe_dump(content)


def my_cell(shop, path):
    path.mkdir()
    for file in CONFIG.glob("*_driver.yaml"):
        node_file(file.stem)(shop, path / file.name)
    for name in ("calibrator", "corrector", "recorder", "viewer"):
        node_file(name)(shop, path / f"{name}.yaml")


def shipped(shop, path):
    shutil.copy(ROOT / path.relative_to(shop.folder), path)


NAMES = {
    "steps.mcap": steps(1), "steps2.mcap": steps(2), "steps3.mcap": steps(3),
    **dict.fromkeys(("scan.mcap", "scan1.mcap"), scan()),
    **dict.fromkeys(("fast.mcap", "scan2.mcap"), scan(seed=2, spindle_speed=60.0)),
    "CW.mcap": scan(seed=3), "CCW.mcap": scan(seed=4, spindle_speed=-30.0),
    "chirp.mcap": chirp, "sphere.mcap": sphere,
    "cal.json": calibration("steps.mcap"), "cal1.json": calibration("steps.mcap"),
    "cal2.json": calibration("steps2.mcap"), "cal3.json": calibration("steps3.mcap"),
    "old_cal.json": calibration("steps2.mcap"),
    "mirror.yaml": lambda shop, path: write_nominal(path),
    "machine.yaml": sources, "result": result("scan.mcap"), "old_result": result("fast.mcap"),
    "result/cloud.ply": cloud, "recordings": recordings, "interferometer.datx": datx,
    "step_test.csv": columns(lambda: planned_test_of(Scenario(seed=6))),
    "scan1.csv": columns(lambda: scan_of(Scenario(start_radius=1.5e-3, part_seed=1, seed=7))),
    "scan2.csv": columns(
        lambda: scan_of(
            Scenario(start_radius=1.5e-3, part_seed=1, seed=8, spindle_speed=60.0, outward=True)
        )
    ),
    "step_test.yaml": step_test_map, "scan.yaml": scan_map, "origin.yaml": origin,
    "steps.csv": shop_log, "map.yaml": shop_map, "log.csv": log,
    "record.csv": motion_columns, "model.json": model, "my_cell": my_cell,
    "config/disturbances.yaml": shipped,
    **{f"{name}.yaml": node_file(name)
       for name in ("confocal_driver", "calibrator", "corrector", "viewer")},
}  # fmt: skip
"""Function that makes each name on the pages; called with the workshop and the path."""
