"""The base of all devices that send samples: bytes become blocks, and each sample is counted.

``decoded = delivered + pending + held + duplicates + spoilt + withheld``; samples that
never came are ``lost``; bytes that hold none are counted by the decoder of the protocol.
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np

from omsm_ros.errors import DeviceError, NoSamplesError
from omsm_ros.instruments.blocks import BlockCutter, BlockPair, BlockSettings, Channels
from omsm_ros.instruments.counting import SAMPLE, Counting, Samples, SequenceTracker
from omsm_ros.instruments.transport import Transport
from omsm_ros.units import NANOSECONDS_PER_S

# Bytes that hold no sample for this long come from another device or at another baud rate [s].
UNREADABLE_S = 2.0
# A counter of so few counts misses losses that are likely enough to be stated.
_SMALL_COUNTER = 16
# A silent stream is connected once more after this time [s], or this number of its periods if that
# is longer, then each time the silence has grown by this part: a returned device is heard soon.
_RENEW_S, _RENEW_PERIODS, _RENEW_PART = 1.0, 5, 0.1
# Time between two checks of the time-out of an answer [s].
_ANSWER_S = 0.05

_COUNTS = (
    "decoded", "delivered", "pending", "held", "spoilt", "duplicates", "withheld", "missed",
    "least_missed", "lost", "gaps", "restarts", "resets", "blocks", "period_deviation",
    "period_warnings", "renewals",
)  # fmt: skip
"""All counts since construction, exact between two calls of ``poll``.

decoded: samples that came whole
delivered, pending: in blocks handed over, and waiting for their block to fill
held: waiting for their successor;  spoilt: with a counter that jumped ahead and back
duplicates: received twice
withheld: kept back because the device runs at another rate than it was set to, its encoders
    lost their positions, or no arrival confirms that it missed no trigger before them
missed: triggers without a sample of this device, by its time or the arrivals
least_missed: the least number of them that the arrivals show; 0 = none do
lost, gaps: trigger counts that never arrived, and in how many places
restarts: how often the device's counter or clock fell back
resets: how many of these came after a silence, with the connection kept: the counter was reset
period_deviation: of the last full block's device time from nominal, relative [1]
period_warnings: full blocks beyond PERIOD_TOLERANCE
renewals: connections made again because nothing came
"""


class StreamDevice:
    """Reads a stream of samples and hands over blocks.

    A model implements ``_prepare`` (set up), ``_decode`` and ``_rest`` (bytes → samples) and
    ``_listen_in`` (check a silent device). The trigger count continues over ``close`` and ``open``,
    so the samples lost with a connection appear as a gap.

    described_by: the parameter that states what the stream holds, if the device cannot report it
    """

    described_by = ""

    def __init__(
        self,
        transport: Transport,
        settings: BlockSettings,
        channels: Channels,
        counting: Counting,
        now_ns: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """now_ns: the host clock that stamps refer to [ns];  monotonic: for time-outs [s]."""
        self.channels = channels
        self._decoder: Any = None  # of the protocol, with ``statistics`` and ``reset``
        self._unread = 0  # bytes that came since the last sample, an idle line's left out
        self._transport = transport
        self._spare: Any = None  # a second connection of a silent stream
        self._settings = settings
        self._now_ns = now_ns
        self._monotonic = monotonic
        self._tracker = SequenceTracker(counting, settings.sample_period, settings.pause)
        self._small_counter = counting.modulus if counting.modulus <= _SMALL_COUNTER else 0
        self._cutter = BlockCutter(settings, channels, counting.period > 0)
        self._identity: dict[str, str] = {}
        self.decoded = 0
        self._counting_lock = threading.RLock()  # held while samples pass from one count to another
        self._heard = self._opened = self._renewed = monotonic()
        self._came_ns, self._came_at = 0, self._heard  # of the last bytes
        self._down = False
        self.renewals = 0
        self._went_on = self._heard  # when a counter last advanced

    def open(self) -> None:
        """Connect, or connect again, and set the device up; raises DeviceError."""
        self._transport.open()
        self._down = True
        self._prepare()
        self._opened = self._went_on = self._monotonic()

    def poll(self, timeout: float) -> list[BlockPair]:
        """Return the blocks completed by what arrives within ``timeout`` [s]; may be none.

        Raises DeviceError when the connection or the device is lost; ``close`` then still
        hands over the partial block.
        """
        try:
            data = self._receive(timeout)
        except DeviceError:
            self._cutter.lost_settings = self.decoded > 0  # it may have been switched off
            raise
        age = getattr(self._transport, "age", 0.0)  # known of TCP
        arrival_ns, now = self._now_ns() - round(age * NANOSECONDS_PER_S), self._monotonic() - age
        if data or not self._came_ns:
            self._came_ns, self._came_at = arrival_ns, now
        samples = self._decode(data)
        silent = now - self._heard
        if len(samples):
            self._heard = now
            blocks = self._add(samples, arrival_ns, silent)
            if now - self._went_on > UNREADABLE_S:
                raise NoSamplesError(
                    f"{self._transport.name} repeats its sample counter "
                    f"({int(samples['counter'][-1])!r}), so every sample is a duplicate; check "
                    "that the settings name the place of the counter, and that it counts"
                )
            return blocks
        if silent <= self._settings.pause:
            return []
        blocks = self._end(arrival_ns)
        if silent > UNREADABLE_S:
            blocks += self._cutter.end()
        silent = now - max(self._heard, self._opened)
        self._listen_in(silent)
        if self._settings.renew:
            self._renew(now, silent)
        return blocks

    def _receive(self, timeout: float) -> bytes:
        """Return what arrives; of a silent connection and a spare one, the first is kept."""
        data, spare = self._transport.read(timeout), self._spare
        if spare and not data:
            with suppress(DeviceError):
                data = spare.read(0.0)
            if data:
                self._transport, spare = spare, self._transport
                self._prepare()
                self._down = True
        if spare and data:
            spare.close()
            self._spare = None
        return data

    def _renew(self, now: float, silent: float) -> None:
        """Connect once more to a stream that rests, or whose device forgot it; raises DeviceError.

        The silent connection is kept, so that a device that waits for its trigger loses nothing.
        """
        least = max(_RENEW_S, _RENEW_PERIODS * self._settings.sample_period)
        pause = min(max(least, _RENEW_PART * silent), self._settings.renew)
        if now - max(self._renewed, self._heard, self._opened) < pause:
            return
        self._renewed = now
        if self._spare:
            self._spare.close()
        self._spare = self._transport.spare()  # type: ignore[attr-defined]  # only TCP renews
        try:
            self._spare.open()
            self.renewals += 1
        except DeviceError:
            if silent > self._settings.renew:
                raise

    def close(self) -> list[BlockPair]:
        """Disconnect and hand over the partial block, if any."""
        off = self._cutter.lost_settings
        blocks = [*self._end(self._now_ns()), *self._cutter.end()]
        self._cutter.withhold()
        self._cutter.lost_settings = off  # what waited was measured before
        if self._spare:
            self._spare.close()
        self._transport.close()
        return blocks

    @property
    def identity(self) -> dict[str, str]:
        """Return make, model, version and settings as the device reported them; empty before."""
        return self._identity

    @property
    def settings(self) -> dict[str, object]:
        """Return the settings that a calibration depends on, as far as reported; JSON values."""
        return {}

    @property
    def trouble(self) -> str:
        """Return why the samples that come cannot be used; empty if they can."""
        if self._cutter.restarted_at_zero:
            return (
                f"{self._transport.name}: the encoders count from zero after a restart of the "
                "device, so positions are lost and samples are withheld: home the axes, then start "
                "this driver again"
            )
        if self._cutter.unconfirmed:
            return f"{self._transport.name}: {self._doubt()}"
        if self._cutter.wrong_rate:
            return (
                f"{self._transport.name} measures at {self._rates()}; its samples are withheld: "
                "set sample_period to the device's"
            )
        return ""

    def _doubt(self) -> str:
        """Return why arrivals confirm no samples, and the remedy."""
        if self._cutter.detector and self._cutter.detector.lost:
            return (
                "triggers were missed, or may have been, and arrivals do not show how many, so "
                "samples are withheld: restart the counters of both devices together"
            )
        if not self._cutter.delivered:
            return (
                "samples arrive too unevenly to show a missed trigger and are withheld: relieve "
                "this computer, let the device send each sample at once, or its time with it, or "
                "let one device latch probe and axes"
            )
        return (
            "all samples arrive late, as after missed triggers or at another rate, or too unevenly "
            "to show missed ones, and are withheld: if this lasts, check sample_period, then "
            "restart the counters of both devices together"
        )

    @property
    def caution(self) -> str:
        """Return why the samples may be wrong, although they are handed over; empty if not."""
        if self._cutter.arrives_otherwise:
            return (
                f"samples come at {self._rates()}: set sample_period to the trigger's, unless a "
                "recording is played in time lapse"
            )
        if self.decoded and not self._cutter.rate_known:
            return (
                f"{self._transport.name}: the rate of the samples is not verified yet; they carry "
                "no time, and arrivals show the rate after 5 s"
            )
        if self._small_counter:
            return (
                f"{self._transport.name}: a counter of {self._small_counter} shows no loss of "
                f"{self._small_counter} samples or a multiple; let the device count further"
            )
        if self._cutter.perhaps_at_zero:
            return (
                f"{self._transport.name}: counter and encoders are at zero after a silence; if the "
                "device was switched off, home the axes and start this driver again"
            )
        return ""

    def _rates(self) -> str:
        period = self._settings.sample_period
        found = period * (1 + self._cutter.period_deviation)
        rate = f"{1 / found:.6g} Hz" if found > 0 else "no rate (its time does not increase)"
        return f"{rate}, sample_period states {1 / period:.6g} Hz"

    @property
    def statistics(self) -> SimpleNamespace:
        """Return the counts of all samples."""
        owners = (self, self._tracker, self._cutter, self._cutter.detector)
        found = {n: next((getattr(o, n) for o in owners if hasattr(o, n)), 0) for n in _COUNTS}
        found["missed"] += self._tracker.missed_by_time
        return SimpleNamespace(**found)

    def counts(self) -> dict[str, float]:
        """Return all statistics by name, those of the protocol included; from any thread."""
        found = {} if self._decoder is None else vars(self._decoder.statistics)
        with self._counting_lock:
            return vars(self.statistics) | found

    def _prepare(self) -> None:
        """Set the device up; raises DeviceError."""
        if self._decoder is not None:
            self._decoder.reset()
        self._unread = 0

    def _decode(self, data: bytes) -> Samples:
        """Return the samples that ``data`` completes, shape (n,); n may be 0."""
        raise NotImplementedError

    def _rest(self) -> Samples:
        """Return samples that were complete, but waited for what follows them; shape (n,)."""
        return np.empty(0, SAMPLE)

    def _ahead(self) -> float:
        """Return how many of the samples that arrived are not decoded yet; may be a fraction."""
        return 0.0

    def _listen_in(self, silent: float) -> None:
        """Raise DeviceError if the device is gone or not understood, after ``silent`` [s]."""
        if silent > UNREADABLE_S and self._unread:
            described = f"{self.described_by}, " if self.described_by else ""
            raise NoSamplesError(
                f"{self._transport.name} sends bytes ({self._unread} in {silent:.1f} s), but no "
                f"samples of this device; check {described}the baud rate and what is connected"
            )

    def _read_answer(self, said: bytes, unanswered: Callable[[bytes], DeviceError]) -> bytes:
        """Return what arrives; if another service closes the line, raise ``unanswered(said)``."""
        try:
            return self._transport.read(_ANSWER_S)
        except DeviceError as err:
            if b"HTTP" in said or b"SSH" in said:
                raise unanswered(said) from err
            raise

    def _add(self, samples: Samples, arrival_ns: int, silent: float) -> list[BlockPair]:
        with self._counting_lock:
            self.decoded += len(samples)
            after_silence = self._down or silent > self._settings.pause
            self._down = False
            runs = list(self._tracker.split(samples, silent, broken=after_silence))
            if runs:
                self._went_on = self._monotonic()
            waited = self._ahead() * self._settings.sample_period
            came_ns = arrival_ns - round(waited * NANOSECONDS_PER_S)
            came = self._came_at - waited
            return list(self._cutter.add(runs, came_ns, came, after_silence=after_silence))

    def _end(self, arrival_ns: int) -> list[BlockPair]:
        """Return all samples that waited for the next ones."""
        with self._counting_lock:
            rest, blocks = self._rest(), []
            if len(rest):
                silent, self._heard = max(self._came_at - self._heard, 0.0), self._came_at
                blocks = self._add(rest, self._came_ns or arrival_ns, silent)
            blocks += self._cutter.add(list(self._tracker.settle()), arrival_ns, self._came_at)
            return [*blocks, *self._cutter.flush()]
