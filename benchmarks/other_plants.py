"""Identify plants other than the paper's: modes, a delay, masses and springs.

The motion is the default step test, unless a row says otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.against_truth import band_held, inside, mass_errors, mode_errors, over_stated, worst
from benchmarks.identification import record_once, rms, seeds
from benchmarks.recorded import two_mass_response
from benchmarks.row import Row, at_least, at_most, between
from benchmarks.step_test import StepTest
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.modes import FITTED, TwoMass, known_modes
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.twin.plant import Plant

MACHINE = TwoMass(m1=10.0, m2=2.0, k1=2e6, k2=4e5, c1=450.0, c2=60.0)
_OMEGA = 2 * np.pi * 60
LONE_MODE = TransferFunction.from_ascending([1.0], [1.0, 0.04 / _OMEGA, _OMEGA**-2])


def rows(full: bool) -> Iterator[Row]:
    """Yield the rows of every study; few runs of each unless ``full``."""
    runs = 20 if full else 3
    yield from modes_and_delay(runs, 3 if full else 1)
    yield from wrong_orders(3 * runs)
    yield from two_masses(2 * runs)


def modes_and_delay(runs: int, fast_runs: int) -> list[Row]:
    """Return errors of a single mode, a delay, and the pole pair of Eq. 12 at 10 kHz."""
    late = TransferFunction(np.ones(1), np.ones(1), 0.7e-3)
    lone, delayed = identified(LONE_MODE, runs), identified(late, runs)
    sharp = StepTest(rise=0.0)
    fast = [identify(record_once(s, sharp, period=1e-4)).calibration for s in seeds(fast_runs)]
    frequency, damping = mode_errors(lone, LONE_MODE, 0)
    pair, pair_damping = mode_errors(fast, Plant().dynamics, 0)
    off = [c.dynamics.low_frequency_delay - late.delay for c in delayed]
    stated = [c.certificate.response.low_frequency_delay_uncertainty_s for c in delayed]
    pair_off = 100 * worst(pair)
    over = over_stated(pair)
    return [
        at_most("frequency of a lone 60 Hz mode", 100 * worst(frequency), "%", 0.1, runs=runs),
        at_most("its damping of 2 %", 100 * worst(damping), "%", 5, runs=runs),
        at_most("a delay of 0.7 ms", 1e6 * float(np.max(np.abs(off))), "us", 5, runs=runs),
        at_most("pole pair of Eq. 12 at 10 kHz", pair_off, "%", 1, runs=fast_runs),
        at_most("its damping", 100 * worst(pair_damping), "%", 5, runs=fast_runs),
        inside("frequency of a lone 60 Hz mode", lone, *frequency),
        inside("damping of a lone 60 Hz mode", lone, *damping),
        inside("delay of 0.7 ms", delayed, np.array(off), np.array(stated)),
        at_most("pole pair of Eq. 12, error over stated", over, "", 3, runs=fast_runs),
    ]


def wrong_orders(runs: int) -> list[Row]:
    """Return coverage for wrong orders: rejected, or the band holds the truth."""
    first_order = TransferFunction.from_ascending([1.0], [1.0, 3e-3])
    table = []
    for order, truth, name in (
        (3, first_order, "first order as third"),
        (1, LONE_MODE, "60 Hz mode as first order"),
        (2, two_mass_response(MACHINE, collocated=False), "two masses as second order"),
        (1, Plant().dynamics, "Eq. 12 as first order"),
    ):
        table += band_held(name, identified(truth, runs, order), truth)
    return table


def two_masses(runs: int) -> list[Row]:
    """Return errors of modes, masses, springs and dampers over their stated uncertainty."""
    table = []
    for name in ("non-collocated", "collocated"):
        truth = two_mass_response(MACHINE, collocated=name == "collocated")
        found = identified(truth, runs)
        for index, mode in enumerate(known_modes(truth)):
            what = f"frequency of {mode.frequency:.0f} Hz mode, {name}"
            table.append(inside(what, found, *mode_errors(found, truth, index)[0]))
        errors = mass_errors(found, MACHINE, collocated=name == "collocated")
        recognised = 100 * len(errors.over_stated) / runs
        table.append(at_least(f"recognised as {name}", recognised, "%", 95, runs=runs))
        # An rms of n runs scatters by 1/√(2n), relative.
        off = 2 / np.sqrt(2 * max(len(errors.over_noise), 1)) + 0.1
        low, high = round(1 - off, 2), round(1 + off, 2)
        for part, stated, noise in zip(FITTED, *map(rms, errors), strict=True):
            what = f"{part}, {name}"
            table += [
                at_most(f"rms error over stated, {what}", stated, "", high, runs=runs),
                between(f"  over what noise does, {what}", noise, "", low, high, runs=runs),
            ]
    return table


def identified(truth: TransferFunction, runs: int, order: int = 0) -> list[Calibration]:
    """Return the calibrations of one recording per seed."""
    return [
        identify(record_once(s, plant=Plant(truth)), order=order).calibration for s in seeds(runs)
    ]
