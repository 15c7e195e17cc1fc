"""Plan the scans of a part: which set reaches an accuracy, and the programs to run."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.adjustment import ScanDesign, plan_scans, usual_sets
from omsm_ros.core.correction.machine_sources import MachineSources
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.kinematics.limits import MachineLimits, speed_limits
from omsm_ros.core.kinematics.planner import PlannedPath, plan_path
from omsm_ros.core.kinematics.scan_path import ScanPath
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.aperture import BoundedSurface
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.files import save_text
from omsm_ros.io.gcode_file import path_gcode
from omsm_ros.pipelines.adjust import contribution_text, priors_of
from omsm_ros.units import RPM_RAD_S

# Largest distance of an executed path from the surface [m], and cycle of the planner's servo [s].
PATH_ERROR_M, SERVO_PERIOD_S = 100e-9, 1e-3
# Samples a second at which limits of a path are judged, and turns that stand for all.
_JUDGED_HZ, _JUDGED_TURNS = 1000.0, 20.0
_HEAD = "time_s,x_m,z_m,c_rad"


def scan_path(
    design: ScanDesign, nominal: Surface, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return x [m], z [m] and c [rad] of ``design`` at ``time`` [s], Z on the nominal surface."""
    x = design.start + (design.end - design.start) * time / design.duration
    c = design.rpm * RPM_RAD_S * time
    place = x * np.exp(-1j * (c + design.clocking))
    return x, nominal.height(place.real, place.imag), c


def refuse_beyond(
    design: ScanDesign, nominal: Surface, limits: MachineLimits, accuracy: float
) -> None:
    """Raise ConfigurationError where ``design`` exceeds a limit of the machine."""
    if exceeded := exceeded_limits(design, nominal, limits, accuracy):
        raise ConfigurationError(
            f"a scan at {design.rpm:.5g} rpm exceeds {', '.join(exceeded)}; give a smaller --rpm"
        )


def exceeded_limits(
    design: ScanDesign, nominal: Surface, limits: MachineLimits, accuracy: float
) -> list[str]:
    """Return the limits of the machine that ``design`` exceeds, none where it may be run.

    accuracy: asked for, k = 2 [m], for what exposure and timing cost
    """
    turns = abs(design.end - design.start) / design.pitch
    share = min(_JUDGED_TURNS / turns, 1.0)
    time = np.arange(0.0, design.duration * share, 1 / _JUDGED_HZ)
    # The steepest turns are the outer ones.
    ends = sorted((design.start, design.end), key=abs)
    outer = replace(design, start=ends[1], end=ends[0])
    x, z, c = scan_path(outer, nominal, time)
    path = ScanPath(z=z, sample_period=1 / _JUDGED_HZ, x=x, c=c)
    found, _ = speed_limits(path, limits, _JUDGED_HZ / 2, accuracy)
    exceeded = [limit.name for limit in found if limit.speed_factor < 1]
    if limits.x_beyond is not None and ends[0] * ends[1] < 0 and abs(ends[0]) > limits.x_beyond:
        exceeded.append("travel of X")
    return exceeded


def planned_set(
    first: ScanDesign, nominal: Surface, stated: MachineSources, accuracy: float,
    limits: MachineLimits,
) -> tuple[tuple[ScanDesign, ...], dict[str, Any]]:  # fmt: skip
    """Return the shortest set of scans that reaches the accuracy, and what each set would reach.

    first: a scan that the machine can make;  accuracy: asked for, k = 2 [m]

    Raises ConfigurationError where the first scan exceeds a limit of the machine.
    """
    refuse_beyond(first, nominal, limits, accuracy)
    possible = {
        name: designs
        for name, designs in usual_sets(first).items()
        if not any(exceeded_limits(design, nominal, limits, accuracy) for design in designs)
    }
    sets = plan_scans(possible, priors_of(stated), nominal, accuracy)
    best = sets[0]
    return best.designs, {
        "set": best.name,
        "reaches": best.reaches,
        "accuracy": accuracy,
        "largest": None if (most := best.uncertainty.largest) is None else contribution_text(most),
        "sets": [
            {
                "name": planned.name,
                "expanded_uncertainty": 2 * planned.uncertainty.pv,
                "duration": planned.uncertainty.duration,
                "reaches": planned.reaches,
                "scans": [asdict(design) for design in planned.designs],
            }
            for planned in sets
        ],
    }


def _path_entry(path: PlannedPath, design: ScanDesign, nominal: Surface) -> dict[str, float]:
    found = {f: getattr(path, f) for f in ("error", "rms", "segment", "c_acceleration")}
    if isinstance(nominal, BoundedSurface):
        time = np.arange(0.0, design.duration, 1 / design.rate, dtype=np.float64)
        x, _, c = scan_path(design, nominal, time)
        place = x * np.exp(-1j * (c + design.clocking))
        found["points"] = int(np.count_nonzero(nominal.aperture.holds(place.real, place.imag)))
    return found


def write_scans(
    designs: Sequence[ScanDesign],
    nominal: Surface,
    out: Path,
    bound: float,
    cycle: float,
    dialect: str = "linuxcnc",
) -> dict[str, Any]:
    """Write scan_N.csv (time_s, x_m, z_m, c_rad) and scan_N.nc (G-code) of each design.

    Return the bound, the files, and figures of each path: error [m], rms [m], segment [s],
    acceleration of C [rad/s²]; points on the part, if its aperture is known.

    bound: on the distance of the executed path from the surface [m];  cycle: of the servo [s]
    """
    paths, files = [], []
    for k, design in enumerate(designs):
        path, text = scan_program(design, nominal, bound, cycle, dialect)
        columns = zip(path.time, path.x, path.height, path.c, strict=True)
        rows = (f"{a:.6f},{b:.10f},{d:.12f},{e:.8f}" for a, b, d, e in columns)
        csv, gcode = (out / f"scan_{k + 1}.{end}" for end in ("csv", "nc"))
        save_text(csv, "\n".join([_HEAD, *rows]) + "\n")
        save_text(gcode, text)
        paths.append(_path_entry(path, design, nominal))
        files += [str(csv), str(gcode)]
    return {"path_error": bound, "paths": paths, "files": files}


def scan_program(
    design: ScanDesign,
    nominal: Surface,
    bound: float = PATH_ERROR_M,
    cycle: float = SERVO_PERIOD_S,
    dialect: str = "linuxcnc",
) -> tuple[PlannedPath, str]:
    """Return the path of ``design`` as a planner executes it, and its G-code."""
    path = plan_path(partial(scan_path, design, nominal), design.duration, cycle, bound)
    turned = f"part turned on the chuck by {np.degrees(design.clocking):g} degrees"
    return path, path_gcode(path, [f"scan at {design.rpm:g} rpm", turned], dialect)
