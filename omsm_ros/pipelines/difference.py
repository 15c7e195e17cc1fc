"""Compare two measurements of one part, also of another instrument: task and files."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.comparison.agreement import (
    COVERAGE_FACTOR,
    FIGURES,
    ComparisonAgreement,
    figures_of,
)
from omsm_ros.core.comparison.compare import Comparison, SideSummary, compare_measurements_of_part
from omsm_ros.core.comparison.matching import SEATED
from omsm_ros.core.comparison.resampling import RADIUS_CELLS, TREND_DEGREE
from omsm_ros.core.comparison.stated_errors import ComparedMeasurement, ErrorFields
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.registration.placement import Placed, PointBatch, placed
from omsm_ros.core.registration.register import register
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.deviation import deviation
from omsm_ros.core.surface.height_grid import as_grid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.io.files import (
    DIFFERENCE,
    REPORT,
    SUMMARY,
    SYSTEMATIC,
    read_result,
    save_json,
    save_text,
)
from omsm_ros.io.maps.columns_file import write_columns
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.io.results import load_fields
from omsm_ros.pipelines.form import point_batches
from omsm_ros.readable import now_text
from omsm_ros.units import LengthUnits

MAP = "difference.csv"

_METHOD = (
    "local quadratic regression on means of square cells, tricube weights over "
    f"{RADIUS_CELLS:g} cells, together with a polynomial of degree {TREND_DEGREE}"
)


@dataclass(frozen=True, kw_only=True)
class ComparisonOptions:
    """Options of a comparison.

    dofs: degrees of freedom in which the second is moved onto the first
    uncertainty: standard uncertainty of the heights of a file that states none [m]
    drift: standard deviation at the end of a scan whose fields hold none [m]
    units: of files that do not state them;  spacing: of the compared grid [m]
    length: correlation length of errors of unknown form [m]
    register: degrees of freedom to register each to the nominal surface first; None: not at all
    """

    dofs: Sequence[str] = SEATED
    uncertainty: float | None = None
    drift: float | None = None
    units: LengthUnits | None = None
    spacing: float | None = None
    length: float | None = None
    register: Sequence[str] | None = None


def measurement_at(
    path: Path, options: ComparisonOptions, nominal: Surface | None
) -> ComparedMeasurement:
    """Read a result folder, a cloud or a map, minus the ``nominal`` heights if given.

    Raises FileError for a file that cannot be read, DataError for points beyond the nominal
    surface.
    """
    units = options.units and replace(options.units, where_unsaid=True)
    points = _in_order(read_points(path, units), options.drift)
    if nominal is not None and options.register is None:
        height = deviation(points.x, points.y, points.height, nominal)
        points = replace(points, height=height)
    summary = path / SUMMARY
    calibration = ""  # not known
    if summary.is_file():
        calibration = str(read_result(summary, "summary").get("calibration", ""))
    measured = ComparedMeasurement(
        name=str(path), points=points, fields=_fields_file_of(path, points),
        common=options.uncertainty if points.uncertainty is None else None, drift=options.drift,
        calibration=calibration,
    )  # fmt: skip
    if nominal is None or options.register is None:
        return measured
    return registered(measured, nominal, options.register)


def _in_order(points: MeasuredPoints, drift: float | None) -> MeasuredPoints:
    """Return the points with sample numbers in file order if a ``drift`` is stated [m].

    Scattered points of other programs are in the order of measurement; the points of a map are
    sorted, so they get no numbers.
    """
    if points.sample is not None or as_grid(points) is not None:
        return points
    if drift:
        note = "points without sample numbers: their order in the file is assumed to be the scan's"
        sample = np.arange(len(points), dtype=np.int64)
        return replace(points, sample=sample, notes=(*points.notes, note))
    note = (
        "points without sample numbers: drift counts as form; if their order in the file is that "
        "of the scan, state the drift, such as --drift 20e-9"
    )
    return replace(points, notes=(*points.notes, note)) if drift is None else points


def _fields_file_of(path: Path, points: MeasuredPoints) -> ErrorFields | None:
    """Return the fields of the systematic errors at the points of a result folder, if stored."""
    folder = path if path.is_dir() else path.parent
    if path.is_file() and path.name != "cloud.ply":
        return None
    file = folder / SYSTEMATIC
    if not file.is_file() or points.missing:
        return None
    fields = load_fields(file)
    return ErrorFields(fields.names, fields.at, fields.aligned)


def compare_measurements(
    a: Path, b: Path, options: ComparisonOptions, nominal: Surface | None
) -> tuple[Comparison, dict[str, Any]]:
    """Compare two measurements; return the comparison and the content of its JSON."""
    measured = [measurement_at(path, options, nominal) for path in (a, b)]
    found = compare_measurements_of_part(*measured, options.dofs, options.spacing, options.length)
    facts = facts_of(found)
    for key, m in zip(("a", "b"), measured, strict=True):
        facts[key]["notes"] = list(m.points.notes)
    return found, facts


def write_difference(out: Path, found: Comparison, facts: dict[str, Any]) -> None:
    """Write ``difference.csv``, ``difference.json`` and ``report.html`` into ``out``."""
    matched, columns = found.matched, {}
    for name, values in (("x", matched.x), ("y", matched.y), ("difference", matched.difference)):
        columns[f"{name}_m"] = values
    if found.agreement is not None:
        columns["uncertainty_m"] = found.agreement.uncertainty
    write_columns(out / MAP, columns, csv=True)
    # Imported on demand, because loading the figures takes a second.
    from omsm_ros.report.difference import render

    date = now_text()
    names = [Path(facts[key]["file"]).name for key in ("a", "b")]
    save_text(out / REPORT, render(" and ".join(names), date, facts, found))
    save_json(out / DIFFERENCE, facts)


def facts_of(found: Comparison) -> dict[str, Any]:
    """Return the content of ``difference.json``: lengths in metres, angles in radians."""
    matched, agreement = found.matched, found.agreement
    figures = agreement.figures if agreement is not None else figures_of(matched)
    return {
        "schema": "omsm-difference/1",
        "verdict": found.verdict,
        "reasons": [*map(str, found.reasons)],
        "reservations": [*map(str, found.reservations)],
        "a": _side(found.sides[0]),
        "b": _side(found.sides[1]),
        "difference": {
            **{name: float(figure(matched.difference)) for name, figure in FIGURES.items()},
            "uncertainty": None
            if agreement is None
            else float(np.sqrt(np.mean(agreement.uncertainty**2))),
            "places": len(matched.x),
            "shared_area": found.shared,
        },
        "registration": {
            "fitted": list(matched.dofs),
            "moved": matched.moved,
            "not_determined": {name: str(why) for name, why in matched.refused.items()},
        },
        "resampling": {"method": _METHOD, "spacing": matched.grid.dx},
        "e_n": {name: asdict(number) for name, number in figures.items()},
        "zernike": _terms(agreement),
        "within": None if agreement is None else agreement.within,
        "probability": None if agreement is None else agreement.probability,
        "correlation_length": found.length,
        "common_errors": list(found.common),
        "coverage_factor": COVERAGE_FACTOR,
    }


def _side(side: SideSummary) -> dict[str, Any]:
    entry = asdict(side)
    return {"file": entry.pop("name"), **entry}


def _terms(agreement: ComparisonAgreement | None) -> dict[str, Any] | None:
    if agreement is None:
        return None
    radius, x, y = agreement.aperture
    return {
        "convention": "each term is 1 at the rim; cos for m >= 0, sin for m < 0, from x to y",
        "expanded": "for all terms together, 95 %",
        "aperture": {"radius": radius, "x": x, "y": y},
        "terms": [asdict(term) for term in agreement.terms],
    }


POSE = "pose of the part"


def registered(
    m: ComparedMeasurement, nominal: Surface, dofs: Sequence[str]
) -> ComparedMeasurement:
    """Return the measurement's deviations along the normal, in the frame of its part.

    The effects of its errors are those after the fit of the pose, and the uncertainty of the pose
    is a further source. Outliers such as dust are left out and noted.

    Raises DataError for points that do not fit the surface.
    """
    points, fields = m.points, m.fields
    names = fields.names if fields is not None else ()

    def portions() -> Iterator[PointBatch]:
        return point_batches(points, fields)

    found = register(nominal, portions, dofs, sources=names, even=as_grid(points) is not None)
    where = [placed(nominal, found.placement, portion) for portion in portions()]
    whole = Placed(*(np.concatenate(parts, axis=-1) for parts in zip(*where, strict=True)))
    kept = np.flatnonzero(np.isfinite(whole.deviation) & found.good(0, len(points)))
    part = whole.part(kept)
    held = 2 * len(found.held_effects)

    def effects(first: int, count: int, systematic: FloatArray) -> tuple[FloatArray, FloatArray]:
        here = Placed(*(values[..., first : first + count] for values in part))
        return found.effects(here, systematic)

    def of_scan(first: int, count: int) -> FloatArray:
        chosen = kept[first : first + count]
        low, end = (int(chosen[0]), int(chosen[-1]) + 1) if len(chosen) else (0, 0)
        rows = fields.at(low, end - low) if fields is not None else np.empty((0, end - low))
        return effects(first, count, rows[:, chosen - low])[1][: len(rows)]

    def of_pose(first: int, count: int) -> FloatArray:
        none = np.zeros((found.moved.shape[1] - held, len(part.x[first : first + count])))
        pose, sources = effects(first, count, none)
        return np.concatenate([pose, sources[len(none) :]])

    moved = ", ".join(f"{name} {found.placement.value(name):.4g}" for name in found.dofs.fitted)
    left_out = [f"{len(points) - len(kept)} points left out"] * (len(points) > len(kept))
    return replace(
        m,
        points=replace(
            points.part(kept), x=part.x, y=part.y, height=part.deviation,
            notes=(*points.notes, f"registered by {moved}", *left_out),
        ),
        fields=fields and ErrorFields(names, of_scan, fields.aligned),
        # Errors of two poses are independent, so none is aligned.
        pose=ErrorFields((POSE,) * (len(found.pose_effects) + held), of_pose),
    )  # fmt: skip
