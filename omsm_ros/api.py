"""The Python interface: arrays in, results out. Works without ROS.

Use it as ``import omsm_ros as omsm``. All quantities are in SI units. Results are small frozen
objects: they print in a few lines, ``plot()`` returns a matplotlib figure, ``to_dict()`` values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.interface_results import Adjusted, Calibration, Form, Points, Recording, Spectrum

if TYPE_CHECKING:
    from omsm_ros.core.kinematics.kinematics import Surface
    from omsm_ros.core.registration.placement import Aperture

__all__ = [
    "Adjusted",
    "Calibration",
    "Form",
    "Points",
    "Recording",
    "Spectrum",
    "adjust",
    "correct",
    "form",
    "identify",
    "load",
    "read",
    "simulate",
    "spectrum",
    "surface",
]


def read(path: Path | str) -> Recording:
    """Read a bag: axes and distance on one trigger count.

    path: ``.mcap`` or ``.db3`` file, or the folder of a bag
    Raises BagError for a path that is no bag, or holds no samples.
    """
    from omsm_ros.io import bags
    from omsm_ros.io.topics import AXES_TOPIC, DISTANCE_TOPIC

    axes: list[AxisBlock] = []
    distance: list[DistanceBlock] = []
    with bags.BagReader(path) as bag:
        for _, _, block in bag.blocks(AXES_TOPIC, DISTANCE_TOPIC):
            (axes if isinstance(block, AxisBlock) else distance).append(block)
    if not axes or not distance:
        raise DataError(f"{str(path)!r} has no samples of axes and probe; record both")
    first = min(b.first_sample for b in (*axes, *distance))
    last = max(b.first_sample + len(b) for b in (*axes, *distance))
    columns = {name: np.full(last - first, np.nan) for name in ("z", "x", "c", "distance")}
    for block in (*axes, *distance):
        names = ("z", "x", "c") if isinstance(block, AxisBlock) else ("distance",)
        begin = block.first_sample - first
        for name in names:
            columns[name][begin : begin + len(block)] = getattr(block, name)
    return Recording(**columns, period=float(axes[0].sample_period), name=str(path))


def identify(
    recording: Recording | ArrayLike,
    distance: ArrayLike | None = None,
    period: float | None = None,
    *,
    order: int = 0,
    settings: Mapping[str, object] | None = None,
) -> Calibration:
    """Identify the dynamics from encoder to probe from a motion before a fixed target.

    Parameters
    ----------
    recording
        A recording, or the positions of the encoder [m], (n,).
    distance, period
        Reading of the probe [m], (n,), and sample period [s], where arrays are given.
    order
        Number of poles; 0 lets the data choose.
    settings
        What the calibration belongs to, such as machine, probe rate and exposure.

    Raises
    ------
    StepTestError, IdentificationError
        Where the data hold no usable motion.
    """
    from omsm_ros.core.identification.identify import identify as identify_record
    from omsm_ros.core.streams.motion_record import assemble

    pairs = list(_recording(recording, distance, period).blocks())
    record = assemble([a for a, _ in pairs], [d for _, d in pairs])
    return Calibration(identify_record(record, order=order, settings=settings).calibration)


def _recording(
    given: Recording | ArrayLike, distance: ArrayLike | None, period: float | None
) -> Recording:
    if isinstance(given, Recording):
        return given
    if distance is None or period is None:
        raise ConfigurationError("arrays need distance and period; or give a Recording")
    z, reading = (np.asarray(v, np.float64) for v in (given, distance))
    return Recording(z, reading, period)


def correct(
    recording: Recording,
    calibration: Calibration,
    *,
    nominal: Surface | None = None,
    latency: float | None = None,
    polarity: int = 1,
) -> Points:
    """Correct a scan: heights free of the dynamic error, with an uncertainty for each.

    nominal: surface of the part, for its slopes;  latency: of the probe [s], None: as certified
    polarity: 1 if the distance falls when z rises, else -1
    """
    from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
    from omsm_ros.core.correction.surface_points import join_points

    options = CorrectionOptions(polarity=polarity, probe_latency=latency, surface=nominal)
    corrector, parts = Corrector(calibration.core, options), []
    for axes, distance in recording.blocks():
        corrector.push_axes(axes)
        corrector.push_distance(distance)
        parts.append(corrector.take())
    made = join_points([*parts, corrector.finish()])
    return Points(
        x=made.x,
        y=made.y,
        height=made.height,
        uncertainty=made.uncertainty,
        dynamic_error=made.dynamic_error,
        sample=made.sample,
        counted=corrector.account.as_dict(),
    )


def form(
    points: Points,
    nominal: Surface,
    *,
    fit: Sequence[str] | str = "auto",
    aperture: Aperture | None = None,
) -> Form:
    """Register points to their nominal surface, and evaluate the form.

    fit: degrees of freedom of the pose that are fitted, or "auto";  aperture: disc of the part
    Raises DataError for points that do not determine the pose.
    """
    from omsm_ros.core.form.analyse import analyse_form
    from omsm_ros.core.registration.placement import PointBatch

    batch = PointBatch(points.x, points.y, points.height, np.zeros((0, len(points))))
    asked = [fit] if isinstance(fit, str) else list(fit)
    return Form(analyse_form(nominal, lambda: [batch], asked, aperture=aperture))


def adjust(
    scans: Sequence[Path | str],
    calibration: Calibration,
    *,
    nominal: Surface | None = None,
    sources: Path | str | None = None,
    clocking: Sequence[float] = (),
    accuracy: float | None = None,
    tolerance: float | None = None,
) -> Adjusted:
    """Adjust scans of one part together: form, error sources and verdict.

    Parameters
    ----------
    scans
        Bags of one part; two that differ in speed or direction make the result verifiable.
    nominal
        Surface of the part; None fits a polynomial.
    sources
        ``SOURCES.yaml`` with the declared sources, the priors of the adjustment.
    clocking
        Angle by which the part is turned on the chuck in each scan [rad].
    accuracy, tolerance
        Expanded uncertainty asked for, and tolerance of the peak to valley [m].
    """
    from omsm_ros.core.correction.machine_sources import NOTHING_STATED
    from omsm_ros.io.descriptions import load_sources
    from omsm_ros.pipelines.adjust import adjust_bags, adjustment_facts

    found, read_scans = adjust_bags(
        [Path(scan) for scan in scans],
        calibration.core,
        nominal=nominal,
        stated=load_sources(sources) if sources else NOTHING_STATED,
        clockings=clocking,
        accuracy=accuracy,
    )
    return Adjusted(found, adjustment_facts(found, read_scans, calibration.core, tolerance))


def spectrum(values: ArrayLike, step: float) -> Spectrum:
    """Return the power spectral density of evenly spaced ``values``, their mean removed.

    step: between the values [s], or [m] along a path
    """
    from omsm_ros.core.ripple.density import density

    array = np.asarray(values, np.float64)
    found = density(array - array.mean(), step)
    return Spectrum(found.frequency, found.density)


def surface(shape: str | Path, **parameters: Any) -> Surface:
    """Return a nominal surface: a shape with its parameters, or a ``SURFACE.yaml``.

    >>> surface("sphere", radius=0.1).height(np.zeros(1), np.zeros(1))
    array([0.])
    """
    from omsm_ros.io.descriptions import load_surface, surface_of

    if Path(shape).suffix in (".yaml", ".yml"):
        return load_surface(shape)
    return surface_of({"shape": str(shape), **parameters}, f"surface {shape!r}")


def simulate(
    motion: str = "scan",
    *,
    seed: int = 1,
    rpm: float = 30.0,
    radius: float = 2e-3,
    outward: bool = False,
) -> Recording:
    """Simulate the paper's machine: ``"step_test"``, or ``"scan"`` of its mirror.

    seed: of noise and figure error;  rpm: spindle speed;  radius: of the scan [m]
    """
    from omsm_ros.twin.scenario import Scenario, planned_test_of, scan_of

    scenario = Scenario(seed=seed, spindle_speed=rpm, start_radius=radius, outward=outward)
    motions = {"scan": scan_of, "step_test": planned_test_of}
    if motion not in motions:
        raise ConfigurationError(f"motion {motion!r} is unknown, expected one of {[*motions]}")
    made = motions[motion](scenario)
    return Recording(
        z=made.axes.z,
        distance=made.distance.distance,
        period=made.axes.sample_period,
        x=made.axes.x,
        c=made.axes.c,
        name=f"twin, seed {seed}",
    )


def load(path: Path | str) -> Calibration:
    """Load a calibration from ``CAL.json``."""
    from omsm_ros.io.calibration_file import load_calibration

    return Calibration(load_calibration(path))
