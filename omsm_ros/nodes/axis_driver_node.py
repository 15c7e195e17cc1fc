"""``axis_driver``: reads the axes where the probe does not carry them, and publishes them."""

from __future__ import annotations

from omsm_ros.instruments.factory import AXIS_PARAMETERS, make_axes
from omsm_ros.nodes.driver import DriverNode
from omsm_ros.nodes.running import run


class AxisDriverNode(DriverNode):
    """One of the streams in ``docs/devices.md``."""

    def __init__(self) -> None:
        super().__init__("axis_driver", AXIS_PARAMETERS, make_axes, axes="axes")


def main() -> None:
    """Run ``ros2 run omsm_ros axis_driver``."""
    run(AxisDriverNode)


if __name__ == "__main__":
    main()
