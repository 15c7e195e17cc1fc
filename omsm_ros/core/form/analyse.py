"""From scattered points and a nominal surface to the form of the part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.form.cells import Cells
from omsm_ros.core.form.figures import (
    DeviationMap,
    Figure,
    noise_beside,
    root_mean_square,
)
from omsm_ros.core.form.open_place import with_open_place
from omsm_ros.core.form.optical_terms import optical_terms
from omsm_ros.core.form.part_figures import extents_of_part, rms_of_part
from omsm_ros.core.form.power_density import Curve, PowerDensity, power_density
from omsm_ros.core.form.profiles import profiles
from omsm_ros.core.form.removal import best_fit, without_form, without_second_order
from omsm_ros.core.form.texture import (
    Bands,
    bands_of,
    slopes_without_second_order,
    texture,
)
from omsm_ros.core.form.zernike_fit import ZernikeFit, fit_zernikes
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.registration.placement import (
    Aperture,
    Placed,
    Portion,
    Portions,
    placed,
)
from omsm_ros.core.registration.pose_budget import Registration
from omsm_ros.core.registration.register import CHUNK, register
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.core.samples.even_selection import EvenSelection
from omsm_ros.core.samples.scatter import noise_of
from omsm_ros.core.surface.area_weights import area_weights
from omsm_ros.core.surface.zernike_terms import first_terms
from omsm_ros.errors import DataError

ZERNIKES = first_terms(37, "fringe")
# Twelve numbers each make 50 MB. Extremes and counts are of all points.
MOST_WEIGHED = 2**19


@dataclass(frozen=True, eq=False, kw_only=True)
class Form:
    """The form of a part.

    registration: how it sits;  aperture: the disc of the part on which it is judged
    map: its deviations, of all points or of half a million and more, evenly chosen
    deviation: figures by their name;  zernike: terms of the deviation, one at the rim
    bands: wavelengths of the filters;  profiles, density: curves of the map
    counts: of the points, by what became of them; they add up to "read"
    """

    registration: Registration
    aperture: Aperture
    map: DeviationMap
    deviation: dict[str, Figure]
    zernike: ZernikeFit
    bands: Bands
    profiles: dict[str, Curve]
    density: PowerDensity
    counts: dict[str, int]


def analyse_form(
    surface: Surface,
    portions: Portions,
    asked: Sequence[str],
    *,
    sources: Sequence[str] = (),
    bounds: Sequence[str] = (),
    aperture: Aperture | None = None,
    even: bool = False,
    filters: tuple[float | None, float | None] = (None, None),
) -> Form:
    """Register the points and judge what they deviate by.

    portions: reads the points, see :class:`omsm_ros.core.registration.placement.Portion`
    asked: freedoms of the fit, or "auto";  sources: names of the systematic ones
    bounds: of these, the ones of which only an upper bound is known
    aperture: of the part; None: the disc about the part's origin that holds all points
    even: the points are those of an evenly spaced grid, each of the same area
    filters: wavelengths of the S- and the L-filter [m], None for what the points allow

    Raises DataError for points that are too few, do not fit, or do not determine a freedom.
    """
    found = register(surface, portions, asked, sources=sources, aperture=aperture, even=even)
    gathered = _Gathered(surface, found, aperture)
    for portion in portions():
        for begin in range(0, len(portion.x), CHUNK):
            gathered.add(Portion(*(v[..., begin : begin + CHUNK] for v in portion)))
    bounded = [n for n, name in enumerate(sources) if name in bounds]
    # What is held may be where it should: how far off it is at most is all that is known.
    bounded += range(len(sources), found.moved.shape[1])
    map_ = gathered.map(found, even, bounded)
    points = (map_.x, map_.y, map_.deviation)
    zernike = fit_zernikes(*points, ZERNIKES, found.disc, weights=map_.area, effects=map_.effects)
    zernike = with_open_place(zernike, map_, found)
    cells = Cells.of(map_)
    bands = bands_of(cells, *filters)
    return Form(
        registration=found,
        aperture=found.disc,
        map=map_,
        deviation=_figures(map_, gathered, found)
        | optical_terms(map_, zernike)
        | _textures(map_, cells, bands, found),
        zernike=zernike,
        bands=bands,
        profiles=profiles(map_, found.disc),
        density=power_density(cells),
        counts=gathered.counts,
    )


def _figures(map_: DeviationMap, gathered: _Gathered, found: Registration) -> dict[str, Figure]:
    rest = without_second_order(map_)
    whole, robust = extents_of_part(map_, found.disc)
    fitted = best_fit(map_)
    return {
        "peak_to_valley": whole,
        "robust_peak_to_valley": robust,
        "rms": rms_of_part(map_),
        "peak_to_valley_best_fit": extents_of_part(fitted, found.disc)[0],
        "rms_best_fit": rms_of_part(fitted),
        "peak_to_valley_without_second_order": extents_of_part(rest, found.disc)[0],
        "rms_without_second_order": rms_of_part(rest),
        # As measured: what errors have added is in them.
        "peak_to_valley_of_points": Figure(gathered.extent, None),
        "rms_of_points": Figure(root_mean_square(map_), None),
        "point_noise": Figure(map_.noise, None),
        # Before the fit the pose is part of the deviation, and its uncertainty is not asked for.
        "rms_before_fit": Figure(found.before, None),
    }


def _textures(
    map_: DeviationMap, cells: Cells, bands: Bands, found: Registration
) -> dict[str, Figure]:
    formless, rest = without_form(map_, found.disc), without_second_order(map_)
    return texture(cells, Cells.of(formless), bands) | slopes_without_second_order(
        Cells.of(rest), bands
    )


class _Gathered:
    """The points in the part's frame, while they pass."""

    def __init__(self, surface: Surface, found: Registration, aperture: Aperture | None) -> None:
        self._surface, self._found, self._aperture = surface, found, aperture
        self._kept = EvenSelection(MOST_WEIGHED)
        self._least, self._most = np.inf, -np.inf
        self._noise: list[float] = []
        self.counts = dict.fromkeys(
            ("read", "used", "not_finite", "beyond_surface", "outside_aperture", "outliers"), 0
        )

    def add(self, portion: Portion) -> None:
        """Take in the next points."""
        finite = np.isfinite(portion.x) & np.isfinite(portion.y) & np.isfinite(portion.height)
        at, found = self._found.placement, self._found
        whole = placed(self._surface, at, portion)
        has_height = np.isfinite(whole.deviation)
        inside = np.ones(len(finite), bool)
        if self._aperture is not None:
            inside = self._aperture.holds(whole.x, whole.y)
        good = np.zeros(len(finite), bool)
        chosen = has_height & inside
        good[chosen] = found.good(whole.part(chosen))
        self._count(finite, has_height, inside, good)
        if np.any(good):
            self._keep(whole.part(good), portion.systematic[:, good])

    def _count(
        self, finite: BoolArray, has_height: BoolArray, inside: BoolArray, good: BoolArray
    ) -> None:
        for name, chosen in (
            ("read", np.ones(len(good), bool)),
            ("used", good),
            ("not_finite", ~finite),
            ("beyond_surface", finite & ~has_height),
            ("outside_aperture", has_height & ~inside),
            ("outliers", has_height & inside & ~good),
        ):
            self.counts[name] += int(np.count_nonzero(chosen))

    def _keep(self, points: Placed, systematic: FloatArray) -> None:
        self._least = min(self._least, float(points.deviation.min()))
        self._most = max(self._most, float(points.deviation.max()))
        self._noise.append(noise_of(points.deviation))
        # What a source does to the heights, and what the pose that follows it takes away again.
        pose, along = self._found.effects(points, systematic)
        rows = [points.x, points.y, points.deviation, *pose, *along]
        self._kept.add(np.stack(rows, axis=1))

    @property
    def extent(self) -> float:
        """Largest minus smallest deviation of all points [m]."""
        return float(self._most - self._least)

    def map(self, found: Registration, even: bool, bounds: Sequence[int]) -> DeviationMap:
        """Return the deviations gathered. Raises DataError if there are none.

        bounds: places of the sources of which only an upper bound is known
        """
        if not self.counts["used"]:
            raise DataError(f"no point can be used: {self.counts!r}; check aperture and surface")
        rows = np.ascontiguousarray(self._kept.rows().T)
        return DeviationMap(
            x=rows[0],
            y=rows[1],
            deviation=rows[2],
            area=area_weights(rows[0], rows[1], even=even),
            effects=rows[3:],
            # Points need not come in the order of a path; then their neighbours are elsewhere.
            noise=min(float(np.median(self._noise)), noise_beside(*rows[:3]), found.noise),
            # The sources' effects stand behind those of the pose.
            bounds=len(found.pose_effects) + np.array(bounds, np.int64),
            moves=found.moves,
            taken=found.taken,
        )
