"""The whole cell: a motion over a surface, as the devices report it and as it truly was.

What is imitated, beside the probe's dynamics, scale, noise, resolution and range, the servo's lag
and the encoder's noise, is what ``Disturbances`` lists; what is not stands in each family's file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.machine.trajectories import Motion
from omsm_ros.core.samples.blocks import AccelerationBlock, AxisBlock, DistanceBlock, FloatArray
from omsm_ros.core.samples.motion_record import MotionRecord, assemble
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.clocks import Instants
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.plant import Plant
from omsm_ros.twin.probe import LEVEL, Probe, ProbeRandom, read, slope_of
from omsm_ros.twin.scene import Look, Scene, Timing, scene_of
from omsm_ros.twin.true_response import TrueResponse
from omsm_ros.units import NANOMETRE_M, NANOSECONDS_PER_S

__all__ = ["Cell", "Probe", "Recording", "Truth", "blocks_of", "record"]

_LEAST_SUBSTEPS = 16
# Half of this step changes a step test of 20 ms edges by 0.02 nm; the error falls with its square.
_LONGEST_STEP_S = 1e-3 / _LEAST_SUBSTEPS


@dataclass(frozen=True)
class Cell:
    """Everything that decides what the devices report.

    encoder_noise: standard deviation [m]
    sample_period: of the common trigger [s];  seed: of all noise
    disturbances: what else is not as it should be
    """

    plant: Plant = field(default_factory=Plant)
    probe: Probe = field(default_factory=Probe)
    encoder_noise: float = 0.4 * NANOMETRE_M
    sample_period: float = 1e-3
    seed: int = 1
    disturbances: Disturbances = field(default_factory=Disturbances)

    def __post_init__(self) -> None:
        if not self.sample_period > 0:
            raise ConfigurationError(f"sample_period {self.sample_period!r} s is not positive")


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """What only the twin knows beside the motion of the probe; arrays of shape (n,).

    time: when the trigger came [s];  carriage: true Z of the carriage then [m]
    x, y: where on the chuck the probe looked [m]
    distance: true distance along the beam, before the probe's own errors [m]
    surface: the part as it sits on the chuck
    response: the transfer function from encoder to probe, and the share of latency in it
    """

    time: FloatArray
    carriage: FloatArray
    x: FloatArray
    y: FloatArray
    distance: FloatArray
    surface: Surface
    response: TrueResponse


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """Samples as reported, one block each, and the truth behind them; arrays of shape (n,).

    axes, distance: what the devices say;  reference, acceleration: if there are such
    probe_motion: true motion of the probe, G · X_d, when (on the mean) the reading was made [m]
    surface_height: true height of the surface then under the probe [m]
    truth: what else is true, None where nobody knows

    ``probe_motion - truth.carriage`` is the true dynamic error.
    """

    axes: AxisBlock
    distance: DistanceBlock
    probe_motion: FloatArray
    surface_height: FloatArray
    reference: DistanceBlock | None = None
    acceleration: AccelerationBlock | None = None
    truth: Truth | None = None

    def motion_record(self) -> MotionRecord:
        """Return the samples on one grid, as an identification takes them."""
        reference = [self.reference] if self.reference else []
        return assemble([self.axes], [self.distance], reference)


def record(
    cell: Cell,
    motion: Motion,
    surface: Surface,
    *,
    stand_off: float = 0.0,
    substeps: int | None = None,
) -> Recording:
    """Run ``motion`` over ``surface`` and report every sample of the trigger.

    stand_off: height of the probe's zero above the axis zero [m]; the reading is
    ``scale · (surface - probe motion - stand_off)``, rounded, and a lost target beyond range.
    substeps: simulated steps in a sample period; None takes enough for 0.1 nm
    """
    random = _random_streams(cell.seed)
    errors = cell.disturbances
    steps = substeps or _enough_substeps(cell.sample_period)
    timing = Timing(round(motion.duration / cell.sample_period), cell.sample_period, steps)
    scene = scene_of(cell.plant, errors, motion, surface, stand_off, timing, random)
    nominal = np.arange(timing.samples, dtype=np.float64) * cell.sample_period
    instants = errors.clocks.instants(nominal, random["clocks"])
    seen = scene.over_an_exposure(instants.probe)
    return Recording(
        axes=_axes(cell, scene, instants, random["encoder"]),
        distance=_distance(cell, scene, instants, seen, random),
        probe_motion=seen.probe,
        surface_height=seen.surface,
        **_further_channels(scene, instants, timing, random),
        truth=Truth(
            time=instants.trigger,
            carriage=scene.carriage.at(instants.trigger),
            x=seen.x,
            y=seen.y,
            distance=seen.distance,
            surface=scene.surface,
            response=TrueResponse(cell.plant.dynamics, errors, cell.probe),
        ),
    )


def _enough_substeps(sample_period: float) -> int:
    return max(_LEAST_SUBSTEPS, int(np.ceil(sample_period / _LONGEST_STEP_S)))


# A new stream goes to the end: those before it stay as they are.
_STREAMS = (
    *("encoder", "probe", "drift", "vibration"),
    *("spindle", "clocks", "dropout", "reference", "accelerometer"),
)


def _random_streams(seed: int) -> dict[str, np.random.Generator]:
    """Return independent random numbers for each use: switching one on leaves the others."""
    children = np.random.SeedSequence(seed).spawn(len(_STREAMS))
    return {n: np.random.default_rng(child) for n, child in zip(_STREAMS, children, strict=True)}


def _axes(cell: Cell, scene: Scene, when: Instants, random: np.random.Generator) -> AxisBlock:
    encoder, slides = scene.disturbances.encoder, scene.positions(when.trigger)
    z = encoder.seen(scene.carriage).at(when.z)
    late = scene.positions(when.c).c if when.c is not when.trigger else slides.c
    return AxisBlock(
        stamp_ns=0,
        first_sample=0,
        sample_period=cell.sample_period,
        x=slides.x,
        y=slides.y,
        z=encoder.read(z, random.normal(0.0, cell.encoder_noise, len(z))),
        b=slides.b,
        c=late,
    )


def _distance(
    cell: Cell,
    scene: Scene,
    when: Instants,
    seen: Look,
    random: Mapping[str, np.random.Generator],
) -> DistanceBlock:
    errors, slope = scene.disturbances.probe, LEVEL
    if errors.sees_slope:
        c = scene.positions(when.probe - errors.lag_s).c
        slope = slope_of(scene.surface, seen.x, seen.y, c)
    streams = ProbeRandom(random["probe"], random["dropout"])
    return read(cell.probe, errors, seen.distance, slope, cell.sample_period, streams)


def _further_channels(
    scene: Scene, when: Instants, timing: Timing, random: Mapping[str, np.random.Generator]
) -> dict[str, Any]:
    """Return the reference and acceleration, as far as there are such sensors."""
    channels: dict[str, Any] = {}
    if reference := scene.disturbances.reference:
        channels["reference"] = reference.read(
            scene.carriage, when.trigger, timing.period, random["reference"]
        )
    if accelerometer := scene.disturbances.accelerometer:
        period = accelerometer.sample_period_s or timing.period
        time = np.arange(round(timing.duration / period), dtype=np.float64) * period
        channels["acceleration"] = accelerometer.read(
            scene.acceleration(time, period), period, random["accelerometer"]
        )
    return channels


def blocks_of(recording: Recording, size: int = 100) -> list[tuple[AxisBlock, DistanceBlock]]:
    """Return the recording cut into blocks of ``size`` samples, as a driver publishes them."""
    axes, distance = recording.axes, recording.distance
    pairs = []
    for start in range(0, len(axes), size):
        part = slice(start, start + size)
        stamp = axes.stamp_ns + round(start * axes.sample_period * NANOSECONDS_PER_S)
        common = {
            "stamp_ns": stamp,
            "first_sample": axes.first_sample + start,
            "sample_period": axes.sample_period,
        }
        axis_block = AxisBlock(
            **common,  # type: ignore[arg-type]
            **{name: getattr(axes, name)[part] for name in ("x", "y", "z", "b", "c")},
        )
        distance_block = DistanceBlock(
            **common,  # type: ignore[arg-type]
            **{name: getattr(distance, name)[part] for name in ("distance", "intensity", "status")},
        )
        pairs.append((axis_block, distance_block))
    return pairs
