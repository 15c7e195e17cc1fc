"""``viewer``: shows the running scan in a browser."""

import os
import stat
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from omsm_msgs.msg import AccelerationBlock, Calibration
from sensor_msgs.msg import PointCloud2

from omsm_ros import quantities
from omsm_ros.errors import ConfigurationError, FileError, OmsmError
from omsm_ros.io import message_mapping
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.files import read_text
from omsm_ros.live_page.live_view import LiveView
from omsm_ros.live_page.server import LiveServer, render
from omsm_ros.nodes.diagnostics import StateReport
from omsm_ros.nodes.managed import ManagedNode
from omsm_ros.nodes.running import run
from omsm_ros.nodes.topics import LATCHED_QOS, MessageInfo, listen
from omsm_ros.quantities import Parameter

PARAMETERS = (
    Parameter("host", "127.0.0.1", "address of the page; another than loopback needs a token"),
    Parameter("port", 8080, "TCP port of the page", quantities.TCP_PORT),
    Parameter(
        "token_file",
        "",
        "file with the token that must stand in the address behind ?token=; only its owner may "
        "read it; empty = none",
    ),
    Parameter("nominal", "", "SURFACE.yaml that heights are compared with; empty = none"),
)
_MAX_TOKEN_BYTES = 1000
_LEVELS = {getattr(DiagnosticStatus, name): name for name in ("OK", "WARN", "ERROR", "STALE")}


class ViewerNode(ManagedNode):
    """Subscribes to points, calibration, acceleration and diagnostics, and shows them."""

    name, parameters = "viewer", PARAMETERS
    _refused = 0

    def configure(self, undo: ExitStack) -> None:
        """Make the page and its content."""
        nominal = self.values["nominal"]
        self._view = LiveView(load_surface(Path(nominal)) if nominal else None)
        where = self.get_namespace().strip("/")
        self._server = LiveServer(
            self._view,
            render(f"Cell {where}"),
            self.values["host"],
            self.values["port"],
            load_token(self.values["token_file"]) if self.values["token_file"] else "",
        )

    def activate(self, undo: ExitStack) -> None:
        """Serve the page, and begin to receive."""
        self._server.start()
        undo.callback(self._server.stop)
        self.get_logger().info(f"look at {self._shown}")
        view, convert = self._view, message_mapping
        shows = partial(self._show, convert.cloud_array, view.add_points)
        listen(self, undo, PointCloud2, "points", shows)
        shows = partial(self._show, convert.block_of, view.add_acceleration)
        listen(self, undo, AccelerationBlock, "acceleration", shows)
        shows = partial(self._show, convert.calibration, view.set_calibration)
        listen(self, undo, Calibration, "calibration", shows, LATCHED_QOS)
        heard = self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        undo.callback(self.destroy_subscription, heard)

    @property
    def _shown(self) -> str:
        """Return the address for logs and diagnostics, which others on the network can read."""
        hint = "?token=…" if self.values["token_file"] else ""
        return f"{self._server.address}{hint}"

    def report(self) -> StateReport:
        """Return the address of the page, and the number of messages refused."""
        return StateReport(f"look at {self._shown}", {"refused_messages": self._refused})

    def _show(
        self, convert: Callable[..., Any], show: Callable[..., Any], message: Any, _: MessageInfo
    ) -> None:
        try:
            show(convert(message))
        except OmsmError as err:
            self._warn(str(err))

    def _warn(self, text: str) -> None:
        self._refused += 1
        self.get_logger().warning(text, throttle_duration_sec=5.0)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        where = self.get_namespace().rstrip("/") + "/"
        for status in message.status:
            if status.name.startswith(where):
                level = _LEVELS.get(status.level, "ERROR")
                values = {entry.key: entry.value for entry in status.values[:200]}
                try:
                    self._view.add_state(status.name, level, status.message, values)
                except OmsmError as err:
                    self._warn(str(err))


def load_token(path: str) -> str:
    """Return the token in a file of one line that others may not read; or ConfigurationError."""
    text = read_text(path, _MAX_TOKEN_BYTES, FileError, "token file").strip()
    if os.stat(path).st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigurationError(
            f"token file {path!r} can be read by other users of this computer: chmod 600 {path}"
        )
    if not text or len(text.split()) > 1:
        raise ConfigurationError(
            f"token file {path!r} holds no token; make one: (umask 077; openssl rand -hex 16 > "
            f"{path})"
        )
    return text


main = partial(run, ViewerNode)
