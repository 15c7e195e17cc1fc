"""Maps without some of their terms: what bending, focus or turning would take away.

Removal is linear, so that what an error does to the map goes the same way as the map.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omsm_ros.core.form.figures import DeviationMap
from omsm_ros.core.registration.placement import Aperture
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.zernike_terms import Term, terms_up_to, zernike_values

# Piston, both tilts and power; what a Gaussian of a quarter of the side takes for form; what a
# turned part has all around, to order 12.
POWER = (Term(0, 0), Term(1, -1), Term(1, 1), Term(2, 0))
_FORM = terms_up_to(4)
SYMMETRIC = tuple(Term(n, 0) for n in range(4, 14, 2))


def without(map_: DeviationMap, columns: FloatArray) -> DeviationMap:
    """Return the map without its area-weighted best sum of ``columns`` (k, n)."""
    weighted = columns * map_.area
    # Of points on a line some columns are the same; then the least solution serves.
    solve = np.linalg.pinv(weighted @ columns.T, rcond=1e-12, hermitian=True)
    values = np.concatenate([map_.deviation[np.newaxis], map_.effects])
    rest = values - (solve @ (weighted @ values.T)).T @ columns
    return replace(map_, deviation=rest[0], effects=rest[1:])


def best_fit(map_: DeviationMap) -> DeviationMap:
    """Return the map where the part sits as it fits best, in all that was fitted or held.

    What no move of the part explains: however it sat, so much deviates. Form that looks like a move
    is not in it, and neither is what the pose leaves open.
    """
    moves = map_.effects[map_.moves]
    size = np.sqrt(np.mean(moves**2, axis=1))
    return without(map_, moves[size > 0] / size[size > 0, np.newaxis])


def without_second_order(map_: DeviationMap) -> DeviationMap:
    """Return the map without its best ``Σ c_ij x^i y^j``, i + j ≤ 2."""
    u, v = (_scaled(values) for values in (map_.x, map_.y))
    return without(map_, np.stack([np.ones_like(u), u, v, u * u, u * v, v * v]))


def without_tilt(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the map without piston and tilts."""
    return without(map_, zernike_values(*disc.scaled(map_.x, map_.y), POWER[:3]))


def without_power(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the map without piston, tilts and power: the irregularity of ISO 10110-5."""
    return without(map_, zernike_values(*disc.scaled(map_.x, map_.y), POWER))


def without_form(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the map without Zernike terms up to order 4: the F-operation of ISO 25178-2.

    A Gaussian filter would leave them along the rim, where its window is cut off.
    """
    return without(map_, zernike_values(*disc.scaled(map_.x, map_.y), _FORM))


def asymmetric(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the map without power and without what is the same all around, up to order 12."""
    return without(map_, zernike_values(*disc.scaled(map_.x, map_.y), POWER + SYMMETRIC))


def _scaled(values: FloatArray) -> FloatArray:
    low, high = float(values.min()), float(values.max())
    return np.asarray((values - (low + high) / 2) / ((high - low) / 2 or 1.0), np.float64)
