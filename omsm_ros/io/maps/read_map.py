"""Reads a map of any known format as points in metres."""

import codecs
from dataclasses import replace
from pathlib import Path

from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import DataError, FileError
from omsm_ros.io.files import CLOUD, exception_text, open_regular
from omsm_ros.io.maps import instrument_files
from omsm_ros.io.maps.columns_file import has_dabam_header, read_columns, read_dabam
from omsm_ros.io.maps.grid_sag_file import is_grid_sag, read_grid_sag
from omsm_ros.io.maps.instrument_files import read_foreign
from omsm_ros.io.maps.vertex_file import read_pcd, read_ply
from omsm_ros.io.maps.x3p_file import read_x3p
from omsm_ros.units import NOT_USED, LengthUnits

_HEAD_BYTES = 4096
_BAGS = (b"\x89MCAP0\r\n", b"#ROSBAG V")
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
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
    try:
        return _read(file, units, channel)
    except DataError as err:
        raise FileError(f"map {str(file)!r}: {err}") from err
    except OSError as err:
        raise FileError(
            f"map {str(file)!r} cannot be read: {exception_text(err)}; check the path"
        ) from err


def _head(path: Path) -> bytes:
    """Return the beginning of a file; FileError for an empty one or a bag."""
    with open_regular(path, FileError, "map") as stream:
        head = stream.read(_HEAD_BYTES)
    if not head:
        raise FileError(f"map {str(path)!r} is empty; write it again")
    if head.startswith(_BAGS):
        raise FileError(
            f"{str(path)!r} is a bag, no map; make points of it with 'omsm correct', or give "
            "'omsm form' its --calibration, too; one of ROS 1 needs 'omsm import' first"
        )
    if head.startswith(_UTF_16):
        raise FileError(f"map {str(path)!r} is text in UTF-16; save it as UTF-8")
    return head


def _read(path: Path, units: LengthUnits | None, channel: str | None) -> MeasuredPoints:
    head = _head(path)
    if (found := _of_channels(path, head, channel)) is not None:
        return replace(found, notes=(*found.notes, *([NOT_USED] if units else ())))
    text, suffix = b"\0" not in head, path.suffix.lower()
    points = _of_one(path, head, units)
    if points is None and not (text and suffix in _TEXT_SUFFIXES):
        return read_foreign(path, units, channel)
    if channel is not None:
        raise FileError(f"{str(path)!r} has no channels; leave out --channel")
    return read_columns(path, units) if points is None else points


def _of_channels(path: Path, head: bytes, channel: str | None) -> MeasuredPoints | None:
    """Read a file of a format with channels that fixes its units; None for any other."""
    if head.startswith(instrument_files.MAGIC):
        return instrument_files.read_hdf5(path, channel)
    return read_x3p(path, channel) if path.suffix.lower() == ".x3p" else None


def _of_one(path: Path, head: bytes, units: LengthUnits | None) -> MeasuredPoints | None:
    """Read a file of a format of one map or cloud; None for any other."""
    if head.startswith((b"ply\n", b"ply\r\n")):
        return read_ply(path, units)
    if head.startswith((b"# .PCD", b"VERSION")):
        return read_pcd(path, units)
    if (found := _in_metres(path, head)) is not None:
        # These formats fix the units, so ``units`` are not used.
        unasked = (NOT_USED,) if units else ()
        return replace(found, notes=(*found.notes, *unasked))
    grid = b"\0" not in head and path.suffix.lower() in _GRID_SAG_SUFFIXES
    return (
        read_grid_sag(path, units).points() if grid and is_grid_sag(*_first_lines(head)) else None
    )


def _in_metres(path: Path, head: bytes) -> MeasuredPoints | None:
    """Read a file of a format that fixes its units; None for any other."""
    if head.startswith(instrument_files.METROPRO_MAGIC):
        return instrument_files.read_metropro(path)
    return read_dabam(path) if has_dabam_header(path) else None


def _first_lines(head: bytes) -> tuple[str, str]:
    """Return the first two lines that are neither empty nor comments; "" without one."""
    lines = head.decode("utf-8-sig", "replace").splitlines()
    data = [line for line in lines if line.strip() and not line.startswith("!")]
    first, second = (*data[:2], "", "")[:2]
    return first, second
