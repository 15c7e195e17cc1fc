"""The base of all emulated instruments: a clock, a line, and spoilt bytes.

A model implements its answers and the encoding of samples. The instrument measures whether a
client is connected or not: samples that are not sent are lost, and its counter advances.

Not imitated: latency of the link, baud rate and UART overrun, jitter of the trigger.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.instruments.scaling import AXES, AxisScaling, ProbeReading
from omsm_ros.twin.cell import Recording
from omsm_ros.units import NANOSECONDS_PER_S


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Consecutive samples, arrays of shape (n,).

    distance: [m], NaN = none;  intensity: 0-1;  status: Status
    axes: x, y, z [m], b, c [rad] by name
    """

    distance: FloatArray
    intensity: NDArray[np.float32]
    status: NDArray[np.uint8]
    axes: dict[str, FloatArray]

    def __len__(self) -> int:
        return len(self.distance)


class RecordingSource:
    """Supplies a motion of the twin, once: a sample for each trigger."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.length: float = len(recording.axes)
        self.period = recording.axes.sample_period

    def take(self, first: int, count: int) -> Measured:
        """Return samples ``first`` to ``first + count``, as far as the length reaches."""
        part = slice(first, first + count)
        axes, distance = self._recording.axes, self._recording.distance
        size = len(axes.z[part])
        reported = len(distance.intensity) > 0
        return Measured(
            distance.distance[part],
            distance.intensity[part] if reported else np.full(size, 0.5, np.float32),
            distance.status[part] if len(distance.status) else np.zeros(size, np.uint8),
            {name: getattr(axes, name)[part] for name in AXES},
        )


# The encoders of an emulated cell. One turn is 2^28 counts: 32 bits hold 16 whole turns, so
# nothing is lost when they wrap.
_LINEAR = AxisScaling(counts_per_unit=1e10, wrap=2**32)
_ROTARY = AxisScaling(counts_per_unit=2**28 / (2 * np.pi), wrap=2**32)
AXIS_SCALING = (_LINEAR, _LINEAR, _LINEAR, _ROTARY, _ROTARY)

# Between two writes: shorter costs processor time, longer delays samples [s].
WRITE_INTERVAL_S = 0.005
# Bounds memory and the time to stop at any time lapse [samples].
_MAX_SAMPLES = 2000
_NOISE_BYTES = 20


class InstrumentLink(Protocol):
    """The instrument's end of a line: a ``Pty`` or a ``TcpServer``."""

    @property
    def sessions(self) -> int:
        """Return how many clients have connected so far."""
        ...

    def read(self) -> bytes:
        """Return the bytes that the driver sent; b"" if none."""

    def write(self, data: bytes, stop: threading.Event | None = None) -> int:
        """Send ``data``; return how many bytes of it were taken."""


@dataclass(slots=True)
class InstrumentFaults:
    """Faults of the line and the clock.

    rate: actual rate over the rate set [1]
    noise_rate, flip_rate, drop_rate: probability, for each sample, of random bytes before it, of
        one inverted bit in it, of its loss [1]
    """

    rate: float = 1.0
    noise_rate: float = 0.0
    flip_rate: float = 0.0
    drop_rate: float = 0.0


class Instrument:
    """A device that is switched on when made; ``step`` does what is due."""

    counter_range = 2**32

    def __init__(
        self,
        line: InstrumentLink,
        source: RecordingSource | None = None,
        *,
        triggered: bool = False,
        probe: ProbeReading | None = None,
        axes: tuple[AxisScaling, ...] = AXIS_SCALING,
        clock: Callable[[], float] = time.monotonic,
        seed: int = 1,
    ) -> None:
        """triggered: samples only while a motion plays, with the motion's own trigger.

        probe, axes: how readings and positions are sent
        """
        self.faults = InstrumentFaults()
        self._line = line
        self._source = source
        self._triggered = triggered
        self._probe, self._axes = probe or ProbeReading(), axes
        self._clock = clock
        self._random = np.random.default_rng(seed)
        self._lapse = 1.0
        self._taken = 0  # samples of the source
        self._counter = 0
        self._origin = self._started = clock()
        self._due = 0.0  # samples measured since ``_origin``
        self._session = 0
        self._stop: threading.Event | None = None
        self.reset()

    def reset(self) -> None:
        """Set everything as after switching on."""

    def rate(self) -> float:
        """Return the samples per second as set."""
        return 1 / self._source.period if self._source is not None else 1.0

    def streaming(self) -> bool:
        """Return whether samples are to be sent."""
        return True

    def greet(self) -> None:
        """Send the greeting to a new client."""

    def receive(self, data: bytes) -> None:
        """Take commands, in portions of any size."""

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the bytes of each sample, or of several in the place of their first one."""
        raise NotImplementedError

    def step(self, stop: threading.Event | None = None) -> None:
        """Do what is due now: answer, measure, send."""
        self._stop = stop
        data = self._line.read()
        if self._line.sessions != self._session:
            self._session = self._line.sessions
            self.greet()
        if data:
            self.receive(data)
        if wire := b"".join(self._measure(self._clock())):
            self._line.write(wire, stop)

    def serve(self, stop: threading.Event) -> None:
        """Work until ``stop``."""
        while not stop.wait(WRITE_INTERVAL_S):
            self.step(stop)

    def play(self, source: RecordingSource, time_lapse: float = 1.0) -> None:
        """Begin a motion; its trigger counts from zero."""
        self._source, self._lapse = source, time_lapse
        self._taken = self._counter = 0
        self._origin, self._due = self._clock(), 0.0

    @property
    def played(self) -> int:
        """Return the number of samples of the motion measured so far."""
        return self._taken

    @property
    def playing(self) -> bool:
        """Return whether a motion has samples left."""
        return self._source is not None and self._taken < self._source.length

    def halt(self) -> None:
        """End the motion."""
        self._source = None

    def _measure(self, now: float) -> list[bytes]:
        """Return the bytes of the samples that are due; empty while none are to be sent."""
        elapsed = (now - self._origin) * self._lapse
        self._origin = now
        if self._source is None:
            return []
        self._due += elapsed * self.rate() * self.faults.rate
        most = _MAX_SAMPLES if self.streaming() else self._due
        count = int(min(self._due, most, self._source.length - self._taken))
        self._due -= count
        if count <= 0:
            return []
        counters = (self._counter + np.arange(count)) % self.counter_range
        measured = self._source.take(self._taken, count)
        packed = self.pack(measured, counters, self._times(count, now)) if self.streaming() else []
        pieces = self._spoil(packed)
        self._taken += count
        self._counter = (self._counter + count) % self.counter_range
        return pieces

    def _times(self, count: int, now: float) -> np.ndarray:
        """Return the device time of the last ``count`` samples [ns]."""
        true_period = 1 / (self.rate() * self.faults.rate)
        if self._lapse == 1.0:
            last = now - self._started - self._due * true_period
        else:
            last = (self._taken + count) * true_period
        seconds = last - np.arange(count)[::-1] * true_period
        return np.asarray(np.rint(seconds * NANOSECONDS_PER_S), np.int64)

    def _spoil(self, packed: list[bytes]) -> list[bytes]:
        pieces, faults = list[bytes](), self.faults
        rates, n = (faults.drop_rate, faults.noise_rate, faults.flip_rate), len(packed)
        # No random number is used without a fault, so each fault alone repeats with its seed.
        struck = [self._random.random(n) < rate if rate else np.zeros(n, bool) for rate in rates]
        for piece, dropped, noisy, flipped in zip(packed, *struck, strict=True):
            if piece and dropped:
                continue
            if piece and flipped:
                damaged = bytearray(piece)
                damaged[self._random.integers(len(piece))] ^= 1 << int(self._random.integers(8))
                piece = bytes(damaged)
            if piece and noisy:
                piece = self._random.bytes(_NOISE_BYTES) + piece
            pieces.append(piece)
        return pieces

    def say(self, wire: bytes) -> None:
        """Send an answer."""
        self._line.write(wire, self._stop)
