"""Inputs of the Python interface: recordings, saved results, surfaces, the twin."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, on_counts
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.interface_calibration import Calibration
from omsm_ros.interface_results import Points, Recording, load_saved

if TYPE_CHECKING:
    from omsm_ros.core.kinematics.kinematics import Surface


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
    made = {
        name: on_counts(((b.first_sample, getattr(b, name)) for b in blocks), first, last)
        for blocks, names in ((axes, ("z", "x", "c")), (distance, ("distance",)))
        for name in names
    }
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
    return _points_of(file)


def _points_of(file: Path) -> Points:
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
        For another motion.

    Examples
    --------
    >>> print(scan)
    recording  20000 samples, 20.0 s
    from       twin, seed 1
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
