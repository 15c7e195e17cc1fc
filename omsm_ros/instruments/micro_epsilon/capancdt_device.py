"""Micro-Epsilon capaNCDT 62xx, a digital capacitive reference: data and commands over TCP.

Not tested on hardware. A controller that is switched off and on leaves its old connection open
and silent, so the driver connects again after a silence.
"""

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import IntArray, Status
from omsm_ros.errors import DeviceError
from omsm_ros.instruments.blocks import RATE_TOLERANCE, Channels
from omsm_ros.instruments.counting import SAMPLE, Samples
from omsm_ros.instruments.micro_epsilon.device import BlockStreamDevice, ControllerSettings
from omsm_ros.instruments.micro_epsilon.protocol import Frames, channel_dtype
from omsm_ros.instruments.parameters import (
    NowNs,
    Values,
    block_settings,
    command_transport,
    probe_reading_of,
)
from omsm_ros.instruments.scaling import ProbeReading
from omsm_ros.instruments.transport import CommandPort, Transport, transport_for
from omsm_ros.units import MICROMETRE_M, MICROSECOND_S

PROMPT = rb"OK *[\r\n]|\$WRONG|\$UNKNOWN"
# The range of a channel of 24 bits.
FULL_SCALE = 0xFFFFFF


@dataclass(frozen=True, slots=True, kw_only=True)
class CapaNcdtSettings(ControllerSettings):
    """Settings of the controller;  channel: from 1."""

    probe: ProbeReading = field(default_factory=lambda: ProbeReading(full_scale=250 * MICROMETRE_M))
    channel: int = 1


class CapaNcdtDevice(BlockStreamDevice):
    """Reads one channel, and sets the sample time if there is a command port."""

    kind, prompt = "capacitive", PROMPT

    def __init__(
        self,
        transport: Transport,
        settings: CapaNcdtSettings | None = None,
        *clocks: Any,
        commands: Transport | None = None,
    ) -> None:
        """commands: the controller's port 23; None = keep its settings."""
        settings = settings or CapaNcdtSettings()
        super().__init__(transport, settings, Channels(timed=False), *clocks, commands=commands)

    def _set_up(self, port: CommandPort) -> dict[str, str]:
        """Set the sample time; the controller rounds it and reports the result."""
        identity = {"model": port.ask("$VER", "\r", rb"\$VER").strip()}
        wanted = self._wanted.sample_period / MICROSECOND_S
        said = port.ask(f"$STI{wanted:.0f}", "\r", rb"\$STI")
        found = re.search(r"\$STI\d+\s*,(\d+)\s*OK", said)  # the end is echoed, too
        if found is None:
            raise DeviceError(
                f"{self._transport.name} did not accept a sample time of {wanted:.0f} µs: "
                f"{said!r}; choose another sample_period"
            )
        if abs(float(found[1]) / wanted - 1) > RATE_TOLERANCE:
            raise DeviceError(
                f"{self._transport.name}: {wanted:.0f} µs were requested, the controller samples "
                f"every {found[1]} µs; set sample_period to {float(found[1]) * MICROSECOND_S:.9g} s"
            )
        port.ask(f"$TRG{int(not self._wanted.period)}", "\r", rb"\$TRG")
        return identity

    def _frame(self, kind: tuple[int, int]) -> np.dtype[np.void]:
        return channel_dtype(kind[0])

    def _samples_of(self, frames: Frames, counter: IntArray) -> Samples:
        name = f"channel {self._wanted.channel}"
        if name not in (frames.dtype.names or ()):
            raise DeviceError(
                f"{self._transport.name} has no {name}, only {frames.dtype.names!r}; set channel"
            )
        value = frames[name].astype(np.float64)
        samples = np.zeros(len(frames), SAMPLE)
        samples["counter"] = counter
        raw = value * (self._wanted.probe.full_scale / FULL_SCALE)
        samples["distance"] = self._wanted.probe.distance(raw)
        samples["intensity"] = np.nan
        outside = (value <= 0) | (value >= FULL_SCALE)  # at the ends of its range
        samples["status"] = np.where(outside, Status.OUT_OF_RANGE, Status.OK)
        return samples


def make(values: Values, now_ns: NowNs) -> CapaNcdtDevice:
    """Return the device that ``values`` describe."""
    settings = CapaNcdtSettings(
        **block_settings(values),
        probe=probe_reading_of(values),
        channel=values["channel"],
        trigger="each" if values["triggered"] else "free_run",
    )
    commands = command_transport(values["port"], values["command_port"])
    return CapaNcdtDevice(transport_for(values["port"]), settings, now_ns, commands=commands)
