"""Reads devices that latch positions on the trigger, as the generic six-channel stream.

A TwinCAT PLC, and a PandABox.
"""

import ctypes
import re
import socket
import time
from contextlib import suppress
from functools import partial
from typing import Any
from urllib.parse import parse_qs

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.errors import ConfigurationError, DeviceError, DeviceTimeoutError
from omsm_ros.instruments.scaling import AXES, whole_counts
from omsm_ros.instruments.six_channel.protocol import BODY_SIZE, FRAME, ProbeScaling, encode_frames
from omsm_ros.instruments.transport import TcpTransport, optional_package, parts_of
from omsm_ros.units import NANOSECONDS_PER_S

# Variables read one by one over Beckhoff ADS are neither synchronous with the trigger nor fast
# enough. So the PLC writes each sample, with its trigger counter, into a ring buffer, and the whole
# ring is read at once: ADS answers between two cycles of the PLC, so the samples are consistent.
# In structured text, packed to one byte::
#
#     TYPE OmsmSample : STRUCT
#         sequence : UDINT; device_time : ULINT; distance : DINT; status : USINT;
#         counts : ARRAY[0..4] OF LINT;
#     END_STRUCT END_TYPE
#     TYPE OmsmRing : STRUCT
#         written : ULINT;                       (* samples so far *)
#         samples : ARRAY[0..999] OF OmsmSample; (* sample n is at n MOD 1000 *)
#     END_STRUCT END_TYPE
#
# Tested against the test server of pyads, not on hardware.

_WRITTEN_SIZE = 8
# At 1 kHz this gives twenty samples at a time, and a ring of a thousand holds a second [s].
_POLL_S = 0.02
# An answer that takes longer than this counts as lost, so that the driver connects again [s].
_ANSWER_S = 0.5
_MOST_SAMPLES = 200_000


class AdsRing:
    """Reads ``ads://host[:port][/AMS.net.id][?symbol=GVL.omsm&samples=1000]``.

    The ring is delivered as the six-channel stream. Without a net id it is the host's address with
    ``.1.1``, as TwinCAT sets it. The PLC must have a route to this computer. Samples that were
    overwritten before they were read are a gap of the trigger counter; those that the ring still
    holds after a lost connection are not lost.
    """

    def __init__(self, address: str) -> None:
        """Raise ConfigurationError for an address that is not valid."""
        parts = parts_of(address)
        query = {"symbol": ["GVL.omsm"], "samples": ["1000"]} | parse_qs(parts.query)
        samples = query["samples"][0]
        usable = samples.isdecimal() and 0 < int(samples[:9]) <= _MOST_SAMPLES
        if parts.scheme != "ads" or not parts.hostname or len(query) != 2 or not usable:
            raise ConfigurationError(
                f"address {address!r}, expected ads://host:851/1.2.3.4.1.1?symbol=GVL.omsm"
                f"&samples=1000, with at most {_MOST_SAMPLES} samples"
            )
        self.name = address
        self._host = parts.hostname
        self._net_id = parts.path.strip("/") or f"{self._host}.1.1"
        self._port = parts.port or 851
        self._symbol = query["symbol"][0]
        self._capacity = int(samples)
        self._size = _WRITTEN_SIZE + self._capacity * BODY_SIZE
        self._plc: Any = None
        self._taken = -1

    def open(self) -> None:
        """Connect, the first time to begin with the next sample; raises DeviceError."""
        self.close()
        pyads = _pyads()
        try:
            # pyads itself would wait for two minutes for a host that is switched off.
            socket.create_connection((self._host, 48898), _ANSWER_S).close()
            self._plc = pyads.Connection(self._net_id, self._port, self._host)
            self._plc.open()
        except (pyads.ADSError, OSError, ValueError, TypeError) as err:
            self.close()
            raise DeviceError(
                f"{self.name} does not answer: {err}; check address, net id, and the PLC's route "
                "to this computer"
            ) from err
        self._plc.set_timeout(round(_ANSWER_S * 1000))
        written, _ = self._snapshot()
        self._taken = written if self._taken < 0 else self._taken
        with suppress(pyads.ADSError, RuntimeError):  # refused if there is no byte more
            self._plc.read_by_name(self._symbol, ctypes.c_ubyte * (self._size + 1))
            raise DeviceError(f"{self.name}: the ring has more samples than that; state how many")

    def read(self, timeout: float) -> bytes:
        """Return new samples as frames of the six-channel stream, b"" if none came in time."""
        if self._plc is None:
            raise DeviceError(f"{self.name} is not open")
        deadline = time.monotonic() + timeout
        while not (data := self._new()):
            left = deadline - time.monotonic()
            if left <= 0:
                return b""
            time.sleep(min(_POLL_S, left))
        return data

    def write(self, data: bytes) -> None:
        """Raise DeviceError: nothing is written to a PLC."""
        raise DeviceError(f"{self.name} is only read")

    def close(self) -> None:
        """Disconnect; does nothing when not connected."""
        if self._plc is not None:
            plc, self._plc = self._plc, None
            with suppress(Exception):  # it is closed in any state
                plc.close()

    def _new(self) -> bytes:
        written, ring = self._snapshot()
        if written < self._taken:  # the PLC was restarted
            self._taken = 0
        count = min(written - self._taken, self._capacity)
        if not count:
            return b""
        places = ((written - count) % self._capacity + np.arange(count)) % self._capacity
        self._taken = written
        frames = np.zeros((count, FRAME.itemsize), np.uint8)
        frames[:, :BODY_SIZE] = ring[places]
        return encode_frames(frames.reshape(-1).view(FRAME))

    def _snapshot(self) -> tuple[int, NDArray[np.uint8]]:
        """Return how many samples were written so far, and the ring (capacity, bytes)."""
        pyads = _pyads()
        try:
            kind = ctypes.c_ubyte * self._size
            raw = bytes(self._plc.read_by_name(self._symbol, kind, return_ctypes=True))
        except (pyads.ADSError, OSError, RuntimeError) as err:
            raise DeviceError(
                f"{self.name} returns no {self._symbol!r} of {self._size} bytes: {err}; check the "
                f"PLC, the network, and that its ring has {self._capacity} samples, packed to one "
                "byte"
            ) from err
        ring = np.frombuffer(raw, np.uint8, offset=_WRITTEN_SIZE).reshape(-1, BODY_SIZE)
        return int.from_bytes(raw[:_WRITTEN_SIZE], "little"), ring


_pyads = partial(optional_package, "ADS", "pyads")


# Written by the documentation of PandABlocks-server, tested against an emulator, not on hardware.

PANDA_COUNTS = 2**32
"""After which the counts of its encoders start again at zero."""
TIME_FIELD = "PCAP.TS_TRIG"
_PANDA_PORT = 8888  # for commands; data come from the next one
# Bounds the memory of a header or answer, and of a frame, of which the server sends 64 KiB at most.
_MOST_HEADER, _MOST_FRAME = 2**15, 2**17
# After such a silence the box is asked whether its capture goes on, and how often [s].
_SILENT_S, _ASK_S = 1.0, 0.5
_DIGITS = 19  # of a number that a box states
# The server states 12 digits of a scale, so counts computed with it are nearly whole: up to this.
_NO_COUNT = 0.1
_FIELD = re.compile(r"[A-Z]+[0-9]*\.[A-Z][A-Z0-9_]*")
_ENDS = {
    "Disarmed": "another program disarmed it; it is armed again, so end that program",
    "Data overrun": "this computer or the network took the samples too slowly; relieve them",
    "Framing error": "triggers came too fast; lower their rate, or capture fewer fields",
    "Driver data overrun": "the box is overloaded; close its web page and other clients",
    "DMA data error": "too many data for the box; capture fewer fields, or lower the rate",
}


class PandaBox:
    """Reads ``panda://host[:8888]?x=INENC1.VAL&z=INENC2.VAL``: positions latched by a PandABox.

    Each axis has the field that is captured for it, one that is not named stays at zero counts. The
    capture is armed if none is running, otherwise joined. The trigger is wired in the box
    (``PCAP.TRIG``). Samples are delivered as the six-channel stream without a distance; their count
    is that of the capture. The box keeps some seconds, so those of a lost connection are not lost.
    """

    def __init__(self, address: str) -> None:
        """Raise ConfigurationError for an address that is not valid."""
        parts = parts_of(address)
        query = parse_qs(parts.query)
        self._fields = {axis: fields[0] for axis, fields in query.items()}
        usable = parts.scheme == "panda" and parts.hostname and not parts.path.strip("/")
        named = len(parts.query.split("&")) == len(query) > 0 and set(query) <= set(AXES)
        if not (usable and named and all(map(_FIELD.fullmatch, self._fields.values()))):
            raise ConfigurationError(
                f"address {address!r}, expected panda://host?x=INENC1.VAL&z=INENC2.VAL, with a "
                f"field of the PandABox for each axis that it latches, of {AXES}"
            )
        self.name = address
        port = parts.port or _PANDA_PORT
        self._control = TcpTransport(parts.hostname or "", port, _ANSWER_S)
        self._data = TcpTransport(parts.hostname or "", port + 1, _ANSWER_S)
        self._talk: Any = None  # of pandablocks: the control connection, and the data connection
        self._stream: Any = None
        self._columns: dict[str, Any] = {}  # of the header, by name; empty before it
        self._armed = self._ended = self._wrong = ""
        self._at = self._next = 0  # number of the next sample to come, and to be delivered
        self._captured = 0  # by the box, when it was asked the last time
        self._unread = 0  # bytes since the last whole header or frame, at most
        self._heard = self._asked = 0.0

    def open(self) -> None:
        """Connect, set up what is captured, and arm; raises DeviceError."""
        self.close()
        panda = _pandablocks()
        self._talk = panda.connections.ControlConnection()
        self._control.open()
        for field in (*self._fields.values(), TIME_FIELD):
            self._ask(panda.commands.Put(f"{field}.CAPTURE", "Value"))
        for field in ("PCAP.TRIG", "PCAP.ENABLE"):
            if self._ask(panda.commands.GetLine(field)) == "ZERO":
                raise DeviceError(
                    f"{self.name}: {field} of the box is ZERO, so nothing is captured; set it on "
                    "its web page to the input of the trigger (PCAP.TRIG) or ONE (PCAP.ENABLE)"
                )
        self._columns, self._ended, self._wrong = {}, "", ""
        self._at = self._captured = self._unread = 0
        self._stream = panda.connections.DataConnection()
        self._data.open()
        self._data.write(self._stream.connect(scaled=True))
        if self._ask(panda.commands.GetLine("*PCAP.COMPLETION")) != "Busy":
            self._arm()
        elif not self._armed:  # what was captured before is not of interest
            self._next = self._number(panda.commands.GetLine("*PCAP.CAPTURED"))
        self._heard = time.monotonic()

    def read(self, timeout: float) -> bytes:
        """Return new samples as frames of the six-channel stream, b"" if none came in time."""
        if self._wrong:
            raise DeviceError(self._wrong)
        if self._ended == "Ok":  # PCAP.ENABLE fell: the next capture begins when it rises
            self._ended = ""
            self._arm()
        elif self._ended:
            remedy = _ENDS.get(self._ended, "look at the box's web page")
            raise DeviceError(f"{self.name} ended its capture, {self._ended!r}: {remedy}")
        data = self._data.read(timeout)
        now = time.monotonic()
        if data:
            self._heard = now
        elif now - max(self._heard + _SILENT_S, self._asked + _ASK_S) > 0:
            self._asked = now
            self._look()
        return self._frames(data)

    def write(self, data: bytes) -> None:
        """Raise DeviceError: a PandABox takes no bytes of the six-channel stream."""
        raise DeviceError(f"{self.name} is only read")

    def close(self) -> None:
        """Disconnect; does nothing when not connected. The capture goes on."""
        self._control.close()
        self._data.close()

    def _look(self) -> None:
        """Raise DeviceError if the capture is over, or its samples do not come."""
        line = _pandablocks().commands.GetLine
        if (said := self._ask(line("*PCAP.COMPLETION"))) != "Busy":
            raise DeviceError(
                f"{self.name} has no capture any more ({said!r}), as after a restart; it is armed "
                "again"
            )
        if self._at < self._captured:
            raise DeviceError(
                f"{self.name} has captured {self._captured} samples, of which {self._at} came; "
                "check the network, and that nothing keeps its data port busy"
            )
        self._captured = self._number(line("*PCAP.CAPTURED"))

    def _number(self, command: Any) -> int:
        said = self._ask(command)
        if not (said.isdecimal() and len(said) < _DIGITS):
            raise self._unreadable(f"{said!r} to {command!r}")
        return int(said)

    def _arm(self) -> None:
        deadline, armed = time.monotonic() + _ANSWER_S, False
        while not armed:
            try:
                armed = self._ask(_pandablocks().commands.Arm()) is None
            except DeviceError as err:  # the last capture is still being sent to its clients
                if "still taking data" not in str(err) or time.monotonic() > deadline:
                    raise
                time.sleep(_POLL_S)
        self._armed, self._next, self._at, self._captured = "", 0, 0, 0

    def _ask(self, command: Any) -> Any:
        """Return the answer to a command; raises DeviceError, DeviceTimeoutError."""
        self._control.write(self._talk.send(command))
        deadline, received = time.monotonic() + _ANSWER_S, 0
        while (left := deadline - time.monotonic()) > 0 and received <= _MOST_HEADER:
            data = self._control.read(left)
            received += len(data)
            try:
                self._talk.receive_bytes(data)
            except Exception as err:  # it asserts what a server sends
                raise self._unreadable(err) from err
            for _, answer in self._talk.responses():
                if isinstance(answer, Exception):
                    said = " ".join(str(answer).split()).rpartition("AssertionError: ")[2]
                    raise DeviceError(
                        f"{self.name} refused a command: {said}; check the names of the fields in "
                        "the address, and other clients of the box"
                    )
                return answer
        raise DeviceTimeoutError(
            f"{self.name} did not answer {command!r} within {_ANSWER_S:g} s ({received} bytes "
            "received); check address, network and power"
        )

    def _unreadable(self, err: object) -> DeviceError:
        said = f"{type(err).__name__}: {err}" if isinstance(err, Exception) else err
        return DeviceError(
            f"{self.name} sends what no PandABlocks server sends ({str(said)[:200]}); check that "
            "the address is that of a PandABox with server 3.0 or later"
        )

    def _frames(self, data: bytes) -> bytes:
        """Return the samples that ``data`` completes; an error is raised by the next ``read``."""
        found = []
        self._unread += len(data)
        try:
            for item in self._stream.receive_bytes(data):
                self._unread = len(data)  # at most: a part may belong to the item
                if hasattr(item, "fields"):
                    self._begin(item)
                elif hasattr(item, "reason"):
                    self._columns, self._ended = {}, item.reason.value
                elif hasattr(item, "data"):
                    found.append(self._latched(item.data))
            if self._unread > (_MOST_FRAME if self._columns else _MOST_HEADER):
                raise self._unreadable(f"{self._unread} bytes without an end")
        except DeviceError as err:
            self._wrong = str(err)
        except Exception as err:
            self._wrong = str(self._unreadable(err))
        return b"".join(found)

    def _begin(self, start: Any) -> None:
        """Take the header of a capture."""
        columns = {each.name: each for each in start.fields if each.capture == "Value"}
        if missing := {*self._fields.values(), TIME_FIELD} - set(columns):
            raise DeviceError(
                f"{self.name}: the capture that is running has no {sorted(missing)!r}, only "
                f"{sorted(columns)!r}; disarm it, and it is armed with them"
            )
        if not start.arm_time or not 0 <= start.missed < 2**62:
            raise self._unreadable(f"arm_time {start.arm_time!r}, missed {start.missed!r}")
        if self._armed not in ("", start.arm_time):
            self._next = 0
        self._columns, self._armed, self._at = columns, start.arm_time, start.missed

    def _latched(self, rows: NDArray[np.void]) -> bytes:
        """Return the frames of the samples (n,) that were not delivered before."""
        first = max(self._next, self._at)
        self._at, rows = self._at + len(rows), rows[first - self._at :]
        self._next = max(self._next, self._at)
        frames = np.zeros(len(rows), FRAME)
        frames["sequence"] = (first % 2**32 + np.arange(len(rows))) % 2**32
        frames["distance"] = ProbeScaling().invalid
        seconds = rows[f"{TIME_FIELD}.Value"]
        times = whole_counts(TIME_FIELD, np.rint(seconds * NANOSECONDS_PER_S), np.int64)
        frames["device_time"] = times.astype(np.int64)
        for axis, field in self._fields.items():
            frames["counts"][:, AXES.index(axis)] = self._counts(field, rows[f"{field}.Value"])
        return encode_frames(frames)

    def _counts(self, field: str, values: FloatArray) -> IntArray:
        """Return the encoder's counts (n,) of what the box's web page shows."""
        column = self._columns[field]
        counts = (values - column.offset) / column.scale
        whole = whole_counts(field, np.rint(counts), np.int64)
        if len(whole) and float(abs(counts - whole).max()) > _NO_COUNT:
            raise DeviceError(
                f"{self.name}: {field} with SCALE {column.scale!r} and OFFSET {column.offset!r} is "
                "no whole number of counts; state at most 12 digits of both on the box's web page"
            )
        return whole.astype(np.int64)


_pandablocks = partial(
    optional_package, "a PandABox", "pandablocks.commands", "pandablocks.connections"
)
