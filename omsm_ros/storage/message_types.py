"""The messages that bags are read and written with, where ROS is not installed.

Ours come from the ``.msg`` texts that ROS builds from. The few of ROS itself are stated here as
Jazzy has them (std_msgs, sensor_msgs, builtin_interfaces): to load all that ROS 2 knows takes as
long as to correct a scan.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from omsm_ros.storage.conversions import Messages

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
    """Return the types of omsm_msgs and those of ROS 2 Jazzy that they and our clouds hold."""
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
    """Return the folder of our ``.msg`` texts."""
    package = Path(__file__).resolve().parents[1]
    # Installed beside the code, or in a source checkout next to the package.
    installed = package / "interfaces" / "msg"
    return installed if installed.is_dir() else package.parent / "msg_defs" / "msg"


@lru_cache(maxsize=1)
def bag_messages() -> Messages:
    """Return message classes for writing bags without ROS."""
    types = typestore().types
    return Messages({name.split("/")[-1]: types[name] for name in _MESSAGES}, _bag_sequence)


def _bag_sequence(values: ArrayLike, dtype: DTypeLike) -> Any:
    return np.ascontiguousarray(values, dtype)
