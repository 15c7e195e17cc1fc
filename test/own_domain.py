"""A ROS domain that no other run of the tests on this machine uses."""

import os
from contextlib import contextmanager, suppress

import pytest

from omsm_ros.errors import ConfigurationError
from omsm_ros.io.files import exclusive_lock, runtime_folder


@contextmanager
def own_domain():
    """Its number, as long as it is needed."""
    for k in range(100):
        domain = 102 + (os.getpid() + k) % 100
        with suppress(ConfigurationError), exclusive_lock(runtime_folder() / f"domain_{domain}"):
            yield domain
            return
    pytest.fail("no free ROS_DOMAIN_ID")
