"""A CHRocodile in the dollar protocol, over a serial line or TCP."""

import re
from functools import partial
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import IntArray
from omsm_ros.errors import DeviceError, ProtocolError
from omsm_ros.instruments.chrocodile.device import (
    FORMATS,
    Chrocodile,
    ChrocodileSettings,
    RefusedError,
    settings_from,
)
from omsm_ros.instruments.chrocodile.protocol import (
    Answer,
    BinaryDecoder,
    DollarStream,
    LineDecoder,
    command,
)
from omsm_ros.instruments.chrocodile.telegram import (
    DISTANCE,
    FLAGS,
    INTENSITY,
    SAMPLE_COUNTER,
    START_TIME,
    Layout,
    Records,
)
from omsm_ros.instruments.counting import Samples
from omsm_ros.instruments.parameters import NowNs, Values
from omsm_ros.instruments.transport import Transport
from omsm_ros.units import NANOSECONDS_PER_S

_TIME_RANGE = 2**32
# A refusal has no number of its own but words.
_REFUSAL = re.compile(r"\b(error|unknown|invalid|illegal|refused|denied|fail\w*|not \w+)\b", re.I)
# Start bit, eight data bits, stop bit.
_BITS_PER_BYTE = 10


class ChrocodileDevice(Chrocodile):
    """Reads telegrams in the layout that the device describes."""

    usual = (SAMPLE_COUNTER, START_TIME, FLAGS, DISTANCE, INTENSITY)

    def __init__(
        self, transport: Transport, settings: ChrocodileSettings | None = None, *clocks: Any
    ) -> None:
        super().__init__(transport, settings, *clocks)
        self._stream = DollarStream()
        self._early: list[Records] = []
        self._raw_time: int | None = None
        self._device_ns = 0
        self._time_at = 0.0

    def _begin(self) -> None:
        self._stream.start()
        self._early.clear()
        self._try("STO")
        if self._unheard:
            # Another program may have changed the sync bytes, which follow this command at once.
            self._exchange(b"$SSQ" + self._wanted.sync + b"\r")

    def _finish(self) -> None:
        self._ask(FORMATS[self._wanted.format])
        layout = self._layout()
        baud_rate = getattr(self._transport, "baud_rate", None)
        needed = layout.length * _BITS_PER_BYTE / self._wanted.sample_period
        if baud_rate is not None and needed > baud_rate:
            raise DeviceError(
                f"{self._transport.name}: {layout.length} bytes a sample need {needed:.0f} bit/s, "
                f"the line has {baud_rate}; raise the baud rate or select fewer signals"
            )
        binary = self._wanted.format == "binary"
        self._decoder = BinaryDecoder(layout) if binary else LineDecoder(layout)
        self._stream.decoder = self._decoder
        self._try("STA")

    def _layout(self) -> Layout:
        answer = self._try("DTF")
        try:
            layout = Layout.described(answer.text, self._wanted.sync)
        except ProtocolError:
            layout = Layout.of(self._selection, self._wanted.sync)
        if missing := set(self._selection) - set(layout.signals):
            raise DeviceError(
                f"{self._transport.name}: signals {sorted(missing)!r} were selected, the device "
                f"sends {layout.signals!r} ($DTF {answer.text!r}); choose signals that it has"
            )
        self._signals = layout.signals
        return layout

    def _ask(self, name: str, *arguments: str | float, patience: float = 0.0) -> Answer:
        """Return the answer to a command, keeping telegrams; DeviceTimeoutError without one."""
        answer = self._exchange(command(name, *arguments), patience)
        if _REFUSAL.search(answer.text):
            raise RefusedError(
                f"{self._transport.name} refused ${name} {arguments!r}: {answer.text!r}; choose a "
                "value that it accepts"
            )
        return answer

    def _exchange(self, wire: bytes, patience: float = 0.0) -> Answer:
        self._stream.expect(wire)
        self._transport.write(wire)
        asked = self._monotonic()
        unanswered = partial(self._unanswered, wire.decode("latin-1").strip())
        while True:
            data = self._read_answer(self._stream.last_outside, unanswered)
            self._early += self._stream.feed(data)
            if not data:
                self._stream.settle_answer()
            answer = self._stream.take_answer()
            took = self._monotonic() - asked
            if answer is not None:
                if not patience:
                    self._answers.note(took)
                return answer
            if took > (patience or self._answers.seconds):
                raise unanswered(self._stream.last_outside)

    def _decode(self, data: bytes) -> Samples:
        early, self._early = self._early, []
        return self._converted(early + self._stream.feed(data))

    def _ahead(self) -> float:
        """Return 1 while a telegram waits for the next one, so it arrived a sample earlier."""
        binary = isinstance(self._decoder, BinaryDecoder)
        return float(binary and self._decoder.statistics.bytes_pending > 0)

    def _rest(self) -> Samples:
        return self._converted(self._stream.settle())

    def _convert(self, records: Records) -> Samples:
        samples = super()._convert(records)
        if START_TIME in self._signals:
            samples["time"] = self._unwrap(records[str(START_TIME)].astype(np.int64))
        return samples

    def _unwrap(self, raw: IntArray) -> IntArray:
        """Return device time [ns] without wraps; those in a silence by the host's clock."""
        now = self._monotonic()
        previous = self._raw_time if self._raw_time is not None else int(raw[0])
        # Signed, so that a flipped bit costs its own sample only.
        steps = (np.diff(raw, prepend=previous) + _TIME_RANGE // 2) % _TIME_RANGE
        steps -= _TIME_RANGE // 2
        undetected = (now - self._time_at) * NANOSECONDS_PER_S - steps[0]
        steps[0] += max(0, round(undetected / _TIME_RANGE)) * _TIME_RANGE
        times: IntArray = self._device_ns + np.cumsum(steps)
        self._raw_time, self._device_ns, self._time_at = int(raw[-1]), int(times[-1]), now
        return times


def make(values: Values, transport: Transport, now_ns: NowNs) -> ChrocodileDevice:
    """Return the device that ``values`` describe."""
    return ChrocodileDevice(transport, settings_from(values), now_ns)
