"""Commands for the form of a part: form, compensate, surface."""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.cli.arguments import Arguments, cell_of, refuse_cell
from omsm_ros.cli.command import LIMIT, CliCommand, Facts, Rows, written
from omsm_ros.cli.fit_option import declare_fit, declare_tolerance, form_rows, registration_of
from omsm_ros.core.form.analyse import FormResult
from omsm_ros.core.form.compensation import (
    CutSurface,
    check_last_cut,
    compensation,
    cut_path,
    path_gcode,
    spiral_offsets,
)
from omsm_ros.core.form.drawing import Drawing
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.kinematics.limits import MachineLimits, speed_limits
from omsm_ros.core.kinematics.planner import plan_path
from omsm_ros.core.kinematics.scan_path import ScanPath
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.registration.pose_parameters import AUTO
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.height_grid import gradient_of
from omsm_ros.errors import ConfigurationError, DataError, FileError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_limits, load_surface
from omsm_ros.io.files import (
    CURVES,
    DEVIATION,
    FORM,
    FORM_FILES,
    MEASUREMENT_FILES,
    REPORT,
    atomic_file,
    result_folder,
    save_bytes,
    save_text,
)
from omsm_ros.io.gcode_file import path_gcode as program_of
from omsm_ros.messages import text_from
from omsm_ros.pipelines.form import judge_form, open_measurement
from omsm_ros.quantities import (
    FEED,
    LENGTH,
    PROBE_ANGLE,
    SAMPLE_PERIOD,
    SPACING,
    SPEED,
    SPIRAL_PLACES,
    STEP,
)
from omsm_ros.readable import count, expanded, percent, plain, quantity
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M, NANOMETRE_M, RPM_HZ

FIGURE = "surface.png"
_ACROSS = 401
# A spiral is fastest at the rim, so four turns there determine the demands on the axes.
_TURNS, _SAMPLES_PER_TURN = 4, 2000
_BAND = "calibrated band"


def show_surface(
    scan: Spiral, limits: MachineLimits, probe_angle: float | None = None, out: Path | None = None
) -> dict[str, Any]:
    """Return extent, steepest slope and limits of a surface that is scanned; draw it into ``out``.

    probe_angle: largest angle to the normal at which the probe reads [rad]; None: unknown

    Raises DataError if the surface has no height somewhere on the disc.
    """
    x, y, height, steep = _over_disc(scan.surface, scan.start_radius)
    place = int(np.argmax(steep))
    angle = float(np.arctan(steep[place]))
    speed = abs(scan.spindle_speed) * RPM_HZ
    period = max(1 / (speed * _SAMPLES_PER_TURN), SAMPLE_PERIOD.low)
    samples = min(_TURNS * _SAMPLES_PER_TURN, int(scan.duration / period))
    axes = scan.positions(np.arange(max(samples, 100)) * period)
    path = ScanPath(z=axes.z, sample_period=period, x=axes.x, c=axes.c)
    evaluated, missing = speed_limits(path, limits, np.inf, np.inf)
    evaluated = [limit for limit in evaluated if limit.name != _BAND]
    if probe_angle is None:
        missing.append("angle of the probe to the surface")
    if out is not None:
        # Imported on demand, because loading the figures takes longer than the evaluation.
        from omsm_ros.report.measurement.figures import deviation_map
        from omsm_ros.report.style import png

        made = deviation_map(
            x, y, height - height.min(), unit="µm", title="Nominal height [µm]",
            limits=(0.0, float(np.ptp(height)) or 1e-9), quantity="above the lowest point",
        )  # fmt: skip
        save_bytes(out / FIGURE, png(made))
    return {
        "radius": scan.start_radius,
        "peak_to_valley": float(np.ptp(height)),
        "steepest_slope": float(steep[place]),
        "steepest_angle": angle,
        "steepest_at": [float(x[place]), float(y[place])],
        "probe_angle": probe_angle,
        "probe_can_follow": None if probe_angle is None else bool(angle <= probe_angle),
        "axes_can_follow": all(limit.speed_factor >= 1 for limit in evaluated),
        "limits": [asdict(limit) for limit in evaluated],
        "not_evaluated": [_BAND, *(name for name in missing if name != _BAND)],
        **({"figure": FIGURE} if out is not None else {}),
    }


def _over_disc(
    surface: Surface, radius: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return x, y, height [m] and slope [1] on the disc, each (n,)."""
    line = np.linspace(-radius, radius, _ACROSS)
    x, y = (v.ravel() for v in np.meshgrid(line, line))
    inside = x**2 + y**2 <= radius**2
    x, y = x[inside], y[inside]
    height = surface.height(x, y)
    if not np.all(np.isfinite(height)):
        raise DataError(
            f"the surface has no height at {int(np.sum(~np.isfinite(height)))} of {len(x)} points "
            f"of a disc of radius {radius!r} m; give a smaller radius, or check its parameters"
        )
    return x, y, height, np.hypot(*gradient_of(surface, x, y))


COMPENSATION, PATH, CUT = "compensation.csv", "compensation.nc", "cut.nc"
# Bound on the distance of the executed cut from its path [m].
_CUT_ERROR_M = 10 * NANOMETRE_M
# Cycle of the controller's planner [s].
_SERVO_PERIOD_S = 1e-3
# Coverage factor beyond which an offset is significant, at 95 %.
_COVERAGE = 2.0
# With a smaller share of the area significant, the cut follows the noise of the measurement.
_LEAST_SIGNIFICANT_SHARE = 0.5
# A cut that leaves a larger share of the rms is not worth while.
_LARGEST_REMAINDER = 0.9
_HEAD = "x_m,y_m,offset_m,uncertainty_m"
# In the table of a first cut, which has no more columns, the offsets are the change.
_COLUMNS = 4


_SIGN = (
    "add offset_m to the height of the surface that is cut, along z, positive away from the part; "
    "x and y are those of the nominal surface"
)


def _offsets(previous: Path, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return total and last offsets (r, c) [m] of an earlier compensation.csv; FileError."""
    try:
        table = np.loadtxt(previous, delimiter=",", skiprows=1, ndmin=2)
        values = table[:, [2, -1]] if table.shape[1] > _COLUMNS else table[:, [2, 2]]
    except (ValueError, IndexError, OSError) as err:
        raise FileError(f"{str(previous)!r} is no {COMPENSATION}: {err}") from err
    found = scipy.interpolate.NearestNDInterpolator(table[:, :2], values)(x, y)
    return found[..., 0], found[..., 1]


def _program(
    surface: Surface, rim: float, feed: float, nose: float, speed: float, out: Path
) -> dict[str, Any]:
    path, duration = cut_path(surface, rim, feed, speed, nose)
    planned = plan_path(path, duration, _SERVO_PERIOD_S, _CUT_ERROR_M)
    remark = f"cut at {speed:g} rpm with a nose of {nose / MILLIMETRE_M:g} mm"
    save_text(out / CUT, program_of(planned, [remark], measures=False))
    return {"cut": CUT, "path_error": planned.error, "cut_duration": duration}


def _warnings(sure: float, before: float, after: float) -> list[str]:
    found = []
    if sure < _LEAST_SIGNIFICANT_SHARE:
        found.append(
            f"on {percent(1 - sure)} of the area the offset is less than twice its uncertainty: a "
            "cut would transfer measurement errors to the part; measure more accurately, fit fewer "
            "degrees of freedom (--fit piston,tip,tilt), or give a longer --low-pass"
        )
    if after > _LARGEST_REMAINDER * before:
        found.append(
            f"the cut would leave {quantity(after, 'm')} of {quantity(before, 'm')} rms, which is "
            "shorter than --low-pass"
        )
    return found


def _declare_form(add: Arguments) -> None:
    add.bags("measured", help="result folder, cloud or map; or a scan with --calibration")
    add("--nominal", "SURFACE.yaml", required=True)
    add("--out", "DIR", required=True)
    add("--calibration", "CAL.json", "calibration to correct a scan with")
    add.shared("--unit", "--channel")
    declare_fit(add, (AUTO,))
    declare_tolerance(add)
    add("--drawing", Drawing.parsed, metavar="INDICATION")
    add.shared("--origin")
    add("--no-report", None, "write results without a report")
    for name, what in (("s", "shorter"), ("l", "longer")):
        add(
            f"--{name}-filter", SPACING,
            f"remove {what} wavelengths from the texture [m] (ISO 25178)", metavar="WAVELENGTH",
        )  # fmt: skip


def _form(args: argparse.Namespace) -> Facts:
    surface = load_surface(args.nominal, args.fit)
    with result_folder(args.out, MEASUREMENT_FILES if args.calibration else FORM_FILES) as out:
        source = args.measured
        if args.calibration:
            # Imported on demand, because it takes longer to load than many forms to evaluate.
            from omsm_ros.pipelines.measure import measure

            calibration = load_calibration(args.calibration)
            measure(cell_of(source, args), calibration, out, nominal=surface, report=False)
            source = out
        else:
            refuse_cell(source, args)
        points = open_measurement(source, args.unit, args.channel)
        facts = judge_form(points, surface, out, registration_of(args))
        if not args.no_report:
            # Imported on demand, because it takes longer to load than many forms to evaluate.
            from omsm_ros.pipelines.publish import publish_form

            publish_form(source, out, args.measured.resolve().name, args.origin)
            facts = {**facts, "report": REPORT}
    return {**facts, "out": str(args.out)}


def _show_form(facts: Facts) -> Rows:
    verdict = []
    if held := facts.get("conformity"):
        verdict = [("tolerance", f"{held['verdict']}, {quantity(held['tolerance'], 'm')}")]
        verdict += [("reason", text) for text in held["reasons"]]
    else:
        verdict = [("open", o["reason"]) for o in facts["open"] if o["peak_to_valley"] is not None]
    verdict += _drawing_rows(facts.get("drawing"))
    files = [FORM, CURVES, DEVIATION, *([facts["report"]] if "report" in facts else [])]
    return [*verdict, *form_rows(facts), written(files, facts["out"])]


def _drawing_rows(found: Facts | None) -> Rows:
    if not found:
        return []
    spacing = found["fringe_spacing"]
    unit = f"fringe spacings of {quantity(spacing, 'm', 4)}" if spacing else "nm"
    rows = [("drawing", f"{found['verdict']}: {found['text']}; numbers without a unit: {unit}")]
    for name, held in found["terms"].items():
        if held is None:
            rows.append((f"  {name}", "not evaluated"))
            continue
        value = expanded(held["value"], (held["expanded"] or 0.0) / 2, "m")
        limit = quantity(held["tolerance"], "m", 4)
        rows.append((f"  {name}", f"{held['verdict']}: {value}, tolerance {limit}"))
        rows += [("", text) for text in held["reasons"]]
    return rows


def _declare_compensate(add: Arguments) -> None:
    add("measured", Path, "result folder, cloud or map")
    add("--nominal", "SURFACE.yaml", required=True)
    add("--low-pass", SPACING, required=True, metavar="WAVELENGTH")
    add("--out", "DIR", required=True)
    add.shared("--unit", "--channel")
    add(
        "--spiral",
        SPACING,
        f"feed per turn of the next cut [m]: write {PATH}, G-code of Z offsets over X, C",
        metavar="FEED",
    )
    add("--per-turn", SPIRAL_PLACES, "points per turn of the spiral", default=360)
    add("--tool-radius", LENGTH, f"nose of the tool [m]: write {CUT}, the complete next cut")
    add("--rpm", SPEED, "spindle speed of the cut [rpm]", default=60.0)
    add("--previous", COMPENSATION)
    declare_fit(add, (AUTO,))


def _compensate(args: argparse.Namespace) -> Facts:
    surface = load_surface(args.nominal, args.fit)
    if args.tool_radius and not args.spiral:
        raise ConfigurationError("--tool-radius needs the feed of the cut: give --spiral FEED")
    with result_folder(args.out, (COMPENSATION, PATH, CUT)) as out:
        points = open_measurement(args.measured, args.unit, args.channel)
        form = points.form(surface, registration_of(args))
        facts = _write_cut(form, args, out)
    unknown = [] if points.systematic else ["systematic errors of the measurement"]
    return {**facts, "sign": _SIGN, "not_evaluated": unknown, "out": str(args.out)}


def _write_cut(form: FormResult, args: argparse.Namespace, out: Path) -> Facts:
    """Write the offsets of the next cut, as a table, along a spiral, and as a whole program."""
    surface = form.registration.surface
    found = compensation(form.map, surface, args.low_pass)
    (x, y), known = np.meshgrid(found.x, found.y), np.isfinite(found.offset)
    share, total = None, found.offset
    if args.previous is not None:
        before, change = _offsets(args.previous, x, y)
        share, total = check_last_cut(found, change), total + before
    columns = (x, y, total, found.uncertainty, *([found.offset] if args.previous else []))
    head = f"{_HEAD},change_m" if args.previous else _HEAD
    with atomic_file(out / COMPENSATION, "w") as stream:
        rows = np.column_stack([values[known] for values in columns])
        np.savetxt(stream, rows, "%.9g", ",", header=head, comments="")
    path: Facts = {}
    if args.spiral:
        along = spiral_offsets(found, args.spiral, int(args.per_turn))
        save_text(out / PATH, path_gcode(along))
        path = {"path": PATH, "path_places": len(along.offset), "path_left_out": along.left_out}
    if args.tool_radius:
        cut, rim = CutSurface(surface, found.x, found.y, total), np.max(np.hypot(x, y)[known])
        path |= _program(cut, float(rim), args.spiral, args.tool_radius, args.rpm, out)
    offset, spread = np.abs(found.offset[known]), found.uncertainty[known]
    sure = float(np.mean(offset > _COVERAGE * spread))
    return path | {
        "file": COMPENSATION, "places": int(np.sum(known)), "low_pass": args.low_pass,
        "removed": list(form.registration.dofs.fitted), "rms_before": found.before,
        "rms_after": found.after, "largest_offset": float(np.max(offset)),
        "largest_uncertainty": float(np.max(spread)), "significant_share": sure, "last_cut": share,
        "warnings": _warnings(sure, found.before, found.after),
    }  # fmt: skip


def _show_compensate(facts: Facts) -> Rows:
    lengths = ("rms_before", "rms_after", "largest_offset", "largest_uncertainty", "low_pass")
    rows = [(name.replace("_", " "), quantity(facts[name], "m")) for name in lengths]
    rows += [("warning", text) for text in facts["warnings"]]
    rows += [("not evaluated", text) for text in facts["not_evaluated"]]
    rows.append(("points", count(facts["places"])))
    files = [facts["file"]]
    if "path" in facts:
        rows.append(("points on the spiral", count(facts["path_places"])))
        files.append(facts["path"])
    if "cut" in facts:
        rows.append(("path error of the cut", quantity(facts["path_error"], "m")))
        files.append(facts["cut"])
    if facts["last_cut"] is not None:
        rows.append(("effect of the last cut", f"{facts['last_cut']:.2f} of what was asked for"))
    return [*rows, ("sign", facts["sign"]), written(files, facts["out"])]


def _declare_surface(add: Arguments) -> None:
    add("what", str, choices=("show",))
    add("surface", "SURFACE.yaml")
    add("--radius", STEP, "radius of the disc [m]", required=True)
    add("--feed", FEED, "feed per turn of the spiral [m]", default=1e-4)
    add("--rpm", SPEED, "spindle speed [rpm]", default=30.0)
    add("--limits", "LIMITS.yaml", "machine limits, as of 'omsm predict'")
    add("--probe-angle", PROBE_ANGLE)
    add("--out", "DIR", "folder for a figure")


def _surface(args: argparse.Namespace) -> Facts:
    scan = Spiral(load_surface(args.surface), args.radius, args.feed, args.rpm)
    facts = show_surface(scan, load_limits(args.limits), args.probe_angle, args.out)
    where = {"out": str(args.out)} if args.out is not None else {}
    return {"surface": str(args.surface), **facts, **where}


_FOLLOWS = {True: "can follow", False: "CANNOT follow", None: "not evaluated"}


def _show_surface(facts: Facts) -> Rows:
    degrees = plain(facts["steepest_angle"] / DEGREE_RAD)
    at = text_from("x = {steepest_at[0]:m}, y = {steepest_at[1]:m}", facts)
    drawn = [written([facts["figure"]], facts["out"])] if "figure" in facts else []
    return [
        ("peak to valley", quantity(facts["peak_to_valley"], "m")),
        ("steepest", f"{degrees}° at {at}"),
        ("probe", _FOLLOWS[facts["probe_can_follow"]]),
        ("axes", _FOLLOWS[facts["axes_can_follow"]]),
        *((f"  {limit['name']}", text_from(LIMIT, limit)) for limit in facts["limits"]),
        ("not evaluated", ", ".join(facts["not_evaluated"])),
        *drawn,
    ]


COMMANDS = (
    CliCommand("form", _declare_form, _form, _show_form),
    CliCommand("compensate", _declare_compensate, _compensate, _show_compensate),
    CliCommand("surface", _declare_surface, _surface, _show_surface),
)
