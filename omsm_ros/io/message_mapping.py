"""Converts messages to records of the core, and records to messages.

Messages of rclpy and those that ``rosbags`` deserialises without ROS have the same field names, so
one function reads both. To create messages, :class:`Messages` has the classes of either, and the
function that makes their arrays.
"""

from __future__ import annotations

import array
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from omsm_ros.core.calibration.calibration import FURTHER, SCHEMA, SCHEMA_1, Calibration, content_id
from omsm_ros.core.calibration.calibration_set import CalibrationSet
from omsm_ros.core.correction.surface_points import CLOUD_FIELDS, POINT_DTYPE
from omsm_ros.core.streams.blocks import AccelerationBlock, AxisBlock, Block, DistanceBlock
from omsm_ros.errors import BagError, CalibrationError, DataError
from omsm_ros.io import json_and_yaml
from omsm_ros.io.calibration_file import calibration_from, calibration_of
from omsm_ros.io.json_and_yaml import NUMBER, check_form, form, or_none
from omsm_ros.quantities import TEMPERATURE
from omsm_ros.units import NANOSECONDS_PER_S

# A set of the most members, each with a certificate of its own, is a megabyte.
MAX_JSON_CHARACTERS = 2_000_000
_SET = "calibration_set"

CHANNELS: dict[Any, dict[str, Any]] = {
    AxisBlock: dict.fromkeys("xyzbc", np.float64),
    DistanceBlock: {"distance": np.float64, "intensity": np.float32, "status": np.uint8},
    AccelerationBlock: dict.fromkeys("xyz", np.float64),
}
"""The sequences of the message of each kind of block, in their order on the wire."""
_BLOCKS = {kind.__name__: kind for kind in CHANNELS}  # rosbags adds package and folder to a name
_POINT_FIELD_TYPES = {"<f4": 7, "<f8": 8, "<u4": 6}  # sensor_msgs/PointField constants
_PLACES: Mapping[str, Any] = POINT_DTYPE.fields or {}
# Name, offset [bytes], type and count of each field of a point.
_POINT_LAYOUT = [
    (name, _PLACES[name][1], _POINT_FIELD_TYPES[kind], 1) for name, kind in CLOUD_FIELDS
]


@dataclass(frozen=True)
class Messages:
    """Message classes by their short name ("AxisBlock", "Header", …) and an array maker."""

    classes: Mapping[str, Callable[..., Any]]
    sequence: Callable[[ArrayLike, DTypeLike], Any]

    def make(self, name: str, /, **fields: object) -> Any:
        """Return a new message ``name`` with all ``fields``."""
        return self.classes[name](**fields)


def ros_messages() -> Messages:
    """Return the message classes of the sourced ROS workspace."""
    from builtin_interfaces.msg import Time
    from omsm_msgs import msg
    from sensor_msgs.msg import PointCloud2, PointField
    from std_msgs.msg import Header

    ours = {name: kind for name, kind in vars(msg).items() if name[:1].isupper()}
    others = {c.__name__: c for c in (Time, Header, PointCloud2, PointField)}
    return Messages({**ours, **others}, _ros_sequence)


def _ros_sequence(values: ArrayLike, dtype: DTypeLike) -> array.array[Any]:
    contiguous = np.ascontiguousarray(values, dtype)
    result: array.array[Any] = array.array(contiguous.dtype.char)
    # From a buffer this is thousands of times faster than from an iterable.
    result.frombytes(contiguous.view(np.uint8).data)
    return result


def stamp_of(message: Any) -> int:
    """Return the header stamp of a message [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS_PER_S + int(stamp.nanosec)


def block_of(message: Any) -> Any:
    """Return the record of a message of samples; DataError if its channels do not fit."""
    kind = _BLOCKS[type(message).__name__.rpartition("__")[2]]
    channels = {name: np.asarray(getattr(message, name), t) for name, t in CHANNELS[kind].items()}
    return kind(
        stamp_ns=stamp_of(message),
        first_sample=int(message.first_sample),
        sample_period=float(message.sample_period),
        **channels,
    )


# Fields of the message of a calibration that its file has, too.
_CALIBRATION_ARRAYS = ("numerator", "denominator", "covariance")
_CALIBRATION_NUMBERS = ("delay", "static_gain", "sample_period", "valid_up_to")


def calibration(message: Any) -> Calibration:
    """Return the record of an ``omsm_msgs/Calibration``; CalibrationError if malformed or altered.

    The certificate of a set contains the whole set; the other fields are of its middle member.
    The certificate also contains the responses to further axes.
    """
    certificate = _json_object("certificate", message.certificate)
    further = {FURTHER: certificate.pop(FURTHER)} if FURTHER in certificate else {}
    if isinstance(content := certificate.get(_SET), dict):
        return calibration_of({**content, "id": message.id}, "calibration message")
    content = {
        **{name: list(getattr(message, name)) for name in _CALIBRATION_ARRAYS},
        **{name: float(getattr(message, name)) for name in _CALIBRATION_NUMBERS},
        "settings": _json_object("settings", message.settings),
        "certificate": certificate,
        **further,
    }
    # The message does not name its schema; its id does.
    schemas = (SCHEMA, SCHEMA_1)
    try:
        own = [s for s in schemas if content_id({**content, "schema": s}) == message.id]
    except ValueError as err:
        raise CalibrationError(
            "calibration message holds a number that is not finite; identify or load it again"
        ) from err
    if not own:
        raise CalibrationError(
            f"calibration message carries id {message.id!r}, which is not that of its content: "
            "it was altered on the way; identify or load it again"
        )
    return calibration_from({**content, "schema": own[0]}, message.id)


def probe_settings(message: Any) -> dict[str, object]:
    """Return the settings of a probe, a JSON object in a ``std_msgs/String``."""
    return _json_object("probe_settings", message.data)


def temperature(message: Any) -> float:
    """Return the reading of a ``sensor_msgs/Temperature`` [°C], NaN if it is out of range."""
    return float(TEMPERATURE.nan_if_implausible(np.array([message.temperature]))[0])


def _json_object(name: str, text: str) -> dict[str, object]:
    if len(text) > MAX_JSON_CHARACTERS:
        raise CalibrationError(
            f"{name} of {len(text)} characters, at most {MAX_JSON_CHARACTERS} are accepted; "
            "shorten it"
        )
    return json_and_yaml.object_of(text or "{}", CalibrationError, name)


def cloud_array(message: Any) -> NDArray[np.void]:
    """Return our PointCloud2 as a structured array (n,) of ``POINT_DTYPE``; or DataError."""
    if message.point_step != POINT_DTYPE.itemsize or message.is_bigendian:
        raise DataError(
            f"cloud with point_step {message.point_step!r}, expected {POINT_DTYPE.itemsize}; give "
            "one that the corrector published"
        )
    layout = [(field.name, field.offset, field.datatype, field.count) for field in message.fields]
    if layout != _POINT_LAYOUT:
        names = ", ".join(name for name, *_ in _POINT_LAYOUT)
        raise DataError(
            f"cloud of {len(layout)} fields, expected {names}, each in its place and of its type; "
            "give one that the corrector published"
        )
    size = message.width * message.height * message.point_step
    if len(message.data) != size:
        raise DataError(
            f"cloud of {message.width} by {message.height} points with {len(message.data)} bytes, "
            f"expected {size}; give one that the corrector published"
        )
    return np.frombuffer(memoryview(message.data), POINT_DTYPE)


def header(messages: Messages, stamp_ns: int, frame: str) -> Any:
    """Return a std_msgs/Header."""
    sec, nanosec = divmod(stamp_ns, NANOSECONDS_PER_S)
    return messages.make(
        "Header", stamp=messages.make("Time", sec=sec, nanosec=nanosec), frame_id=frame
    )


def block_message(messages: Messages, block: Block, frame: str | None = None) -> Any:
    """Return the message of a record; frame: None = machine for axes, probe for the others."""
    kind = type(block)
    if frame is None:
        frame = "machine" if kind is AxisBlock else "probe"
    channels = {n: messages.sequence(getattr(block, n), t) for n, t in CHANNELS[kind].items()}
    return messages.make(
        kind.__name__,
        header=header(messages, block.stamp_ns, frame),
        first_sample=block.first_sample,
        sample_period=block.sample_period,
        **channels,
    )


def calibration_message(messages: Messages, record: Calibration, stamp_ns: int) -> Any:
    """Return ``omsm_msgs/Calibration`` of a record, or of a set, see :func:`calibration`."""
    own: dict[str, Any] = Calibration.content(record)
    certificate = own["certificate"]
    if isinstance(record, CalibrationSet):
        certificate[_SET] = record.content()
    elif FURTHER in own:
        certificate[FURTHER] = own[FURTHER]
    return messages.make(
        "Calibration",
        header=header(messages, stamp_ns, "machine"),
        id=record.id,
        **{n: messages.sequence(own[n], np.float64) for n in _CALIBRATION_ARRAYS},
        **{name: own[name] for name in _CALIBRATION_NUMBERS},
        settings=json.dumps(own["settings"], sort_keys=True),
        certificate=json.dumps(certificate, sort_keys=True),
    )


def cloud_message(
    messages: Messages, packed: NDArray[np.void], stamp_ns: int, frame: str = "workpiece"
) -> Any:
    """Return ``sensor_msgs/PointCloud2`` of packed points (n,) of ``POINT_DTYPE``."""
    fields = [
        messages.make("PointField", name=name, offset=offset, datatype=datatype, count=count)
        for name, offset, datatype, count in _POINT_LAYOUT
    ]
    return messages.make(
        "PointCloud2",
        header=header(messages, stamp_ns, frame),
        height=1,
        width=len(packed),
        fields=fields,
        is_bigendian=False,
        point_step=POINT_DTYPE.itemsize,
        row_step=POINT_DTYPE.itemsize * len(packed),
        data=messages.sequence(packed.view(np.uint8), np.uint8),
        is_dense=all(
            bool(np.isfinite(packed[name]).all()) for name, kind in CLOUD_FIELDS if "f" in kind
        ),
    )


MAX_CHARACTERS = 100_000
_MOST_BANDS = 100
_LEVEL: dict[str, Any] = {"type": "number", "minimum": 0}
_LEVELS = {"type": "array", "items": _LEVEL, "maxItems": _MOST_BANDS}
_BAND = {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2}
_LINE = {"frequency": _LEVEL, "amplitude": _LEVEL}
_SHAPE = {
    "bands": {"type": "array", "items": _BAND, "minItems": 1, "maxItems": _MOST_BANDS},
    "rms": form(dict.fromkeys("xyz", _LEVELS), "xyz"),
    "line": form({"axis": {"enum": list("xyz")}, **_LINE}, ("axis", *_LINE)),
    "height": or_none(_LEVELS),
    "height_total": or_none(_LEVEL),
    "windows": {"type": "integer", "minimum": 1},
    "alarm": {"type": "boolean"},
    "limit": _LEVEL,
}
# Older recordings lack ``height_line`` and ``height_noise``.
_LATER = {"height_line": form(_LINE, tuple(_LINE)), "height_noise": or_none(_LEVEL)}
_SCHEMA = form({**_SHAPE, **_LATER}, tuple(_SHAPE))


def vibration_levels(message: Any) -> dict[str, Any]:
    """Return ``VibrationLevels.entry``, alarm and limit; BagError for another content."""
    text = message.data
    if len(text) > MAX_CHARACTERS:
        raise BagError(
            f"vibration of {len(text)} characters, at most {MAX_CHARACTERS} are read; record the "
            "topic of the vibration monitor"
        )
    found = json_and_yaml.object_of(text, BagError, "vibration")
    check_form(found, _SCHEMA, BagError, "vibration")
    lists = [*found["rms"].values(), *([found["height"]] if found["height"] is not None else [])]
    lengths = {len(levels) for levels in lists}
    if lengths != {len(found["bands"])}:
        raise BagError(
            f"vibration has {len(found['bands'])} bands and {sorted(lengths)} levels, expected one "
            "of each; record the topic of the vibration monitor"
        )
    return found


# Definitions for bags without ROS. Ours are the ``.msg`` files that ROS uses; the few of ROS itself
# are copied from Jazzy (std_msgs, sensor_msgs, builtin_interfaces), since loading all of them takes
# as long as correcting a scan.

_OF_ROS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/String": "string data\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "sensor_msgs/msg/Temperature": (
        "std_msgs/Header header\nfloat64 temperature\nfloat64 variance\n"
    ),
    "sensor_msgs/msg/PointField": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\n"
        "uint8 UINT32=6\nuint8 FLOAT32=7\nuint8 FLOAT64=8\n"
        "string name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    ),
    "sensor_msgs/msg/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
        "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
}
_MESSAGES = (
    "omsm_msgs/msg/AxisBlock",
    "omsm_msgs/msg/DistanceBlock",
    "omsm_msgs/msg/AccelerationBlock",
    "omsm_msgs/msg/Calibration",
    *_OF_ROS,
)


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Return the types of omsm_msgs, and those of ROS 2 Jazzy that they and our clouds need."""
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    ours = {
        f"omsm_msgs/msg/{p.stem}": p.read_text() for p in sorted(message_folder().glob("*.msg"))
    }
    for name, text in (_OF_ROS | ours).items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


def message_folder() -> Path:
    """Return the folder of our ``.msg`` files."""
    package = Path(__file__).resolve().parents[1]
    # Installed within the package, or next to it in a source checkout.
    installed = package / "interfaces" / "msg"
    return installed if installed.is_dir() else package.parent / "msg_defs" / "msg"


@lru_cache(maxsize=1)
def bag_messages() -> Messages:
    """Return message classes for writing bags without ROS."""
    types = typestore().types
    return Messages({name.split("/")[-1]: types[name] for name in _MESSAGES}, np.ascontiguousarray)
