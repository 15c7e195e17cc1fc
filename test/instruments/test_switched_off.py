"""A probe that is switched off and on keeps its settings, and loses positions of its encoders."""

from __future__ import annotations

import pytest

from omsm_ros.errors import DeviceError
from omsm_ros.instruments.chrocodile.device import ChrocodileSettings
from omsm_ros.instruments.scaling import AxisScaling

from .test_devices_by_the_facts import Device, blocks_for, connected


class Positioned(Device):
    """A device whose encoders count from where it was switched on."""

    position = 0

    def value_of(self, signal: int, count: int) -> float:
        return self.position if 65 <= signal <= 69 else super().value_of(signal, count)


@pytest.mark.parametrize("position", [0, 1_000_000])
def test_encoders_at_zero_after_switching_off_are_not_published(position: int) -> None:
    """The last telegram before waited for its successor, and came before the restart."""
    device = Positioned()
    device.position = 1_000_000
    driver = connected(device, ChrocodileSettings(axes=(AxisScaling(1e10),) * 5))
    device.zero -= 30.0
    assert len(blocks_for(driver, device, 1.0)) > 8
    device.up = False
    with pytest.raises(DeviceError):
        driver.poll(0.05)
    driver.close()
    device.now += 1.0
    device.up, device.zero, device.position = True, device.now, position
    driver.open()
    assert bool(blocks_for(driver, device, 1.0)) == bool(position)
    assert ("home the axes" in driver.trouble) != bool(position)
    assert driver.statistics.restarts == 1
