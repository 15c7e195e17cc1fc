"""Reads tables that are no text: files of arrays, and the messages of ROS topics, a row for each.

Arrays are of NumPy, MATLAB, HDF5, TDMS (LabVIEW, DIAdem). A column of a table is named
``dataset[3]``, counted from 0; columns of a single array are ``[0]``, ``[1]`` and so on. Arrays in
a group, a MATLAB structure or a structured array are ``group/name``, channels of TDMS
``group/channel``.

Messages are of any type with numbers. A column is named by its topic and the path of the field, as
``/probe.range``, ``/joint_states.position[z_slide]`` by the joint's name, ``/gap.data`` or
``/pose.pose.position.z``. ``header.stamp`` without a topic is that of each topic, ``log_time`` is
the time of recording; both are dates.
"""

from __future__ import annotations

import io
import logging
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path
from typing import IO, Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import BagError, FileError
from omsm_ros.io.bag_checks import (
    bag_errors,
    check_checksums,
    check_files,
    check_index,
    check_length_of_definitions,
)
from omsm_ros.io.child_process import import_optional, read_in_child, walk_in_child
from omsm_ros.io.files import library_errors, open_regular
from omsm_ros.io.tables.table import PIECE_ROWS, ForeignTable, micro_sign
from omsm_ros.units import NANOSECONDS_PER_S

# Archives of NumPy and MATLAB files are loaded completely.
_MAX_WHOLE_BYTES = 4_000_000_000
# No recording has a compression ratio of 100; a large file with more was made to fill memory.
_MAX_PACKED, _ALWAYS_UNPACKED_BYTES = 100, 100_000_000
_MAX_COLUMNS = 1000
_AGAIN = "write it again, or as CSV"

_MATLAB_PACKED = 15  # miCOMPRESSED of "MAT-File Format"


class ArrayTable(ForeignTable):
    """The arrays of one file, of one dimension or two."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        read = {
            ".npy": self._numpy, ".npz": self._numpy, ".mat": self._matlab,
            ".h5": self._hdf5, ".hdf5": self._hdf5,
        }[path.suffix.lower()]  # fmt: skip
        with open_regular(path, FileError, "table") as stream:
            size = stream.seek(0, io.SEEK_END)
        if size > _MAX_WHOLE_BYTES and read != self._hdf5:
            raise FileError(f"{self} has {size} bytes, at most {_MAX_WHOLE_BYTES}; split it")
        with library_errors(str(self), _AGAIN):
            arrays = {micro_sign(name): array for name, array in _flat("", read())}
        self._columns: dict[str, tuple[Any, int | None]] = {}
        for name, array in arrays.items():
            found: dict[str, tuple[Any, int | None]] = {}
            if array.dtype.kind in "fiu" and array.ndim == 1:
                found = {name: (array, None)}
            elif array.dtype.kind in "fiu" and array.ndim == 2:
                columns = range(min(array.shape[1], _MAX_COLUMNS))
                found = {f"{name}[{column}]": (array, column) for column in columns}
            self._columns |= found
            self.names += found  # a name that two arrays give stands twice

    def _numpy(self) -> Mapping[str, Any]:
        with open_regular(self.path, FileError, "table") as stream:
            if zipfile.is_zipfile(stream):
                with zipfile.ZipFile(stream) as archive:
                    self._check_unpacked(sum(member.file_size for member in archive.infolist()))
            stream.seek(0)
            alone = stream.read(len(np.lib.format.MAGIC_PREFIX)) == np.lib.format.MAGIC_PREFIX
            stream.seek(0)
            # numpy refuses pickles by default.
            if alone:
                return {"": np.load(self.path, mmap_mode="r")}
            loaded = np.load(stream)
            return {name: loaded[name] for name in loaded.files}

    def _matlab(self) -> Mapping[str, Any]:
        from scipy.io import loadmat

        with open_regular(self.path, FileError, "table") as stream:
            head = stream.read(10)
            if head == b"MATLAB 7.3":  # an HDF5 file
                return self._hdf5()
            if head == b"MATLAB 5.0":
                self._check_unpacked(_unpacked_matlab(stream))

        def load() -> Mapping[str, Any]:
            with warnings.catch_warnings():  # else the imaginary part is lost silently
                warnings.simplefilter("error", np.exceptions.ComplexWarning)
                warnings.simplefilter("error", UserWarning)  # else the byte order is guessed
                loaded: Mapping[str, Any] = loadmat(self.path, mat_dtype=True, simplify_cells=True)
            return loaded

        # A damaged file may crash the library.
        read_in_child(self.path, str(self), _AGAIN, lambda: load() and None)
        return load()

    def _check_unpacked(self, size: int) -> None:
        """Raise FileError for an archive that unpacks to more bytes than any recording."""
        packed = self.path.stat().st_size
        if size > max(_MAX_PACKED * packed, _ALWAYS_UNPACKED_BYTES):
            raise FileError(
                f"{self} has {packed} bytes and would unpack to {size}; check that it is a "
                "recording, and leave out other arrays"
            )

    def _hdf5(self) -> Mapping[str, Any]:
        h5py = import_optional("h5py", str(self))
        walk_in_child(self.path, str(self))
        found: dict[str, Any] = {}
        file = self._opened.enter_context(h5py.File(self.path, "r"))

        def keep(name: str, item: object) -> None:
            if isinstance(item, h5py.Dataset):
                # MATLAB writes a column as a table of one row.
                row = item.ndim == 2 and item.shape[0] == 1
                if row and item.dtype.names is not None and item.nbytes < _ALWAYS_UNPACKED_BYTES:
                    found[name] = item[0]
                else:
                    found[name] = _Row(item) if row else item
                stated = item.attrs.get("units", item.attrs.get("unit"))
                if isinstance(stated, str):
                    self.units[name] = stated

        file.visititems(keep)
        return found

    def _pieces(
        self, names: Sequence[str], dates: frozenset[str]
    ) -> Iterator[dict[str, FloatArray]]:
        if dates:
            raise FileError(
                f"{self} has numbers, no dates, in {sorted(dates)}; give them another unit"
            )
        views = {name: self._columns[name] for name in names}
        lengths = {name: len(array) for name, (array, _) in views.items()}
        if len(set(lengths.values())) > 1:
            raise FileError(f"{self} has columns of different lengths {lengths}; cut them alike")
        for low in range(0, lengths[names[0]], PIECE_ROWS):
            rows = slice(low, low + PIECE_ROWS)
            yield {
                name: np.asarray(array[rows] if column is None else array[rows, column], np.float64)
                for name, (array, column) in views.items()
            }


class _Row:
    """A data set of one row (1, n) as a column (n,), read piece by piece."""

    ndim = 1

    def __init__(self, dataset: Any) -> None:
        self._dataset, self.dtype = dataset, dataset.dtype

    def __len__(self) -> int:
        return int(self._dataset.shape[1])

    def __getitem__(self, rows: slice) -> Any:
        return self._dataset[0, rows]


def _unpacked_matlab(stream: IO[bytes]) -> int:
    """Return the unpacked size of a MATLAB 5 file, as stated by its variables [bytes]."""
    stream.seek(126)
    order = "<" if stream.read(2) == b"IM" else ">"
    total = 0
    while len(head := stream.read(8)) == 8:
        kind, size = struct.unpack(f"{order}II", head)
        after = stream.tell() + size
        if kind == _MATLAB_PACKED:
            inside = zlib.decompressobj().decompress(stream.read(min(size, 1000)), 8)
            size = struct.unpack(f"{order}II", inside)[1]
        total += size
        stream.seek(after)
    return total


def _flat(name: str, found: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(found, Mapping):
        parts = list(found.items())
    elif fields := getattr(getattr(found, "dtype", None), "names", None):
        # A field of a data set is read by a view, that of an array by its name.
        read = found.fields if hasattr(found, "fields") else found.__getitem__
        parts = [(field, read(field)) for field in fields]
    else:
        if hasattr(found, "dtype"):
            yield name, found
        return
    for part, value in parts:
        yield from _flat(f"{name}/{part}" if name else part, value)


# Properties of a channel (ni.com, "TDMS File Format Internal Structure").
_UNIT, _PERIOD = "unit_string", "wf_increment"
_BEGINS = ("wf_start_time", "wf_start_offset")
_SCALES, _MOST_SCALES = "NI_Number_Of_Scales", 100
# Loggers of the library that warn of wrong numbers, and go on.
_NOT_PASSED_OVER = ("nptdms.scaling", "nptdms.base_segment", "nptdms.tdms_segment")


class _Refusal(logging.Handler):
    """Makes a warning an error: with an unknown scale, raw numbers would be read."""

    def emit(self, record: logging.LogRecord) -> None:
        raise ValueError(record.getMessage())


class TdmsTable(ForeignTable):
    """The channels of one file; its units and period must agree with the map."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            from nptdms import TdmsFile
            from nptdms.log import log_manager
        except ImportError as err:
            raise FileError(f"{self} needs npTDMS; pip install npTDMS, or give CSV") from err
        log_manager.set_level(logging.CRITICAL)
        for name in _NOT_PASSED_OVER:
            logger = logging.getLogger(name)
            logger.setLevel(logging.WARNING)
            logger.handlers[:] = [_Refusal()]
        with ExitStack() as opening:
            stream = opening.enter_context(open_regular(path, FileError, "table"))
            with library_errors(str(self), _AGAIN):
                self._take(opening.enter_context(TdmsFile.open(stream)))
            self._opened = opening.pop_all()

    def _take(self, file: Any) -> None:
        if file.file_status.incomplete_final_segment:
            raise ValueError("it was cut short")
        for group in file.groups():
            for known_properties in (file, group, *group.channels()):
                scales = known_properties.properties.get(_SCALES, 0)
                if isinstance(scales, int | float | np.number) and not scales <= _MOST_SCALES:
                    raise ValueError(f"{_SCALES} is {scales}, expected at most {_MOST_SCALES}")
        self._channels = {
            micro_sign(f"{g.name}/{c.name}"): c for g in file.groups() for c in g.channels()
        }
        self.names = [n for n, c in self._channels.items() if _kind(c) in "fiuM"]
        properties = {name: self._channels[name].properties for name in self.names}
        self.units = {n: str(p[_UNIT]) for n, p in properties.items() if p.get(_UNIT)}
        self._properties = properties

    def used(self, names: Sequence[str]) -> None:
        """Take the period of the channels ``names``; FileError if their times differ."""
        known_properties = {name: self._properties[name] for name in names}
        for key in (_PERIOD, *_BEGINS):
            values = {p[key]: name for name, p in known_properties.items() if p.get(key)}
            if len(values) > 1:
                one, other = list(values.items())[:2]
                raise FileError(
                    f"{self} states {key} {one[0]} of {one[1]!r} and {other[0]} of {other[1]!r}; "
                    "their rows do not belong together: write them on one clock"
                )
            if key == _PERIOD and values:
                with library_errors(str(self), _AGAIN):
                    (self.sample_period,) = map(float, values)

    def _pieces(
        self, names: Sequence[str], dates: frozenset[str]
    ) -> Iterator[dict[str, FloatArray]]:
        lengths = {name: len(self._channels[name]) for name in names}
        if len(set(lengths.values())) > 1:
            raise FileError(f"{self} has channels of different lengths {lengths}; cut them alike")
        for low in range(0, lengths[names[0]], PIECE_ROWS):
            yield {name: self._slice(name, low, name in dates) for name in names}

    def _slice(self, name: str, low: int, dated: bool) -> FloatArray:
        with library_errors(str(self), _AGAIN):
            values: Any = self._channels[name][low : low + PIECE_ROWS]
        if dated != (values.dtype.kind == "M"):
            holds = "numbers" if dated else "dates"
            raise FileError(
                f"{self} has {holds} in {name!r}; its unit in the map does not match: correct it"
            )
        if dated:  # always UTC
            since = values.astype("datetime64[ns]").astype(np.int64)
            return np.asarray(since / NANOSECONDS_PER_S)
        with np.errstate(invalid="ignore"):  # damaged singles; NaN is reported later
            return np.asarray(values, np.float64)


def _kind(channel: Any) -> str:
    """Return the kind of a channel's numbers; "f" if it can only be known by reading."""
    try:
        return str(channel.dtype.kind)
    except Exception:  # of a channel that may not be used
        return "f"


LOG_TIME = "log_time"

_STAMP = "builtin_interfaces/msg/Time"
_RANGE = "sensor_msgs/msg/Range"
_REMEDY = "give a rosbag2 folder, an .mcap or a ROS 1 .bag file that was closed"
_LOOKED_AT, _MOST_ELEMENTS, _DEEPEST = 100, 64, 6
_PART = re.compile(r"([^.\[\]]+)(?:\[([^\[\]]*)\])?")

_Get = Callable[[Any], float]


def topics_of(path: Path) -> list[TopicTable]:
    """Open a bag of any topics, and return a table for each; closing one closes the bag."""
    with bag_errors(path, _REMEDY), ExitStack() as opening:
        check_files(path)
        reader = AnyReader([path], default_typestore=_standard())
        if reader.is2:
            check_length_of_definitions(path)
        opening.enter_context(reader)
        if reader.is2:
            for part in reader.readers:
                assert isinstance(part, Reader)
                check_index(path, part)
            check_checksums(path)
        opened = opening.pop_all()
    names = sorted({c.topic for c in reader.connections if c.msgcount})
    return [TopicTable(path, reader, opened, topic) for topic in names]


@lru_cache(maxsize=1)
def _standard() -> Typestore:
    """Return the types for bags without definitions: sqlite3 before ROS 2 Iron."""
    return get_typestore(Stores.ROS2_JAZZY)


class TopicTable(ForeignTable):
    """The messages of one topic, a row for each."""

    units_in_names = False  # position[A] is a joint

    def __init__(self, path: Path, reader: AnyReader, opened: ExitStack, topic: str) -> None:
        super().__init__(path)
        self._reader, self._opened, self._topic = reader, opened, topic
        self._connections: list[Connection] = [c for c in reader.connections if c.topic == topic]
        kinds = sorted({c.msgtype for c in self._connections})
        if len(kinds) > 1:
            raise BagError(f"{self} has messages of {kinds}; record them on topics of their own")
        self._kind = kinds[0]
        # Several nodes may publish different joints on one topic.
        seen = [_leaves(message) for _, message in islice(self._messages(), _LOOKED_AT)]
        relative = [*dict.fromkeys(chain.from_iterable(seen)), LOG_TIME]
        self.names = [*relative, *(f"{topic}.{name}" for name in relative)]

    def __str__(self) -> str:
        return f"topic {self._topic!r} of bag {str(self.path)!r}"

    @property
    def label(self) -> str:
        """Return the bag's path and the topic."""
        return f"{self.path}:{self._topic}"

    def _messages(self) -> Iterator[tuple[int, Any]]:
        with bag_errors(self.path, _REMEDY):
            for _, stamp_ns, raw in self._reader.messages(self._connections):
                yield stamp_ns, self._reader.deserialize(raw, self._kind)

    def _pieces(
        self, names: Sequence[str], dates: frozenset[str]
    ) -> Iterator[dict[str, FloatArray]]:
        fields = [name.removeprefix(f"{self._topic}.") for name in names]
        for name, field in dict(zip(names, fields, strict=True)).items():
            is_date = field == LOG_TIME or field.endswith("stamp")
            if is_date != (name in dates):
                expected = "unit: date" if is_date else "another unit than date"
                raise FileError(f"{self}: {name!r} needs {expected} in the map")
        take = [_getter(field, self._kind) for field in fields]
        timed = [field == LOG_TIME or field.endswith("stamp") for field in fields]
        rows: list[list[float]] = []
        for number, (logged_ns, message) in enumerate(self._messages()):
            found = [self._taken(get, message, logged_ns) for get in take]
            absent = [n for n, value in zip(names, found, strict=True) if value is None]
            if absent and all(v is None or t for v, t in zip(found, timed, strict=True)):
                self.passed_over += 1  # it has none of the columns
                continue
            if absent:
                raise FileError(
                    f"{self}, message {number}: it has no {absent[0]!r}, but others of the map's "
                    "columns; publish axes that are latched together in one message"
                )
            rows.append(found)  # type: ignore[arg-type]
            if len(rows) == PIECE_ROWS:
                yield _columns(names, rows)
                rows = []
        if rows:
            yield _columns(names, rows)

    @staticmethod
    def _taken(get: _Get | None, message: Any, logged_ns: int) -> float | None:
        if get is None:
            return logged_ns / NANOSECONDS_PER_S
        try:
            return get(message)
        except (LookupError, ValueError):
            return None


def _columns(names: Sequence[str], rows: list[list[float]]) -> dict[str, FloatArray]:
    table = np.array(rows)
    return {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}


def _leaves(message: Any, way: str = "", deep: int = 0) -> Iterator[str]:
    if deep > _DEEPEST:
        return
    labels = getattr(message, "name", None)
    for field in message.__dataclass_fields__:
        value = getattr(message, field)
        here = f"{way}{field}"
        if isinstance(value, np.ndarray):
            named = isinstance(labels, list) and len(labels) == len(value)
            marks: Any = labels if named else range(len(value))
            yield from (f"{here}[{mark}]" for mark in list(marks)[:_MOST_ELEMENTS])
        elif getattr(value, "__msgtype__", "") == _STAMP:
            yield here
        elif hasattr(value, "__dataclass_fields__"):
            yield from _leaves(value, f"{here}.", deep + 1)
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield here


def _getter(field: str, kind: str) -> _Get | None:
    """Return the getter of ``field`` of a message of type ``kind``; None = time of recording."""
    if field == LOG_TIME:
        return None
    parts = [(name, mark) for name, mark in _PART.findall(field)]

    def get(message: Any) -> float:
        for name, mark in parts:
            holder, message = message, getattr(message, name)
            if mark:
                labels = getattr(holder, "name", ())
                message = message[labels.index(mark) if mark in labels else int(mark)]
        if hasattr(message, "nanosec"):
            return float(message.sec) + float(message.nanosec) / NANOSECONDS_PER_S
        return float(message)

    return _within_range if (kind, field) == (_RANGE, "range") else get


def _within_range(message: Any) -> float:
    """Return the distance of a Range.msg, NaN below range_min or above range_max."""
    value = float(message.range)
    stated = message.max_range > message.min_range
    outside = stated and not message.min_range <= value <= message.max_range
    return float("nan") if outside else value
