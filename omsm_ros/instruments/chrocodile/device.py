"""Sets up and reads a Precitec CHRocodile, whatever its protocol; the base of both drivers.

Not tested on hardware. Details that the public documents leave open are settings, or several
forms are accepted.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from omsm_ros.errors import ConfigurationError, DeviceError, DeviceTimeoutError, NoSamplesError
from omsm_ros.instruments.blocks import (
    PERIOD_TOLERANCE,
    BlockPair,
    BlockSettings,
    Channels,
    wrapping,
)
from omsm_ros.instruments.chrocodile.protocol import QUERY, Answer
from omsm_ros.instruments.chrocodile.telegram import (
    DISTANCE,
    ENCODER_RANGE,
    FLAGS,
    INTENSITY,
    LATCHES,
    SAMPLE_COUNTER,
    START_TIME,
    SYNC,
    TRIGGER_DELAYED,
    TRIGGER_LOST,
    Records,
    check_selection,
    counts_of,
    distance_of,
)
from omsm_ros.instruments.counting import SAMPLE, Counting, Samples
from omsm_ros.instruments.parameters import Values, axes_of, block_settings, probe_reading_of
from omsm_ros.instruments.scaling import AxisScaling, ProbeReading, encoder_places
from omsm_ros.instruments.stream import StreamDevice
from omsm_ros.instruments.transport import Patience, Transport
from omsm_ros.units import MICROMETRE_M

TRIGGERS = {"free_run": "CTN", "each": "TRE", "once": "TRG", "window": "TRW"}
FORMATS = {"binary": "BIN", "ascii": "ASC"}
# In `TRE` the device's own rate must be slightly above that of the trigger.
_ABOVE_TRIGGER = 1.05
# Settings on which a calibration depends; that of the lamp is its time within an exposure.
_DECISIVE = {
    "model": "model", "SEN": "head", "SHZ": "rate", "AVD": "averaging", "LAI": "lamp",
    "SCA": "full_scale",
}  # fmt: skip
_COUNTER_RANGE = 2**16
# Relative deviation of a rate from a whole multiple of another [1].
_MULTIPLE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class ChrocodileSettings(BlockSettings):
    """Settings of the device; None keeps the device's own value.

    signals: numbers for `$SODX`; empty = counter, time, flags, distance, intensity, encoders
    axes: scaling of the encoders on X, Y, Z, B, C; None = no encoders
    encoders: encoder X Y Z U V (0 to 4) of the device on each axis
    latch: encoders at the exposure's "start", "end", or their "mean"
    trigger: "free_run", "each", "once" or "window";  format: "binary" or "ascii"
    lamp: 0-100;  averaging: samples;  threshold: of detection;  head: sensor head 0-15
    sync: the device's sync bytes
    patience: for an answer, and for samples of a free-running device [s]
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
        if self.signals:
            check_selection(self.signals, self.latched)

    @property
    def latched(self) -> tuple[int, ...]:
        """Return the signals of the encoders."""
        return sum(LATCHES[self.latch], ()) if self.axes is not None else ()


class RefusedError(DeviceError):
    """The device refused a command or its value."""


class Chrocodile(StreamDevice):
    """Sets the device up, reads the settings back, and converts its signals to samples.

    triggers_lost, triggers_delayed: samples with these flags of the device
    """

    # The signals if the settings state none.
    usual: tuple[int, ...] = (SAMPLE_COUNTER, FLAGS, DISTANCE, INTENSITY)
    always_timed = False

    def __init__(
        self, transport: Transport, settings: ChrocodileSettings | None = None, *clocks: Any
    ) -> None:
        settings = settings or ChrocodileSettings()
        free = settings.trigger == "free_run"
        selection = settings.signals or (*self.usual, *settings.latched)
        timed = self.always_timed or START_TIME in selection
        period = settings.sample_period if free else 0.0
        super().__init__(
            transport,
            settings,
            Channels(axes=wrapping(settings.axes, ENCODER_RANGE), timed=timed),
            Counting(_COUNTER_RANGE, timed=timed, checked=False, period=period),
            *clocks,
        )
        self.triggers_lost = self.triggers_delayed = 0
        self._wanted = settings
        self._selection = self._signals = selection
        self._probe = settings.probe
        self._asked = 0.0
        self._answers = Patience(settings.patience)
        self._ever_set_up = False
        self._exposures = 1  # averaged into a sample by the device
        self._slowed_by_averaging = True
        self._unheard = False  # it answered, but sent no readable telegram

    @property
    def settings(self) -> dict[str, object]:
        """Return the settings that change a reading or its time: model, head, rate, lamp …"""
        reported = {n: _value(v) for c, v in self._identity.items() if (n := _DECISIVE.get(c))}
        chosen = {"latch": self._wanted.latch, "trigger": self._wanted.trigger}
        return reported | chosen if reported else {}

    def counts(self) -> dict[str, float]:
        """Return all statistics by name, those of the protocol included."""
        flags = {"triggers_lost": self.triggers_lost, "triggers_delayed": self.triggers_delayed}
        return super().counts() | flags

    def poll(self, timeout: float) -> list[BlockPair]:
        """Return the blocks; raise DeviceError if the device averages without a lower rate."""
        blocks = super().poll(timeout)
        self._unheard &= not blocks
        faster = (1 + self._cutter.period_deviation) * self._exposures
        if self._exposures > 1 and self._cutter.wrong_rate and abs(faster - 1) < _MULTIPLE:
            self._slowed_by_averaging = False
            raise DeviceError(
                f"{self._transport.name} averages {self._exposures} exposures and sends no fewer "
                "samples; it is set up again for that"
            )
        if self._cutter.wrong_rate and not blocks:
            self._check_settings(math.inf)
        return blocks

    def dark_reference(self) -> str:
        """Take the dark reference, for about three seconds; no target may be in range.

        Return the stray light as the device states it; empty if it does not. Raises DeviceError.
        """
        answer = self._ask("DRK", patience=self._wanted.patience + 8.0)
        if not answer.numbers and answer.text.strip(" $DRK\r\n"):
            raise RefusedError(f"{self._transport.name} took no dark reference: {answer.text!r}")
        light = f"{answer.numbers[-1]:g}" if answer.numbers else ""
        self._identity["stray_light"] = light or "not reported"
        return light

    def _begin(self) -> None:
        """Make the device accept commands; raises DeviceError."""

    def _finish(self) -> None:
        """Make the device send the selected signals; raises DeviceError."""

    def _ask(self, name: str, *arguments: str | float, patience: float = 0.0) -> Answer:
        """Return the answer to a command; DeviceTimeoutError if none comes. Samples are kept."""
        raise NotImplementedError

    def open(self) -> None:
        """Connect, or connect again, and set the device up; raises DeviceError."""
        with self._answers:
            super().open()

    def _prepare(self) -> None:
        wanted, before = self._wanted, self._identity
        self._begin()
        model = self._try("VER").text  # a refusal has no digits
        self._identity = {"model": model if any(map(str.isdigit, model)) else "CHRocodile"}
        intact = self._ever_set_up and self._is_unchanged(before, DeviceTimeoutError)
        self._try("MMD", 0)
        self._read("MMD")
        if self._identity.get("MMD", "0") != "0":
            raise DeviceError(
                f"{self._transport.name}: $MMD {self._identity['MMD']} measures thickness by "
                "interference, and the device refuses $MMD 0; choose the chromatic mode on it"
            )
        if wanted.head is not None:
            self._set("SEN", wanted.head)
        self._set("SODX", *self._selection)
        if wanted.averaging is not None:
            self._set("AVD", wanted.averaging)
        self._read("AVD")
        for name in ("AVS", "AVDS"):  # averaging that another program left
            self._try(name, 1)
            self._read(name)
        self._set_rate()
        for name, value in (("LAI", wanted.lamp), ("THR", wanted.threshold)):
            if value is not None:
                self._set(name, value)
        found = self._try("SCA", QUERY).numbers
        if found and found[0] > 0:
            self._probe = replace(self._wanted.probe, full_scale=found[0] * MICROMETRE_M)
            self._identity["SCA"] = f"{found[0]:g}"
        for name in ("SEN", "LAI"):
            self._read(name)
        if not intact:
            tell = self._try if wanted.trigger == "free_run" else self._ask
            tell(TRIGGERS[wanted.trigger])  # some of these reset the counter
            self._tracker.restart_count()
            self._cutter.lost_settings = self._ever_set_up
        self._ever_set_up = True
        self._finish()
        self._asked = self._monotonic()

    def _try(self, name: str, *arguments: str | float) -> Answer:
        """Return the answer to a command; an empty one if the model refuses it."""
        try:
            return self._ask(name, *arguments)
        except RefusedError:
            return Answer(b"", "")

    def _is_unchanged(self, before: dict[str, str], *suppressed: type[DeviceError]) -> bool:
        """Return whether the device was not restarted since the settings ``before`` were read.

        A new client has ordered no signals: an empty selection, or an error that is ``suppressed``,
        is no sign. Setting the trigger again would reset the counter, and with it the pairing with
        another device.
        """
        with suppress(*suppressed):
            found = self._try("SODX", QUERY).numbers
            if found and not set(self._selection) <= set(found):
                return False
        answers = ((name, self._try(name, QUERY).numbers) for name in ("SHZ", "AVD", "AVS"))
        now = {name: f"{said[0]:g}" for name, said in answers if said and name in before}
        return all(before[name].split()[0] == value for name, value in now.items())

    def _read(self, name: str) -> None:
        if name not in self._identity and (found := self._try(name, QUERY).numbers):
            self._identity[name] = " ".join(f"{number:g}" for number in found)

    def _set(self, name: str, *values: float) -> None:
        """Set values and read them back; DeviceError if they differ."""
        self._ask(name, *values)
        found = self._ask(name, QUERY).numbers
        self._identity[name] = " ".join(f"{number:g}" for number in found)
        said = found[: len(values)]  # more may follow
        same = len(said) == len(values) and np.allclose(said, values, rtol=1e-3)
        if not (set(values) <= set(found) if name == "SODX" else same):  # it has its own order
            raise DeviceError(
                f"{self._transport.name}: ${name} was set to {values!r}, the device has {found!r}; "
                "choose a value that it accepts"
            )

    def _set_rate(self) -> None:
        """Set SHZ, the rate of exposures: each sample or trigger has as many as are averaged."""
        averaging = math.prod(self._averaged())
        if not averaging:
            raise DeviceError(
                f"{self._transport.name}: with $AVD 0 it averages over the length of the trigger "
                "pulse, so the time of a reading is unknown; set averaging to 1 or more"
            )
        self._exposures = averaging if self._slowed_by_averaging else 1
        rate = self._exposures / self._wanted.sample_period
        free = self._wanted.trigger == "free_run"
        self._ask("SHZ", rate if free else float(round(rate * _ABOVE_TRIGGER)))
        found = self._ask("SHZ", QUERY).numbers
        if not found:
            raise DeviceError(
                f"{self._transport.name} does not report its rate ($SHZ ?); check that it is a "
                "CHRocodile and accepts commands"
            )
        self._identity["SHZ"] = f"{found[0]:g}"
        if free and abs(found[0] / rate - 1) > PERIOD_TOLERANCE:
            raise DeviceError(
                f"{self._transport.name}: {rate:.6g} Hz was requested, the device measures at "
                f"{found[0]:.6g} Hz; set sample_period to {self._exposures / found[0]:.9g} s"
            )
        if not free and found[0] < rate:
            raise DeviceError(
                f"{self._transport.name}: its {found[0]:.6g} Hz are below the trigger's "
                f"{rate:.6g} Hz, so triggers would be lost; reduce exposure or averaging"
            )

    def _averaged(self) -> tuple[int, ...]:
        """Return the exposures in a spectrum, in a reading, and the readings in a sample."""
        serial = getattr(self._transport, "baud_rate", None) is not None
        names = ("AVS", "AVD", "AVDS") if serial else ("AVS", "AVD")
        values = (_value(self._identity.get(name, "1")) for name in names)
        return tuple(round(value) if isinstance(value, float) else 1 for value in values)

    def _unanswered(self, name: str, said: bytes) -> DeviceTimeoutError:
        if said:
            hint = f"it sends {said[-32:]!r}: another baud rate, or no CHRocodile is there"
        else:
            hint = (
                "check power, cable, and that this is the device's port: by TCP 7890 (packets "
                "7891), on a serial line at the right baud rate, 115200 by default"
            )
        return DeviceTimeoutError(f"{self._transport.name} did not answer {name!r}; {hint}")

    def _listen_in(self, silent: float) -> None:
        """Check that a silent device still has its settings; a free-running one must send."""
        asked = self._check_settings(silent) and silent >= self._wanted.patience
        sends = self._monotonic() - self._came_at < self._settings.pause
        if asked and (sends or self._wanted.trigger == "free_run"):
            self._unheard = True
            raise NoSamplesError(
                f"{self._transport.name} answers, but sent no readable telegram for "
                f"{silent:.1f} s; check its trigger, that its counter goes on by 1 each sample "
                "(AVDS 1), and that no other program changes its settings"
            )

    def _check_settings(self, waited: float) -> bool:
        """Return whether it was time to check them; DeviceError if the device has others."""
        now = self._monotonic()
        # TCP does not show that the device forgot a connection, so this is half of the patience.
        if min(waited, now - self._asked) < self._wanted.patience / 2:
            return False
        self._asked = now
        if not self._is_unchanged(self._identity):
            raise DeviceError(
                f"{self._transport.name} lost its settings (a restart, or another client?); it is "
                "set up again"
            )
        return True

    def _converted(self, batches: Sequence[Records]) -> Samples:
        parts = (self._convert(records) for records in batches if len(records))
        return np.concatenate([np.empty(0, SAMPLE), *parts])

    def _convert(self, records: Records) -> Samples:
        samples = np.zeros(len(records), SAMPLE)
        samples["counter"] = records[str(SAMPLE_COUNTER)]
        found = distance_of(records, self._signals, self._probe)
        samples["distance"], samples["intensity"], samples["status"] = found
        if self.channels.axes is not None:
            samples["counts"] = counts_of(records, self._wanted.latch, self._wanted.encoders)
        if FLAGS in self._signals:
            flags = records[str(FLAGS)].astype(np.int64)
            self.triggers_lost += int(np.sum((flags & TRIGGER_LOST) > 0))
            self.triggers_delayed += int(np.sum((flags & TRIGGER_DELAYED) > 0))
        return samples


def _value(text: str) -> object:
    try:
        return float(text)
    except ValueError:
        return text


def settings_from(values: Values) -> ChrocodileSettings:
    """Return the settings that parameters describe; ConfigurationError if they are not valid."""
    return ChrocodileSettings(
        **block_settings(values),
        signals=_numbers("signals", values["signals"]),
        axes=tuple(axes_of(values).values()) if values["encoders"] else None,
        encoders=encoder_places(values["encoders"] or "XYZUV", "XYZUV", 5),
        latch=values["latch"],
        trigger=values["trigger"],
        format=values["format"],
        probe=probe_reading_of(values),
        **{  # a negative value keeps the device's own
            name.removeprefix("sensor_"): values[name]
            for name in ("lamp", "averaging", "threshold", "sensor_head")
            if values[name] >= 0
        },
    )


def _numbers(name: str, text: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.replace(",", " ").split())
    except ValueError as err:
        raise ConfigurationError(f"{name} {text!r}, expected numbers, like '83 256 257'") from err
