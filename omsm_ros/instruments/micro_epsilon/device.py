"""Micro-Epsilon confocalDT controllers, over RS-422 or Ethernet.

Not tested on hardware. Over RS-422 the driver only listens, and the values in a frame are a
setting. Over Ethernet the blocks state their content, and the rate is set and read back if a
command port is given.
"""

import itertools
import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import IntArray, Status
from omsm_ros.errors import ConfigurationError, DeviceError, NoSamplesError
from omsm_ros.instruments.blocks import PERIOD_TOLERANCE, BlockSettings, Channels, wrapping
from omsm_ros.instruments.counting import SAMPLE, Counting, Samples
from omsm_ros.instruments.micro_epsilon.protocol import (
    BEFORE_RANGE_NM,
    BEHIND_RANGE_NM,
    FIRST_ERROR,
    HEADERS,
    INTENSITY_FULL,
    VALUE_BITS,
    BlockDecoder,
    Frames,
    MeasurementBlock,
    PlausibleValueFilter,
    SerialDecoder,
    confocal_dtype,
    distance_of,
    intensity_leads,
    intensity_of,
)
from omsm_ros.instruments.parameters import (
    NowNs,
    Values,
    axes_of,
    block_settings,
    command_transport,
    probe_reading_of,
)
from omsm_ros.instruments.scaling import AxisScaling, ProbeReading, encoder_places
from omsm_ros.instruments.stream import UNREADABLE_S, StreamDevice
from omsm_ros.instruments.transport import CommandPort, Patience, Transport
from omsm_ros.units import NANOMETRE_M

SERIAL_VALUES = ("distance", "intensity", "counter")
# Marks a value of the frame that is ignored.
SKIPPED_VALUES = "-"
# An answer to GETINFO contains one of these; the second is a refusal.
_INFORMATION = rb"Serial|E\d\d"
_KILOHERTZ = 1000.0

# With this number of distances in a portion, chance does not put all of them before the range.
_MANY_VALUES = 5
COUNTER_RANGE = 2**32
# The beginning of blocks whose header does not describe the frames.
_UNDESCRIBED = b"DATA"


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings(BlockSettings):
    """Settings of all controllers.

    probe: ``full_scale`` is the measuring range, of which RS-422 and capaNCDT send fractions
    trigger: "free_run", or anything else for an external trigger
    patience: for an answer, and for samples of a free-running controller [s]
    """

    probe: ProbeReading = field(default_factory=ProbeReading)
    trigger: str = "free_run"
    patience: float = 2.0

    @property
    def period(self) -> float:
        """Return the period of a free-running controller [s]; 0 = triggered."""
        return self.sample_period if self.trigger == "free_run" else 0.0


class BlockStreamDevice(StreamDevice):
    """Decodes the blocks of an Ethernet controller, and sets it up if there is a command port.

    A model implements ``_frame`` (its fields), ``_samples_of`` (a block → samples) and ``_set_up``
    (commands); ``kind`` is that of :class:`BlockDecoder`, ``prompt`` the regular expression of the
    end of an answer.
    """

    kind, prompt = "", b""

    def __init__(
        self,
        transport: Transport,
        settings: ControllerSettings,
        channels: Channels,
        *clocks: Any,
        commands: Transport | None,
    ) -> None:
        """commands: the controller's port 23; None = keep its settings."""
        counting = Counting(COUNTER_RANGE, timed=False, checked=False, period=settings.period)
        super().__init__(transport, settings, channels, counting, *clocks)
        self._wanted: Any = settings  # of the model
        self._decoder = BlockDecoder(self.kind, self._frame)
        self._head_bytes, self._frame_bytes = HEADERS[self.kind].size, 1
        self._undescribed = False
        self._next: int | None = None  # counter of the next block
        self._doubtful: list[MeasurementBlock] = []  # a block whose counter is not the next one
        self._latest: tuple[int, bytes] | None = None  # counter and frames
        self._commands, self._answers = commands, Patience(settings.patience)

    def _prepare(self) -> None:
        super()._prepare()
        self._doubtful, self._next, self._latest = [], None, None
        self._undescribed = False
        if self._commands is None:
            return
        port = CommandPort(self._commands, self.prompt, self._answers, self._monotonic)
        with self._answers, port:
            self._identity = self._set_up(port)

    def _decode(self, data: bytes) -> Samples:
        samples = self._converted(self._numbered(self._decoder.feed(data)))
        self._unread = 0 if len(samples) else self._unread + len(data)
        self._undescribed = not len(samples) and (self._undescribed or _UNDESCRIBED in data)
        return samples

    def _ahead(self) -> float:
        """Return the frames of the next block that have arrived, since a block waits for it."""
        waiting = int(self._decoder.statistics.bytes_pending) - self._head_bytes
        return max(waiting, 0) / self._frame_bytes

    def _rest(self) -> Samples:
        last = self._numbered(self._decoder.settle())
        waited, self._doubtful = self._doubtful, []
        return self._converted([*last, *waited])

    def _numbered(self, blocks: list[MeasurementBlock]) -> list[MeasurementBlock]:
        """Return the blocks, with the counter of a spoilt header as the next block shows it.

        The last block waits for the next one if its counter is not the one expected. A repeated
        block keeps its counter, or its values would take the place of a block that was lost.
        """
        waiting, found = self._doubtful + blocks, []
        self._doubtful = []
        for block, after in itertools.zip_longest(waiting, waiting[1:]):
            content = (block.counter, block.frames.tobytes())
            if content == self._latest:
                found.append(block)
                continue
            if self._next is not None and block.counter != self._next:
                if after is None:
                    self._doubtful = [block]
                    break
                follows = (self._next + len(block.frames)) % COUNTER_RANGE
                if block.counter != after.counter == follows:
                    block = block._replace(counter=self._next)
            self._next = (block.counter + len(block.frames)) % COUNTER_RANGE
            self._latest = content
            found.append(block)
        return found

    def _converted(self, blocks: list[MeasurementBlock]) -> Samples:
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
                self._decoder.reset()  # the bytes that wait hold the same
                raise
        return np.concatenate(parts) if parts else np.empty(0, SAMPLE)

    def _listen_in(self, silent: float) -> None:
        """Raise NoSamplesError for another controller, or a free-running one that is silent."""
        if silent > UNREADABLE_S and self._undescribed:
            raise NoSamplesError(
                f"{self._transport.name} sends blocks {_UNDESCRIBED.decode()!r}, which do not "
                "describe their content; read this controller over RS-422 (device: confocaldt)"
            )
        super()._listen_in(silent)
        _check_not_silent(self._transport.name, self._wanted, silent)

    def _frame(self, kind: tuple[int, int]) -> np.dtype[np.void]:
        """Return the fields of a frame, by the flags in the block's header."""
        raise NotImplementedError

    def _samples_of(self, frames: Frames, counter: IntArray) -> Samples:
        """Return the samples of the frames (n,) of a block, with their ``counter`` (n,)."""
        raise NotImplementedError

    def _set_up(self, port: CommandPort) -> dict[str, str]:
        """Set the controller up, and return the identity that it reports."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfocalDtSettings(ControllerSettings):
    """Settings of the controller.

    values: SERIAL_VALUES in a frame over RS-422, in order; "-" is ignored
    axes: scaling of X, Y, Z, B, C, or None;  wired: axes on encoders 1, 2, 3 (0 = X … 4 = C);
        an axis without an encoder stays at its offset
    """

    values: tuple[str, ...] = ("distance",)
    axes: tuple[AxisScaling, ...] | None = None
    wired: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        named = [value for value in self.values if value != SKIPPED_VALUES]
        unknown, doubled = set(named) - set(SERIAL_VALUES), len(set(named)) < len(named)
        if "distance" not in named or unknown or doubled:
            raise ConfigurationError(
                f"values {self.values!r}, expected 'distance' and more of {SERIAL_VALUES!r}, each "
                f"once, in the order of the frame; {SKIPPED_VALUES!r} for another value"
            )


class ConfocalDtDevice(StreamDevice):
    """Reads values of three bytes each over RS-422.

    Without a counter among the values, frames are counted: a place with missing bytes counts as
    one lost sample, a silence as a restart.
    """

    described_by = "`signals` (the values of a frame)"

    def __init__(
        self, transport: Transport, settings: ConfocalDtSettings | None = None, *clocks: Any
    ) -> None:
        settings = settings or ConfocalDtSettings()
        counted = "counter" in settings.values
        modulus = 2**VALUE_BITS if counted else 2**62
        counting = Counting(modulus, timed=False, checked=not counted, period=settings.period)
        super().__init__(transport, settings, Channels(timed=False), counting, *clocks)
        self._wanted = settings
        self._decoder = SerialDecoder(len(settings.values))
        self._believed = PlausibleValueFilter(len(settings.values))
        self._counted = 0

    def counts(self) -> dict[str, float]:
        """Return all statistics by name, those of the protocol included."""
        return super().counts() | {"unconfirmed": self._believed.unconfirmed}

    def _prepare(self) -> None:
        super()._prepare()
        self._believed.reset()
        if "counter" not in self._wanted.values:
            self._tracker.restart_count()

    def _decode(self, data: bytes) -> Samples:
        values, spoilt = self._believed.feed(*self._decoder.feed(data))
        self._unread = 0 if len(values) else self._unread + len(data)
        columns = dict(zip(self._wanted.values, values.T, strict=True))
        samples = np.zeros(len(values), SAMPLE)
        distance = columns["distance"]
        if len(distance) >= _MANY_VALUES and np.all(distance <= INTENSITY_FULL):
            self._decoder.reset()
            raise NoSamplesError(
                f"{self._transport.name}: the values taken for distance are at most "
                f"{int(distance.max())}, far before the range, as an intensity is; check the order "
                "of `signals`"
            )
        raw, samples["status"] = distance_of(distance, self._wanted.probe.full_scale)
        samples["distance"] = self._wanted.probe.distance(raw)
        samples["intensity"] = intensity_of(columns.get("intensity"))
        if "counter" in columns:
            samples["counter"] = columns["counter"]
        elif len(samples):
            samples["counter"] = self._counted + np.cumsum(1 + spoilt) - 1
            self._counted = int(samples["counter"][-1]) + 1
        return samples

    def _listen_in(self, silent: float) -> None:
        if "counter" not in self._wanted.values:
            self._tracker.restart_count()
        super()._listen_in(silent)
        _check_not_silent(self._transport.name, self._wanted, silent)


class ConfocalDtEthernetDevice(BlockStreamDevice):
    """Reads blocks, and sets the measuring rate if there is a command port."""

    kind, prompt = "confocal", b"->"

    def __init__(
        self,
        transport: Transport,
        settings: ConfocalDtSettings | None = None,
        *clocks: Any,
        commands: Transport | None = None,
    ) -> None:
        """commands: the controller's port 23; None = keep its settings."""
        settings = settings or ConfocalDtSettings()
        channels = Channels(axes=wrapping(settings.axes, COUNTER_RANGE), timed=False)
        super().__init__(transport, settings, channels, *clocks, commands=commands)
        self._intensity_leads = False  # the order of the manual, until the data show another

    @property
    def settings(self) -> dict[str, object]:
        """Return the controller's identity and rate, if there is a command port."""
        kept = ("name", "article", "serial", "rate")
        return {name: self._identity[name] for name in kept if name in self._identity}

    def _frame(self, kind: tuple[int, int]) -> np.dtype[np.void]:
        return confocal_dtype(kind)

    def _set_up(self, port: CommandPort) -> dict[str, str]:
        pairs = re.findall(r"(\w[\w ]*):([^\r\n]+)", port.ask("GETINFO", "\n", _INFORMATION))
        identity = {key.strip().lower(): value.strip() for key, value in pairs}
        wanted = 1 / (self._wanted.sample_period * _KILOHERTZ)
        said = port.ask(f"MEASRATE {wanted:.4g}", "\n")
        if error := re.search(r"E\d\d[^\r\n]*", said):
            raise DeviceError(
                f"{self._transport.name} refused {wanted:.4g} kHz: {error[0]!r}; choose another"
            )
        said = port.ask("MEASRATE", "\n")
        answered = [n for n in map(float, re.findall(r"\d+(?:\.\d*)?", said)) if n > 0]
        if not answered:
            raise DeviceError(
                f"{self._transport.name} did not report its measuring rate ({said[-64:]!r}); check "
                "that command_port is this controller's, or set it to 0"
            )
        if abs(answered[-1] / wanted - 1) > PERIOD_TOLERANCE:
            raise DeviceError(
                f"{self._transport.name}: {wanted:.4g} kHz was requested, the controller measures "
                f"at {answered[-1]:g} kHz; set sample_period to {1e-3 / answered[-1]:.9g} s"
            )
        return identity | {"rate": f"{1 / self._wanted.sample_period:g}"}  # as read back

    def _samples_of(self, frames: Frames, counter: IntArray) -> Samples:
        names = frames.dtype.names or ()
        samples = np.zeros(len(frames), SAMPLE)
        samples["counter"] = frames["counter"] if "counter" in names else counter
        raw, light = self._peak(frames)
        nothing = raw >= FIRST_ERROR
        metres = np.where(nothing, np.nan, raw * NANOMETRE_M)
        samples["distance"] = self._wanted.probe.distance(metres)
        beyond = np.abs(metres) > self._wanted.probe.full_scale
        beyond |= (raw >= BEFORE_RANGE_NM) & (raw <= BEHIND_RANGE_NM)
        samples["status"] = np.select(
            [beyond, nothing], [Status.OUT_OF_RANGE, Status.NO_TARGET], Status.OK
        )
        samples["intensity"] = intensity_of(light)
        for number, axis in enumerate(self._wanted.wired, start=1):
            if f"encoder {number}" not in names:
                raise DeviceError(
                    f"{self._transport.name} sends no encoder {number}; select it "
                    "(OUTADD_ETH … ENC1 ENC2 ENC3) or take the axis from `encoders`"
                )
            samples["counts"][:, axis] = frames[f"encoder {number}"]
        return samples

    def _peak(self, frames: Frames) -> tuple[IntArray, IntArray | None]:
        distance: IntArray = frames["distance 1"].astype(np.int64)
        if "intensity 1" not in (frames.dtype.names or ()):
            return distance, None
        words = np.stack([distance, frames["intensity 1"].astype(np.int32)], axis=1)
        answered = intensity_leads(words, self._wanted.probe.full_scale / NANOMETRE_M)
        if answered is not None:
            self._intensity_leads = answered
        first, second = words.T
        return (second, first) if self._intensity_leads else (first, second)


def _check_not_silent(name: str, settings: ControllerSettings, silent: float) -> None:
    """Raise NoSamplesError for a controller that keeps a period itself and sends nothing."""
    if settings.period and silent > settings.patience:
        raise NoSamplesError(
            f"{name} sent no readable data for {silent:.1f} s; check power, output "
            "interface and (RS-422) baud rate"
        )


def make_serial(values: Values, transport: Transport, now_ns: NowNs) -> ConfocalDtDevice:
    """Return the device that ``values`` describe, over RS-422."""
    signals = tuple(values["signals"].replace(",", " ").split()) or ("distance",)
    return ConfocalDtDevice(transport, _settings(values, values=signals), now_ns)


def make_ethernet(values: Values, transport: Transport, now_ns: NowNs) -> ConfocalDtEthernetDevice:
    """Return the device that ``values`` describe, over Ethernet."""
    wired = values["encoders"].lower()
    axes = tuple(axes_of(values, wired).values()) if wired else None
    settings = _settings(values, axes=axes, wired=encoder_places(values["encoders"], "XYZBC"))
    commands = command_transport(values["port"], values["command_port"])
    return ConfocalDtEthernetDevice(transport, settings, now_ns, commands=commands)


def _settings(given: Values, **more: Any) -> ConfocalDtSettings:
    common = block_settings(given) | {"trigger": given["trigger"]}
    return ConfocalDtSettings(**common, probe=probe_reading_of(given), **more)
