"""Reads and writes x3p (ISO 25178-72): a map, a profile or a cloud, in metres; writes SDF.

Files are written in the revision ``ISO5436 - 2000``, which all readers accept.
"""

import re
import zipfile
from datetime import datetime, timezone
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.measured_points import MeasuredPoints, measured
from omsm_ros.errors import FileError
from omsm_ros.io.files import atomic_file, library_errors, open_regular
from omsm_ros.io.maps.instrument_files import channel_note, chosen_channel
from omsm_ros.io.optional_libraries import import_optional
from omsm_ros.quantities import MAP_POINTS

# The greatest number of points, of eight bytes each, and their description.
MAX_UNPACKED_BYTES = 8 * int(MAP_POINTS.high) + 4_000_000

_REVISION = re.compile(rb"<(?:[\w.-]+:)?Revision>([^<]*)<")
# Letters and digits of a revision, and its text in the standard.
_REVISIONS = {
    b"iso54362000": b"ISO5436 - 2000",
    b"iso25178722017": b"ISO5436 - 2000",
    b"iso25178722017dam1": b"ISO25178-72:2017/DAM1",
    b"iso25178722017amd12020": b"ISO25178-72:2017/DAM1",
}

# Integer types of heights, which need an increment.
_WHOLE = ("I", "L")


def read_x3p(path: Path, channel: str | None = None) -> MeasuredPoints:
    """Read the first layer of an x3p file, or that of the number ``channel``, in its global frame.

    Raises FileError for another or a damaged file, or one that unpacks to too many bytes.
    """
    what = f"x3p file {str(path)!r}"
    x3pio = import_optional("x3pio", what)
    with open_regular(path, FileError, "x3p file") as stream, library_errors(what, "save it again"):
        with zipfile.ZipFile(stream) as archive:
            size = sum(member.file_size for member in archive.infolist())
            if size > MAX_UNPACKED_BYTES:
                raise FileError(
                    f"{what} unpacks to {size} bytes, at most {MAX_UNPACKED_BYTES} are read; "
                    "thin it"
                )
            known = _with_known_revision(archive)
        stream.seek(0)
        content = x3pio.read(known or stream)
        names = [f"layer {k}" for k in range(len(content.layers))]
        chosen = chosen_channel(names, channel, 0, what)
        place = _places(x3pio, content, chosen)
    notes = (channel_note(names, chosen),) if len(names) > 1 else ()
    return measured(place[:, 0], place[:, 1], place[:, 2], notes=notes)


def _with_known_revision(archive: zipfile.ZipFile) -> BytesIO | None:
    """Return the archive with the revision spelled as x3pio expects; None if it already is.

    Some programs deviate from the standard: ISO5436_2000, ISO25178-72:2017.
    """
    main = archive.read("main.xml")
    found = _REVISION.search(main)
    bare = re.sub(rb"[^a-z0-9]", b"", found[1].lower()) if found else b""
    if found is None or bare not in _REVISIONS or found[1].strip() == _REVISIONS[bare]:
        return None
    spelled = BytesIO()
    with zipfile.ZipFile(spelled, "w") as made:
        for member in archive.infolist():
            # The checksum of main.xml is no longer valid.
            if member.filename.endswith("md5checksum.hex"):
                continue
            content = archive.read(member)
            if member.filename == "main.xml":
                content = main[: found.start(1)] + _REVISIONS[bare] + main[found.end(1) :]
            made.writestr(member.filename, content)
    spelled.seek(0)
    return spelled


def _places(x3pio: Any, content: Any, chosen: int = 0) -> FloatArray:
    """Return x, y, height (n, 3) [m] of one layer; NaN = missing."""
    layer, header = content.layers[chosen], content.header
    # A missing increment reads as 1: steps of a metre, which no instrument has.
    if header.z.data_type.value in _WHOLE and header.z.increment == 1.0:
        raise ValueError("its heights are whole numbers without an increment; save it with one")
    if isinstance(content, x3pio.PointCloud):
        places = np.asarray(layer.points(), np.float64)
    elif not header.x.is_incremental or (np.ndim(layer.z) == 2 and not header.y.is_incremental):
        raise ValueError("its places are not evenly spaced; save it with even spacings")
    else:
        height = np.atleast_2d(np.asarray(layer.z, np.float64))
        dx = header.x.increment
        dy = header.y.increment if np.ndim(layer.z) == 2 else dx
        grid = HeightGrid(height=height, x0=0.0, y0=0.0, dx=dx, dy=dy)
        x, y = np.meshgrid(grid.x, grid.y)
        places = np.column_stack([x.ravel(), y.ravel(), height.ravel()])
    if content.placement is None:
        return places
    return np.asarray(content.placement.apply(places), np.float64)


def write_x3p(path: Path, grid: HeightGrid, comment: str) -> None:
    """Write a map [m] with its place as x3p."""
    x3pio = import_optional("x3pio", f"writing {str(path)!r}")
    surface = x3pio.Surface.from_array(
        grid.height,
        x_scale=grid.dx,
        y_scale=grid.dy,
        placement=x3pio.Placement(offset=(grid.x0, grid.y0, 0.0)),
        coordinate_system=x3pio.CoordinateSystem.VIEW,
        revision=x3pio.Revision.ISO5436_2000,
    )
    named = surface.with_metadata(manufacturer="omsm_ros", model="omsm_ros", comment=comment)
    with atomic_file(path) as stream:
        named.save(stream)


def write_sdf(path: Path, grid: HeightGrid) -> None:
    """Write a map [m] as text SDF (ISO 25178-71), profile by profile from the least y."""
    date = datetime.now(timezone.utc).strftime("%d%m%Y%H%M")
    rows, columns = grid.height.shape
    head = {
        "ManufacID": "omsm_ros", "CreateDate": date, "ModDate": date,
        "NumPoints": columns, "NumProfiles": rows,
        "Xscale": f"{grid.dx:.17g}", "Yscale": f"{grid.dy:.17g}", "Zscale": 1, "Zresolution": -1,
        "Compression": 0, "DataType": 7, "CheckType": 0,
    }  # fmt: skip
    with atomic_file(path, "w") as stream:
        stream.write("aISO-1.0\n" + "".join(f"{k} = {v}\n" for k, v in head.items()) + "*\n")
        for row in grid.height:
            cells = (f"{v:.9g}" if np.isfinite(v) else "BAD" for v in row)
            stream.write(" ".join(cells) + "\n")
        stream.write("*\n")
