"""``confocal_driver``: reads a probe, with its encoders, and publishes distance and axes."""

from __future__ import annotations

from omsm_ros.devices.factory import PARAMETERS, make_device
from omsm_ros.nodes.driving import DriverNode
from omsm_ros.nodes.running import run


class ConfocalDriverNode(DriverNode):
    """One of the probes in ``docs/devices.md``."""

    def __init__(self) -> None:
        super().__init__(
            "confocal_driver", PARAMETERS, make_device, axes="axes", distance="confocal"
        )


def main() -> None:
    """Entry point of ``ros2 run omsm_ros confocal_driver``."""
    run(ConfocalDriverNode)


if __name__ == "__main__":
    main()
