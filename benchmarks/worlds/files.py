"""Write recordings as a shop would have them: text with millimetres, degrees and micrometres."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.worlds.machine import Recording
from benchmarks.worlds.world import QUICK_FEED_M, World

COLUMNS = (
    ("t_s", "t", 1.0, "%.6f"),
    ("x_mm", "x", 1e3, "%.6f"),
    ("z_mm", "z", 1e3, "%.7f"),
    ("c_deg", "c", 180 / np.pi, "%.6f"),
    ("distance_um", "distance", 1e6, "%.4f"),
)
"""Name in the file, channel, factor from its unit and format."""


def write_csv(recording: Recording, path: Path, wrapped: bool = False) -> Path:
    """Write one recording; a missing reading is an empty cell, C within 0–360° if ``wrapped``."""
    values = [factor * getattr(recording, channel) for _, channel, factor, _ in COLUMNS]
    if wrapped:
        values[3] = np.mod(values[3], 360.0)
    form = ",".join(column[3] for column in COLUMNS)
    rows = [form % row for row in zip(*(v.tolist() for v in values), strict=True)]
    text = "\n".join([",".join(column[0] for column in COLUMNS), *rows, ""])
    path.write_text(text.replace("nan", ""))
    return path


def write_world(
    world: World,
    plan: Iterable[tuple[float, str, float]],
    folder: Path,
    feed: float = QUICK_FEED_M,
    wrapped: bool = False,
) -> dict[str, object]:
    """Write steps.csv, scan_0.csv, scan_1.csv …, sources.json and truth.json; return the truth.

    ``plan`` holds (rpm, direction, clocking) of each scan. JSON is read as YAML too.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(world.step_test(), folder / "steps.csv", wrapped)
    plan = list(plan)
    for number, one in enumerate(world.scans(plan, feed)):
        write_csv(one, folder / f"scan_{number}.csv", wrapped)
    truth = {
        "kind": world.kind,
        "group": world.row.group,
        "source": world.row.source,
        "value": world.value,
        "unit": world.row.unit,
        "seed": world.seed,
        "plan": plan,
        "along": {
            way: {**asdict(t := world.truth(way)), "zernike": t.zernike.tolist()}
            for way in ("normal", "z")
        },
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    (folder / "sources.json").write_text(json.dumps(world.declared(), indent=1) + "\n")
    return truth
