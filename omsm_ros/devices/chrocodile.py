"""A Precitec CHRocodile in the dollar protocol, over a serial line or TCP: set up and read.

Untried on hardware. What the public facts leave open is a setting or is read tolerantly.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from omsm_ros.core.samples.blocks import IntArray
from omsm_ros.devices.blocks import RATE_TOLERANCE, BlockSettings, Channels
from omsm_ros.devices.counting import SAMPLE, Counting, Samples
from omsm_ros.devices.stream import StreamDevice
from omsm_ros.devices.transport import Transport
from omsm_ros.errors import ConfigurationError, DeviceError, DeviceTimeoutError, ProtocolError
from omsm_ros.protocols.chrocodile import QUERY, Answer, DollarStream, command
from omsm_ros.protocols.chrocodile_decoder import BinaryDecoder, LineDecoder
from omsm_ros.protocols.chrocodile_readings import (
    ENCODER_RANGE,
    LATCHES,
    TRIGGER_DELAYED,
    TRIGGER_LOST,
    ProbeReading,
    counts_of,
    distance_of,
)
from omsm_ros.protocols.chrocodile_telegram import (
    DISTANCE,
    FLAGS,
    INTENSITY,
    SAMPLE_COUNTER,
    START_TIME,
    SYNC,
    Layout,
    Records,
)
from omsm_ros.protocols.generic_stream import AxisScaling
from omsm_ros.units import MICROMETRE_M, NANOSECONDS_PER_S

TRIGGERS = {"free_run": "CTN", "each": "TRE", "once": "TRG", "window": "TRW"}
FORMATS = {"binary": "BIN", "ascii": "ASC"}
# In `TRE` the device's own rate must be just above that of the trigger.
_ABOVE_TRIGGER = 1.05
_COUNTER_RANGE = 2**16
_TIME_RANGE = 2**32
# Start bit, eight data bits, stop bit.
_BITS_PER_BYTE = 10
_READ_S = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class ChrocodileSettings(BlockSettings):
    """How the device is set up and read; None leaves as it is what the device has.

    signals: numbers for `$SODX`; empty = counter, time, flags, distance, intensity, encoders
    axes: scaling of the encoders on X, Y, Z, B, C; None = it has none
    encoders: which of the device's encoders X Y Z U V (0 to 4) is on each axis
    latch: of the encoders at the exposure's "start", "end" or their "mean"
    trigger: "free_run", "each", "once" or "window";  format: "binary" or "ascii"
    lamp: 0-100;  averaging: samples;  threshold: of detection;  head: sensor head 0-15
    sync: the device's sync bytes
    patience: for an answer, and for samples of a device that runs freely [s]
    """

    signals: tuple[int, ...] = ()
    axes: tuple[AxisScaling, ...] | None = None
    encoders: tuple[int, ...] = (0, 1, 2, 3, 4)
    latch: str = "start"
    trigger: str = "free_run"
    format: str = "binary"
    lamp: float | None = None
    averaging: int | None = None
    threshold: float | None = None
    head: int | None = None
    sync: bytes = SYNC
    probe: ProbeReading = field(default_factory=ProbeReading)
    patience: float = 2.0

    def __post_init__(self) -> None:
        BlockSettings.__post_init__(self)
        for name, choice in (("trigger", TRIGGERS), ("format", FORMATS), ("latch", LATCHES)):
            if getattr(self, name) not in choice:
                raise ConfigurationError(
                    f"{name} {getattr(self, name)!r}, expected one of {sorted(choice)}"
                )
        if sorted(self.encoders) != [0, 1, 2, 3, 4]:
            raise ConfigurationError(f"encoders {self.encoders!r}, expected 0 to 4, each once")
        if self.signals and SAMPLE_COUNTER not in self.signals:
            raise ConfigurationError(
                f"signals {self.signals!r} lack {SAMPLE_COUNTER}, the sample counter: without "
                "it lost samples would not show"
            )

    @property
    def selection(self) -> tuple[int, ...]:
        """Signals to ask for."""
        if self.signals:
            return self.signals
        encoders = sum(LATCHES[self.latch], ()) if self.axes is not None else ()
        return (SAMPLE_COUNTER, START_TIME, FLAGS, DISTANCE, INTENSITY, *encoders)


class ChrocodileDevice(StreamDevice):
    """Sets the device up, reads back what was set, and reads its telegrams.

    triggers_lost, triggers_delayed: samples the device flagged so
    """

    def __init__(
        self,
        transport: Transport,
        settings: ChrocodileSettings | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        settings = settings or ChrocodileSettings()
        free = settings.trigger == "free_run"
        settings = replace(settings, free_running=free)
        timed = START_TIME in settings.selection
        channels = Channels(axes=_wrapping(settings.axes), timed=timed)
        period = settings.sample_period if free else 0.0
        counting = Counting(_COUNTER_RANGE, timed=timed, checked=False, period=period)
        super().__init__(transport, settings, channels, counting, now_ns, monotonic)
        self.triggers_lost = self.triggers_delayed = 0
        self._wanted = settings
        self._probe = settings.probe
        self._stream = DollarStream()
        self._signals: tuple[int, ...] = settings.selection
        self._early: list[Records] = []
        self._identity: dict[str, str] = {}
        self._asked = 0.0
        self._ever_set_up = False
        self._raw_time: int | None = None
        self._device_ns = 0
        self._time_at = 0.0

    @property
    def identity(self) -> dict[str, str]:
        """Return what the device told of itself and its settings."""
        return self._identity

    def counts(self) -> dict[str, float]:
        """Return all statistics by name, those of the protocol included."""
        decoder = self._stream.decoder
        wire = asdict(decoder.statistics) if decoder is not None else {}
        flags = {"triggers_lost": self.triggers_lost, "triggers_delayed": self.triggers_delayed}
        return super().counts() | wire | flags

    def dark_reference(self) -> None:
        """Take the dark reference: no target may be in range. It lasts about three seconds."""
        self._ask("DRK", patience=self._wanted.patience + 8.0)

    # --- setting up

    def _prepare(self) -> None:
        wanted = self._wanted
        self._stream.start()
        self._early.clear()
        self._ask("STO")
        self._identity = {"model": self._ask("VER").text or "CHRocodile"}
        intact = self._ever_set_up and self._selected()
        if wanted.head is not None:
            self._set("SEN", wanted.head)
        self._set("SODX", *wanted.selection)
        self._set_rate()
        for name, value in (
            ("LAI", wanted.lamp), ("AVD", wanted.averaging), ("THR", wanted.threshold),
        ):  # fmt: skip
            if value is not None:
                self._set(name, value)
        self._read_scale()
        self._ask(FORMATS[wanted.format])
        layout = self._layout()
        self._check_line(layout)
        if not intact:
            self._ask(TRIGGERS[wanted.trigger])  # some of them start the counter anew
            self._tracker.begin_anew()
        binary = wanted.format == "binary"
        self._ever_set_up = True
        self._stream.decoder = BinaryDecoder(layout) if binary else LineDecoder(layout)
        self._ask("STA")
        self._asked = self._monotonic()

    def _set(self, name: str, *values: float) -> None:
        """Set and read back; DeviceError if the device has other values then."""
        self._ask(name, *values)
        found = self._ask(name, QUERY).numbers
        self._identity[name] = " ".join(f"{number:g}" for number in found)
        if found and not np.allclose(
            found[: len(values)] + (np.nan,) * (len(values) - len(found)), values, rtol=1e-3
        ):
            raise DeviceError(
                f"{self._transport.name}: ${name} was set to {values!r}, the device has {found!r}; "
                "choose a value that it accepts"
            )

    def _set_rate(self) -> None:
        rate = 1 / self._wanted.sample_period
        free = self._wanted.trigger == "free_run"
        self._ask("SHZ", rate if free else round(rate * _ABOVE_TRIGGER))
        found = self._ask("SHZ", QUERY).numbers
        if not found:
            return
        self._identity["SHZ"] = f"{found[0]:g}"
        if free and abs(found[0] / rate - 1) > RATE_TOLERANCE:
            raise DeviceError(
                f"{self._transport.name}: {rate:.6g} Hz was asked for, the device measures at "
                f"{found[0]:.6g} Hz; set sample_period to {1 / found[0]:.9g} s"
            )
        if not free and found[0] < rate:
            raise DeviceError(
                f"{self._transport.name}: its {found[0]:.6g} Hz are below the trigger's "
                f"{rate:.6g} Hz, so triggers would be lost; shorten exposure or averaging"
            )

    def _read_scale(self) -> None:
        found = self._ask("SCA", QUERY).numbers
        if found and found[0] > 0:
            self._probe = replace(self._wanted.probe, full_scale=found[0] * MICROMETRE_M)
            self._identity["SCA"] = f"{found[0]:g}"

    def _layout(self) -> Layout:
        """As the device describes its telegrams; as the table says where it does not."""
        answer = self._ask("DTF")
        try:
            layout = Layout.described(answer.text, self._wanted.sync)
        except ProtocolError:
            layout = Layout.of(self._wanted.selection, self._wanted.sync)
        if missing := set(self._wanted.selection) - set(layout.signals):
            raise DeviceError(
                f"{self._transport.name}: signals {sorted(missing)!r} were selected, the device "
                f"sends {layout.signals!r} ($DTF {answer.text!r}); choose signals that it has"
            )
        self._signals = layout.signals
        return layout

    def _check_line(self, layout: Layout) -> None:
        baud_rate = getattr(self._transport, "baud_rate", None)
        needed = layout.length * _BITS_PER_BYTE / self._wanted.sample_period
        if baud_rate is not None and needed > baud_rate:
            raise DeviceError(
                f"{self._transport.name}: {layout.length} bytes a sample need {needed:.0f} bit/s, "
                f"the line has {baud_rate}; raise the baud rate or select fewer signals"
            )

    def _ask(self, name: str, *arguments: str | float, patience: float = 0.0) -> Answer:
        """The answer to a command; DeviceTimeoutError if none comes. Telegrams are kept."""
        wire = command(name, *arguments)
        self._stream.expect(wire)
        self._transport.write(wire)
        deadline = self._monotonic() + (patience or self._wanted.patience)
        while True:
            self._early += self._stream.feed(self._transport.read(_READ_S))
            answer = self._stream.take_answer()
            if answer is not None:
                return answer
            if self._monotonic() > deadline:
                raise self._unanswered(wire)

    def _unanswered(self, wire: bytes) -> DeviceTimeoutError:
        said = self._stream.last_outside
        if said:
            hint = f"it sends {said[-32:]!r}: another baud rate, or no CHRocodile is there"
        else:
            hint = "check power, cable, and (on a serial line) the baud rate, 115200 by default"
        asked = wire.decode().strip()
        return DeviceTimeoutError(f"{self._transport.name} did not answer {asked!r}; {hint}")

    # --- reading

    def _decode(self, data: bytes) -> Samples:
        early, self._early = self._early, []
        return self._samples(early + self._stream.feed(data))

    def _rest(self) -> Samples:
        return self._samples(self._stream.settle())

    def _listen_in(self, silent: float) -> None:
        """Ask a silent device whether it is still set up; a device that runs freely must talk."""
        now = self._monotonic()
        if min(silent, now - self._asked) < self._wanted.patience:
            return
        self._asked = now
        if not self._selected():
            raise DeviceError(
                f"{self._transport.name} lost its settings (a restart?); setting it up again"
            )
        if self._wanted.trigger == "free_run":
            raise DeviceError(
                f"{self._transport.name} answers, but sent no telegram for {silent:.1f} s; "
                "setting it up again"
            )

    def _selected(self) -> bool:
        """Whether the device still has our selection; one that was restarted has its own."""
        found = self._ask("SODX", QUERY).numbers
        return not found or found == tuple(map(float, self._wanted.selection))

    def _samples(self, batches: Sequence[Records]) -> Samples:
        parts = [self._convert(records) for records in batches if len(records)]
        return np.concatenate(parts) if parts else np.empty(0, SAMPLE)

    def _convert(self, records: Records) -> Samples:
        samples = np.zeros(len(records), SAMPLE)
        samples["counter"] = records[str(SAMPLE_COUNTER)]
        found = distance_of(records, self._signals, self._probe)
        samples["distance"], samples["intensity"], samples["status"] = found
        if self.channels.axes is not None:
            samples["counts"] = counts_of(records, self._wanted.latch, self._wanted.encoders)
        if START_TIME in self._signals:
            samples["time"] = self._unwrap(records[str(START_TIME)].astype(np.int64))
        if FLAGS in self._signals:
            flags = records[str(FLAGS)].astype(np.int64)
            self.triggers_lost += int(np.sum((flags & TRIGGER_LOST) > 0))
            self.triggers_delayed += int(np.sum((flags & TRIGGER_DELAYED) > 0))
        return samples

    def _unwrap(self, raw: IntArray) -> IntArray:
        """Device time [ns] that does not wrap: whole turns of a silence by the host's clock."""
        now = self._monotonic()
        previous = self._raw_time if self._raw_time is not None else int(raw[0])
        steps = np.diff(raw, prepend=previous) % _TIME_RANGE
        hidden = (now - self._time_at) * NANOSECONDS_PER_S - steps[0]
        steps[0] += max(0, round(hidden / _TIME_RANGE)) * _TIME_RANGE
        times: IntArray = self._device_ns + np.cumsum(steps)
        self._raw_time, self._device_ns, self._time_at = int(raw[-1]), int(times[-1]), now
        return times


def _agree(found: Sequence[float], wanted: Sequence[float]) -> bool:
    """Whether an answer holds the values set; more numbers than those may follow."""
    return len(found) >= len(wanted) and np.allclose(found[: len(wanted)], wanted, rtol=1e-3)


def _wrapping(axes: tuple[AxisScaling, ...] | None) -> tuple[AxisScaling, ...] | None:
    """The encoders wrap with their 32 bits where nothing else is said."""
    if axes is None:
        return None
    return tuple(replace(axis, wrap=axis.wrap or ENCODER_RANGE) for axis in axes)
