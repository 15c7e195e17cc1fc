"""A line of commands beside a stream of data: one question, one answer."""

from __future__ import annotations

import time
from collections.abc import Callable

from omsm_ros.devices.transport import Transport
from omsm_ros.errors import DeviceTimeoutError

_READ_S = 0.05
# An answer longer than this is none.
_MAX_BYTES = 65_536


class CommandPort:
    """Asks a device that ends every answer with a prompt; connected only while it is asked."""

    def __init__(
        self,
        transport: Transport,
        prompts: tuple[bytes, ...],
        patience: float,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """prompts: any of them ends an answer;  patience: for an answer [s]."""
        self._transport = transport
        self._prompts = prompts
        self._patience = patience
        self._monotonic = monotonic

    def __enter__(self) -> CommandPort:
        self._transport.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._transport.close()

    def ask(self, text: str, end: str) -> str:
        """The answer to ``text``, its echo and prompt included; DeviceTimeoutError if none."""
        self._transport.write((text + end).encode())
        said, deadline = b"", self._monotonic() + self._patience
        while not any(prompt in said for prompt in self._prompts):
            said = (said + self._transport.read(_READ_S))[-_MAX_BYTES:]
            if self._monotonic() > deadline:
                raise DeviceTimeoutError(
                    f"{self._transport.name} did not answer {text!r} (it said {said[-32:]!r}); "
                    "check that the controller's command port is open and no other client uses it"
                )
        return said.decode("latin-1")
