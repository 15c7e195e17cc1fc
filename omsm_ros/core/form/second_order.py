"""What is left without tilt, power and astigmatism, as an optic's bending would take them away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omsm_ros.core.form.figures import DeviationMap
from omsm_ros.core.samples.blocks import FloatArray


def without_second_order(map_: DeviationMap) -> DeviationMap:
    """Return the map without its area-weighted best ``Σ c_ij x^i y^j``, i + j ≤ 2."""
    u, v = (_scaled(values) for values in (map_.x, map_.y))
    columns = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v])
    weighted = columns * map_.area
    # Of points on a line some columns are the same; then the least solution serves.
    solve = np.linalg.pinv(weighted @ columns.T, rcond=1e-12, hermitian=True)
    values = np.concatenate([map_.deviation[np.newaxis], map_.effects])
    rest = values - (solve @ (weighted @ values.T)).T @ columns
    return replace(map_, deviation=rest[0], effects=rest[1:])


def _scaled(values: FloatArray) -> FloatArray:
    low, high = float(values.min()), float(values.max())
    return np.asarray((values - (low + high) / 2) / ((high - low) / 2 or 1.0), np.float64)
