"""Decoders beside a plain ``numpy.frombuffer``, and drivers reading emulators in real time."""

from __future__ import annotations

import math
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from benchmarks.row import Row, at_least, at_most
from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import DeviceError
from omsm_ros.instruments.chrocodile.emulator import ChrocodileEmulator, ChrocodilePacketEmulator
from omsm_ros.instruments.chrocodile.packet_protocol import (
    DataFormat,
    PacketDecoder,
    encode_data,
    encode_format,
)
from omsm_ros.instruments.chrocodile.protocol import BinaryDecoder
from omsm_ros.instruments.chrocodile.telegram import ENCODERS_AT_START, Layout
from omsm_ros.instruments.emulator import Measured, RecordingSource
from omsm_ros.instruments.emulator_factory import emulated, line_for
from omsm_ros.instruments.factory import make_device
from omsm_ros.instruments.parameters import defaults
from omsm_ros.instruments.six_channel.protocol import FRAME, FrameDecoder, encode_frames

QUICK_S, FULL_S = 20.0, 300.0
# Counter, distance in nm, five encoders: 28 bytes a telegram.
SIGNALS = (83, 33024, *ENCODERS_AT_START)
PORTION = 4096
_EMULATORS = {"chrocodile": ChrocodileEmulator, "chrocodile_packet": ChrocodilePacketEmulator}


# Decoders.


def _rate(feed: Callable[[bytes], object], wire: bytes, size: int) -> float:
    """Bytes per second of ``feed``, given ``wire`` in portions of ``size``."""
    portions = [wire[i : i + size] for i in range(0, len(wire), size)]
    start = time.perf_counter()
    for portion in portions:
        feed(portion)
    return len(wire) / (time.perf_counter() - start)


def _telegrams(count: int) -> tuple[BinaryDecoder, bytes, np.dtype[np.void]]:
    layout = Layout.of(SIGNALS)
    records = layout.records(count)
    records["83"] = np.arange(count) % 2**16
    decoder = BinaryDecoder(layout)
    decoder.reset(synchronised=True)
    return decoder, records.tobytes(), layout.dtype


def _packets(count: int) -> tuple[PacketDecoder, bytes, np.dtype[np.void]]:
    signals = tuple((n, kind, 1) for n, kind in zip(SIGNALS, Layout.of(SIGNALS).types, strict=True))
    form = DataFormat(1, 70e3, signals)
    decoder = PacketDecoder()
    decoder.feed(encode_format(form))
    packets = [encode_data(form, np.zeros(100, form.dtype), i * 10**6) for i in range(count // 100)]
    return decoder, b"".join(packets), form.dtype


def _decoding() -> Iterator[Row]:
    stream = FrameDecoder(), encode_frames(np.zeros(20_000, FRAME)), FRAME
    for name, (decoder, wire, dtype) in (
        ("dollar protocol", _telegrams(200_000)),
        ("packet protocol", _packets(200_000)),
        ("six-channel stream", stream),
    ):
        plain = _rate(lambda p, d=dtype: np.frombuffer(p, d, len(p) // d.itemsize), wire, PORTION)  # type: ignore[misc]
        found = _rate(decoder.feed, wire, PORTION)
        # 70 kHz of 28 bytes are 2 MB/s: decoding them may take a fifth of a core.
        yield at_least(f"decoding the {name}", found / 1e6, "MB/s", 10.0, plain / 1e6)


# Drivers.


class _Endless(RecordingSource):
    """Samples without end: a surface at 10 µm, all axes at zero."""

    def __init__(self) -> None:
        self.length, self.period = math.inf, 1e-3

    def take(self, first: int, count: int) -> Measured:
        """Return ``count`` samples."""
        zero = np.zeros(count)
        status = np.full(count, Status.OK, np.uint8)
        return Measured(zero + 10e-6, np.float32(zero + 0.5), status, dict.fromkeys("xyzbc", zero))


def _serve(name: str, link: str, link_queue: multiprocessing.Queue[str], stop: Event) -> None:
    with line_for(link) as line:
        link_queue.put(line.path)
        _EMULATORS[name](line, _Endless()).serve(stop)  # type: ignore[arg-type]


def read(name: str, link: str, period: float, seconds: float) -> dict[str, float]:
    """Read an emulator in another process for ``seconds``; what became of its samples."""
    context = multiprocessing.get_context("spawn")
    link_queue, stop = context.Queue(), context.Event()
    process = context.Process(target=_serve, args=(name, link, link_queue, stop), daemon=True)
    process.start()
    values = {"device": name, "port": link_queue.get(timeout=30.0), "sample_period": period}
    values |= {"block_size": max(100, round(0.01 / period)), "encoders": "XYZUV"}
    values |= {"signals": " ".join(map(str, SIGNALS))}
    scales = {k: v for k, v in emulated(name).driver.items() if k.endswith("counts_per_unit")}
    device = make_device(defaults() | scales | values)
    device.open()
    start, used = time.monotonic(), time.process_time()
    delivered = 0
    while time.monotonic() - start < seconds:
        delivered += sum(len(b.distance) for b in device.poll(0.05) if b.distance is not None)
    used = (time.process_time() - used) / (time.monotonic() - start)
    counts = device.counts()
    device.close()
    stop.set()
    process.join(5.0)
    if not delivered:
        raise DeviceError(f"nothing came from the emulated {name}: {device.trouble}")
    return {"cpu": used, "delivered": delivered, "lost": counts["lost"] + counts["restarts"]}


def rows(full: bool) -> Iterator[Row]:
    """Decoding rates; then loss and processor time at the rates of real probes."""
    seconds = FULL_S if full else QUICK_S
    yield from _decoding()
    with tempfile.TemporaryDirectory() as folder:
        pty = str(Path(folder) / "probe")
        for words, name, link, period in (
            ("1 kHz, pty", "chrocodile", pty, 1e-3),
            ("25 kHz, TCP", "chrocodile", "tcp://127.0.0.1:0", 40e-6),
            ("70 kHz, packets", "chrocodile_packet", "tcp://127.0.0.1:0", 14.3e-6),
        ):
            found = read(name, link, period, seconds)
            yield at_most(f"driver, {words}, {seconds:.0f} s: samples lost", found["lost"], "1", 0)
            yield at_most(f"driver, {words}: share of a core", found["cpu"], "1", 0.4)
            due = seconds / period
            yield at_least(
                f"driver, {words}: samples delivered", found["delivered"] / due, "1", 0.98
            )
