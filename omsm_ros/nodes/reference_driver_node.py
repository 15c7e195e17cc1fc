"""``reference_driver``: reads the reference sensor and publishes its distance."""

from __future__ import annotations

from omsm_ros.instruments.factory import REFERENCE_PARAMETERS, make_reference
from omsm_ros.nodes.driver import DriverNode
from omsm_ros.nodes.running import run


class ReferenceDriverNode(DriverNode):
    """One of the reference sensors in ``docs/devices.md``."""

    def __init__(self) -> None:
        super().__init__(
            "reference_driver", REFERENCE_PARAMETERS, make_reference, distance="reference"
        )


def main() -> None:
    """Run ``ros2 run omsm_ros reference_driver``."""
    run(ReferenceDriverNode)


if __name__ == "__main__":
    main()
