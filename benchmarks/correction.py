"""Measure errors of the correction, and compare them with the stated uncertainties."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy import signal

from benchmarks.row import Row, at_most, shown
from benchmarks.twin_motions import step_test_of
from omsm_ros.core.adjustment.resolved_calibration import reversal
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.lti.discretisation import bilinear, discretisation_error, discretise
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M
from omsm_ros.pipelines.recording import scan_data
from omsm_ros.twin.cell import Cell, Recording, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.scenario import Scenario
from omsm_ros.units import MICROSECOND_S, NANOMETRE_M

# The probe's noise and resolution, 10 nm each, at the scale of the surface.
_FLOOR_M = float(np.hypot(10, 10 / np.sqrt(12))) * NANOMETRE_M / PAPER_STATIC_GAIN
SOURCES = ErrorSources(
    probe_noise=10 * NANOMETRE_M,
    probe_resolution=10 * NANOMETRE_M,
    encoder_noise=0.4 * NANOMETRE_M,
    static_gain=1e-5,
)


def true_calibration(relative: float = 1e-3) -> Calibration:
    """Return the plant's dynamics, each parameter except G(0) known to ``relative``."""
    g = Plant().dynamics
    deviations = relative * abs(np.concatenate([g.numerator, g.denominator[1:], [0.0]]))
    deviations[0] = 0.0
    return Calibration(
        dynamics=g,
        static_gain=PAPER_STATIC_GAIN,
        sample_period=1e-3,
        valid_up_to=100.0,
        covariance=np.diag(deviations**2),
    )


def identified_calibration(seed: int = 1) -> Calibration:
    """Identify from the paper's step test on the twin."""
    test = step_test_of(Scenario(seed=seed))
    return identify(assemble([test.axes], [test.distance])).calibration


def scan(spindle_speed: float = 30.0, seed: int = 2, cell: Cell | None = None) -> Recording:
    """Record a scan of the paper's mirror at its feed of 0.1 mm per turn."""
    spiral = Spiral(PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, 1e-4, spindle_speed)
    return record(replace(cell or Cell(), seed=seed), spiral, PAPER_MIRROR)


def corrected(
    calibration: Calibration, axes: AxisBlock, distance: DistanceBlock, **options: object
) -> SurfacePoints:
    """Return all points of one recording."""
    corrector = Corrector(calibration, CorrectionOptions(sources=SOURCES, **options))  # type: ignore[arg-type]
    corrector.push_axes(axes)
    corrector.push_distance(distance)
    return join_points([corrector.finish()])


def _motion_error(made: Recording, points: SurfacePoints) -> np.ndarray:
    return made.axes.z[points.sample] - points.dynamic_error - made.probe_motion[points.sample]


def accuracy_with_the_true_dynamics() -> list[Row]:
    """Return errors with the true dynamics: noise of encoder and probe only."""
    made = scan()
    points = corrected(true_calibration(), made.axes, made.distance)
    error = _motion_error(made, points)
    heights = points.height - made.surface_height[points.sample]
    quiet = scan(cell=Cell(encoder_noise=0.0))
    silent = _motion_error(quiet, corrected(true_calibration(), quiet.axes, quiet.distance))
    return [
        at_most("true G: H(z) - motion, PV", np.ptp(error) / NANOMETRE_M, "nm", 5.0),
        at_most("true G, no encoder noise: PV", np.ptp(silent) / NANOMETRE_M, "nm", 0.1),
        at_most("true G: height rms / noise floor", np.std(heights) / _FLOOR_M, "1", 1.1),
    ]


def accuracy_with_identified_dynamics() -> list[Row]:
    """Return errors of step test, identification and scan at two speeds."""
    calibration = identified_calibration()
    slow, fast = scan(), scan(spindle_speed=120.0)
    points = corrected(calibration, slow.axes, slow.distance)
    at_30, before = _motion_error(slow, points), points.dynamic_error
    against = points.height - slow.surface_height[points.sample]
    at_120 = _motion_error(fast, corrected(calibration, fast.axes, fast.distance))
    return [
        shown("dynamic error of the paper's scan before: PV", np.ptp(before) / NANOMETRE_M, "nm"),
        shown("the same: rms over the area", _over_area(points, before) / NANOMETRE_M, "nm"),
        shown("cloud against the true surface: rms", np.std(against) / NANOMETRE_M, "nm"),
        shown("noise and resolution of the probe alone: rms", _FLOOR_M / NANOMETRE_M, "nm"),
        at_most("identified G, 30 rpm: PV", np.ptp(at_30) / NANOMETRE_M, "nm", 20.0),
        at_most(
            "identified G, 30 rpm: rms over the area",
            _over_area(points, at_30) / NANOMETRE_M,
            "nm",
            5.0,
        ),
        at_most("identified G, 120 rpm: PV", np.ptp(at_120) / NANOMETRE_M, "nm", 50.0),
    ]


def _over_area(points: SurfacePoints, values: np.ndarray) -> float:
    """Return the standard deviation of ``values`` (n,) over the area, weighted by radius."""
    weight = np.hypot(points.x, points.y)
    mean = np.average(values, weights=weight)
    return float(np.sqrt(np.average((values - mean) ** 2, weights=weight)))


def discretisation() -> list[Row]:
    """Return errors of the default discretisation and of the bilinear transform."""
    z = scan(cell=Cell(encoder_noise=0.0)).axes.z
    dynamics = Plant().dynamics
    ours, peer = discretise(dynamics, 1e-3), bilinear(dynamics, 1e-3)
    errors = [discretisation_error(dynamics, h, z, up_to=100.0)[1] for h in (ours, peer)]
    return [
        at_most(
            "discretisation, 30 rpm: PV",
            errors[0] / NANOMETRE_M,
            "nm",
            0.1,
            errors[1] / NANOMETRE_M,
        ),
        at_most("white noise gain of H", ours.noise_gain, "1", 1.1, peer.noise_gain),
    ]


def fast_path(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Z and distance [m] that excite every parameter within the valid band."""
    time = np.arange(samples) * 1e-3
    z = 0.4e-3 * np.sin(2 * np.pi * 6 * time) + 0.05e-3 * np.cos(2 * np.pi * 31 * time)
    return z, 40e-6 * np.cos(2 * np.pi * 2 * time)


def blocks_of(z: np.ndarray, reading: np.ndarray) -> tuple[AxisBlock, DistanceBlock]:
    zero = np.zeros(len(z))
    place = {"stamp_ns": 0, "first_sample": 0, "sample_period": 1e-3}
    return (
        AxisBlock(**place, x=zero, y=zero, z=z, b=zero, c=zero),  # type: ignore[arg-type]
        DistanceBlock(**place, distance=reading),  # type: ignore[arg-type]
    )


def honesty(runs: int = 3000) -> list[Row]:
    """Compare the stated uncertainty with Monte Carlo of dynamics, gain and all noise."""
    calibration, skip = true_calibration(relative=2e-3), 200
    z, reading = fast_path(1200)
    points = corrected(calibration, *blocks_of(z, reading))
    stated = points.uncertainty[points.sample >= skip]
    errors = _monte_carlo(calibration, z, reading, runs)[:, skip:]
    errors -= signal.sosfilt(discretise(calibration.dynamics, 1e-3).sections, z)[skip:]
    errors -= reading[skip:] / calibration.static_gain
    ratio = stated / np.sqrt(np.mean(errors**2, axis=0))
    covered = float(np.mean(abs(errors) < 2 * stated))
    return [
        at_most(
            "stated / Monte Carlo, worst point: |1 - ratio|",
            max(abs(ratio - 1)),
            "1",
            0.05,
            runs=runs,
        ),
        at_most("coverage at k = 2: |0.954 - c|", abs(covered - 0.9545), "1", 0.02, runs=runs),
    ]


def _monte_carlo(
    calibration: Calibration, z: np.ndarray, reading: np.ndarray, runs: int
) -> np.ndarray:
    rng = np.random.default_rng(3)
    g = calibration.dynamics
    m = len(g.numerator)
    centre = np.concatenate([g.numerator, g.denominator[1:], [g.delay]])
    values, vectors = np.linalg.eigh(_correlation(calibration.covariance))
    mixing = vectors * np.sqrt(np.maximum(values, 0.0))
    deviations = np.sqrt(np.diag(calibration.covariance))
    heights = np.empty((runs, len(z)))
    for run in range(runs):
        draw = centre + deviations * (mixing @ rng.normal(size=len(centre)))
        drawn = TransferFunction(draw[:m], np.r_[1.0, draw[m:-1]], max(draw[-1], 0.0))
        noisy = z + SOURCES.encoder_noise * rng.normal(size=len(z))
        seen = reading + SOURCES.probe_noise * rng.normal(size=len(z))
        seen += SOURCES.probe_resolution * (rng.random(len(z)) - 0.5)
        gain = calibration.static_gain + SOURCES.static_gain * rng.normal()
        heights[run] = signal.sosfilt(discretise(drawn, 1e-3).sections, noisy) + seen / gain
    return heights


def _correlation(covariance: np.ndarray) -> np.ndarray:
    deviations = np.sqrt(np.diag(covariance))
    scale = np.where(deviations > 0, deviations, 1.0)
    return covariance / np.outer(scale, scale)


def probe_latency() -> list[Row]:
    """Return the error of a latency of 0.34 ms from scans of opposite spindle directions."""
    latency = 0.34e-3
    prompt = TransferFunction(np.ones(1), np.array([1.0, 1 / (2 * np.pi * 5000)]))
    late = Disturbances(probe=ProbeErrors(latency_s=latency))
    cell = Cell(plant=Plant(dynamics=prompt), disturbances=late)
    calibration = replace(
        true_calibration(),
        dynamics=TransferFunction(prompt.numerator, prompt.denominator, latency),
        covariance=np.zeros((3, 3)),
    )
    scans = []
    for speed, seed in ((30.0, 1), (-30.0, 2)):
        made = scan(speed, seed, cell)
        points = corrected(calibration, made.axes, made.distance, probe_latency=0.0)
        scans.append(scan_data([made.axes], [points], made.axes.sample_period)[0])
    found = reversal(scans, calibration)
    error = abs(found.lag - latency)
    put_right = corrected(calibration, made.axes, made.distance, probe_latency=found.lag)
    before, after = (_surface_rms(points) / cell.probe.noise for points in (points, put_right))
    return [
        at_most("probe latency, error / stated uncertainty", error / found.uncertainty, "1", 2.0),
        at_most("probe latency, stated uncertainty", found.uncertainty / MICROSECOND_S, "us", 1.0),
        at_most("probe latency corrected: surface rms / probe noise", after, "1", 2.0, before),
    ]


def _surface_rms(points: SurfacePoints) -> float:
    """Return the standard deviation of heights from the true surface [m]."""
    return float(np.std(points.height - PAPER_MIRROR.height(points.x, points.y)))


STUDIES: tuple[Callable[[], list[Row]], ...] = (
    accuracy_with_the_true_dynamics,
    accuracy_with_identified_dynamics,
    discretisation,
    honesty,
    probe_latency,
)


def rows(full: bool) -> Iterator[Row]:
    """Yield the rows of all studies."""
    del full
    for study in STUDIES:
        yield from study()
