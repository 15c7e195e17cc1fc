"""``confocal_driver``: reads a probe, with its encoders, and publishes distance and axes."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial

from std_srvs.srv import Trigger

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.factory import PARAMETERS, make_device
from omsm_ros.nodes.background_worker import BackgroundWorker
from omsm_ros.nodes.driver import DriverNode
from omsm_ros.nodes.running import run

# A dark reference takes some three seconds; more if the device is slow to answer.
_DARK_PATIENCE_S = 30.0


class ConfocalDriverNode(DriverNode):
    """One of the probes in ``docs/devices.md``."""

    def __init__(self) -> None:
        super().__init__(
            "confocal_driver",
            PARAMETERS,
            make_device,
            axes="axes",
            distance="confocal",
            settings="probe_settings",
        )

    def configure(self, undo: ExitStack) -> None:
        """Make the device, which nobody touches yet, and answer requests."""
        super().configure(undo)
        self._aside = BackgroundWorker(self, undo)
        self._aside.serve(undo, Trigger, "~/dark_reference", self._on_dark_reference)

    async def _on_dark_reference(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> None:
        take = getattr(self._device, "dark_reference", None)
        if take is None:
            raise ConfigurationError(
                f"device {self.values['device']!r} takes no dark reference by command; take "
                "it as the device's manual says"
            )
        await self._aside.do(partial(self._reader.ask, take, _DARK_PATIENCE_S))
        response.success, response.message = True, "dark reference taken; identify anew"


def main() -> None:
    """Run ``ros2 run omsm_ros confocal_driver``."""
    run(ConfocalDriverNode)


if __name__ == "__main__":
    main()
