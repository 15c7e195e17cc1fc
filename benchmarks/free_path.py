"""Identify from continuous motions, and compare with the true response of the twin.

The motions are the paper's chirp, a faster one, and several sines at once, also cut out of the
middle, so that they start and end in motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.against_truth import band_held
from benchmarks.recorded import record_from_arrays
from benchmarks.row import Row, at_most
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.kinematics.trajectories import AxisPositions, Chirp, Motion
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord, assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant

_FIRST_SEED = 7000
_OMEGA = 2 * np.pi * 60
_LIGHT_MODE = Plant(TransferFunction.from_ascending([1.0], [1.0, 0.04 / _OMEGA, _OMEGA**-2]))
_FAST = Chirp(end_frequency=50.0, peak_to_peak=20e-6)
_WHOLE, _MIDDLE = slice(None), slice(7321, 21_117)


@dataclass(frozen=True, slots=True)
class Multisine:
    """Z swings at several ``frequencies`` [Hz] at once, each with ``amplitude`` [m].

    Their phases keep the peak low (Schroeder 1970). It oscillates also before its start.
    """

    frequencies: tuple[float, ...] = (0.7, 1.3, 2.9, 5.1, 7.7, 11.3, 14.9)
    amplitude: float = 3e-6
    duration: float = 20.0

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]."""
        count, z = len(self.frequencies), np.zeros_like(time)
        for k, frequency in enumerate(self.frequencies):
            z = z + np.cos(2 * np.pi * frequency * time - np.pi * k * k / count)
        still = np.zeros_like(time)
        return AxisPositions(still, still, self.amplitude * z, still, still)


# name, motion, plant, part of the recording, highest frequency in that part [Hz]
_CASES: tuple[tuple[str, Motion, Plant, slice, float], ...] = (
    ("chirp", Chirp(), Plant(), _WHOLE, 15.0),
    ("middle of a chirp, light mode", Chirp(), _LIGHT_MODE, _MIDDLE, 12.7),
    ("middle of a chirp to 50 Hz, light mode", _FAST, _LIGHT_MODE, _MIDDLE, 42.2),
    ("sines", Multisine(), Plant(), _WHOLE, 14.9),
    ("sines, light mode", Multisine(), _LIGHT_MODE, _WHOLE, 14.9),
)


def rows(full: bool) -> Iterator[Row]:
    """Yield the least share of bands that hold the truth, and how far the band is valid."""
    runs = 100 if full else 4
    for name, motion, plant, part, reaches in _CASES:
        found = [
            identify(_recorded(seed, motion, plant, part)).calibration
            for seed in range(_FIRST_SEED, _FIRST_SEED + runs)
        ]
        yield from band_held(name, found, plant.dynamics)
        trusted = max(c.valid_up_to for c in found) / reaches
        yield at_most(
            f"valid up to, over its highest frequency, {name}", trusted, "", 1.3, runs=runs
        )


def _recorded(seed: int, motion: Motion, plant: Plant, part: slice) -> MotionRecord:
    made = record(Cell(plant=plant, seed=seed), motion, Flat())
    whole = assemble([made.axes], [made.distance])
    return record_from_arrays(whole.sample_period, whole.z[part], whole.distance[part])
