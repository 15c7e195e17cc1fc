"""How fast are correction, identification and the choice of an order, and against their peers?

PyDynamic is the peer for propagating uncertainty through a recursive filter; it is optional,
and needs NumPy below 2.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from time import process_time

import numpy as np
from scipy import signal

from benchmarks.correction import SOURCES, corrected, identified_calibration
from benchmarks.identification import record_once
from benchmarks.row import Row, at_least, at_most, not_compared
from benchmarks.step_test import StepTest
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.estimation.sampled_choice import choose_sampled
from omsm_ros.core.estimation.sampled_fit import SampledRecord
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.twin.cell import Recording, blocks_of

PAPER_POINTS = 290_011


def _synthetic(samples: int) -> tuple[AxisBlock, DistanceBlock]:
    """Six channels of the paper's kind of motion, without running the twin."""
    time = np.arange(samples) * 1e-3
    c = np.pi * time
    z = 0.5e-3 * np.cos(c) + 0.05e-3 * np.cos(3 * c)
    x, zero = np.linspace(14.5e-3, 0.0, samples), np.zeros(samples)
    place = {"stamp_ns": 0, "first_sample": 0, "sample_period": 1e-3}
    return (
        AxisBlock(**place, x=x, y=zero, z=z, b=zero, c=c),  # type: ignore[arg-type]
        DistanceBlock(**place, distance=1e-6 * np.sin(5 * c)),  # type: ignore[arg-type]
    )


def _seconds(work: Callable[[], object], repeats: int = 5) -> float:
    """The quickest of some runs: what the work costs when nobody else wants the machine."""
    times = []
    for _ in range(repeats):
        begin = process_time()
        work()
        times.append(process_time() - begin)
    return min(times)


def rows(full: bool) -> list[Row]:
    """A whole scan at once, ten times as much, live blocks, and the peer."""
    del full  # it takes seconds
    calibration = identified_calibration()
    one, ten = _synthetic(PAPER_POINTS), _synthetic(10 * 80_000)
    tenth = _synthetic(80_000)
    whole = _seconds(lambda: corrected(calibration, *one))
    factor = _seconds(lambda: corrected(calibration, *ten), 3) / _seconds(
        lambda: corrected(calibration, *tenth)
    )
    peer = _peer_seconds_per_sample(calibration, one[0].z)
    table = [
        at_most("290 011 samples x 6 with uncertainty", whole, "s", 0.3),
        at_most("ten times the samples, time factor", factor, "1", 11.0),
        at_most("one live pair of blocks of 100", 1e3 * _live_seconds(calibration), "ms", 0.5),
        at_most("model of 3000 samples, order chosen", *_choice_seconds()),
    ]
    name = "times as fast as PyDynamic's IIRuncFilter"
    if peer is None:
        table.append(not_compared(name, "1", ">= 25", "needs PyDynamic and NumPy below 2.4"))
    else:
        table.append(at_least(name, peer * PAPER_POINTS / whole, "1", 25.0, "PyDynamic"))
    return [*table, *_identification()]


def _identification() -> list[Row]:
    """Processor time of one identification, and how it grows with the data."""
    short, long = record_once(1), record_once(1, StepTest(dwell=5.0))
    once, tenfold = (_seconds(partial(identify, r), 3) for r in (short, long))
    return [
        at_most("identification of 20 steps at 1 kHz, processor time", once, "s", 2.0),
        at_most("time for ten times the data", tenfold / once, "x", 12.0),
    ]


def _choice_seconds() -> tuple[float, str, float, str]:
    """Processor time of the free choice of an order behind a hold."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], 750), 4)
    # A mode of 0.87 Hz at 10 Hz, from rest.
    y = signal.lfilter([0.0, 0.142, 0.135], [1.0, -1.584, 0.861], u) + rng.normal(0, 0.05, 3000)
    record = SampledRecord(u[:, np.newaxis], y, np.ones(3000, np.bool_))
    return _seconds(lambda: choose_sampled([record], "zero-order"), 2), "s", 3.0, "three seconds"


def _live_seconds(calibration: Calibration) -> float:
    axes, distance = _synthetic(20_000)
    truth = np.zeros(len(axes))
    made = Recording(axes=axes, distance=distance, probe_motion=truth, surface_height=truth)
    pairs = blocks_of(
        replace(
            made,
            distance=replace(
                distance,
                intensity=np.ones(len(axes), np.float32),
                status=np.zeros(len(axes), np.uint8),
            ),
        )
    )

    corrector = Corrector(calibration, CorrectionOptions(sources=SOURCES))

    def live() -> None:
        for a, d in pairs:
            corrector.push_axes(a)
            corrector.push_distance(d)
            corrector.take()
        corrector.finish()

    # The first run also designs the filters, which happens once.
    return _seconds(live, 4) / len(pairs)


def _peer_seconds_per_sample(calibration: Calibration, z: np.ndarray) -> float | None:
    """PyDynamic's filter with coefficient covariance, on a part of the same path [s]."""
    try:
        from PyDynamic.uncertainty.propagate_filter import IIRuncFilter
    except ImportError:
        return None
    if np.lib.NumpyVersion(np.__version__) >= "2.4.0":
        # PyDynamic 2.5.1 writes arrays of one element into scalars, which NumPy 2.4 refuses.
        return None
    b, a = signal.sos2tf(discretise(calibration.dynamics, 1e-3).sections)
    used = z[:8000]
    coefficients = np.diag((1e-6 * np.r_[a[1:], b]) ** 2)
    return _seconds(lambda: IIRuncFilter(used, 4e-10, b, a, coefficients), 2) / len(used)
