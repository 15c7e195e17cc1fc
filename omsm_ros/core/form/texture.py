"""Texture and slope of a map: ISO 25178-2 parameters, band-limited rms, ISO 10110-14 slopes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.form.cells import Cells
from omsm_ros.core.form.figures import Figure
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import DataError

# Any, but one: the same points have the same figures.
_NOISE_SEED = 21
# An S-filter below this many cells would pass what cells fold; beyond it half a sine passes.
_LEAST_CELLS = 3.0
# Ends of the bands, as shares of the longest side: form, waviness, and what is finer.
_BANDS = {"form": (np.inf, 1 / 4), "waviness": (1 / 4, 1 / 20), "finer": (1 / 20, 0.0)}
# What is longer is form, by the bands above.
_DEFAULT_L = 1 / 4


@dataclass(frozen=True, slots=True)
class Bands:
    """Wavelengths [m] at which half passes: of the S- and the L-filter, and of the bands of rms."""

    s_filter: float
    l_filter: float
    rms_bands: dict[str, tuple[float | None, float]]


def bands_of(cells: Cells, s_filter: float | None = None, l_filter: float | None = None) -> Bands:
    """Return the wavelengths asked for, or else three cells, and a quarter of the longest side.

    Raises DataError where the two leave nothing between them.
    """
    across = max(cells.present.shape) * cells.pitch
    shortest = max(s_filter or 0.0, _LEAST_CELLS * cells.pitch)
    longest = l_filter or _DEFAULT_L * across
    if l_filter is not None and longest <= shortest:
        raise DataError(
            f"L-filter of {longest!r} m leaves nothing beside the S-filter of {shortest!r} m, as "
            "the points allow it; give a longer --l-filter, or measure more points"
        )
    ends = {
        name: (None if long == np.inf else long * across, max(short * across, shortest))
        for name, (long, short) in _BANDS.items()
    }
    found = {name: (long, short) for name, (long, short) in ends.items() if (long or 1e9) > short}
    return Bands(shortest, longest, found)


@dataclass(frozen=True, eq=False)
class _Filtered:
    """One band of the cells: the map, the map under as much noise again, and what errors do."""

    values: FloatArray
    noisier: FloatArray
    effects: FloatArray

    def figure(self, of: Callable[[FloatArray], float]) -> Figure:
        """Return a figure of the values, its uncertainty from noise and from every effect."""
        value = of(self.values)
        noise = (of(self.noisier) - value) / (np.sqrt(2) - 1)
        shares = [(of(self.values + e) - of(self.values - e)) / 2 for e in self.effects]
        return Figure(value, float(np.sqrt(noise**2 + np.sum(np.square(shares)))))


def texture(cells: Cells, formless: Cells, bands: Bands) -> dict[str, Figure]:
    """Return Sa, Sq, Sz [m], Ssk, Sku [1] of the S-L surface, rms by band [m], slopes [1].

    formless: the same cells after the F-operation, of which the L-filter leaves the fine part
    """
    surface = _band(formless, bands.l_filter, bands.s_filter)
    found = {name: surface.figure(of) for name, of in _PARAMETERS.items()}
    for name, (long, short) in bands.rms_bands.items():
        found[f"rms_{name}"] = _band(formless if long else cells, long, short).figure(_rms)
    return found | _slope_figures(cells, bands)


def slopes_without_second_order(rest: Cells, bands: Bands) -> dict[str, Figure]:
    """Return the rms slope [1] of cells whose second order was taken off."""
    return {"slope_rms_without_second_order": _slope_figures(rest, bands)["slope_rms"]}


def _slope_figures(cells: Cells, bands: Bands) -> dict[str, Figure]:
    smooth = _band(cells, None, bands.s_filter, whole=True)
    if not len(_slopes(smooth.values, cells)):
        return dict.fromkeys(("slope_rms", "slope_largest"), Figure(None, None))
    return {
        "slope_rms": smooth.figure(lambda image: _rms_about_zero(_slopes(image, cells))),
        "slope_largest": smooth.figure(lambda image: float(np.max(_slopes(image, cells)))),
    }


def _band(cells: Cells, long: float | None, short: float, whole: bool = False) -> _Filtered:
    """Return what has wavelengths from ``short`` to ``long``: present cells, or whole images.

    The L-filter takes its share of what the S-filter left (ISO 25178-2), not of the cells.
    """
    more = np.random.default_rng(_NOISE_SEED).normal(size=cells.mean.shape) * cells.noise
    images = np.concatenate([[cells.mean, more], cells.effects])
    fine = cells.smoothed(images, short)
    if long is not None:
        fine = fine - cells.smoothed(fine, long)
    rows = fine if whole else fine[:, cells.present]
    return _Filtered(rows[0], rows[0] + rows[1], rows[2:])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean((values - values.mean()) ** 2)))


def _moment(values: FloatArray, order: int) -> float:
    size = _rms(values)
    return float(np.mean(((values - values.mean()) / size) ** order)) if size > 0 else 0.0


_PARAMETERS: dict[str, Callable[[FloatArray], float]] = {
    "Sa": lambda values: float(np.mean(np.abs(values - values.mean()))),
    "Sq": _rms,
    "Sz": lambda values: float(np.ptp(values)),
    "Ssk": lambda values: _moment(values, 3),
    "Sku": lambda values: _moment(values, 4),
}


def _rms_about_zero(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _slopes(image: FloatArray, cells: Cells) -> FloatArray:
    """Return the slopes (k,) over two cells where all neighbours are there; of a row, along it."""
    ways = [axis for axis, size in enumerate(image.shape) if size > 1]
    inside = cells.present.copy()
    square = np.zeros(image.shape)
    for axis in ways:
        before, after = (np.roll(image, way, axis) for way in (1, -1))
        square += (after - before) ** 2
        # What is rolled in from the other side is no neighbour.
        there = np.pad(cells.present, [(1, 1) if n == axis else (0, 0) for n in (0, 1)])
        size = image.shape[axis]
        inside &= there.take(range(size), axis) & there.take(range(2, size + 2), axis)
    return np.asarray(np.sqrt(square[inside]) / (2 * cells.pitch)) if ways else np.empty(0)
