"""Reads a map of any known format as points in metres."""

from dataclasses import replace
from pathlib import Path

from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import DataError, FileError, named_errors
from omsm_ros.io.files import CLOUD, explained_errors, open_regular
from omsm_ros.io.maps import instrument_files
from omsm_ros.io.maps.columns_file import UTF_16, has_dabam_header, read_columns, read_dabam
from omsm_ros.io.maps.grid_sag_file import is_grid_sag, read_grid_sag
from omsm_ros.io.maps.instrument_files import read_foreign, read_x3p
from omsm_ros.io.maps.vertex_file import read_cloud
from omsm_ros.units import NOT_USED, LengthUnits

_HEAD_BYTES = 4096
_BAGS = (b"\x89MCAP0\r\n", b"#ROSBAG V")
_GRID_SAG_SUFFIXES = (".dat", ".grd")
_TEXT_SUFFIXES = (".xyz", ".txt", ".asc", ".csv", ".dat", ".tsv")


def read_points(
    path: Path, units: LengthUnits | None = None, channel: str | None = None
) -> MeasuredPoints:
    """Read a map or cloud; the content determines the format; a folder is a result of ours.

    units: of a file that does not state them
    channel: name or number, from 0, of one of several; None for the first that holds heights

    Raises FileError for a file of unknown format, a damaged one, one that needs ``units``, or one
    without this ``channel``.
    """
    file = path / CLOUD if path.is_dir() else path
    what = f"map {str(file)!r}"
    unreadable = explained_errors(f"{what} cannot be read", "check the path", caught=OSError)
    with named_errors(FileError, what, DataError), unreadable:
        return _read(file, units, channel)


def _head(path: Path) -> bytes:
    """Return the beginning of a file; FileError for an empty one or a bag."""
    with open_regular(path, FileError, "map") as stream:
        head = stream.read(_HEAD_BYTES)
    if not head:
        raise FileError(f"map {str(path)!r} is empty; write it again")
    if head.startswith(_BAGS):
        raise FileError(
            f"{str(path)!r} is a bag, no map; make points of it with 'omsm correct', or give "
            "'omsm form' its --calibration, too; a bag of ROS 1 needs 'omsm import' first"
        )
    return head


def _read(path: Path, units: LengthUnits | None, channel: str | None) -> MeasuredPoints:
    head, suffix = _head(path), path.suffix.lower()
    text = b"\0" not in head or head.startswith(UTF_16)
    if head.startswith(instrument_files.MAGIC):
        return _in_own_units(instrument_files.read_hdf5(path, channel), units)
    if suffix == ".x3p":
        return _in_own_units(read_x3p(path, channel), units)
    points = None
    if head.startswith((b"ply\n", b"ply\r\n", b"# .PCD", b"VERSION")):
        points = read_cloud(path, units)
    elif head.startswith(instrument_files.METROPRO_MAGIC):
        points = _in_own_units(instrument_files.read_metropro(path), units)
    elif head.startswith(instrument_files.ZYGO_TEXT):
        points = _in_own_units(instrument_files.read_zygo_text(path), units)
    elif has_dabam_header(path):
        points = _in_own_units(read_dabam(path), units)
    elif text and suffix in _GRID_SAG_SUFFIXES and is_grid_sag(*_first_lines(head)):
        points = read_grid_sag(path, units).points()
    elif not (text and suffix in _TEXT_SUFFIXES):
        return read_foreign(path, units, channel)
    if channel is not None:
        raise FileError(f"{str(path)!r} has no channels; leave out --channel")
    return read_columns(path, units) if points is None else points


def _in_own_units(found: MeasuredPoints, units: LengthUnits | None) -> MeasuredPoints:
    """Return points of a format that fixes its units, with a note if others were stated."""
    return replace(found, notes=(*found.notes, *([NOT_USED] if units else ())))


def _first_lines(head: bytes) -> tuple[str, str]:
    """Return the first two lines that are neither empty nor comments; "" without one."""
    lines = head.decode("utf-8-sig", "replace").splitlines()
    data = [line for line in lines if line.strip() and not line.startswith("!")]
    first, second = (*data[:2], "", "")[:2]
    return first, second
