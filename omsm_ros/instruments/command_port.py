"""A line of commands beside a stream of data: one question, one answer."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

from omsm_ros.errors import DeviceTimeoutError
from omsm_ros.instruments.transport import Transport

_READ_S = 0.05
# A greeting is over when nothing came for so long, and none is longer.
_QUIET_S, _GREETING_S = 0.1, 1.0
# An answer longer than this is none.
_MAX_BYTES = 65_536


class CommandPort:
    """Asks a device that ends every answer with a prompt; connected only while it is asked."""

    def __init__(
        self,
        transport: Transport,
        prompt: bytes,
        patience: float,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """prompt: a regular expression for what ends an answer;  patience: for an answer [s]."""
        self._transport = transport
        self._prompt = re.compile(prompt)
        self._patience = patience
        self._monotonic = monotonic

    def __enter__(self) -> CommandPort:
        """Connect, and let the device finish its greeting, which may end with a prompt, too."""
        self._transport.open()
        deadline = self._monotonic() + _GREETING_S
        while self._transport.read(_QUIET_S) and self._monotonic() < deadline:
            pass
        return self

    def __exit__(self, *_: object) -> None:
        self._transport.close()

    def ask(self, text: str, end: str, sign: bytes = b"") -> str:
        """Return the answer to ``text``, its echo and prompt included; DeviceTimeoutError if none.

        sign: a regular expression for what every answer to it holds; a prompt before it is a
        late one, of something else. Without it in all the time, the last prompt counts.
        """
        self._transport.write((text + end).encode())
        said, deadline = b"", self._monotonic() + self._patience
        while not self._complete(said, sign):
            said = (said + self._transport.read(_READ_S))[-_MAX_BYTES:]
            if self._monotonic() > deadline:
                if self._complete(said, b""):
                    break
                raise DeviceTimeoutError(
                    f"{self._transport.name} did not answer {text!r} (it said {said[-32:]!r}); "
                    "check that the controller's command port is open and no other client uses it"
                )
        return said.decode("latin-1")

    def _complete(self, said: bytes, sign: bytes) -> bool:
        begun = re.search(sign, said)
        return begun is not None and self._prompt.search(said, begun.end()) is not None
