"""Our few types against all that ROS 2 Jazzy has."""

from __future__ import annotations

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from omsm_ros.storage.message_types import message_folder, typestore


@pytest.fixture(scope="module")
def jazzy():
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in message_folder().glob("*.msg"):
        store.register(get_types_from_msg(path.read_text(), f"omsm_msgs/msg/{path.stem}"))
    return store


@pytest.mark.parametrize("name", sorted(typestore().types))
def test_a_type_is_that_of_jazzy(jazzy, name):
    assert typestore().hash_rihs01(name) == jazzy.hash_rihs01(name)
    ours, theirs = (store.generate_msgdef(name, ros_version=2)[0] for store in (typestore(), jazzy))
    assert ours == theirs
