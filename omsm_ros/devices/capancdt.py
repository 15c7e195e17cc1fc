"""A Micro-Epsilon capaNCDT 62xx, a digital capacitive reference: data over TCP, commands beside.

Untried on hardware. A controller that is switched off and on leaves its old connection open
and silent, so silence alone makes the driver connect anew.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from omsm_ros.core.samples.blocks import Status
from omsm_ros.devices.blocks import RATE_TOLERANCE, BlockSettings, Channels
from omsm_ros.devices.command_port import CommandPort
from omsm_ros.devices.counting import SAMPLE, Counting, Samples
from omsm_ros.devices.stream import StreamDevice
from omsm_ros.devices.transport import Transport
from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.protocols.chrocodile_readings import ProbeReading
from omsm_ros.protocols.micro_epsilon import Block, BlockDecoder, channel_dtype
from omsm_ros.units import MICROMETRE_M, MICROSECOND_S

PROMPTS = (b"OK\r\n", b"$WRONG", b"$UNKNOWN")
# A channel's 24 bits are its measuring range.
FULL_SCALE = 0xFFFFFF
_COUNTER_RANGE = 2**32


@dataclass(frozen=True, slots=True, kw_only=True)
class CapaNcdtSettings(BlockSettings):
    """How the controller is read.

    probe: ``full_scale`` is the channel's measuring range [m]
    channel: of the controller, from 1
    triggered: samples come with a trigger from outside, not continuously
    patience: for an answer, and for samples of a controller that runs freely [s]
    """

    probe: ProbeReading = field(default_factory=lambda: ProbeReading(full_scale=250 * MICROMETRE_M))
    channel: int = 1
    triggered: bool = False
    patience: float = 2.0

    def __post_init__(self) -> None:
        BlockSettings.__post_init__(self)
        if not 1 <= self.channel <= 8:
            raise ConfigurationError(f"channel {self.channel!r}, expected 1 to 8")


class CapaNcdtDevice(StreamDevice):
    """Reads one channel, and sets the sample time where there is a command port."""

    def __init__(
        self,
        transport: Transport,
        settings: CapaNcdtSettings | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
        commands: Transport | None = None,
    ) -> None:
        """commands: the controller's port 23; None = leave it as it is set."""
        settings = settings or CapaNcdtSettings()
        free = not settings.triggered
        period = settings.sample_period if free else 0.0
        counting = Counting(_COUNTER_RANGE, timed=False, period=period)
        base = replace(settings, free_running=free)
        super().__init__(transport, base, Channels(timed=False), counting, now_ns, monotonic)
        self._wanted = settings
        self._decoder = BlockDecoder("capacitive", _dtype)
        self._commands = commands
        self._identity: dict[str, str] = {}

    def counts(self) -> dict[str, float]:
        """Return all statistics by name, those of the protocol included."""
        return super().counts() | asdict(self._decoder.statistics)

    @property
    def identity(self) -> dict[str, str]:
        """Return what the controller told of itself."""
        return self._identity

    def _prepare(self) -> None:
        self._decoder.reset()
        if self._commands is None:
            return
        with CommandPort(self._commands, PROMPTS, self._wanted.patience, self._monotonic) as port:
            self._identity = {"model": port.ask("$VER", "\r").strip()}
            self._set_sample_time(port)

    def _set_sample_time(self, port: CommandPort) -> None:
        """The controller takes the next time it has, and says which."""
        wanted = self._wanted.sample_period / MICROSECOND_S
        said = port.ask(f"$STI{wanted:.0f}", "\r")
        found = re.search(r"\$STI\d+,(\d+)\s*OK", said)
        if found is None:
            raise DeviceError(
                f"{self._transport.name} did not take a sample time of {wanted:.0f} µs: {said!r}"
            )
        if abs(float(found[1]) / wanted - 1) > RATE_TOLERANCE:
            raise DeviceError(
                f"{self._transport.name}: {wanted:.0f} µs were asked for, the controller samples "
                f"every {found[1]} µs; set sample_period to {float(found[1]) * MICROSECOND_S:.9g} s"
            )
        port.ask(f"$TRG{int(self._wanted.triggered)}", "\r")

    def _decode(self, data: bytes) -> Samples:
        parts = [self._samples(block) for block in self._decoder.feed(data)]
        return np.concatenate(parts) if parts else np.empty(0, SAMPLE)

    def _samples(self, block: Block) -> Samples:
        frames = block.frames.reshape(-1).view(_dtype(block.kind))
        self._identity |= {"order": str(block.order), "serial": str(block.serial)}
        name = f"channel {self._wanted.channel}"
        if name not in (frames.dtype.names or ()):
            raise DeviceError(
                f"{self._transport.name} has no {name}, only {frames.dtype.names!r}; set channel"
            )
        value = frames[name].astype(np.float64)
        samples = np.zeros(len(frames), SAMPLE)
        samples["counter"] = (block.counter + np.arange(len(frames))) % _COUNTER_RANGE
        raw = value * (self._wanted.probe.full_scale / FULL_SCALE)
        samples["distance"] = self._wanted.probe.distance(raw)
        samples["intensity"] = np.nan
        outside = (value <= 0) | (value >= FULL_SCALE)  # at its stops, it tells no distance
        samples["status"] = np.where(outside, Status.OUT_OF_RANGE, Status.OK)
        return samples

    def _listen_in(self, silent: float) -> None:
        if not self._wanted.triggered and silent > self._wanted.patience:
            raise DeviceError(
                f"{self._transport.name} sent nothing for {silent:.1f} s; check power and network"
            )


def _dtype(kind: tuple[int, int]) -> np.dtype[np.void]:
    return channel_dtype(kind[0])
