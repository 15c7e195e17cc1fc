"""Compare stated uncertainties of PV, rms and Zernike terms with the errors of repeated scans.

Every scan is of another part on another machine: each source, including the part's pose, is drawn
from its stated distribution, and the calibration comes from a separate step test. The true value
is the figure error of the part after removal of the fit. It is 0.1 to 1 µm: for smaller values PV
and rms, which cannot be negative, would nearly always lie within their uncertainty.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from benchmarks.drawn_machine import (
    ABBE_ARM_M,
    LATENCY_S,
    LATENCY_UNCERTAINTY_S,
    PRIORS,
    drawn,
    stated,
)
from benchmarks.row import Row, between, shown
from omsm_ros.core.calibration.calibration import Calibration, with_latency
from omsm_ros.core.calibration.latency import declared_latency
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.machine_sources import scan_budget
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.systematic import ScanFields, scan_fields
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.form.analyse import FormResult, analyse_form
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.twin.cell import Cell, Recording, record
from omsm_ros.twin.part import FigureError
from omsm_ros.twin.scenario import Scenario, planned_test_of, spiral_of
from omsm_ros.units import NANOMETRE_M

TERMS, PLACES = 15, 40_000
# Eight turns per ring of the part's ripple, so that the scan resolves it; every fifth point, which
# takes a twelfth of the time.
FEED_M, EVERY = 2e-4, 5
# Each machine is calibrated once and measures several parts, as a step test takes longer.
MACHINES = 20
NONE = ScanFields((), np.empty((0, 0)), 1)
FITS = (("piston",), ("piston", "tip", "tilt"))


@dataclass(frozen=True, eq=False)
class Scan:
    """The measured form of a corrected scan, and the true form."""

    measured: FormResult
    true: FormResult


def scans(seed: int, feed: float = FEED_M) -> list[Scan]:
    """Calibrate, scan, correct and evaluate one machine and part, for each of ``FITS``."""
    machine = seed % MACHINES
    scenario, errors = Scenario(seed=seed, feed_per_turn=feed), drawn(machine, seed)
    part = _part(seed)
    # Another seed than the part's, so that noise and part are independent.
    cell = Cell(seed=seed + 1, disturbances=errors.scan)
    made = record(cell, spiral_of(scenario), part)
    points, fields = _corrected(_calibrated(machine), made)
    return [_judged(points, fields, part, fitted) for fitted in FITS]


def _judged(
    points: SurfacePoints, fields: ScanFields, part: FigureError, fitted: Sequence[str]
) -> Scan:
    acting = fields.at(0, len(points.x))
    rows = (points.x, points.y, points.height, *acting)
    x, y, height, *systematic = (row[::EVERY] for row in rows)
    portion = PointBatch(x, y, height, np.reshape(systematic, (-1, len(x))))
    measured = _form(portion, fitted, fields)
    x, y = _everywhere(measured.aperture.radius)
    true = PointBatch(x, y, part.height(x, y), np.empty((0, len(x))))
    return Scan(measured, _form(true, fitted, NONE))


def _everywhere(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points x, y [m] evenly over a disc (H. Vogel, Math. Biosci. 44, 179).

    The stated uncertainty of a scan covers the surface between its turns, too.
    """
    k = np.arange(PLACES) + 0.5
    angle = np.pi * (3 - np.sqrt(5)) * k
    from_centre = radius * np.sqrt(k / PLACES)
    return from_centre * np.cos(angle), from_centre * np.sin(angle)


def _part(seed: int) -> FigureError:
    """Return the paper's mirror with its figure error, or up to ten times that."""
    usual = Scenario(seed=seed).part
    size = 10 ** np.random.default_rng(seed).uniform(0.0, 1.0)
    return replace(
        usual,
        astigmatism=size * usual.astigmatism,
        trefoil=size * usual.trefoil,
        ripple=size * usual.ripple,
    )


@lru_cache(MACHINES)
def _calibrated(machine: int) -> Calibration:
    """Calibrate this machine by a planned step test without drift, with a declared latency."""
    test = planned_test_of(Scenario(seed=1000 + machine), drawn(machine, 0).quiet)
    made = identify(test.motion_record(), settings={"priors": PRIORS}).calibration
    lag = made.dynamics.low_frequency_delay
    latency = declared_latency(
        lag, LATENCY_S, LATENCY_UNCERTAINTY_S, "measured with a light switch"
    )
    return with_latency(made, latency)


def _corrected(calibration: Calibration, made: Recording) -> tuple[SurfacePoints, ScanFields]:
    sources = replace(ErrorSources.of(calibration), **stated().point_uncertainties())
    # The arm declares the pitch error; no correction uses it.
    geometry = Geometry(abbe_arm=ABBE_ARM_M)
    options = CorrectionOptions(sources=sources, accept_other_rate=True, geometry=geometry)
    corrector = Corrector(calibration, options)
    corrector.push_axes(made.axes)
    corrector.push_distance(made.distance)
    points = join_points([corrector.finish()])
    trace = corrector.trace.points().with_slopes(PAPER_MIRROR)
    budget = scan_budget(calibration, sources, corrector.budget, geometry, stated(), trace)
    return points, scan_fields(budget.fields, corrector.trace.every, budget.bounds)


def _form(portion: PointBatch, fitted: Sequence[str], fields: ScanFields) -> FormResult:
    return analyse_form(
        PAPER_MIRROR, lambda: [portion], fitted, sources=fields.names, bounds=fields.bounds
    )


def deviations(scan: Scan) -> dict[str, tuple[float, float]]:
    """Return error and stated standard uncertainty of each figure [m]."""
    found: dict[str, tuple[float, float]] = {}
    for name in ("peak_to_valley", "robust_peak_to_valley", "rms"):
        stated_figure, true = scan.measured.deviation[name], scan.true.deviation[name]
        found[name] = stated_figure.value - true.value, stated_figure.uncertainty
    reported_terms, true_terms = scan.measured.zernike, scan.true.zernike
    errors = reported_terms.coefficients - true_terms.coefficients
    for k in range(TERMS):
        found[f"zernike {k + 1}"] = float(errors[k]), float(reported_terms.uncertainty[k])
    return found


def rows(full: bool) -> Iterator[Row]:
    """Yield coverage at k = 2, and rms error over rms stated uncertainty."""
    runs = 200 if full else 6
    bars = (92.0, 98.0) if full else (60.0, 100.0)
    by_fit: list[dict[str, list[tuple[float, float]]]] = [{} for _ in FITS]
    for seed in range(1, runs + 1):
        for found, scan in zip(by_fit, scans(seed), strict=True):
            for name, pair in deviations(scan).items():
                found.setdefault(name, []).append(pair)
    for fitted, found in zip(FITS, by_fit, strict=True):
        terms = [p for name, pairs in found.items() if name.startswith("zernike") for p in pairs]
        groups = {n: p for n, p in found.items() if not n.startswith("zernike")}
        for name, pairs in (groups | {f"first {TERMS} Zernike terms": terms}).items():
            label = f"{name.replace('_', ' ')}, {len(fitted)} fitted"
            yield from _coverage(label, np.array(pairs), bars)


def _coverage(label: str, pairs: np.ndarray, bars: tuple[float, float]) -> Iterator[Row]:
    error, spread = pairs.T
    covered = 100 * np.mean(abs(error) <= 2 * spread)
    yield between(f"{label}: truth within k = 2", covered, "%", *bars, runs=len(pairs))
    stated_ = float(np.sqrt(np.mean(spread**2)))
    ratio = float(np.sqrt(np.mean(error**2))) / stated_
    yield shown(f"{label}: rms error / stated", ratio, "1", stated_ / NANOMETRE_M, len(pairs))
