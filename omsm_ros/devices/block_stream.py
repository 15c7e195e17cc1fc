"""What Micro-Epsilon's Ethernet controllers have in common: blocks of data, commands beside."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from omsm_ros.devices.blocks import BlockSettings, Channels
from omsm_ros.devices.command_port import CommandPort
from omsm_ros.devices.counting import SAMPLE, Counting, Samples
from omsm_ros.devices.stream import UNREADABLE_S, StreamDevice
from omsm_ros.devices.transport import Transport
from omsm_ros.errors import DeviceError, NoSamplesError
from omsm_ros.protocols.micro_epsilon import HEADERS, Block, BlockDecoder

COUNTER_RANGE = 2**32
# Begins the blocks of controllers whose heads do not say what the frames hold.
_UNDESCRIBED = b"DATA"


class BlockStreamDevice(StreamDevice):
    """Decodes blocks, and talks to the controller where there is a command port.

    A model fills in ``_frame`` (its fields), ``_samples_of`` (a block → samples) and ``_set_up``
    (commands), and says what ends an answer (a regular expression).
    """

    prompt: bytes = b""

    def __init__(
        self,
        transport: Transport,
        settings: BlockSettings,
        channels: Channels,
        *,
        kind: str,
        period: float,
        patience: float,
        commands: Transport | None,
        now_ns: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """kind: of :class:`BlockDecoder`;  period: of a controller that runs freely [s], else 0
        patience: for an answer [s];  commands: the controller's port 23; None = leave it as it is
        """
        counting = Counting(COUNTER_RANGE, timed=False, period=period)
        super().__init__(transport, settings, channels, counting, now_ns, monotonic)
        self._decoder = BlockDecoder(kind, self._frame)
        self._head_bytes, self._frame_bytes = HEADERS[kind].size, 1
        self._unread, self._undescribed = 0, False
        self._commands, self._answers_within = commands, patience
        self._identity: dict[str, str] = {}

    def counts(self) -> dict[str, float]:
        """Return all statistics by name, those of the protocol included."""
        return super().counts() | asdict(self._decoder.statistics)

    @property
    def identity(self) -> dict[str, str]:
        """Return what the controller reported of itself."""
        return self._identity

    def _prepare(self) -> None:
        self._decoder.reset()
        self._unread, self._undescribed = 0, False
        if self._commands is None:
            return
        within = self._answers_within
        with CommandPort(self._commands, self.prompt, within, self._monotonic) as port:
            self._identity = self._set_up(port)

    def _decode(self, data: bytes) -> Samples:
        samples = self._converted(self._decoder.feed(data))
        self._unread = 0 if len(samples) else self._unread + len(data)
        self._undescribed = not len(samples) and (self._undescribed or _UNDESCRIBED in data)
        return samples

    def _ahead(self) -> float:
        """A block counts when the next one has begun, of which frames have come, too."""
        waiting = self._decoder.statistics.bytes_pending - self._head_bytes
        return max(waiting, 0) / self._frame_bytes

    def _rest(self) -> Samples:
        return self._converted(self._decoder.settle())

    def _converted(self, blocks: list[Block]) -> Samples:
        parts = []
        for block in blocks:
            self._identity = {
                "order": str(block.order), "serial": str(block.serial), **self._identity,
            }  # fmt: skip
            self._frame_bytes = block.frames.shape[1]
            frames = block.frames.reshape(-1).view(self._frame(block.kind))
            counter = (block.counter + np.arange(len(frames))) % COUNTER_RANGE
            try:
                parts.append(self._samples_of(frames, counter))
            except DeviceError:
                self._decoder.reset()  # what waits is no better
                raise
        return np.concatenate(parts) if parts else np.empty(0, SAMPLE)

    def _listen_in(self, silent: float) -> None:
        if silent > UNREADABLE_S and self._undescribed:
            raise NoSamplesError(
                f"{self._transport.name} sends blocks {_UNDESCRIBED.decode()!r}, which do not say "
                "what they hold; read this controller over RS-422 (device: confocaldt)"
            )
        self._check_understood(silent, self._unread)

    # What a model fills in.

    def _frame(self, kind: tuple[int, int]) -> np.dtype[np.void]:
        """Return the fields of a frame, by the flags in the block's head."""
        raise NotImplementedError

    def _samples_of(
        self, frames: np.ndarray[tuple[int], np.dtype[np.void]], counter: np.ndarray
    ) -> Samples:
        """Return the samples of the frames (n,) of a block, with their ``counter`` (n,)."""
        raise NotImplementedError

    def _set_up(self, port: CommandPort) -> dict[str, str]:
        """Set what was asked for, and return what the controller reports of itself."""
        raise NotImplementedError
