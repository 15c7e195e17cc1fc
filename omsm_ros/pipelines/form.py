"""From a cloud and a nominal surface to ``form.json``."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.comparison.stated_errors import ErrorFields
from omsm_ros.core.correction.systematic import ScanFields
from omsm_ros.core.form.analyse import FormResult, analyse_form
from omsm_ros.core.form.deviation_map import UncertainValue, conformity
from omsm_ros.core.form.drawing import Drawing
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.registration.isolated_points import ISOLATED, DustRule
from omsm_ros.core.registration.placement import POSE_PARAMETERS, PointBatch, PointBatches
from omsm_ros.core.registration.pose_parameters import MOVES, Registration
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.deviation import mismatch
from omsm_ros.core.surface.height_grid import as_grid
from omsm_ros.core.surface.measured_points import MeasuredPoints, without_duplicates
from omsm_ros.core.surface.shape_parameters import external
from omsm_ros.errors import FileError, Notice
from omsm_ros.io.files import CLOUD, CURVES, DEVIATION, FORM, SYSTEMATIC, save_json
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.io.maps.vertex_file import write_ply
from omsm_ros.io.results import CloudFile, load_fields, summary_of_points
from omsm_ros.readable import quantity
from omsm_ros.report.verdict import headline
from omsm_ros.units import NOT_USED, LengthUnits

_PORTION, _PLACES = 131_072, ("x", "y", "height")
_CORRECTION = "stated with the correction, for the whole scan and all sources of uncertainty"


@dataclass(frozen=True)
class RegistrationOptions:
    """How a part is registered to its nominal surface, and what its form is held against.

    dofs: degrees of freedom to fit, or "auto";  aperture: of the part, None for all points
    tolerance: of the peak to valley of the part [m], None without one
    dust: which points far from the form are left out; None: isolated ones, which still count
        against the tolerance, because nobody has decided that they are no defects
    placement: declared standard uncertainties of x, y and clocking [m], [rad], None if unknown
    filters: wavelengths of the S- and the L-filter [m], None for those that the points allow
    drawing: tolerances of ISO 10110-5
    """

    dofs: Sequence[str]
    aperture: Aperture | None = None
    tolerance: float | None = None
    dust: DustRule | None = None
    placement: Mapping[str, float] | None = None
    filters: tuple[float | None, float | None] = (None, None)
    drawing: Drawing | None = None


@dataclass(frozen=True)
class OpenedMeasurement:
    """Points of a measurement, read in batches with the effects of its systematic errors.

    portions: yields all points from the start;  sources: names of the systematic errors
    systematic: True if the effects of systematic errors are known
    notes: remarks on how the file was read
    even: True for the points of an evenly spaced grid
    bounds: names of the sources of which only an upper bound is known
    missing: number of further points of a map without a height
    """

    portions: PointBatches
    sources: tuple[str, ...]
    systematic: bool
    notes: tuple[str, ...] = ()
    even: bool = False
    bounds: tuple[str, ...] = ()
    missing: int = 0

    def form(self, surface: Surface, how: RegistrationOptions) -> FormResult:
        """Return the form of the points against ``surface``."""
        return analyse_form(
            surface, self.portions, how.dofs, sources=self.sources, bounds=self.bounds,
            aperture=how.aperture, even=self.even, filters=how.filters,
            dust=ISOLATED if how.dust is None else how.dust, declared=how.placement or {},
        )  # fmt: skip


def open_measurement(
    path: Path, units: LengthUnits | None = None, channel: str | None = None
) -> OpenedMeasurement:
    """Open a result folder, an own cloud, or a map or cloud of any other format.

    Own clouds are read in bounded memory, with the systematic fields in the same folder.
    units: of a file that does not state them;  channel: of a file of several maps

    Raises FileError for a file that cannot be read.
    """
    file = path / CLOUD if path.is_dir() else path
    if not file.exists():
        raise FileError(
            f"no cloud at {str(file)!r}; give a cloud, a map, or the folder of a measurement"
        )
    try:
        cloud = CloudFile(file)
    except FileError:
        points = without_duplicates(read_points(file, units, channel))
        gridded = as_grid(points) is not None
        return OpenedMeasurement(
            lambda: point_batches(points), (), False, points.notes, gridded, missing=points.missing
        )
    notes = () if units in (None, LengthUnits(1.0, 1.0)) else (NOT_USED,)
    if (summary := summary_of_points(path)) and summary.get("figures"):
        notes += (f"{_CORRECTION}: {headline(summary)}",)
    fields_path = file.with_name(SYSTEMATIC)
    fields = load_fields(fields_path) if fields_path.is_file() else None
    names, bounds = (fields.names, fields.bounds) if fields is not None else ((), ())

    def portions() -> Iterator[PointBatch]:
        parts = cloud.portions(_PORTION)
        return _batches(([rows[name] for name in _PLACES] for rows in parts), fields)

    return OpenedMeasurement(portions, names, fields is not None, notes, bounds=bounds)


def point_batches(
    points: MeasuredPoints, fields: ErrorFields | ScanFields | None = None
) -> Iterator[PointBatch]:
    """Yield the points in batches with the effects of the ``fields`` of systematic errors."""
    columns, starts = [getattr(points, n) for n in _PLACES], range(0, len(points), _PORTION)
    return _batches(([v[first : first + _PORTION] for v in columns] for first in starts), fields)


def _batches(
    parts: Iterable[Sequence[FloatArray]], fields: ErrorFields | ScanFields | None
) -> Iterator[PointBatch]:
    first = 0
    for part in parts:
        x, y, height = (values.astype(np.float64) for values in part)
        effects = np.empty((0, len(x))) if fields is None else fields.at(first, len(x))
        yield PointBatch(x, y, height, effects)
        first += len(x)


# Points left out as dust that the file lists.
_MOST_LISTED = 2_000
# Blocks of the areal density in each direction: enough for a figure, 70 kB in the file.
_MOST_BLOCKS = 64
_NO_NOISE = (
    "noise of the points is not evaluated, at most {}: no place of the profile was measured twice, "
    "so that it cannot be separated from texture; the figures contain it, and their uncertainty too"
)
_NO_SYSTEMATIC = (
    "systematic errors of the measurement: the uncertainty covers noise, form and pose only"
)


def judge_form(
    measured: OpenedMeasurement, surface: Surface, out: Path, how: RegistrationOptions
) -> dict[str, Any]:
    """Register a measurement to its nominal ``surface``; return the content of ``form.json``.

    Writes into ``out`` form.json, curves.json (profiles and power spectral densities) and
    deviation.ply: deviation along the normal over the part's x and y.

    Raises DataError for points that do not fit the surface or do not determine the pose asked for.
    """
    form = measured.form(surface, how)
    facts = form_facts(form, measured)
    doubts = form.doubts(decided=how.dust is not None)
    if how.dust is not None:
        reached = [d.peak_to_valley for d in form.doubts() if d.peak_to_valley is not None]
        excluded = [Notice("form.excluded_on_request", height=height) for height in reached]
        facts["removed"]["notes"] += map(str, excluded)
    facts["open"] = [{"reason": str(d.reason), "peak_to_valley": d.peak_to_valley} for d in doubts]
    if how.tolerance is not None:
        found = conformity(form.deviation["peak_to_valley"], how.tolerance, doubts)
        facts["conformity"] = found.entry() if found else None
    if how.drawing is not None:
        facts["drawing"] = how.drawing.verdicts(form.deviation, doubts)
    save_json(out / FORM, facts)
    save_json(out / CURVES, _curves(form))
    columns = [form.map.x, form.map.y, form.map.deviation]
    write_ply(out / DEVIATION, np.rec.fromarrays(columns, formats="<f8,<f8,<f8", names="x,y,z"))
    return facts


def form_facts(form: FormResult, measured: OpenedMeasurement) -> dict[str, Any]:
    """Return the content of ``form.json``; lengths in metres, angles in radians."""
    found = form.registration
    placement = found.placement
    return {
        "pose": {
            name: {"value": placement.value(name), "uncertainty": found.spread.get(name)}
            for name in POSE_PARAMETERS
        },
        "shape": {
            name: UncertainValue(*external(name, v, found.spread.get(name))).entry()
            for name, v in placement.shape
        },
        "deviation": {name: figure.entry() for name, figure in form.deviation.items()},
        "zernike": _terms(form),
        "removed": {
            "fitted": list(found.dofs.fitted),
            "not_determined": {name: str(why) for name, why in found.dofs.refused.items()},
            "held": {name: str(why) for name, why in found.dofs.held.items()},
            "pose_uncertainty": {
                source: _shares(found, shares) for source, shares in found.from_source.items()
            },
            "not_evaluated": [] if measured.systematic else [_NO_SYSTEMATIC],
            "notes": _notes(form, measured),
        },
        "aperture": {
            "radius": found.disc.radius,
            "x": found.disc.x,
            "y": found.disc.y,
            "outline": form.aperture.outline,
            "rim": form.aperture.rim().tolist(),
            "uncovered": form.uncovered,
            "s_filter": form.bands.s_filter,
            "resolved": form.bands.resolved,
            "l_filter": form.bands.l_filter,
            "bands": {name: list(ends) for name, ends in form.bands.rms_bands.items()},
            "zernike": "each term is 1 at the rim; cos for m >= 0, sin for m < 0, from x to y",
        },
        "points": form.counts
        | {name: form.counts[name] + measured.missing for name in ("read", "not_finite")},
        "left_out": {
            "largest": float(np.max(np.abs(form.dust[2]), initial=0.0)),
            **dict(zip("xyz", form.dust[:, :_MOST_LISTED].tolist(), strict=True)),
        },
    }


def _shares(found: Registration, shares: FloatArray) -> dict[str, float]:
    """Return the standard uncertainties of the fitted parameters themselves."""
    named = zip(found.dofs.fitted, map(float, shares), strict=True)
    return {n: external(n, found.placement.value(n), share)[1] or 0.0 for n, share in named}


def _notes(form: FormResult, measured: OpenedMeasurement) -> list[str]:
    """Return notes on the points, and advice where a move and the form cannot be separated."""
    dofs, rms = form.registration.dofs, form.deviation["rms"]
    fitted = [n for n in dofs.fitted if n in MOVES]
    if rms.uncertainty is None or rms.value is None or rms.value >= 2 * rms.uncertainty:
        fitted = []
    advice = [
        f"a move along {' and '.join(fitted)} cannot be separated from form here; it was fitted, "
        "so form of that shape is uncertain; figures after best-fit alignment are not affected; if "
        "the part was not moved since it was cut, hold it: --fit piston,tip,tilt"
    ] * bool(fitted)
    if dofs.held:
        others = ",".join(n for n in dofs.fitted if n not in dofs.held)
        advice.append(
            f"{' and '.join(dofs.held)} held at the nominal pose, because a move cannot be "
            "separated from form there; the possible offset of the part is included in every "
            "uncertainty except those after best-fit alignment; if it is known how well the part "
            f"sits, state that with --placement, or hold it: --fit {others}"
        )
    noise = [] if form.map.noise_known else [_NO_NOISE.format(quantity(form.map.noise, "m"))]
    x, y, nominal = form.map.x, form.map.y, form.registration.surface
    unlike = mismatch(x, y, nominal.height(x, y) + form.map.deviation, nominal)
    more = map(str, (*unlike, *(d.reason for d in form.doubts(decided=True))))
    return [*measured.notes, *advice, *noise, *more]


def _curves(form: FormResult) -> dict[str, Any]:
    density = form.density
    x, y, areal = density.coarse(_MOST_BLOCKS)
    return {
        "profiles": {name: curve.entry() for name, curve in form.profiles.items()},
        "psd": {
            "radial": density.radial.entry(),
            "azimuthal": density.azimuthal.entry(),
            "areal": {"x": x.tolist(), "y": y.tolist(), "value": areal.tolist()},
            "mean_square": density.mean_square,
            "band": list(density.band),
            "mean_square_in_band": density.mean_square_in_band,
            "normalisation": "two-sided areal density [m^4] over frequency [1/m], in blocks; its "
            "sum times the area of a block, and the integral of that over direction [m^2/rad], are "
            "mean_square [m^2]; the integral of 2 pi f times the radial one is that in the band",
        },
    }


def _terms(form: FormResult) -> list[dict[str, Any]]:
    fit = form.zernike
    known = [
        {"n": t.n, "m": t.m, "value": float(value), "uncertainty": float(spread)}
        for t, value, spread in zip(fit.terms, fit.coefficients, fit.uncertainty, strict=True)
    ]
    return known + [{"n": t.n, "m": t.m, "value": None, "uncertainty": None} for t in fit.left_out]
