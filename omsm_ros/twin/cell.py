"""Simulate the cell: a motion over a surface, as reported by the devices, and the true values.

The twin imitates dynamics, scale, noise, resolution and range of the probe, the lag of the servo,
the noise of the encoder, and all ``Disturbances``. The file of each family states what it omits.
:func:`compare_with_truth` compares a correction with the true values.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from omsm_ros.core.kinematics.kinematics import Geometry, Surface, workpiece_points, workpiece_xy
from omsm_ros.core.kinematics.trajectories import AxisPositions, Motion
from omsm_ros.core.streams.blocks import (
    AccelerationBlock,
    AnyBlock,
    AxisBlock,
    DistanceBlock,
    FloatArray,
    IntArray,
    part_of,
)
from omsm_ros.core.streams.motion_record import MotionRecord, assemble
from omsm_ros.errors import DataError
from omsm_ros.quantities import LENGTH, SAMPLE_PERIOD, CheckedRecord
from omsm_ros.twin.disturbances import Disturbances, TrueResponse, VibrationLine, with_phases
from omsm_ros.twin.machine_errors import Shift, random_walk
from omsm_ros.twin.part import UnderSpot, mounted_surface
from omsm_ros.twin.plant import Plant, TimeGrid, Trajectory, move
from omsm_ros.twin.probe import LEVEL, Probe, read, slope_of
from omsm_ros.twin.record_checks import is_default
from omsm_ros.twin.sensors import Instants, acceleration_of
from omsm_ros.twin.structure import deform
from omsm_ros.units import NANOMETRE_M

__all__ = ["Cell", "Probe", "Recording", "Truth", "blocks_of", "record"]

Random = Mapping[str, np.random.Generator]

# Sample periods simulated in addition, for the four points of a cubic.
_SPARE_SAMPLES = 3
# The search for the end of an inclined beam converges by slope times inclination; it ends at a
# change of this size [m].
_MOST_BEAM_ITERATIONS = 12
_BEAM_SETTLED_M = 1e-12
_LEAST_SUBSTEPS = 16
# Half of this step changes a step test with 20 ms edges by 0.02 nm; the error is quadratic in it.
_LONGEST_STEP_S = 1e-3 / _LEAST_SUBSTEPS
# Uses of random numbers. New ones are appended, so that the others keep their numbers.
_STREAMS = (
    *("encoder", "probe", "drift", "vibration"),
    *("spindle", "clocks", "dropout", "reference", "accelerometer"),
)


class ProbeTarget(NamedTuple):
    """Situation at the probe, each (n,) [m].

    probe: its true Z;  surface: height of the part under it;  x, y: place on the chuck
    distance: true, along the beam
    """

    probe: FloatArray
    surface: FloatArray
    x: FloatArray
    y: FloatArray
    distance: FloatArray


ShiftFunction = Callable[[FloatArray, AxisPositions], Shift]


@dataclass(frozen=True, eq=False)
class Scene:
    """True state of the cell as signals in time.

    slide, probe: true Z [m];  surface: in its pose on the chuck
    stand_off: height of the zero of the probe above the axis zero [m]
    shifting: shifts of the workpiece relative to the probe, by time and position of the slides
    vibration: lines between workpiece and probe, which an accelerometer measures too
    """

    disturbances: Disturbances
    motion: Motion
    surface: Surface
    stand_off: float
    slide: Trajectory
    probe: Trajectory
    shifting: tuple[ShiftFunction, ...]
    vibration: tuple[VibrationLine, ...]

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the true positions of the axes: the command, and the wobble of B."""
        slides, machine = self.motion.positions(time), self.disturbances.machine
        if not machine.b_wobble_rad:
            return slides
        wobble = machine.b_wobble_rad * np.sin(2 * np.pi * machine.b_wobble_hz * time)
        return slides._replace(b=slides.b + wobble)

    def look(self, time: FloatArray, about: FloatArray | float = 0.0) -> ProbeTarget:
        """Return the situation at ``time`` (n,) [s]; ``about``: start for the distance [m]."""
        slides = self.positions(time)
        total = Shift(np.zeros(1), np.zeros(1), np.zeros(1))
        for shifting in self.shifting:
            part = shifting(time, slides)
            total = Shift(*(a + b for a, b in zip(total, part, strict=True)))
        x, y, raised = total
        shifted = slides._replace(x=slides.x - x, y=slides.y - y)
        probe, mount = self.probe.at(time), self.disturbances.machine.mount
        if is_default(mount) and not slides.b.any():
            on_x, on_y = workpiece_xy(shifted.x, shifted.y, slides.c)
            height = self.surface.height(on_x, on_y)
            distance = height + raised - probe - self.stand_off
            return ProbeTarget(probe, height, on_x, on_y, distance)
        return self._along_the_beam(mount, shifted, probe, raised, about)

    def _along_the_beam(
        self,
        mount: Geometry,
        slides: AxisPositions,
        probe: FloatArray,
        raised: FloatArray,
        about: FloatArray | float,
    ) -> ProbeTarget:
        """Return the same as ``look`` for an inclined beam, or a probe that is moved by B."""
        zero = probe + self.stand_off - raised
        distance = np.zeros_like(probe) + about
        for _ in range(_MOST_BEAM_ITERATIONS):
            at = workpiece_points(mount, (slides.x, slides.y, zero), slides.b, slides.c, distance)
            height = self.surface.height(at.x, at.y)
            change = height - at.height
            distance = distance + change
            if np.all(abs(change) < _BEAM_SETTLED_M):
                break
        return ProbeTarget(probe, height, at.x, at.y, distance)

    def over_an_exposure(self, time: FloatArray) -> ProbeTarget:
        """Return the mean situation during the exposures at ``time``."""
        probe = self.disturbances.probe
        before, weights = probe.exposure_instants()
        look = self.look(time - before[0])
        if len(before) > 1:
            looks = (look, *(self.look(time - ago, look.distance) for ago in before[1:]))
            look = ProbeTarget(*(weights @ np.array(parts) for parts in zip(*looks, strict=True)))
        if not self.vibration:
            return look
        # Lines may be faster than the nodes of the exposure, so their mean is in closed form.
        middle, half = time - probe.lag_s, probe.window_s / 2
        begin, c, end = (self.motion.positions(middle + d).c for d in (-half, 0.0, half))
        shaken = sum(v.height(middle, c, probe.window_s, end - begin) for v in self.vibration)
        return look._replace(distance=look.distance + shaken)

    def acceleration(self, time: FloatArray, period: float) -> FloatArray:
        """Return the acceleration of the probe along Z [m/s²] at ``time`` (n,) [s]."""
        c = self.motion.positions(time).c
        speed = np.asarray(np.gradient(c, period))
        shaken = sum(line.acceleration(time, c, speed) for line in self.vibration)
        # A motion of the part towards the probe counts as a motion of the probe downwards.
        return np.asarray(acceleration_of(self.probe).at(time) - shaken)


def scene_of(
    plant: Plant,
    disturbances: Disturbances,
    motion: Motion,
    surface: Surface,
    stand_off: float,
    grid: TimeGrid,
    random: Random,
) -> Scene:
    """Simulate ``motion`` and return the scene; ``random``: generators by the name of their use."""
    times = np.arange(-grid.lead, grid.samples + 1, dtype=np.float64) * grid.sample_period
    slide, probe = move(plant, motion, grid)
    if not is_default(disturbances.structure):
        slide_x = Trajectory(times[0], grid.sample_period, motion.positions(times).x)
        probe = deform(disturbances.structure, (slide, probe), slide_x)
    if spot := disturbances.probe.spot_m:
        surface = UnderSpot(surface, spot)
    return Scene(
        disturbances=disturbances,
        motion=motion,
        surface=mounted_surface(surface, disturbances.machine.pose),
        stand_off=stand_off,
        slide=slide,
        probe=probe,
        shifting=tuple(_shifting(disturbances, times, random)),
        vibration=with_phases(disturbances.vibration, random["vibration"]),
    )


def _shifting(disturbances: Disturbances, times: FloatArray, random: Random) -> list[ShiftFunction]:
    """Return the active shifts of the workpiece; ``times`` span the simulation."""
    machine, zero = disturbances.machine, np.zeros(1)
    result: list[ShiftFunction] = []
    if not is_default(machine.drift):
        walk = Trajectory(times[0], times[1] - times[0], random_walk(times, random["drift"]))
        result.append(lambda time, slides: Shift(zero, zero, machine.drift.height(time, walk)))
    if not is_default(spindle := machine.spindle):
        noisy = spindle.axial_noise_m or spindle.radial_noise_m or spindle.tilt_noise_rad
        noise = [
            Trajectory(times[0], times[1] - times[0], random["spindle"].normal(size=len(times)))
            for _ in range(5 if noisy else 0)
        ]
        result.append(lambda time, slides: spindle.shift(time, slides, noise))
    across, along = machine.z_slide_along_x, machine.x_slide_along_z
    if not (is_default(across) and is_default(along)):
        # A lateral motion of the probe is an opposite shift of the workpiece.
        result.append(lambda _, at: Shift(-across.deviation(at.z), zero, along.deviation(at.x)))
    return result


def _grid(
    plant: Plant, disturbances: Disturbances, samples: int, period: float, substeps: int
) -> TimeGrid:
    forgotten = int(np.ceil(plant.lead_in() / period))
    if is_default(disturbances):
        return TimeGrid(forgotten, samples, period, substeps, substeps)
    probe, clocks = disturbances.probe, disturbances.clocks.reach_s(samples * period)
    reference = disturbances.reference.latency_s if disturbances.reference else 0.0
    late = max(probe.latency_s + probe.window_s, reference)
    lead = late + clocks + disturbances.structure.lead_s
    return TimeGrid(
        lead=forgotten + int(np.ceil(lead / period)) + _SPARE_SAMPLES,
        samples=samples + int(np.ceil(clocks / period)) + _SPARE_SAMPLES,
        sample_period=period,
        substeps=substeps,
        every=1,
    )


@dataclass(frozen=True)
class Cell(CheckedRecord):
    """Configuration of the twin.

    encoder_noise: standard deviation [m]
    sample_period: of the common trigger [s];  seed: of all noise
    """

    plant: Plant = field(default_factory=Plant)
    probe: Probe = field(default_factory=Probe)
    encoder_noise: float = LENGTH.of_field(0.4 * NANOMETRE_M)
    sample_period: float = SAMPLE_PERIOD.of_field(1e-3)
    seed: int = 1
    disturbances: Disturbances = field(default_factory=Disturbances)


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """True values of a recording, arrays of shape (n,).

    time: of the trigger [s];  slide: true Z of the slide then [m]
    x, y: place of the probe on the chuck [m]
    distance: true distance along the beam, without errors of the probe [m]
    surface: the part in its pose on the chuck
    response: transfer function from encoder to probe, and the share of latency in it
    """

    time: FloatArray
    slide: FloatArray
    x: FloatArray
    y: FloatArray
    distance: FloatArray
    surface: Surface
    response: TrueResponse


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """Reported samples, one block each, and the true values; arrays of shape (n,).

    axes, distance: as reported;  reference, acceleration: None without such a sensor
    probe_motion: true motion of the probe, G · X_d, averaged over the exposure [m]
    surface_height: true height of the surface under the probe then [m]
    truth: further true values, None if unknown

    ``probe_motion - truth.slide`` is the true dynamic error.
    """

    axes: AxisBlock
    distance: DistanceBlock
    probe_motion: FloatArray
    surface_height: FloatArray
    reference: DistanceBlock | None = None
    acceleration: AccelerationBlock | None = None
    truth: Truth | None = None

    def motion_record(self) -> MotionRecord:
        """Return the samples on one grid, as input of an identification."""
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
    """Run ``motion`` over ``surface`` and return a sample for each trigger.

    stand_off: height of the zero of the probe above the axis zero [m]; the reading is
        ``scale · (surface - probe motion - stand_off)``, rounded, with no target out of range
    substeps: simulated steps in a sample period; None takes enough for 0.1 nm
    """
    children = np.random.SeedSequence(cell.seed).spawn(len(_STREAMS))
    random = {n: np.random.default_rng(child) for n, child in zip(_STREAMS, children, strict=True)}
    errors = cell.disturbances
    steps = substeps or max(_LEAST_SUBSTEPS, int(np.ceil(cell.sample_period / _LONGEST_STEP_S)))
    nominal = np.arange(round(motion.duration / cell.sample_period), dtype=np.float64)
    nominal *= cell.sample_period
    plant = cell.plant
    if errors.servo_bandwidth_hz is not None:
        plant = replace(plant, servo_bandwidth=errors.servo_bandwidth_hz)
    grid = _grid(plant, errors, len(nominal), cell.sample_period, steps)
    scene = scene_of(plant, errors, motion, surface, stand_off, grid, random)
    instants = errors.clocks.instants(nominal, random["clocks"])
    seen = scene.over_an_exposure(instants.probe)
    return Recording(
        axes=_axes(cell, scene, instants, random["encoder"]),
        distance=_distance(cell, scene, instants, seen, random),
        probe_motion=seen.probe,
        surface_height=seen.surface,
        **_further_channels(scene, instants, cell.sample_period, random),
        truth=Truth(
            time=instants.trigger,
            slide=scene.slide.at(instants.trigger),
            x=seen.x,
            y=seen.y,
            distance=seen.distance,
            surface=scene.surface,
            response=TrueResponse(cell.plant.dynamics, errors, cell.probe),
        ),
    )


def _axes(cell: Cell, scene: Scene, when: Instants, random: np.random.Generator) -> AxisBlock:
    encoder, slides = scene.disturbances.encoder, scene.positions(when.trigger)
    z = encoder.seen(scene.slide).at(when.z)
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
    cell: Cell, scene: Scene, when: Instants, seen: ProbeTarget, random: Random
) -> DistanceBlock:
    errors, slope = scene.disturbances.probe, LEVEL
    if errors.is_slope_sensitive:
        c = scene.positions(when.probe - errors.lag_s).c
        slope = slope_of(scene.surface, seen.x, seen.y, c)
    return read(cell.probe, errors, seen.distance, slope, cell.sample_period, random)


def _further_channels(
    scene: Scene, when: Instants, trigger_period: float, random: Random
) -> dict[str, Any]:
    channels: dict[str, Any] = {}
    if reference := scene.disturbances.reference:
        channels["reference"] = reference.read(
            scene.slide, when.trigger, trigger_period, random["reference"]
        )
    if accelerometer := scene.disturbances.accelerometer:
        period = accelerometer.sample_period_s or trigger_period
        duration = len(when.trigger) * trigger_period
        time = np.arange(round(duration / period), dtype=np.float64) * period
        channels["acceleration"] = accelerometer.read(
            scene.acceleration(time, period), period, random["accelerometer"]
        )
    return channels


def pieces(block: AnyBlock | None, size: int) -> Iterator[AnyBlock]:
    """Cut a block, if there is one, into blocks of ``size`` samples, as a driver does."""
    if block is not None:
        yield from (part_of(block, k, k + size) for k in range(0, len(block), size))


def blocks_of(recording: Recording, size: int = 100) -> list[tuple[AxisBlock, DistanceBlock]]:
    """Return the recording in blocks of ``size`` samples."""
    return list(zip(pieces(recording.axes, size), pieces(recording.distance, size), strict=True))


def compare_with_truth(
    recording: Recording, sample: ArrayLike, height: FloatArray, dynamic_error: FloatArray
) -> dict[str, dict[str, float]]:
    """Compare corrected points, each array (n,), with the true values of their recording.

    sample: trigger counter;  height, dynamic_error: as in ``cloud.ply`` [m]

    Return peak to valley and rms about zero [m] of

    dynamic_error_before: true motion of the probe minus the encoder; rms weighted by area
    dynamic_error_after: true motion of the probe minus the filtered encoder, likewise
    surface_deviation: corrected height minus the true surface
    """
    index: IntArray = np.asarray(sample, np.int64) - recording.axes.first_sample
    if not len(index):
        raise DataError("no points to compare with the truth")
    if np.any((index < 0) | (index >= len(recording.axes))):
        raise DataError(
            f"samples {index.min()}…{index.max()} do not belong to this recording of "
            f"{len(recording.axes)}"
        )
    before = recording.probe_motion[index] - recording.axes.z[index]
    # In a spiral of constant feed and speed a point stands for an area proportional to its radius.
    radius = np.abs(recording.axes.x[index])
    errors = {
        "dynamic_error_before": (before, radius),
        "dynamic_error_after": (before + dynamic_error, radius),
        "surface_deviation": (height - recording.surface_height[index], None),
    }
    return {
        name: {
            "peak_to_valley": float(np.ptp(error)),
            "rms": float(np.sqrt(np.average(error**2, weights=weight))),
        }
        for name, (error, weight) in errors.items()
    }
