"""Reads maps of instruments: HDF5 (ours and Zygo ``.datx``), MetroPro, x3p, others by a library.

Writes HDF5, x3p (ISO 25178-72) and SDF. x3p files are written in the revision
``ISO5436 - 2000``, which all readers accept.
"""

import io
import math
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.measured_points import MeasuredPoints, measured
from omsm_ros.errors import FileError
from omsm_ros.io.child_process import import_optional, read_in_child, walk_in_child
from omsm_ros.io.files import atomic_file, library_errors, open_regular
from omsm_ros.quantities import MAP_POINTS, shown
from omsm_ros.units import (
    MICROMETRE_M,
    MILLIMETRE_M,
    NANOMETRE_M,
    LengthUnits,
    metres_in,
    needed,
    refuse_other,
)

MAGIC = b"\x89HDF\r\n\x1a\n"
SCHEMA = "omsm-points/1"
_NO_LENGTHS = ("sample", "intensity")
_DATX_SURFACES = "Data/Surface"


def chosen_channel(names: Sequence[str], channel: str | None, default: int, what: str) -> int:
    """Return the index of a ``channel`` given by name or number from 0.

    Raises FileError, which calls the file ``what``, if there is none of that name.
    """
    if channel is None:
        return default
    if channel in names:
        return names.index(channel)
    if channel.isdecimal() and int(channel) < len(names):
        return int(channel)
    raise FileError(f"{what} has no channel {channel!r}; give one of {_listed(names)}")


def channel_note(names: Sequence[str], chosen: int) -> str:
    """Return a remark that names the channel that was read, and those that were not."""
    others = [name for k, name in enumerate(names) if k != chosen]
    rest = f"; --channel selects another one of {_listed(names)}" if others else ""
    return f"channel {chosen}, {names[chosen]!r}{rest}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"{k} {name!r}" for k, name in enumerate(names))


def read_hdf5(path: Path, channel: str | None = None) -> MeasuredPoints:
    """Read a table of ours, or a surface of a ``.datx``; both state their units.

    Raises FileError for other HDF5 files, and for those that are damaged.
    """
    what = f"HDF5 file {str(path)!r}"
    h5py = import_optional("h5py", what)
    with open_regular(path, FileError, "HDF5 file") as stream:
        walk_in_child(path, what)
        with library_errors(what, "write it again"), h5py.File(stream, "r") as content:
            if content.attrs.get("schema") == SCHEMA and channel is None:
                return _table(content, what)
            if _DATX_SURFACES in content:
                return _datx(h5py, content, channel, what)
    raise FileError(f"{what} is neither a table of ours nor a .datx of Zygo; convert it to xyz")


def _table(content: Any, what: str) -> MeasuredPoints:
    column: dict[str, NDArray[Any]] = {}
    for name in ("x", "y", "height", "uncertainty", "sample"):
        if name in content:
            column[name] = _array(content[name], what, 1)
    if gone := {"x", "y", "height"} - set(column):
        raise FileError(f"{what} has no column {min(gone)!r}; write it again")
    lengths = {name: len(values) for name, values in column.items()}
    if len(set(lengths.values())) > 1:
        raise FileError(f"{what} has columns of different lengths {lengths}; write it again")
    x, y, height, spread = (column.get(n) for n in ("x", "y", "height", "uncertainty"))
    return measured(x, y, height, spread, sample=column.get("sample"))  # type: ignore[arg-type]


def _array(dataset: Any, what: str, axes: int) -> NDArray[Any]:
    shape = getattr(dataset, "shape", ())
    if len(shape) != axes:
        raise FileError(f"{what} holds an array of shape {shape!r}, expected {axes} of them")
    if dataset.dtype.kind not in "fiu":
        raise FileError(f"{what} holds an array of {shown(str(dataset.dtype))}, expected numbers")
    MAP_POINTS.checked(math.prod(shape), FileError, f"{what}: number of points")
    return np.asarray(dataset[()])


def _datx(h5py: Any, content: Any, channel: str | None, what: str) -> MeasuredPoints:
    group = content[_DATX_SURFACES]
    names = [name for name in group if isinstance(group[name], h5py.Dataset)]
    if not names:
        raise FileError(f"{what} holds no surface; save it with one")
    chosen = chosen_channel(names, channel, 0, what)
    surface = group[names[chosen]]
    height = _array(surface, what, 2).astype(np.float64)
    no_data = surface.attrs.get("No Data")
    if no_data is not None:
        height[height >= float(np.ravel(no_data)[0])] = np.nan
    # The second number of a converter from pixels is their distance.
    converters = [np.ravel(surface.attrs[f"{axis} Converter"])[0] for axis in "XY"]
    known = all((c[0], c[1]) == (b"LateralCat", b"Pixels") for c in converters)
    pixels = [float(c[-1][1]) if known else np.nan for c in converters]
    notes = (channel_note(names, chosen),) if len(names) > 1 else ()
    return _of_pixels(height * _datx_scale(surface, what), pixels, what).points(notes)


def _datx_scale(surface: Any, what: str) -> float:
    """Return the length of one unit of the heights [m]."""
    unit = np.ravel(surface.attrs["Unit"])[0]
    name = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    if (metres := metres_in(name)) is not None:
        return metres
    if name.lower() not in ("fringes", "waves", "fringewaves"):
        raise FileError(f"{what} has heights in {name!r}, expected a length or fringes")
    keys = ("Wavelength", "Interferometric Scale Factor", "Obliquity Factor")
    return float(np.prod([np.ravel(surface.attrs[key])[0] for key in keys]))


def write_hdf5(path: Path, columns: Mapping[str, NDArray[np.generic]], comment: str) -> None:
    """Write columns (n,) as datasets with their ``units``, lengths in metres."""
    h5py = import_optional("h5py", f"writing {str(path)!r}")
    with atomic_file(path, "w+b") as stream, h5py.File(stream, "w") as content:
        content.attrs["schema"] = SCHEMA
        content.attrs["comment"] = comment
        for name, values in columns.items():
            dataset = content.create_dataset(name, data=values)
            dataset.attrs["units"] = "1" if name in _NO_LENGTHS else "m"


# Zygo MetroPro binary maps (``.dat``), by the layout in Zygo's manual.

METROPRO_MAGIC = b"\x88\x1b\x03"
_HEADER_BYTES = 834
_LARGEST_HEADER = 65_536
# Phase values from here on are error codes.
_NO_DATUM = 2_147_483_640
# Steps of the phase in one fringe, by the entry "phase resolution".
_STEPS = {0: 4096, 1: 32768, 2: 131072}


def read_metropro(path: Path) -> MeasuredPoints:
    """Read the phase map as heights; the first row is the upper one.

    height = phase · wavelength · scale factor · obliquity / steps

    Raises FileError for another or an incomplete file, or one without phase or scales.
    """
    what = f"MetroPro file {str(path)!r}"
    with open_regular(path, FileError, "MetroPro file") as stream:
        head = stream.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or not head.startswith(METROPRO_MAGIC):
            raise FileError(f"{what} has no header of MetroPro, or was cut short; save it again")
        size = _at(">I", head, 6)
        columns, rows = _at(">H", head, 68), _at(">H", head, 70)
        before = _at(">H", head, 52) * _at(">H", head, 54) * _at(">H", head, 56) * 2
        if size > _LARGEST_HEADER:
            raise FileError(f"{what} says that its header has {size} bytes; save it again")
        MAP_POINTS.checked(columns * rows, FileError, f"{what}: number of points")
        stream.seek(size + before)
        raw = stream.read(4 * columns * rows)
        held = stream.seek(0, io.SEEK_END)
    if len(raw) < 4 * columns * rows:
        raise FileError(
            f"{what} has {held} bytes, too few for {columns} × {rows} points; save it again"
        )
    phase = np.frombuffer(raw, ">i4").reshape(rows, columns).astype(np.float64)
    factors = [_at(">f", head, place) for place in (164, 168, 176)]
    height, notes = _of_phase(phase, factors, _at(">h", head, 218), what), list[str]()
    if _at(">h", head, 232):
        height, notes = -height, ["its sign entry says 'inverted': the heights were negated"]
    return _of_pixels(height, [_at(">f", head, 184)] * 2, what).points(tuple(notes))


def _of_phase(
    phase: FloatArray, factors: Sequence[float], resolution: int, what: str
) -> FloatArray:
    """Return heights [m];  factors: scale, wavelength [m], and obliquity."""
    steps = _STEPS.get(resolution)
    if steps is None or not np.all(np.isfinite(factors)) or min(map(abs, factors)) <= 0:
        raise FileError(f"{what} does not say how high a fringe is; export it again with its scale")
    return np.where(phase >= _NO_DATUM, np.nan, phase * (float(np.prod(factors)) / steps))


def _of_pixels(height: FloatArray, sides: Sequence[float], what: str) -> HeightGrid:
    """Return a map whose first row is the upper row of the camera;  sides: of a pixel [m]."""
    if not (np.all(np.isfinite(sides)) and min(sides) > 0):
        raise FileError(f"{what} has no lateral calibration; calibrate the camera and save again")
    return HeightGrid(height=np.flipud(height), x0=0.0, y0=0.0, dx=sides[0], dy=sides[1])


ZYGO_TEXT = (b"Zygo XYZ Data File - Format 1", b"Zygo ASCII Data File - Format 2")
"""First lines of the two texts that MetroPro and Mx export, by the MetroPro Reference Guide."""


def read_zygo_text(path: Path) -> MeasuredPoints:
    """Read column, row and height [µm] of each pixel (format 1), or phases by rows (format 2).

    Raises FileError for an incomplete file, or one without its scales.
    """
    what = f"Zygo file {str(path)!r}"
    with open_regular(path, FileError, "Zygo file") as stream:
        raw = stream.read(40 * int(MAP_POINTS.high))  # lines of forty characters for each pixel
        text = raw.decode("latin-1").replace("\r\n", "\n")
    head, *parts = re.split(r"^# *$", text, flags=re.MULTILINE)
    phases = head.startswith("Zygo ASCII")
    try:
        if parts[-1].strip():
            raise ValueError("no mark of the end")
        lines = [line.split() for line in head.splitlines()]
        left, top, columns, rows = map(int, lines[3][:4])
        optical, resolution = [*map(float, lines[7][1:7])], int(lines[10][0])
        MAP_POINTS.checked(columns * rows, FileError, f"{what}: number of points")
        body = max(parts[1:], key=len) if phases else parts[0]
        height = np.array(body.replace("No Data", "nan").split(), np.float64)
        if phases:
            height = height.reshape(rows, columns)
        else:
            places = height.reshape(-1, 3).T
            column, row = (places[:2] - np.array([[left], [top]])).astype(np.int64)
            height = np.full((rows, columns), np.nan)
            height.flat[np.ravel_multi_index((row, column), (rows, columns))] = places[2]
            height *= MICROMETRE_M
    except (ValueError, IndexError) as err:
        raise FileError(f"{what} is damaged or was cut short; export it again") from err
    if phases:
        height = _of_phase(height, [*optical[:2], optical[3]], resolution, what)
    return _of_pixels(height, [optical[5]] * 2, what).points(())


def _at(form: str, head: bytes, place: int) -> Any:
    return struct.unpack_from(form, head, place)[0]


# Readers of SurfaceTopography whose first row has the least y: of standards that say so, and of
# places. All others begin with the upper row of the image, as Gwyddion does.
_UPWARDS = ("SDFReader", "XYZReader", "NCReader")
# No microscope has such pixels; its release 1.27 takes the nanometres of NanoFocus for millimetres.
_LARGEST_PIXEL_M = 1e-3

_SUR_PACKED, _SUR_PLAIN, _SUR_HEADER_BYTES = b"DSCOMPRESSED", b"DIGITAL SURF", 512


def unpacked_sur(path: Path, what: str) -> io.BytesIO | None:
    """Return a compressed map of Digital Surf as an uncompressed one; None for another file.

    After its header and two texts follow the number of streams of zlib, their sizes unpacked and
    packed, and the streams. Raises FileError if they are damaged or unpack to another size.
    """
    with open_regular(path, FileError, "map") as stream:
        head = stream.read(_SUR_HEADER_BYTES)
        if not head.startswith(_SUR_PACKED) or len(head) < _SUR_HEADER_BYTES:
            return None
        points = MAP_POINTS.checked(_at("<I", head, 116), FileError, f"{what}: number of points")
        texts = stream.read(_at("<H", head, 334) + _at("<H", head, 336))
        try:
            sizes = stream.read(8 * _at("<I", stream.read(4), 0))
            parts = [
                zlib.decompressobj().decompress(stream.read(packed), size + 1)
                for size, packed in struct.iter_unpack("<2I", sizes)
                if size <= 4 * points
            ]
        except (struct.error, zlib.error) as err:
            raise FileError(f"{what} is damaged or cut short; save it again") from err
    if (held := sum(map(len, parts))) != points * _at("<H", head, 98) // 8:
        raise FileError(f"{what} unpacks to {held} bytes for {points} points; save it again")
    return io.BytesIO(b"".join([_SUR_PLAIN, head[len(_SUR_PLAIN) :], texts, *parts]))


def read_foreign(
    path: Path, units: LengthUnits | None, channel: str | None = None
) -> MeasuredPoints:
    """Read a map or profile by the library SurfaceTopography; ``units`` if the file states none.

    channel: name or number of a channel; None for the first one with heights

    Raises FileError if no reader knows it, it has no size, or no such channel.
    """
    what = f"map {str(path)!r}"
    open_regular(path, FileError, "map").close()
    topography = import_optional("SurfaceTopography", what)
    remedy = "if it is of no known format, convert it to xyz"
    return read_in_child(
        path, what, remedy, lambda: _by_topography(topography, path, units, channel, what)
    )


def _by_topography(
    topography: Any, path: Path, units: LengthUnits | None, channel: str | None, what: str
) -> MeasuredPoints:
    # It prints what it cannot decode, and warns of missing values, which are checked below.
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        try:
            opened = topography.open_topography(unpacked_sur(path, what) or str(path))
        except topography.Exceptions.CannotDetectFileFormat as err:  # a list of all its readers
            raise FileError(
                f"{what} is damaged or cut short, or none of the formats that SurfaceTopography "
                "reads; save it again, uncompressed, or convert it to xyz"
            ) from err
        with opened as reader:
            names = [str(one.name) for one in reader.channels]
            holds = [*map(_holds_heights, reader.channels)]
            chosen = chosen_channel(names, channel, holds.index(True) if True in holds else 0, what)
            found = reader.topography(channel_index=chosen)
        height = np.ma.filled(np.asanyarray(found.heights(), np.float64), np.nan)
        height[np.abs(height) > 1e30] = np.nan  # SDF: the largest number of its type
        MAP_POINTS.checked(height.size, FileError, f"{what}: number of points")
        along = np.asarray(found.positions(), np.float64) if height.ndim == 1 else None
    notes = (f"read by SurfaceTopography as {type(reader).__name__}", channel_note(names, chosen))
    if not _holds_heights(reader.channels[chosen]):
        raise FileError(f"{what}: {notes[1]} holds no heights; choose another")
    metres = metres_in(str(found.unit)) if found.unit else None
    if metres:
        refuse_other(units, LengthUnits(metres, metres), what)
    scale = LengthUnits(metres, metres) if metres else needed(units, what)
    if along is not None:
        place = along * scale.lateral
        return measured(
            place, 0 * place, height * scale.height, notes=(*notes, "a profile along x")
        )
    if found.physical_sizes is None:
        raise FileError(f"{what} is no map with its size; convert it to xyz")
    sizes = zip(found.physical_sizes, height.shape, strict=True)
    dx, dy = (size / count * scale.lateral for size, count in sizes)
    if type(reader).__name__ == "NMSReader" and min(dx, dy) > _LARGEST_PIXEL_M:
        dx, dy = (size * NANOMETRE_M / MILLIMETRE_M for size in (dx, dy))
    rows = height.T if type(reader).__name__ in _UPWARDS else np.flipud(height.T)
    return HeightGrid(height=rows * scale.height, x0=0.0, y0=0.0, dx=dx, dy=dy).points(notes)


def _holds_heights(channel: Any) -> bool:
    """Return whether a channel of SurfaceTopography holds heights; older ones do not say."""
    unit = getattr(channel, "data_unit", None)
    kind = getattr(getattr(channel, "data_kind", None), "name", "HEIGHT")
    return kind == "HEIGHT" and (unit is None or metres_in(str(unit)) is not None)


# x3p (ISO 25178-72): a map, a profile or a cloud, in metres.

# The greatest number of points, of eight bytes each, and their description.
MAX_UNPACKED_BYTES = 8 * int(MAP_POINTS.high) + 4_000_000

_CHECKSUM = "md5checksum.hex"
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
    return measured(place[0], place[1], place[2], notes=notes)


def _with_known_revision(archive: zipfile.ZipFile) -> io.BytesIO | None:
    """Return the archive with the revision spelled as x3pio expects; None if it already is.

    Some programs deviate: ISO5436_2000, ISO25178-72:2017; others repeat the checksum of the heights
    in place of that of main.xml.
    """
    main, names = archive.read("main.xml"), archive.namelist()
    found = _REVISION.search(main)
    bare = re.sub(rb"[^a-z0-9]", b"", found[1].lower()) if found else b""
    if found is None or bare not in _REVISIONS:
        return None
    sums = b"".join(archive.read(name) for name in names if name.endswith(_CHECKSUM))
    others = [name for name in names if name != "main.xml" and name.encode() in sums]
    if found[1].strip() == _REVISIONS[bare] and not others:
        return None
    spelled = io.BytesIO()
    with zipfile.ZipFile(spelled, "w") as made:
        for member in archive.infolist():
            # The checksum of main.xml is no longer valid.
            if member.filename.endswith(_CHECKSUM):
                continue
            content = archive.read(member)
            if member.filename == "main.xml":
                content = main[: found.start(1)] + _REVISIONS[bare] + main[found.end(1) :]
            made.writestr(member.filename, content)
    spelled.seek(0)
    return spelled


def _places(x3pio: Any, content: Any, chosen: int = 0) -> FloatArray:
    """Return x, y, height (3, n) [m] of one layer; NaN = missing."""
    layer, header = content.layers[chosen], content.header
    # A missing increment reads as 1: steps of a metre, which no instrument has.
    if header.z.data_type.value in _WHOLE and header.z.increment == 1.0:
        raise ValueError("its heights are whole numbers without an increment; save it with one")
    if isinstance(content, x3pio.PointCloud):
        places = np.asarray(layer.points(), np.float64).T
    elif not header.x.is_incremental or (np.ndim(layer.z) == 2 and not header.y.is_incremental):
        raise ValueError("its places are not evenly spaced; save it with even spacings")
    else:
        height = np.atleast_2d(np.asarray(layer.z, np.float64))
        dx = header.x.increment
        dy = header.y.increment if np.ndim(layer.z) == 2 else dx
        grid = HeightGrid(height=height, x0=0.0, y0=0.0, dx=dx, dy=dy)
        x, y = np.meshgrid(grid.x, grid.y)
        places = np.stack([x.ravel(), y.ravel(), height.ravel()])
    if content.placement is None:
        return places
    return np.asarray(content.placement.apply(places.T), np.float64).T


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
