"""The Python interface: arrays in, results out. Works without ROS.

Use it as ``import omsm_ros as omsm``, which lists the public names. All quantities are in SI units.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.interface_calibration import Calibration
from omsm_ros.interface_results import (
    Adjusted,
    Difference,
    Form,
    Plan,
    Points,
    Prediction,
    Recording,
    Spectrum,
    load_saved,
)

if TYPE_CHECKING:
    from omsm_ros.core.kinematics.kinematics import Surface
    from omsm_ros.core.surface.aperture import Aperture


def read(path: Path | str, columns: Path | str | None = None) -> Recording:
    """Read axes and distance on one trigger count.

    path: ``.mcap`` or ``.db3`` file, or the folder of a bag; a table (CSV, HDF5 …) with ``columns``
    columns: ``MAP.yaml`` with names, units and signs, as for ``omsm import``
    Raises BagError, FileError or DataError for a path that holds no such recording.
    """
    if columns is not None:
        return _read_table(Path(path), Path(columns))
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
    made = {name: np.full(last - first, np.nan) for name in ("z", "x", "c", "distance")}
    for block in (*axes, *distance):
        names = ("z", "x", "c") if isinstance(block, AxisBlock) else ("distance",)
        begin = block.first_sample - first
        for name in names:
            made[name][begin : begin + len(block)] = getattr(block, name)
    return Recording(**made, period=float(axes[0].sample_period), name=str(path))


def _read_table(path: Path, columns: Path) -> Recording:
    from omsm_ros.io.tables.table import load_column_map
    from omsm_ros.pipelines.importing import import_recording

    mapped, form = load_column_map(columns)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "recording.mcap"
        import_recording([path], mapped, form, bag)
        found = read(bag)
    return Recording(found.z, found.distance, found.period, found.x, found.c, str(path))


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
    found = analyse_form(nominal, lambda: [batch], asked, aperture=aperture)
    terms = zip(
        found.zernike.terms, found.zernike.coefficients, found.zernike.uncertainty, strict=True
    )
    return Form(
        figures={name: (v.value, v.uncertainty) for name, v in found.deviation.items()},
        zernike={f"Z({t.n}, {t.m})": (float(c), float(u)) for t, c, u in terms},
        x=found.map.x,
        y=found.map.y,
        deviation=found.map.deviation,
    )


def adjust(
    scans: Sequence[Recording | Path | str],
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
        Recordings or bags of one part; two that differ in speed or direction can verify the result.
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

    with tempfile.TemporaryDirectory() as folder:
        paths = [_bag_of(scan, Path(folder) / f"scan_{k + 1}.mcap") for k, scan in enumerate(scans)]
        found, read_scans = adjust_bags(
            paths,
            calibration.core,
            nominal=nominal,
            stated=load_sources(sources) if sources else NOTHING_STATED,
            clockings=clocking,
            accuracy=accuracy,
        )
    return Adjusted(
        facts=adjustment_facts(found, read_scans, calibration.core, tolerance),
        x=found.form.x,
        y=found.form.y,
        height=found.form.height,
        uncertainty=found.form.uncertainty,
    )


def _bag_of(scan: Recording | Path | str, place: Path) -> Path:
    """Return the path of a bag; a recording is written to ``place`` first."""
    if not isinstance(scan, Recording):
        return Path(scan)
    scan.save(place)
    return place


def difference(
    a: Points | Path | str,
    b: Points | Path | str,
    *,
    nominal: Surface | None = None,
    fit: Sequence[str] = ("piston", "tip", "tilt"),
    uncertainty: float | None = None,
) -> Difference:
    """Compare two measurements of one part, the second moved onto the first.

    a, b: points, or files of any instrument;  nominal: surface to subtract from both first
    fit: pose parameters of the move;  uncertainty: standard, of heights that state none [m]
    Raises DataError for measurements that hardly overlap, or cover no area.
    """
    from omsm_ros.core.comparison.compare import compare_measurements_of_part
    from omsm_ros.core.comparison.stated_errors import ComparedMeasurement
    from omsm_ros.core.surface.deviation import deviation
    from omsm_ros.core.surface.measured_points import MeasuredPoints
    from omsm_ros.pipelines.difference import facts_of

    measured = []
    for name, side in (("a", a), ("b", b)):
        points = side if isinstance(side, Points) else load(side)
        height = points.height
        if nominal is not None:
            height = deviation(points.x, points.y, height, nominal)
        spread = points.uncertainty
        if uncertainty is not None:
            spread = np.where(np.isfinite(spread), spread, uncertainty)
        kept = MeasuredPoints(
            x=points.x,
            y=points.y,
            height=height,
            uncertainty=spread if np.all(np.isfinite(spread)) else None,
            sample=points.sample if np.any(points.sample) else None,
        )
        measured.append(ComparedMeasurement(name=name, points=kept))
    found = compare_measurements_of_part(measured[0], measured[1], fit)
    matched = found.matched
    unknown = np.full(len(matched.x), np.nan)
    return Difference(
        facts=facts_of(found),
        x=matched.x,
        y=matched.y,
        difference=matched.difference,
        uncertainty=unknown if found.agreement is None else found.agreement.uncertainty,
    )


def plan(
    nominal: Surface | None = None,
    *,
    period: float = 1e-3,
    rpm: float = 30.0,
    radius: float = 12.7e-3,
    feed: float = 1e-4,
    dialect: str = "linuxcnc",
    **steps: Any,
) -> Plan:
    """Plan a step test, or a scan of ``nominal`` from ``radius`` [m] to the centre.

    period: of the samples [s];  feed: per turn [m]
    dialect: of the controller, ``linuxcnc``, ``fanuc``, ``siemens`` or ``nanotech``
    steps: ``step``, ``second_step``, ``half_range`` [m], ``count``, ``dwell``, ``rise`` [s]

    Raises ConfigurationError for a motion that the probe or the sampling cannot follow.
    """
    from omsm_ros.core.adjustment import ScanDesign
    from omsm_ros.core.kinematics.trajectories import (
        PLANNED_COUNT,
        PLANNED_DWELL_S,
        SECOND_SHARE,
        plan_steps,
    )
    from omsm_ros.io.gcode_file import DIALECTS, steps_gcode
    from omsm_ros.pipelines.plan_scans import scan_path, scan_program

    if dialect not in DIALECTS:
        raise ConfigurationError(f"dialect {dialect!r} is none of {', '.join(DIALECTS)}")
    if nominal is None:
        step = steps.get("step", 9.8e-6)
        usual = {"step": step, "second_step": SECOND_SHARE * step, "count": PLANNED_COUNT,
                 "dwell": PLANNED_DWELL_S}  # fmt: skip
        test = plan_steps(sample_period=period, **{**usual, **steps})
        z = test.z(np.arange(0.0, test.duration, period, dtype=np.float64))
        zero = np.zeros(len(z))
        return Plan(z=z, x=zero, c=zero, period=period, gcode=steps_gcode(test, dialect))
    design = ScanDesign(rpm=rpm, start=radius, end=0.0, pitch=feed, rate=1 / period, **steps)
    x, z, c = scan_path(design, nominal, np.arange(0.0, design.duration, period, dtype=np.float64))
    program = scan_program(design, nominal, dialect=dialect)[1]
    return Plan(z=z, x=x, c=c, period=period, gcode=program)


def predict(
    motion: Plan | Recording, calibration: Calibration, *, accuracy: float = 20e-9
) -> Prediction:
    """Predict the dynamic error of a motion, what the correction leaves, and the maximum speed.

    accuracy: expanded uncertainty asked for, k = 2 [m]
    Raises DataError for a motion that is shorter than the filter takes to settle.
    """
    from omsm_ros.core.correction.predict import dynamic_error, predict_error
    from omsm_ros.core.kinematics.scan_path import ScanPath

    path = ScanPath(z=motion.z, sample_period=motion.period, x=motion.x, c=motion.c)
    found = predict_error(calibration.core, path, accuracy)
    return Prediction(
        error=dynamic_error(calibration.core.dynamics, motion.z, motion.period),
        period=motion.period,
        residual=found.residual,
        speed_factor=found.speed_factor,
        binding=found.binding,
        advice=found.advice,
    )


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
    part: int | None = None,
) -> Recording:
    """Simulate the paper's machine: ``"step_test"``, or ``"scan"`` of its mirror.

    seed: of noise and part;  rpm: spindle speed;  radius: of the scan [m]
    outward: from the centre;  part: seed of the part alone, for several scans of one part
    Raises ConfigurationError for another motion.
    """
    from omsm_ros.twin.scenario import Scenario, planned_test_of, scan_of

    scenario = Scenario(
        seed=seed, spindle_speed=rpm, start_radius=radius, outward=outward, part_seed=part
    )
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


def load(path: Path | str) -> Any:
    """Load a result: ``CAL.json``, what ``save`` wrote, or points of a cloud or map.

    Maps and clouds of other instruments are read as Points (csv, xyz, ply, x3p, Zygo .dat …).
    Raises FileError for a file that holds none of these.
    """
    file = Path(path)
    if file.suffix == ".json":
        from omsm_ros.io.calibration_file import load_calibration

        return Calibration(load_calibration(file))
    if file.suffix == ".npz":
        return load_saved(file)
    return _points_of(file)


def _points_of(file: Path) -> Points:
    from omsm_ros.io.maps.read_map import read_points

    found = read_points(file)
    zero = np.zeros(len(found), np.int64)
    return Points(
        x=found.x,
        y=found.y,
        height=found.height,
        uncertainty=zero * np.nan if found.uncertainty is None else found.uncertainty,
        dynamic_error=zero.astype(np.float64),
        sample=zero if found.sample is None else found.sample,
    )
