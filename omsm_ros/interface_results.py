"""Results of the Python interface: small frozen objects, all quantities in SI units.

Each prints in a few lines and shows a table in a notebook. ``plot()`` returns matplotlib axes,
``to_dict()`` values, ``to_pandas()`` and ``to_xarray()`` tables; ``save()`` writes what
``omsm.load()`` reads.
"""

from __future__ import annotations

import html
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray, Status
from omsm_ros.errors import ConfigurationError, DataError, FileError
from omsm_ros.readable import expanded, figure, plain, quantity

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from omsm_ros.core.kinematics.kinematics import Surface

_Made = TypeVar("_Made", bound="Result")
_BLOCK = 20_000
_ORIGIN = "omsm_ros result"


class Result:
    """Base of all results: text, tables, axes and files."""

    _along = "sample"

    @classmethod
    def of(cls: type[_Made], record: object, **more: Any) -> _Made:
        """Return the result with the values of ``record`` of the same names, and ``more``."""
        names = {f.name for f in fields(cls)} - set(more)  # type: ignore[arg-type]
        return cls(**more, **{name: getattr(record, name) for name in names})

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield name and value of each printed line, at most 15."""
        raise NotImplementedError

    def _figure(self) -> Figure:
        raise NotImplementedError

    def __str__(self) -> str:
        rows = list(self.rows())
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        cells = "".join(
            f"<tr><th style='text-align:left'>{html.escape(n)}</th><td>{html.escape(v)}</td></tr>"
            for n, v in self.rows()
        )
        return f"<table>{cells}</table>"

    def plot(self) -> Axes:
        """Draw the result, and return its first axes; their ``figure`` has ``savefig``."""
        return self._figure().axes[0]

    def to_dict(self) -> dict[str, Any]:
        """Return the arrays and values by name."""
        # Only results have fields, which their classes declare as dataclasses.
        return {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {k: v for k, v in self.to_dict().items() if isinstance(v, np.ndarray)}

    def to_pandas(self) -> pandas.DataFrame:
        """Return the arrays as a table; without arrays, one row of the values. Needs pandas."""
        import pandas as pd

        return pd.DataFrame(self._columns() or {k: [v] for k, v in self.to_dict().items()})

    def to_xarray(self) -> xarray.Dataset:
        """Return the arrays as a dataset along ``sample``, ``point`` or ``line``. Needs xarray."""
        import xarray as xr

        return xr.Dataset({k: (self._along, v) for k, v in self._columns().items()})

    def save(self, path: Path | str) -> None:
        """Write the result as ``.npz``; ``omsm.load`` reads it."""
        from omsm_ros.io.files import save_bytes

        if Path(path).suffix != ".npz":
            raise ConfigurationError(f"{str(path)!r}: a {type(self).__name__} is saved as .npz")
        arrays = self._columns()
        rest = {k: v for k, v in self.to_dict().items() if k not in arrays}
        head = json.dumps({"origin": _ORIGIN, "kind": type(self).__name__, "values": rest})
        buffer = io.BytesIO()
        np.savez_compressed(buffer, head=np.array(head), **arrays)
        save_bytes(path, buffer.getvalue())


def load_saved(path: Path) -> Any:
    """Return the result that ``save`` wrote to an ``.npz``; raise FileError for another file."""
    try:
        with np.load(path) as held:  # numpy refuses pickles by default
            arrays = dict(held)
        head = json.loads(str(arrays.pop("head")))
        kind = {k.__name__: k for k in Result.__subclasses__()}[head["kind"]]
        return kind(**arrays, **head["values"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, AttributeError) as err:
        raise FileError(f"{str(path)!r} is not a saved result of omsm_ros") from err


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Result):
    """Axes and probe of one recording, sampled by one trigger.

    z, distance: of the encoder and the probe [m], each (n,), NaN where lost;  period: [s]
    x, c: position of X [m], angle of the spindle [rad], (n,);  name: where it is from

    Raises DataError for arrays of different shape.

    >>> import numpy as np
    >>> t = np.arange(1000) * 1e-3
    >>> print(omsm.Recording(z=1e-6 * np.sin(t), distance=-1e-6 * np.sin(t), period=1e-3))
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
        yield "recording", f"{len(self)} samples, {quantity(len(self) * self.period, 's')}"
        yield "from", self.name

    def _figure(self) -> Figure:
        return _over_time(self.time, {"z": self.z, "distance": self.distance})

    def save(self, path: Path | str) -> None:
        """Write a bag ``.mcap`` that the commands read, or ``.npz``."""
        if Path(path).suffix != ".mcap":
            return super().save(path)
        from omsm_ros.io.bag_writer import BagWriter
        from omsm_ros.io.topics import AXES_TOPIC, DISTANCE_TOPIC

        with BagWriter(Path(path), [AXES_TOPIC, DISTANCE_TOPIC]) as bag:
            for axes, distance in self.blocks():
                bag.write_block(axes)
                bag.write_block(distance)
        return None


def _over_time(time: FloatArray, curves: Mapping[str, FloatArray]) -> Figure:
    """Draw ``curves`` (n,) [m] over time [s], one below the other, in µm."""
    from omsm_ros.report.style import Panel, panels

    return panels(
        *(Panel("", "time [s]", f"{n} [µm]", {"": (time, v / 1e-6)}) for n, v in curves.items())
    )


@dataclass(frozen=True, eq=False, repr=False)
class Points(Result):
    """Surface points, arrays (n,).

    x, y: in the frame of the workpiece [m];  height: [m]
    uncertainty: standard [m], NaN where the file of another instrument states none
    dynamic_error: that was removed [m];  sample: trigger count;  counted: samples by reason
    """

    x: FloatArray
    y: FloatArray
    height: FloatArray
    uncertainty: FloatArray
    dynamic_error: FloatArray
    sample: NDArray[np.int64]
    counted: Mapping[str, Any] = field(default_factory=dict)

    _along = "point"

    def __len__(self) -> int:
        return len(self.x)

    def rows(self) -> Iterator[tuple[str, str]]:
        yield "points", str(len(self))
        for stream, account in self.counted.items():
            left = [f"{count} {why}" for why, count in account["counted"].items() if count]
            lost = f", without {', '.join(left)}" if left else ""
            yield f"samples of {stream}", f"{account['received']} received{lost}"
        across = (f"{1e3 * np.ptp(along):.4g} mm" for along in (self.x, self.y))
        yield "extent", " × ".join(across)
        error = self.dynamic_error - self.dynamic_error.mean()
        yield "removed error", f"{quantity(float(np.ptp(error)), 'm')} PV"
        if np.any(np.isfinite(self.uncertainty)):
            middle = float(np.nanmedian(self.uncertainty))
            yield "uncertainty", f"{quantity(middle, 'm')} (median, k = 1)"

    def plot(self, nominal: Surface | None = None) -> Axes:
        """Draw the deviation from ``nominal``, or the heights, as a map; return its axes."""
        height = self.height if nominal is None else self.height - nominal.height(self.x, self.y)
        return _map(self.x, self.y, height - np.mean(height), "height").axes[0]


def _map(x: FloatArray, y: FloatArray, height: FloatArray, title: str) -> Figure:
    from omsm_ros.report.measurement.figures import UNITS_M, deviation_map

    size = float(np.ptp(height))
    unit = next((u for u, length in UNITS_M.items() if size < 3000 * length), "mm")
    return deviation_map(x, y, height, unit=unit, title=f"{title} [{unit}]", quantity=title)


@dataclass(frozen=True, eq=False, repr=False)
class Form(Result):
    """Form of a registered part.

    figures: value and standard uncertainty by name [m], null: not evaluated
    zernike: likewise by "Z(n, m)", each one at the rim [m]
    x, y: in the part's frame [m];  deviation: of the registered part [m], each (n,)
    """

    figures: Mapping[str, Sequence[float | None]]
    zernike: Mapping[str, Sequence[float | None]]
    x: FloatArray
    y: FloatArray
    deviation: FloatArray

    _along = "point"

    def rows(self) -> Iterator[tuple[str, str]]:
        for name in ("peak_to_valley_best_fit", "rms_best_fit", "robust_peak_to_valley"):
            if name in self.figures:
                yield figure(name), expanded(self.figures[name][0], self.figures[name][1], "m")
        largest = sorted(self.zernike.items(), key=lambda term: -abs(term[1][0] or 0.0))
        for name, value in largest[:4]:
            yield name, expanded(value[0], value[1], "m", signed=True)
        yield "points", str(len(self.x))

    def _figure(self) -> Figure:
        return _map(self.x, self.y, self.deviation, "deviation")


@dataclass(frozen=True, eq=False, repr=False)
class Adjusted(Result):
    """Scans of one part, adjusted together: form, sources declared and found, verdict.

    facts: as in ``adjustment.json``
    x, y: of the part [m];  height, uncertainty: form deviation and its standard [m], each (n,)
    """

    facts: Mapping[str, Any]
    x: FloatArray
    y: FloatArray
    height: FloatArray
    uncertainty: FloatArray

    _along = "point"

    @property
    def verdict(self) -> str:
        """``verified``, ``not_verified``, ``contradicted`` or ``too_uncertain``."""
        return str(self.facts["verdict"]["code"])

    def rows(self) -> Iterator[tuple[str, str]]:
        from omsm_ros.report.verdict import headline, next_steps

        yield "result", headline(self.facts)
        yield "verdict", self.facts["verdict"]["text"]
        for text in next_steps(self.facts["verdict"])[:8]:
            yield "", text

    def _figure(self) -> Figure:
        from omsm_ros.report.adjustment import height_map

        return height_map(self.x, self.y, self.height, "form deviation")


@dataclass(frozen=True, eq=False, repr=False)
class Difference(Result):
    """Two measurements of one part, the second moved onto the first and subtracted.

    facts: as in ``difference.json``;  x, y: of the compared places [m]
    difference: b - a [m];  uncertainty: of it, standard [m], NaN where unknown; each (n,)
    """

    facts: Mapping[str, Any]
    x: FloatArray
    y: FloatArray
    difference: FloatArray
    uncertainty: FloatArray

    _along = "point"

    @property
    def verdict(self) -> str:
        """Whether both agree within their uncertainties."""
        return str(self.facts["verdict"])

    def rows(self) -> Iterator[tuple[str, str]]:
        yield "verdict", self.verdict
        for reason in self.facts["reasons"][:3]:
            yield "", reason
        yield "difference", f"{quantity(float(np.sqrt(np.mean(self.difference**2))), 'm')} rms"
        for name, found in list(self.facts["e_n"].items())[:6]:
            e_n = "not evaluated" if found["e_n"] is None else plain(found["e_n"])
            yield f"E_n of {figure(name)}", e_n

    def _figure(self) -> Figure:
        return _map(self.x, self.y, self.difference, "difference")


@dataclass(frozen=True, eq=False, repr=False)
class Spectrum(Result):
    """One-sided power spectral density.

    frequency: [Hz], or [1/m] along a path, (m,);  density: [unit²/Hz], or [unit²·m], (m,)
    """

    frequency: FloatArray
    density: FloatArray

    _along = "line"

    def rms(self, low: float = 0.0, high: float = np.inf) -> float:
        """Return the root mean square between two frequencies."""
        inside = (self.frequency >= low) & (self.frequency <= high)
        step = float(self.frequency[1] - self.frequency[0])
        return float(np.sqrt(np.sum(self.density[inside]) * step))

    def rows(self) -> Iterator[tuple[str, str]]:
        peak = int(np.argmax(self.density[1:])) + 1
        yield "spectrum", f"{len(self.frequency)} lines up to {plain(self.frequency[-1])}"
        yield "highest line at", plain(float(self.frequency[peak]))
        yield "rms", plain(self.rms(float(self.frequency[1])))

    def _figure(self) -> Figure:
        from omsm_ros.report.style import Panel, panels

        x, y = "frequency [Hz or 1/m]", "density [unit²/Hz or unit²·m]"
        return panels(Panel("", x, y, {"": (self.frequency[1:], self.density[1:])}, log="xy"))


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Result):
    """A planned step test or scan.

    z, x: positions [m];  c: angle of the spindle [rad], each (n,);  period: of the samples [s]
    gcode: program for the controller
    """

    z: FloatArray
    x: FloatArray
    c: FloatArray
    period: float
    gcode: str

    @property
    def time(self) -> FloatArray:
        """Time of each position [s], (n,)."""
        return np.arange(len(self.z), dtype=np.float64) * self.period

    def rows(self) -> Iterator[tuple[str, str]]:
        yield "duration", quantity(len(self.z) * self.period, "s")
        yield "travel of Z", quantity(float(np.ptp(self.z)), "m")
        speed = float(np.max(np.abs(np.diff(self.z)))) / self.period
        yield "fastest Z", quantity(speed, "m/s")
        if np.any(self.c):
            turn = (self.c[-1] - self.c[0]) / (2 * np.pi) / (len(self.z) - 1) / self.period
            yield "spindle", f"{60 * turn:.4g} rpm"

    def _figure(self) -> Figure:
        return _over_time(self.time, {"z": self.z})


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Result):
    """Dynamic error that a motion will have, and how fast it may run.

    error: without correction, after the filter has settled [m], (n,);  period: [s]
    residual: largest standard uncertainty after the correction [m]
    speed_factor: of this motion within all limits;  binding: the first limit
    advice: what to do if a limit is exceeded, else empty
    """

    error: FloatArray
    period: float
    residual: float
    speed_factor: float
    binding: str
    advice: str

    def rows(self) -> Iterator[tuple[str, str]]:
        rms = quantity(float(np.std(self.error)), "m")
        yield "dynamic error", f"{quantity(float(np.ptp(self.error)), 'm')} PV, {rms} rms"
        yield "after correction", f"{quantity(self.residual, 'm')} (k = 1)"
        yield "maximum speed", f"{plain(self.speed_factor)} × this motion, by {self.binding}"
        if self.advice:
            yield "advice", self.advice

    def _figure(self) -> Figure:
        return _over_time(
            np.arange(float(len(self.error))) * self.period, {"dynamic error": self.error}
        )
