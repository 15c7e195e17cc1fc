"""Inputs of the Python interface: calibrations, recordings, saved results, surfaces, the twin."""

from __future__ import annotations

import functools
import inspect
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omsm_ros.core.calibration.calibration import Calibration as _Calibration
from omsm_ros.core.lti.transfer_function import TransferFunction, to_control
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, on_counts
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.interface_results import Points, Recording, Result, load_saved
from omsm_ros.quantities import RADIUS, SEED, SPEED, Quantity
from omsm_ros.readable import measured, plain, quantity

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure

    from omsm_ros.core.kinematics.kinematics import Surface


_Task = TypeVar("_Task", bound=Callable[..., Any])


def bounded(**quantities: Quantity) -> Callable[[_Task], _Task]:
    """Return a decorator: an argument outside its quantity is a ConfigurationError with its name.

    None is not stated and always passes.
    """

    def decorate(task: _Task) -> _Task:
        signature = inspect.signature(task)

        @functools.wraps(task)
        def checked(*args: Any, **named: Any) -> Any:
            given = signature.bind(*args, **named).arguments | named
            for name in given.keys() & quantities.keys():
                if given[name] is not None:
                    quantities[name].checked(given[name], ConfigurationError, name)
            return task(*args, **named)

        return cast("_Task", checked)

    return decorate


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Result):
    """Identified dynamics from encoder to probe; ``core`` is what files and nodes share."""

    core: _Calibration

    @classmethod
    def from_control(
        cls,
        system: control.TransferFunction | control.StateSpace,
        period: float,
        delay: float = 0.0,
        static_gain: float = 1.0,
    ) -> Calibration:
        """Return a calibration without uncertainty and certificate from python-control.

        system: continuous, in rad/s; its gain at zero frequency multiplies ``static_gain``
        period: of the samples [s];  delay: of the probe [s], in addition to the system

        Raises ConfigurationError for a system that is sampled, or has no finite static gain.
        """
        import control as package

        rational = package.tf(system)
        numerator, denominator = (
            np.ravel(v[0][0])[::-1].astype(np.float64) for v in (rational.num, rational.den)
        )
        if rational.isdtime(strict=True) or not numerator[0] * denominator[0]:
            raise ConfigurationError(
                "the system must be continuous, with a static gain that is not zero or infinite"
            )
        gain = float(numerator[0] / denominator[0])
        dynamics = TransferFunction(numerator / numerator[0], denominator / denominator[0], delay)
        size = len(numerator) + len(denominator)
        return cls(
            _Calibration(
                dynamics=dynamics,
                static_gain=static_gain * gain,
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
        return self.core.low_frequency_delay_uncertainty

    @property
    def verdict(self) -> str:
        """Verdict of the certificate, empty without one."""
        return self.core.certificate.verdict or ""

    def response(self, frequency: ArrayLike) -> NDArray[np.complex128]:
        """Return G at ``frequency`` [Hz], of its shape; G(0) = 1, without the static gain."""
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

    def _figure(self) -> Figure:
        from omsm_ros.report.response_figures import bode

        return bode(self.core, None, self.core.sample_period)

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of the calibration, SI units; powers of s ascend."""
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
        """Write ``CAL.json``, which commands and nodes read."""
        from omsm_ros.io.calibration_file import save_calibration

        save_calibration(path, self.core)


def read(path: Path | str, columns: Path | str | None = None) -> Recording:
    """Read axes and distance on one trigger count.

    Parameters
    ----------
    path
        ``.mcap`` or ``.db3`` file, or the folder of a bag; a table (CSV, HDF5 …) with ``columns``.
    columns
        ``MAP.yaml`` with names, units and signs, as for ``omsm import``.

    Returns
    -------
    Recording
        Arrays (n,) over the counts from the first to the last, NaN where a sample is missing.

    Raises
    ------
    BagError, FileError, DataError
        For a path that holds no such recording.

    Examples
    --------
    >>> omsm.simulate("step_test").save("steps.mcap")
    >>> len(omsm.read("steps.mcap"))
    29000
    """
    if columns is not None:
        from omsm_ros.io.tables.table import load_column_map
        from omsm_ros.pipelines.importing import import_recording

        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / "recording.mcap"
            import_recording([Path(path)], *load_column_map(Path(columns)), bag)
            return replace(read(bag), name=str(path))
    from omsm_ros.io import bags
    from omsm_ros.io.topics import AXES_TOPIC, DISTANCE_TOPIC

    axes: list[AxisBlock] = []
    distance: list[DistanceBlock] = []
    with bags.BagReader(path) as reader:
        for _, _, block in reader.blocks(AXES_TOPIC, DISTANCE_TOPIC):
            (axes if isinstance(block, AxisBlock) else distance).append(block)
    if not axes or not distance:
        raise DataError(f"{str(path)!r} has no samples of axes and probe; record both")
    first = min(b.first_sample for b in (*axes, *distance))
    last = max(b.first_sample + len(b) for b in (*axes, *distance))
    made = {
        name: on_counts(((b.first_sample, getattr(b, name)) for b in blocks), first, last)
        for blocks, names in ((axes, ("z", "x", "c")), (distance, ("distance",)))
        for name in names
    }
    return Recording(**made, period=float(axes[0].sample_period), name=str(path))


def load(path: Path | str) -> Any:
    """Load a result: ``CAL.json``, what ``save`` wrote, or points of a cloud or map.

    Parameters
    ----------
    path
        ``.json`` or ``.npz`` of a result, else a file of points. Clouds and maps of other
        instruments are read as Points (csv, xyz, ply, x3p, Zygo .dat …).

    Raises
    ------
    FileError
        For a file that holds none of these.

    Examples
    --------
    >>> calibration.save("cal.json")
    >>> omsm.load("cal.json").lag == calibration.lag
    True
    """
    file = Path(path)
    if file.suffix == ".json":
        from omsm_ros.io.calibration_file import load_calibration

        return Calibration(load_calibration(file))
    if file.suffix == ".npz":
        return load_saved(file)
    from omsm_ros.io.maps.read_map import read_points

    found = read_points(file)
    zero = np.zeros(len(found), np.int64)
    return Points.of(
        found,
        uncertainty=zero * np.nan if found.uncertainty is None else found.uncertainty,
        dynamic_error=zero.astype(np.float64),
        sample=zero if found.sample is None else found.sample,
        counted={},
    )


def surface(shape: str | Path, **parameters: Any) -> Surface:
    """Return a nominal surface: a shape with its parameters, or a ``SURFACE.yaml``.

    Parameters
    ----------
    shape
        Name of a shape, or path of a file.
    **parameters
        Of the shape [m, rad], as in the file.

    Raises
    ------
    ConfigurationError
        For an unknown shape or parameter.

    Examples
    --------
    >>> omsm.surface("sphere", radius=0.1).height(np.zeros(1), np.zeros(1))
    array([0.])
    """
    from omsm_ros.io.descriptions import load_surface, surface_of

    if Path(shape).suffix in (".yaml", ".yml"):
        return load_surface(shape)
    return surface_of({"shape": str(shape), **parameters}, f"surface {shape!r}")


@bounded(seed=SEED, part=SEED, rpm=SPEED, radius=RADIUS)
def simulate(
    motion: str = "scan",
    *,
    seed: int = 1,
    rpm: float = 30.0,
    radius: float = 2e-3,
    outward: bool = False,
    part: int | None = None,
) -> Recording:
    """Simulate the paper's machine.

    Parameters
    ----------
    motion
        ``"step_test"``, or ``"scan"`` of its mirror.
    seed
        Of noise and part.
    part
        Seed of the part alone, for several scans of one part.
    rpm
        Speed of the spindle [1/min].
    radius
        Radius of the scan [m].
    outward
        True for a scan from the centre.

    Raises
    ------
    ConfigurationError
        For another motion, or a scan beyond the mirror or of too many samples.

    Examples
    --------
    >>> print(scan)
    recording  20000 samples, 20.0 s
    from       twin, seed 1
    """
    from omsm_ros.pipelines.record_bags import check_scenario
    from omsm_ros.twin.scenario import Scenario, planned_test_of, scan_of

    scenario = Scenario(
        seed=seed, spindle_speed=rpm, start_radius=radius, outward=outward, part_seed=part
    )
    check_scenario(scenario)
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
