"""The whole cell: a motion over a surface, as the devices report it and as it truly was.

Imitated: the servo's lag, the probe's dynamics, scale, noise, resolution and range, the
encoder's noise, a drift of the fixture, and latency of the probe. Not imitated: spindle
error motion, Abbe offsets, speckle, slope-dependent intensity, friction.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.machine.trajectories import Motion
from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock, FloatArray, Status
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant, respond
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M, NANOSECONDS_PER_S


@dataclass(frozen=True, slots=True)
class Probe:
    """A chromatic confocal probe of the paper's kind.

    scale: reading per true distance [1]; the paper's static error is placed here
    noise: standard deviation of the reading [m];  resolution: of the reading [m]
    half_range: beyond it the probe sees no target [m]
    """

    scale: float = PAPER_STATIC_GAIN
    noise: float = 10 * NANOMETRE_M
    resolution: float = 10 * NANOMETRE_M
    half_range: float = 50 * MICROMETRE_M


@dataclass(frozen=True)
class Cell:
    """Everything that decides what the devices report.

    encoder_noise: standard deviation [m];  drift: of the fixture [m/s]
    latency: how late the probe's reading is [s]: it tells of the place it saw that long ago
    sample_period: of the common trigger [s];  seed: of all noise
    """

    plant: Plant = field(default_factory=Plant)
    probe: Probe = field(default_factory=Probe)
    encoder_noise: float = 0.4 * NANOMETRE_M
    drift: float = 0.0
    latency: float = 0.0
    sample_period: float = 1e-3
    seed: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.latency < np.inf:
            raise ConfigurationError(f"latency {self.latency!r} s, expected zero or positive")
        if not self.sample_period > 0:
            raise ConfigurationError(f"sample_period {self.sample_period!r} s is not positive")


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """Samples as reported, one block each, and the truth behind them; arrays of shape (n,).

    axes, distance: what the devices say
    probe_motion: true motion of the probe, G · X_d, when the reading was made [m]
    surface_height: true height of the surface then under the probe [m]
    """

    axes: AxisBlock
    distance: DistanceBlock
    probe_motion: FloatArray
    surface_height: FloatArray


def record(
    cell: Cell, motion: Motion, surface: Surface, *, stand_off: float = 0.0, substeps: int = 16
) -> Recording:
    """Run ``motion`` over ``surface`` and report every sample of the trigger.

    stand_off: height of the probe's zero above the axis zero [m]; the reading is
    ``scale · (surface - probe motion - stand_off)``, rounded, and a lost target beyond range.
    """
    samples = round(motion.duration / cell.sample_period)
    time = np.arange(samples) * cell.sample_period
    plant = _late(cell.plant, cell.latency)
    moved = respond(plant, motion, samples, cell.sample_period, substeps)
    command, seen = motion.positions(time), motion.positions(time - cell.latency)
    truth = surface.height(
        seen.x * np.cos(seen.c) + seen.y * np.sin(seen.c),
        seen.y * np.cos(seen.c) - seen.x * np.sin(seen.c),
    )
    encoder_random, probe_random = (
        np.random.default_rng(child) for child in np.random.SeedSequence(cell.seed).spawn(2)
    )
    axes = AxisBlock(
        stamp_ns=0,
        first_sample=0,
        sample_period=cell.sample_period,
        x=command.x,
        y=command.y,
        z=moved.carriage + encoder_random.normal(0.0, cell.encoder_noise, samples),
        b=command.b,
        c=command.c,
    )
    true_distance = truth + cell.drift * time - moved.probe - stand_off
    distance = _reading(cell.probe, true_distance, cell.sample_period, probe_random)
    return Recording(axes=axes, distance=distance, probe_motion=moved.probe, surface_height=truth)


def _late(plant: Plant, latency: float) -> Plant:
    g = plant.dynamics
    late = TransferFunction(g.numerator, g.denominator, g.delay + latency)
    return replace(plant, dynamics=late)


def _reading(
    probe: Probe, true_distance: FloatArray, period: float, random: np.random.Generator
) -> DistanceBlock:
    samples = len(true_distance)
    noisy = probe.scale * true_distance + random.normal(0.0, probe.noise, samples)
    resolution = probe.resolution
    reading = np.round(noisy / resolution) * resolution if resolution else noisy
    in_range = abs(true_distance) <= probe.half_range
    return DistanceBlock(
        stamp_ns=0,
        first_sample=0,
        sample_period=period,
        distance=np.where(in_range, reading, np.nan),
        intensity=np.where(in_range, 0.5, 0.0).astype(np.float32),
        status=np.where(in_range, Status.OK, Status.NO_TARGET).astype(np.uint8),
    )


def blocks_of(recording: Recording, size: int = 100) -> list[tuple[AxisBlock, DistanceBlock]]:
    """The recording cut into blocks of ``size`` samples, as a driver publishes them."""
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
