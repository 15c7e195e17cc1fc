"""Analyse the form of a part: from scattered points and a nominal surface to figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.form import texture
from omsm_ros.core.form.deviation_map import (
    DeviationMap,
    Doubt,
    GridCells,
    UncertainValue,
    neighbour_noise,
    path_noise,
    profile_noise,
    repeated_noise,
    square_slope,
)
from omsm_ros.core.form.part_extents import extents_of_parts
from omsm_ros.core.form.part_figures import (
    FORM,
    MOST_UNSEEN,
    POWER,
    SECOND_ORDER,
    SYMMETRIC,
    TILT,
    Gaps,
    SmoothTerms,
    best_fit,
    fitted,
    length,
    rms_of_part,
    short_waves,
)
from omsm_ros.core.form.zernike_fit import RimStrip, ZernikeFit, fit_zernikes
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.registration.isolated_points import ISOLATED, DustRule
from omsm_ros.core.registration.placement import Placed, PointBatch, PointBatches, placed
from omsm_ros.core.registration.pose_parameters import Registration, root_of
from omsm_ros.core.registration.register import CHUNK, register
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.statistics import EvenSelection, noise_of
from omsm_ros.core.surface.aperture import Aperture, best_covered, within_aperture
from omsm_ros.core.surface.area_weights import LINE_WIDTH, area_weights
from omsm_ros.core.surface.height_grid import as_grid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.core.surface.zernike_terms import (
    ZernikeIndex,
    first_terms,
    zernike_slopes,
    zernike_values,
)
from omsm_ros.errors import DataError, Notice

ZERNIKES = first_terms(37, "fringe")
# A larger share of the aperture without points keeps a tolerance open.
_COVERED_WELL = 0.02
# Points with all their effects take 50 MB. Extremes and counts are of all points.
MOST_WEIGHED = 2**19
# Standard deviation of an estimate of noise from 6000 points, as a share of it.
_CHANCE = 0.02
# A hundred points for each Zernike term.
_MOST_POINTS = 4_000


def with_pose_uncertainty(fit: ZernikeFit, map_: DeviationMap, found: Registration) -> ZernikeFit:
    """Return the fit with the effect of lateral pose errors on its terms.

    A lateral shift of the part moves the form: its effect is the slope of the smooth form times
    the shift, for each undetermined pose parameter and each pose error.
    """
    few = map_.every(_MOST_POINTS)
    places = fit.disc.scaled(few.x, few.y)
    slopes = fit.coefficients @ np.stack(zernike_slopes(*places, fit.terms)) / fit.disc.radius
    shifts = found.displaced(few.x, few.y), found.undetermined_displacements(few.x, few.y)
    changes = -np.einsum("rin,in->rn", np.concatenate(shifts), slopes)
    root = np.sqrt(few.area)
    columns = zernike_values(*places, fit.terms)
    effects = np.linalg.lstsq((columns * root).T, (changes * root).T, rcond=None)[0]
    effects[:, : fit.effects.shape[1]] += fit.effects
    return replace(fit, effects=effects)


def optical_terms(
    smooth: SmoothTerms, fit: ZernikeFit, gaps: Gaps | None = None
) -> dict[str, UncertainValue]:
    """Return the terms of ISO 10110-5 for deviations along the normal of the surface, each [m].

    smooth: SYMMETRIC terms of the map and others;  fit: of all its terms
    gaps: between its points, None without any

    A (sagitta deviation) is the peak to valley of the power fitted together with piston and
    tilts; C that of the rotationally symmetric part of the rest. RMSt is the rms without piston
    and tilts, RMSi also without power, and RMSa the rms of the asymmetric rest.
    """
    map_ = smooth.map
    best_sphere, shares = (fitted(*smooth.sums(terms)) for terms in (POWER, SYMMETRIC))
    shares[: len(POWER)] -= best_sphere
    symmetric = np.concatenate([shares, _noise_of_rings(smooth)], axis=1)
    # A function of the distance from the middle, whose largest and least are kept.
    reach = np.argsort(np.hypot(map_.x - fit.disc.x, map_.y - fit.disc.y))
    few = reach[np.linspace(0, len(reach) - 1, min(len(reach), _MOST_POINTS)).astype(np.int64)]
    columns = zernike_values(*fit.disc.scaled(map_.x[few], map_.y[few]), SYMMETRIC)
    deviation, effects = symmetric[:, 0] @ columns, symmetric[:, 1:].T @ columns
    rings = replace(map_.part(few), deviation=deviation, effects=effects, noise=0.0)
    return {
        "iso10110_A": _sagitta(map_, fit, float(best_sphere[-1, 0])),
        "iso10110_C": extents_of_parts([rings], fit.disc)[0][0],
        "iso10110_RMSt": _rms_to_rim(smooth.without(TILT), gaps),
        "iso10110_RMSi": _rms_to_rim(smooth.without(POWER), gaps),
        "iso10110_RMSa": _rms_to_rim(smooth.without(SYMMETRIC), gaps),
    }


def _rms_to_rim(map_: DeviationMap, gaps: Gaps | None) -> UncertainValue:
    return rms_of_part(map_, gaps.square(map_.deviation) if gaps else (0.0, 0.0))


def _noise_of_rings(smooth: SmoothTerms) -> FloatArray:
    """Return the noise of the symmetric irregularity, as independent shares of SYMMETRIC (k, s)."""
    power, own = slice(len(POWER)), slice(len(POWER), None)
    gram, _ = smooth.sums(SYMMETRIC)
    places = smooth.disc.scaled(smooth.map.x, smooth.map.y)
    weighted = zernike_values(*places, SYMMETRIC[own]) * smooth.map.area
    half = fitted(gram[own, own], weighted @ weighted.T)
    covariance = fitted(gram[own, own], half.T)
    root = smooth.map.noise * root_of(covariance).T
    return np.concatenate([-fitted(gram[power, power], gram[power, own]) @ root, root])


def _sagitta(map_: DeviationMap, fit: ZernikeFit, power: float) -> UncertainValue:
    """Return twice the ``power`` that was fitted together with piston and tilts, over the area.

    On a whole disc that is the term of the fit. On a strip or a ring several terms of the fit
    share the power, and with them its uncertainty.
    """
    if ZernikeIndex(2, 0) not in fit.terms:
        return UncertainValue(None, None)
    few, places = map_.every(_MOST_POINTS), [fit.terms.index(term) for term in POWER]
    columns = zernike_values(*fit.disc.scaled(few.x, few.y), fit.terms)
    chosen = columns[places] * few.area
    shares = fitted(chosen @ columns[places].T, chosen @ columns.T)[-1]
    variance = shares @ fit.covariance @ shares + np.sum(np.square(shares @ fit.effects))
    # For heights that are metres off, the variance is rounding and may be negative.
    uncertainty = float(2 * np.sqrt(variance)) if variance >= 0 else None
    return UncertainValue(2 * abs(power), uncertainty)


@dataclass(frozen=True, eq=False, kw_only=True)
class FormResult:
    """Form of a part.

    registration: pose, and the disc of the terms;  aperture: of the part; unless it is known, the
        disc, rectangle or ellipse around the points that they cover best
    map: deviations of all points, or of an even selection of half a million
    deviation: figures by name;  zernike: terms of the deviation, one at the rim
    bands: wavelengths of the filters;  profiles, density: curves of the map
    counts: of the points by outcome; they add up to "read"
    dust: x, y and deviation of the points left out as dust (3, d) [m]
    uncovered: share of the aperture without points
    """

    registration: Registration
    aperture: Aperture
    map: DeviationMap
    deviation: dict[str, UncertainValue]
    zernike: ZernikeFit
    bands: texture.Bands
    profiles: dict[str, texture.UncertainCurve]
    density: texture.PowerDensity
    counts: dict[str, int]
    dust: FloatArray
    uncovered: float

    def doubts(self, *, decided: bool = False) -> list[Doubt]:
        """Return what the figures do not contain.  decided: points left out are known dust."""
        found = []
        if self.uncovered > _COVERED_WELL:
            found.append(Doubt(Notice("form.uncovered", share=self.uncovered), None))
        away = self.dust[2]
        if len(away) and not decided:
            largest = float(np.max(np.abs(away)))
            reason = Notice("form.excluded_points", count=len(away), largest=largest)
            height = float(np.ptp(np.append(self.map.deviation, MOST_UNSEEN * away)))
            found.append(Doubt(reason, height))
        return found


def analyse_form(
    surface: Surface, portions: PointBatches, asked: Sequence[str], *, sources: Sequence[str] = (),
    bounds: Sequence[str] = (), aperture: Aperture | None = None, even: bool = False,
    filters: tuple[float | None, float | None] = (None, None), dust: DustRule = ISOLATED,
    declared: Mapping[str, float] = MappingProxyType({}),
) -> FormResult:  # fmt: skip
    """Register the points and evaluate their deviations.

    As in :func:`register`, and  bounds: sources of which only an upper bound is known
    filters: wavelengths of the S- and the L-filter [m], None for the defaults

    Raises DataError for points that are too few, do not fit, or do not determine the pose.
    """
    surface, aperture = within_aperture(surface, aperture)
    how = {"sources": sources, "aperture": aperture, "even": even, "dust": dust}
    found = register(surface, portions, asked, declared=declared, **how)  # type: ignore[arg-type]
    gathered = _Gathered(surface, found, aperture, even)
    for portion in portions():
        for part in portion.chunks(CHUNK):
            gathered.add(part)
    slope = gathered.square_slope() if even and gathered.counts["used"] else None
    held = range(len(sources), found.moved.shape[1])  # Their offsets are upper bounds, too.
    x, y = places = gathered.places
    uncovered, outline = best_covered(x, y, found.spacing, aperture or found.disc, aperture is None)
    bounded = [*[n for n, s in enumerate(sources) if s in bounds], *held]
    map_ = gathered.map(found, area_weights(x, y, even=even, outline=outline), bounded)
    smooth, terms = SmoothTerms.of(map_, found.disc, ZERNIKES), ZERNIKES[: len(map_) // 2]
    strip = RimStrip.of(places, map_.area, outline, found.spacing, terms, found.disc)
    fit = fit_zernikes(
        map_.x, map_.y, map_.deviation, terms, found.disc,
        weights=map_.area, strip=strip, sums=smooth.sums(terms),
    )  # fmt: skip
    zernike = with_pose_uncertainty(fit, map_, found)
    cells = GridCells.of(map_, even=even)
    bands = texture.bands_of(cells, *filters)
    of_rim, guess = None if outline.outline == "annulus" else strip, aperture is None
    gaps = Gaps.of(map_, outline, found.spacing, of_rim, guessed=guess, uncovered=uncovered)
    del strip, of_rim  # it is as large as the map
    figures, textures = _figures(smooth, zernike, cells, bands, outline, gaps, gathered, slope)
    return FormResult(
        registration=found, aperture=outline, map=map_, zernike=zernike, bands=bands,
        deviation=figures | gathered.as_measured(map_) | textures,
        profiles=texture.profiles(map_, found.disc), density=texture.power_density(cells),
        counts=gathered.counts, dust=gathered.dust, uncovered=uncovered,
    )  # fmt: skip


def _figures(
    smooth: SmoothTerms, zernike: ZernikeFit, cells: GridCells, bands: texture.Bands,
    outline: Aperture, gaps: Gaps | None, gathered: _Gathered, slope: float | None,
) -> tuple[dict[str, UncertainValue], dict[str, UncertainValue]]:  # fmt: skip
    """Return figures of the map, and its texture with slopes;  cells: of it."""
    even, missed = gathered.even, gathered.missed
    map_, rest = smooth.map, smooth.without(SECOND_ORDER)
    rest_cells = GridCells.of(rest, even=even)
    maps = [map_, best_fit(map_), rest, smooth.without(POWER)]
    extents = extents_of_parts(maps, smooth.disc, gaps, missed)
    sizes = [_rms_to_rim(each, gaps) for each in maps[:3]]
    del maps, rest  # each is as large as the map
    figures = optical_terms(smooth, zernike, gaps) | {
        # Irregularity: the peak to valley without piston, tilts and power.
        "iso10110_B": extents[3][0],
        "robust_peak_to_valley": extents[0][1],
        "edge_roll_off": texture.edge_roll_off(map_, outline),
    }
    for k, name in enumerate(("", "_best_fit", "_without_second_order")):
        figures |= {f"peak_to_valley{name}": extents[k][0], f"rms{name}": sizes[k]}
    # An even grid was measured once: its scatter counts as texture.
    points = replace(smooth.without(FORM), noise_known=map_.noise_known and not even)
    formless = GridCells.of(points, even=even)
    # Without an S-filter the surface has waves that the cells do not resolve.
    if cells.width == 0 or bands.s_filter is not None:
        return figures, texture.texture(cells, formless, bands, None, rest_cells)
    points = short_waves(points, formless, bands.l_filter)
    textures = texture.texture(cells, formless, bands, points, rest_cells, slope)
    if even:
        height, more = textures["Sz"], sum(missed)
        doubt = length(height.uncertainty or 0.0, more)
        return figures, textures | {"Sz": UncertainValue((height.value or 0.0) + more, doubt)}
    whole = extents_of_parts([points], smooth.disc, gaps)[0][0]
    return figures, textures | {"Sq": _rms_to_rim(points, gaps), "Sz": whole}


class _Gathered:
    """Collects the deviations of points that come in portions."""

    def __init__(
        self, surface: Surface, found: Registration, aperture: Aperture | None, even: bool
    ) -> None:
        self._surface, self._found, self._aperture, self.even = surface, found, aperture, even
        self._kept = EvenSelection(MOST_WEIGHED)
        self.least, self.most = np.inf, -np.inf
        self._noise: list[tuple[float, float]] = []
        self._dust: list[FloatArray] = []
        self._grid: list[NDArray[np.float32]] = []
        self.counts = dict.fromkeys(
            ("read", "used", "not_finite", "beyond_surface", "outside_aperture", "outliers"), 0
        )

    def add(self, portion: PointBatch) -> None:
        """Add points."""
        finite = np.isfinite(portion.x) & np.isfinite(portion.y) & np.isfinite(portion.height)
        at, found = self._found.placement, self._found
        whole = placed(self._surface, at, portion)
        has_height = np.isfinite(whole.deviation)
        inside = np.ones(len(finite), bool)
        if self._aperture is not None:
            inside = self._aperture.holds(whole.x, whole.y)
        usable = has_height & inside
        good = usable & found.good(self.counts["read"], len(finite))
        shares = (np.ones_like(good), good, ~finite, finite & ~has_height, has_height & ~inside)
        for name, chosen in zip(self.counts, (*shares, usable & ~good), strict=True):
            self.counts[name] += int(np.count_nonzero(chosen))
        dust = whole.part(usable & ~good)
        self._dust.append(np.stack([dust.x, dust.y, dust.deviation]))
        if np.any(good):
            self._keep(whole.part(good), portion.systematic[:, good])
            if self.even:
                rows = portion.x[good], portion.y[good], whole.deviation[good]
                self._grid.append(np.array(rows, np.float32))

    def _keep(self, points: Placed, systematic: FloatArray) -> None:
        self.least = min(self.least, float(points.deviation.min()))
        self.most = max(self.most, float(points.deviation.max()))
        self._noise.append((noise_of(points.deviation), path_noise(points.deviation)))
        few = self._kept.chosen(len(points.x))
        part = Placed(*(values[..., few] for values in points))
        pose, along = self._found.effects(part, systematic[:, few])
        rows = [part.x, part.y, part.deviation, *pose, *along]
        self._kept.add_chosen(np.stack(rows, axis=1), len(points.x))

    @property
    def missed(self) -> tuple[float, float]:
        """How far points of a grid that were not kept reach below and above all others [m]."""
        kept, of_grid = self._kept.rows()[:, 2], float(self.even)
        return of_grid * float(kept.min() - self.least), of_grid * float(self.most - kept.max())

    def square_slope(self) -> float | None:
        """Return the mean square slope between the points of a grid [1], and let go of them."""
        rows, self._grid = np.concatenate(self._grid, axis=1), []
        grid = as_grid(MeasuredPoints(x=rows[0], y=rows[1], height=rows[2]))
        return None if grid is None else square_slope(grid.height, (grid.dx, grid.dy))

    @property
    def dust(self) -> FloatArray:
        """Places and deviations (3, d) [m] of the points left out as dust."""
        return np.concatenate(self._dust, axis=1)

    @property
    def places(self) -> FloatArray:
        """Places (2, n) [m] of the collected points; raises DataError if there are none."""
        if not self.counts["used"]:
            raise DataError("form.no_usable_point", counts=self.counts)
        return np.ascontiguousarray(self._kept.rows()[:, :2].T)

    def map(self, found: Registration, area: FloatArray, bounds: Sequence[int]) -> DeviationMap:
        """Return the collected deviations of points with ``area`` (n,).

        bounds: indices of the sources of which only an upper bound is known
        """
        rows = np.ascontiguousarray(self._kept.rows().T)
        noise, known, error = self._point_noise(rows, found.noise)
        return DeviationMap(
            x=rows[0], y=rows[1], deviation=rows[2], area=area, effects=rows[3:], noise=noise,
            noise_known=known, noise_error=error, moves=found.moves, taken=found.taken,
            bounds=len(found.pose_effects) + np.array(bounds, np.int64),
        )  # fmt: skip

    def as_measured(self, map_: DeviationMap) -> dict[str, UncertainValue]:
        """Return figures of the points, with noise and systematic errors."""
        found = {
            "peak_to_valley_of_points": self.most - self.least,
            "rms_of_points": float(np.sqrt(np.average(map_.deviation**2, weights=map_.area))),
            # A profile measured once does not tell noise from texture.
            "point_noise": map_.noise if map_.noise_known else None,
            "rms_before_fit": self._found.before,
        }
        return {name: UncertainValue(value, None) for name, value in found.items()}

    def _point_noise(self, rows: FloatArray, fitted: float) -> tuple[float, bool, float]:
        """Return the noise of a point [m], whether it is certainly no texture, and its error [m].

        Form adds to each estimate, so the least counts, and the next shows how much it may contain.
        """
        x, y, deviation = rows[:3]
        if (repeated := repeated_noise(x, y, deviation)) is not None:
            return repeated, True, 0.0
        spans = sorted((float(np.ptp(x)), float(np.ptp(y))))
        if spans[0] <= LINE_WIDTH * spans[1]:
            return *profile_noise(x if np.ptp(x) > np.ptp(y) else y, deviation), 0.0
        # Points may come in any order, where successive points are no neighbours.
        estimates = [*np.median(self._noise, axis=0), neighbour_noise(x, y, deviation)]
        least, next_ = sorted(map(float, [*estimates, fitted]))[:2]
        # The residual of the fit scatters least: a slightly smaller estimate is chance.
        if least < fitted < (1 + 2 * _CHANCE) * least:
            return fitted, True, fitted - least
        return least, True, length(next_ - least, _CHANCE * least)
