"""Results of the Python interface: small frozen objects, all quantities in SI units.

They print in a few lines, ``plot()`` returns a matplotlib figure, ``to_dict()`` values.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omsm_ros.core.calibration.calibration import Calibration as _Calibration
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.core.lti.transfer_function import TransferFunction, to_control
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray, Status
from omsm_ros.errors import DataError
from omsm_ros.readable import expanded, measured, plain, quantity

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure

    from omsm_ros.core.adjustment import Adjustment
    from omsm_ros.core.form.analyse import FormResult
    from omsm_ros.core.kinematics.kinematics import Surface

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
