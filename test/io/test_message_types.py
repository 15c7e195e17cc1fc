"""Our few types against all that ROS 2 Jazzy has."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from omsm_ros.core.streams.blocks import DistanceBlock, Status
from omsm_ros.io import message_mapping
from omsm_ros.io.message_mapping import bag_messages, message_folder, typestore


@pytest.fixture(scope="module")
def jazzy():
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in message_folder().glob("*.msg"):
        store.register(get_types_from_msg(path.read_text(), f"omsm_msgs/msg/{path.stem}"))
    return store


def test_the_distance_of_a_message_is_nan_where_its_status_is_not_ok():
    """Whether we send it, or somebody else sent a number all the same."""
    status = np.array([Status.OK, Status.OUT_OF_RANGE, Status.OK], np.uint8)
    block = DistanceBlock(
        stamp_ns=0,
        first_sample=0,
        sample_period=1e-3,
        distance=np.array([1e-6, 2e-6, 3e-6]),
        status=status,
    )
    message = message_mapping.block_message(bag_messages(), block)
    np.testing.assert_array_equal(message.distance, [1e-6, np.nan, 3e-6])
    message.distance = np.array([1e-6, 2e-6, 3e-6])
    np.testing.assert_array_equal(message_mapping.block_of(message).distance, [1e-6, np.nan, 3e-6])


@pytest.mark.parametrize("name", sorted(typestore().types))
def test_a_type_is_that_of_jazzy(jazzy, name):
    assert typestore().hash_rihs01(name) == jazzy.hash_rihs01(name)
    ours, theirs = (store.generate_msgdef(name, ros_version=2)[0] for store in (typestore(), jazzy))
    assert ours == theirs
