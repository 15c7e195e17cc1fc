"""The Python interface: arrays in, results out. Works without ROS.

``omsm_ros`` lists the public names. All quantities are in SI units. The examples of the functions
go on from these lines:

>>> import numpy as np
>>> import omsm_ros as omsm
>>> calibration = omsm.identify(omsm.simulate("step_test"))
>>> mirror = omsm.surface("off_axis_paraboloid", parent_focal_length=0.0254,
...                       off_axis_distance=0.0508)
>>> scan = omsm.simulate("scan", radius=1e-3)
>>> points = omsm.correct(scan, calibration)
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.errors import ConfigurationError
from omsm_ros.interface_inputs import Calibration, bounded, load
from omsm_ros.interface_inputs import read as read
from omsm_ros.interface_inputs import simulate as simulate
from omsm_ros.interface_inputs import surface as surface
from omsm_ros.interface_results import (
    Adjusted,
    Difference,
    Form,
    Plan,
    Points,
    Prediction,
    Recording,
    Spectrum,
)
from omsm_ros.quantities import (
    BUDGET,
    COUNT,
    DWELL,
    FEED,
    LAG,
    ORDER,
    RADIUS,
    RISE,
    SAMPLE_PERIOD,
    SPEED,
    STEP,
    TOLERANCE,
    UNCERTAINTY,
    shown,
)


def _checked(value: Any, kind: type) -> Any:
    """Return ``value``; raise ConfigurationError, with the remedy, if it is no ``kind``."""
    if isinstance(value, kind):
        return value
    raise ConfigurationError(f"{shown(value)} is no {kind.__name__}; use omsm.read or omsm.load")


@bounded(period=SAMPLE_PERIOD, order=ORDER)
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
    distance
        Reading of the probe [m], (n,), where arrays are given.
    period
        Sample period [s], where arrays are given.
    order
        Number of poles; 0 lets the data choose.
    settings
        What the calibration belongs to, such as machine, probe rate and exposure.

    Returns
    -------
    Calibration
        Lag, static gain, dynamics and verdict.

    Raises
    ------
    StepTestError, IdentificationError
        Where the data hold no usable motion.

    Examples
    --------
    >>> calibration.verdict
    'accepted'
    """
    from omsm_ros.core.identification.identify import identify as identify_record
    from omsm_ros.core.streams.motion_record import assemble

    if not isinstance(recording, Recording):
        if distance is None or period is None:
            raise ConfigurationError("arrays need distance and period; files need omsm.read(path)")
        recording = Recording(np.asarray(recording), np.asarray(distance), period)
    pairs = list(recording.blocks())
    record = assemble([a for a, _ in pairs], [d for _, d in pairs])
    return Calibration(identify_record(record, order=order, settings=settings).calibration)


@bounded(latency=LAG)
def correct(
    recording: Recording,
    calibration: Calibration,
    *,
    nominal: Surface | None = None,
    latency: float | None = None,
    polarity: int = 1,
) -> Points:
    """Correct a scan: heights free of the dynamic error, with an uncertainty for each.

    Parameters
    ----------
    recording
        The scan, of n samples.
    calibration
        Of the machine and probe that made it.
    nominal
        Surface of the part, for its slopes.
    latency
        Of the probe [s]; None takes the certified one.
    polarity
        1 if the distance falls when z rises, else -1.

    Returns
    -------
    Points
        At most n; ``counted`` has the number of samples that are none, by reason.

    Examples
    --------
    >>> bool(points.uncertainty.max() < 1e-6)
    True
    """
    from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
    from omsm_ros.core.correction.surface_points import join_points

    options = CorrectionOptions(polarity=polarity, probe_latency=latency, surface=nominal)
    corrector, parts = Corrector(_checked(calibration, Calibration).core, options), []
    for axes, distance in _checked(recording, Recording).blocks():
        corrector.push_axes(axes)
        corrector.push_distance(distance)
        parts.append(corrector.take())
    made = join_points([*parts, corrector.finish()])
    return Points.of(made, counted=corrector.account.as_dict())


def form(
    points: Points,
    nominal: Surface,
    *,
    fit: Sequence[str] | str = "auto",
    aperture: Aperture | None = None,
) -> Form:
    """Register points to their nominal surface, and evaluate the form.

    Parameters
    ----------
    points
        Corrected points, or what :func:`load` read.
    nominal
        Surface of the part.
    fit
        Degrees of freedom of the pose that are fitted, or ``"auto"``.
    aperture
        Part of the surface that counts; None takes all points.

    Returns
    -------
    Form
        Figures with standard uncertainty [m], Zernike terms [m], and the map of the deviation.

    Raises
    ------
    DataError
        For points that do not determine the pose.

    Examples
    --------
    >>> value, uncertainty = omsm.form(points, mirror).figures["rms"]
    """
    from omsm_ros.core.form.analyse import analyse_form
    from omsm_ros.core.registration.placement import PointBatch

    points = _checked(points, Points)
    batch = PointBatch(points.x, points.y, points.height, np.zeros((0, len(points))))
    asked = [fit] if isinstance(fit, str) else list(fit)
    found = analyse_form(nominal, lambda: [batch], asked, aperture=aperture)
    terms = zip(
        found.zernike.terms, found.zernike.coefficients, found.zernike.uncertainty, strict=True
    )
    figures = {name: (v.value, v.uncertainty) for name, v in found.deviation.items()}
    zernike = {f"Z({t.n}, {t.m})": (float(c), float(u)) for t, c, u in terms}
    return Form.of(found.map, figures=figures, zernike=zernike)


@bounded(accuracy=BUDGET, tolerance=TOLERANCE)
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
    calibration
        Of the machine and probe that made them.
    nominal
        Surface of the part; None fits a polynomial.
    sources
        ``SOURCES.yaml`` with the declared sources, the priors of the adjustment.
    clocking
        Angle by which the part is turned on the chuck in each scan [rad].
    accuracy
        Expanded uncertainty asked for [m].
    tolerance
        Tolerance of the peak to valley [m].

    Returns
    -------
    Adjusted
        Verdict, figures and found sources in ``facts``; the form [m] with standard uncertainty.

    Examples
    --------
    >>> omsm.adjust([scan], calibration, nominal=mirror).verdict  # one scan does not verify itself
    'not_verified'
    """
    from omsm_ros.io.descriptions import load_sources
    from omsm_ros.pipelines.adjust import adjust_bags, adjustment_facts

    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for k, scan in enumerate(scans):
            given = isinstance(scan, Recording)
            paths.append(Path(folder) / f"scan_{k + 1}.mcap" if given else Path(scan))
            if given:
                scan.save(paths[k])
        found, read_scans = adjust_bags(
            paths,
            _checked(calibration, Calibration).core,
            nominal=nominal,
            stated=load_sources(sources),
            clockings=clocking,
            accuracy=accuracy,
        )
    facts = adjustment_facts(found, read_scans, calibration.core, tolerance)
    return Adjusted.of(found.form, facts=facts)


@bounded(uncertainty=UNCERTAINTY)
def difference(
    a: Points | Path | str,
    b: Points | Path | str,
    *,
    nominal: Surface | None = None,
    fit: Sequence[str] = ("piston", "tip", "tilt"),
    uncertainty: float | None = None,
) -> Difference:
    """Compare two measurements of one part, the second moved onto the first.

    Parameters
    ----------
    a, b
        Points, or files of any instrument.
    nominal
        Surface to subtract from both first.
    fit
        Pose parameters of the move.
    uncertainty
        Standard uncertainty of heights that state none [m].

    Returns
    -------
    Difference
        b - a [m] at the matched points, and whether it is within the uncertainties.

    Raises
    ------
    DataError
        For measurements that hardly overlap, or cover no area.

    Examples
    --------
    >>> float(np.abs(omsm.difference(points, points, nominal=mirror).difference).max()) < 1e-12
    True
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
    spread = unknown if found.agreement is None else found.agreement.uncertainty
    return Difference.of(matched, facts=facts_of(found), uncertainty=spread)


@bounded(
    period=SAMPLE_PERIOD, rpm=SPEED, radius=RADIUS, feed=FEED,
    step=STEP, second_step=STEP, half_range=STEP, count=COUNT, dwell=DWELL, rise=RISE,
)  # fmt: skip
def plan(
    nominal: Surface | None = None,
    *,
    period: float = 1e-3,
    rpm: float | None = None,
    radius: float | None = None,
    feed: float | None = None,
    dialect: str = "linuxcnc",
    **steps: float,
) -> Plan:
    """Plan a step test, or a scan of ``nominal`` from ``radius`` to the centre.

    Parameters
    ----------
    nominal
        Surface of the part; None plans a step test.
    period
        Sample period [s].
    rpm
        Speed of the spindle in a scan [1/min]; 30 unless stated.
    radius
        Radius at the start of a scan [m]; 12.7 mm unless stated.
    feed
        Feed per turn of a scan [m]; 0.1 mm unless stated.
    dialect
        Of the controller: ``linuxcnc``, ``fanuc``, ``siemens`` or ``nanotech``.
    **steps
        Of a step test: ``step``, ``second_step``, ``half_range`` [m], ``count``, ``dwell``,
        ``rise`` [s].

    Returns
    -------
    Plan
        Motion of the axes (n,), and the program as G-code.

    Raises
    ------
    ConfigurationError
        For a motion that the probe or the sampling cannot follow, or arguments of the other kind.

    Examples
    --------
    >>> omsm.plan(dialect="fanuc").gcode.count("G04") > 20
    True
    """
    from omsm_ros.core.adjustment import ScanDesign
    from omsm_ros.core.kinematics import trajectories as motions
    from omsm_ros.io.gcode_file import DIALECTS, steps_gcode
    from omsm_ros.pipelines.plan_scans import scan_path, scan_program

    if dialect not in DIALECTS:
        raise ConfigurationError(f"dialect {dialect!r} is none of {', '.join(DIALECTS)}")
    asked = {"rpm": rpm, "radius": radius, "feed": feed}
    stated = {name: value for name, value in asked.items() if value is not None}
    if wrong := (stated if nominal is None else steps):
        kind, remedy = ("scan", "give") if nominal is None else ("step test", "leave out")
        raise ConfigurationError(f"{', '.join(wrong)}: of a {kind}; {remedy} the nominal surface")
    if nominal is None:
        step = steps.get("step", 9.8e-6)
        usual = {"step": step, "second_step": motions.SECOND_SHARE * step,
                 "count": motions.PLANNED_COUNT, "dwell": motions.PLANNED_DWELL_S}  # fmt: skip
        test = motions.plan_steps(sample_period=period, **{**usual, **steps})
        z = test.z(np.arange(0.0, test.duration, period, dtype=np.float64))
        zero = np.zeros(len(z))
        return Plan(z=z, x=zero, c=zero, period=period, gcode=steps_gcode(test, dialect))
    spiral = {"rpm": 30.0, "radius": 12.7e-3, "feed": 1e-4} | stated
    design = ScanDesign(
        rpm=spiral["rpm"], start=spiral["radius"], end=0.0, pitch=spiral["feed"], rate=1 / period
    )
    x, z, c = scan_path(design, nominal, np.arange(0.0, design.duration, period, dtype=np.float64))
    program = scan_program(design, nominal, dialect=dialect)[1]
    return Plan(z=z, x=x, c=c, period=period, gcode=program)


@bounded(accuracy=BUDGET)
def predict(
    motion: Plan | Recording, calibration: Calibration, *, accuracy: float = 20e-9
) -> Prediction:
    """Predict the dynamic error of a motion, what the correction leaves, and the maximum speed.

    Parameters
    ----------
    motion
        A plan, or a recording.
    calibration
        Of the machine and probe that will execute it.
    accuracy
        Expanded uncertainty asked for, k = 2 [m].

    Returns
    -------
    Prediction
        Error (n,) and what remains of it [m], and by which factor the speed may rise.

    Raises
    ------
    DataError
        For a motion that is shorter than the filter takes to settle.

    Examples
    --------
    >>> omsm.predict(scan, calibration).residual < 20e-9
    True
    """
    from omsm_ros.core.correction.predict import dynamic_error, predict_error
    from omsm_ros.core.kinematics.scan_path import ScanPath

    path = ScanPath(z=motion.z, sample_period=motion.period, x=motion.x, c=motion.c)
    found = predict_error(_checked(calibration, Calibration).core, path, accuracy)
    error = dynamic_error(calibration.core.dynamics, motion.z, motion.period)
    return Prediction.of(found, error=error, period=motion.period)


@bounded(step=STEP)
def spectrum(values: ArrayLike, step: float) -> Spectrum:
    """Return the power spectral density of evenly spaced values, their mean removed.

    Parameters
    ----------
    values
        Of any unit, (n,).
    step
        Between the values [s], or [m] along a path.

    Returns
    -------
    Spectrum
        Frequency [1/s or 1/m] and density [unit² s or unit² m], (n // 2 + 1,).

    Examples
    --------
    >>> wave = np.sin(2 * np.pi * 50 * np.arange(1000) * 1e-3)
    >>> round(omsm.spectrum(wave, 1e-3).rms(40, 60), 3)
    0.707
    """
    from omsm_ros.core.ripple.density import density

    array = np.asarray(values, np.float64)
    found = density(array - array.mean(), step)
    return Spectrum(found.frequency, found.density)
