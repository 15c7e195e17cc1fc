"""The Python interface: arrays in, results out. Works without ROS.

Use it as ``import omsm_ros as omsm``. All quantities are in SI units. Results are small frozen
objects: they print in a few lines, ``plot()`` returns a matplotlib figure, ``to_dict()`` values.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omsm_ros.core.calibration.calibration import Calibration as _Calibration
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.core.lti.transfer_function import TransferFunction, to_control
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray, Status
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.readable import expanded, measured, plain, quantity

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure

    from omsm_ros.core.adjustment import Adjustment
    from omsm_ros.core.form.analyse import FormResult
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

_BLOCK = 20_000


class _Result:
    """Text of a result for terminals and notebooks."""

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield name and value of each printed line."""
        raise NotImplementedError

    def __str__(self) -> str:
        rows = list(self.rows())
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)

    def _repr_html_(self) -> str:
        cells = "".join(
            f"<tr><th style='text-align:left'>{html.escape(n)}</th><td>{html.escape(v)}</td></tr>"
            for n, v in self.rows()
        )
        return f"<table>{cells}</table>"


@dataclass(frozen=True, eq=False, repr=False)
class Recording(_Result):
    """Axes and probe of one recording, sampled by one trigger.

    Parameters
    ----------
    z, distance
        Position of the encoder and reading of the probe [m], each (n,); NaN where lost.
    period
        Sample period [s].
    x, c
        Position of X [m] and angle of the spindle [rad], each (n,); zero where not given.
    name
        Where it is from.

    Raises
    ------
    DataError
        For arrays of different shape.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(1000) * 1e-3
    >>> print(Recording(z=1e-6 * np.sin(t), distance=-1e-6 * np.sin(t), period=1e-3))
    recording  1000 samples, 1.00 s
    from       arrays
    """

    z: FloatArray
    distance: FloatArray
    period: float
    x: FloatArray = field(default_factory=lambda: np.zeros(0))
    c: FloatArray = field(default_factory=lambda: np.zeros(0))
    name: str = "arrays"

    def __post_init__(self) -> None:
        count = len(self.z)
        for name in ("z", "distance", "x", "c"):
            values = np.asarray(getattr(self, name), np.float64)
            if not len(values) and name in "xc":
                values = np.zeros(count)
            if values.shape != (count,):
                raise DataError(f"{name} has shape {values.shape!r}, expected ({count},)")
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.z)

    @property
    def time(self) -> FloatArray:
        """Time since the first sample [s], (n,)."""
        return np.arange(len(self), dtype=np.float64) * self.period

    def blocks(self) -> Iterator[tuple[AxisBlock, DistanceBlock]]:
        """Yield the samples as blocks of both streams."""
        for begin in range(0, len(self), _BLOCK):
            part = slice(begin, begin + _BLOCK)
            head: dict[str, Any] = {
                "stamp_ns": round(begin * self.period * 1e9),
                "first_sample": begin,
                "sample_period": self.period,
            }
            zero = np.zeros(len(self.z[part]))
            status = np.where(np.isfinite(self.distance[part]), Status.OK, Status.NO_TARGET)
            yield (
                AxisBlock(**head, x=self.x[part], y=zero, z=self.z[part], b=zero, c=self.c[part]),
                DistanceBlock(**head, distance=self.distance[part], status=status.astype(np.uint8)),
            )

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield the printed lines."""
        yield "recording", f"{len(self)} samples, {quantity(len(self) * self.period, 's')}"
        yield "from", self.name

    def plot(self) -> Figure:
        """Draw position and distance over time."""
        from omsm_ros.report import style

        made, axes = style.figure(9.2, 4.5, 2, 1, sharex=True)
        for ax, name in zip(axes[:, 0], ("z", "distance"), strict=True):
            ax.plot(self.time, getattr(self, name) / 1e-6, linewidth=0.8)
            style.label(ax, y="µm", title=name)
        style.label(axes[-1, 0], x="time [s]")
        return made

    def to_dict(self) -> dict[str, Any]:
        """Return the arrays by name."""
        return {name: getattr(self, name) for name in ("z", "distance", "x", "c", "period")}


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(_Result):
    """Identified dynamics from encoder to probe; ``core`` is what files and nodes share."""

    core: _Calibration

    @classmethod
    def from_control(
        cls, system: control.TransferFunction, period: float, delay: float = 0.0
    ) -> Calibration:
        """Return a calibration without certificate from a python-control system.

        system: continuous, in rad/s, of gain one at zero frequency;  period, delay: [s]
        """
        numerator, denominator = (np.ravel(v[0][0])[::-1] for v in (system.num, system.den))
        dynamics = TransferFunction(numerator / denominator[0], denominator / denominator[0], delay)
        size = len(numerator) + len(denominator)
        return cls(
            _Calibration(
                dynamics=dynamics,
                static_gain=1.0,
                sample_period=period,
                valid_up_to=0.5 / period,
                covariance=np.zeros((size, size)),
            )
        )

    @property
    def lag(self) -> float:
        """Lag of the probe at low frequency [s]."""
        return self.core.dynamics.low_frequency_delay

    @property
    def lag_uncertainty(self) -> float:
        """Standard uncertainty of :attr:`lag` [s]."""
        return low_frequency_delay_uncertainty(self.core.dynamics, self.core.covariance)

    @property
    def verdict(self) -> str:
        """Verdict of the certificate, empty without one."""
        return self.core.certificate.verdict or ""

    def response(self, frequency: ArrayLike) -> NDArray[np.complex128]:
        """Return G at ``frequency`` [Hz], of its shape."""
        return self.core.dynamics.response(np.asarray(frequency, np.float64))

    def to_control(self, delay_order: int = 3) -> control.TransferFunction:
        """Return G as a python-control system in rad/s, its delay as a Padé approximant."""
        return to_control(self.core.dynamics, delay_order)

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield the printed lines."""
        yield "calibration", self.core.id[:12]
        yield "verdict", self.verdict or "no certificate"
        yield "lag", measured(self.lag, self.lag_uncertainty, "s")
        yield "static gain", plain(self.core.static_gain, 6)
        yield "valid up to", quantity(self.core.valid_up_to, "Hz")
        for reason in self.core.certificate.reasons[:5]:
            yield "reason", str(reason)

    def plot(self) -> Figure:
        """Draw gain, phase and the error of a motion before and after the correction."""
        from omsm_ros.report.response_figures import bode

        return bode(self.core, None, self.core.sample_period)

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of the calibration, SI units."""
        return {
            "id": self.core.id,
            "verdict": self.verdict,
            "lag": self.lag,
            "lag_uncertainty": self.lag_uncertainty,
            "static_gain": self.core.static_gain,
            "valid_up_to": self.core.valid_up_to,
            "numerator": list(self.core.dynamics.numerator),
            "denominator": list(self.core.dynamics.denominator),
            "delay": self.core.dynamics.delay,
        }

    def save(self, path: Path | str) -> None:
        """Write ``CAL.json``."""
        from omsm_ros.io.calibration_file import save_calibration

        save_calibration(path, self.core)


@dataclass(frozen=True, eq=False, repr=False)
class Points(_Result):
    """Corrected surface points, arrays (n,).

    x, y: in the frame of the workpiece [m];  height: [m];  uncertainty: standard [m]
    dynamic_error: that was removed [m];  sample: trigger count;  counted: samples by reason
    """

    x: FloatArray
    y: FloatArray
    height: FloatArray
    uncertainty: FloatArray
    dynamic_error: FloatArray
    sample: NDArray[np.int64]
    counted: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.x)

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield the printed lines."""
        yield "points", str(len(self))
        for stream, account in self.counted.items():
            left = {k: v for k, v in account["counted"].items() if v}
            yield f"samples of {stream}", f"{account['received']} received; left out: {left or 0}"
        error = self.dynamic_error - self.dynamic_error.mean()
        yield "removed error", f"{quantity(float(np.ptp(error)), 'm')} PV"
        yield "uncertainty", f"{quantity(float(np.median(self.uncertainty)), 'm')} (median, k = 1)"

    def plot(self, nominal: Surface | None = None) -> Figure:
        """Draw the deviation from ``nominal``, or the heights, as a map."""
        from omsm_ros.report.measurement.figures import deviation_map

        height = self.height if nominal is None else self.height - nominal.height(self.x, self.y)
        return deviation_map(self.x, self.y, height - height.mean(), unit="nm", title="height [nm]")

    def to_dict(self) -> dict[str, Any]:
        """Return the arrays by name."""
        names = ("x", "y", "height", "uncertainty", "dynamic_error", "sample")
        return {name: getattr(self, name) for name in names}

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame`` of the points; needs pandas."""
        import pandas as pd

        return pd.DataFrame(self.to_dict())


@dataclass(frozen=True, eq=False, repr=False)
class Form(_Result):
    """Form of a registered part: figures with uncertainty, and the deviation map.

    figures: value and standard uncertainty [m] by name;  core: the whole result
    """

    core: FormResult

    @property
    def figures(self) -> dict[str, tuple[float | None, float | None]]:
        """Value and standard uncertainty [m] of each figure, None: not evaluated."""
        return {name: (v.value, v.uncertainty) for name, v in self.core.deviation.items()}

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield the printed lines."""
        for name in ("peak_to_valley_best_fit", "rms_best_fit", "robust_peak_to_valley"):
            if name in self.figures:
                yield name.replace("_", " "), expanded(*self.figures[name], "m")
        yield "points", str(len(self.core.map.x))

    def plot(self) -> Figure:
        """Draw the deviation of the registered part."""
        from omsm_ros.report.measurement.figures import deviation_map

        found = self.core.map
        return deviation_map(found.x, found.y, found.deviation, unit="nm", title="deviation [nm]")

    def to_dict(self) -> dict[str, Any]:
        """Return value and uncertainty of each figure."""
        return {name: v.entry() for name, v in self.core.deviation.items()}


@dataclass(frozen=True, eq=False, repr=False)
class Adjusted(_Result):
    """Scans of one part, adjusted together: form, sources declared and found, verdict.

    facts: as in ``adjustment.json``;  core: the whole result
    """

    core: Adjustment
    facts: Mapping[str, Any]

    @property
    def verdict(self) -> str:
        """``verified``, ``not_verified``, ``contradicted`` or ``too_uncertain``."""
        return self.core.verdict.code

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield the printed lines."""
        from omsm_ros.report.adjustment import headline, next_steps

        yield "result", headline(self.facts)
        yield "verdict", self.facts["verdict"]["text"]
        for text in next_steps(self.facts)[:8]:
            yield "", text

    def plot(self) -> Figure:
        """Draw the form deviation."""
        from omsm_ros.report.adjustment import form_map

        return form_map(self.core)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``adjustment.json``."""
        return dict(self.facts)


@dataclass(frozen=True, eq=False, repr=False)
class Spectrum(_Result):
    """One-sided power spectral density.

    frequency: [Hz], or [1/m] along a path, (m,);  density: [unit²/Hz], or [unit²·m], (m,)
    """

    frequency: FloatArray
    density: FloatArray

    def rms(self, low: float = 0.0, high: float = np.inf) -> float:
        """Return the root mean square between two frequencies."""
        inside = (self.frequency >= low) & (self.frequency <= high)
        step = float(self.frequency[1] - self.frequency[0])
        return float(np.sqrt(np.sum(self.density[inside]) * step))

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield the printed lines."""
        peak = int(np.argmax(self.density[1:])) + 1
        yield "spectrum", f"{len(self.frequency)} lines up to {plain(self.frequency[-1])}"
        yield "highest line at", plain(float(self.frequency[peak]))
        yield "rms", plain(self.rms(float(self.frequency[1])))

    def plot(self) -> Figure:
        """Draw the density over frequency, both axes logarithmic."""
        from omsm_ros.report import style

        made, axes = style.figure(9.2, 4.0)
        axes[0, 0].loglog(self.frequency[1:], self.density[1:], linewidth=0.8)
        style.label(axes[0, 0], x="frequency", y="density")
        return made

    def to_dict(self) -> dict[str, Any]:
        """Return frequency and density."""
        return {"frequency": self.frequency, "density": self.density}


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

    options = CorrectionOptions(polarity=polarity, lateral_lag=latency, surface=nominal)
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
