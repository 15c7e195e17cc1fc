"""A PandABox's server as the PandABlocks documentation describes it, with real TCP.

Control port with commands and answers in lines; on the next port data: "XML FRAMED SCALED",
a header, frames with the length in front, and at the end the number of samples and the reason.
A client that connects during a capture gets all that the buffer still holds, and how many samples
it missed. Written from the server's documentation (commands.rst, capture.rst, fields.rst).

Not imitated: tables, the wiring of the blocks, other formats than framed scaled data, the RAW
format, several captured values of a field, times of the FPGA's data transfer.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from contextlib import suppress

TICK_S = 8e-9
ENCODERS = tuple(f"INENC{n}.VAL" for n in (1, 2, 3, 4))
TIMES = ("PCAP.TS_START", "PCAP.TS_END", "PCAP.TS_TRIG")
NEXT = 0.01


class Panda:
    """Its captures and answers; ``trigger`` latches samples, faults are methods.

    captures: field → Value or No;  scales: field → (scale, offset, units) of the web page
    rows: the buffer, of at most ``room`` samples;  lost: samples it has dropped
    """

    def __init__(self, period: float = 1e-3, room: int = 10_000) -> None:
        self.period, self.room = period, room
        self.captures = dict.fromkeys((*ENCODERS, *TIMES), "No")
        self.scales = dict.fromkeys(ENCODERS, (1.0, 0.0, ""))
        self.scales |= dict.fromkeys(TIMES, (TICK_S, 0.0, "s"))
        self.wiring = {"PCAP.TRIG": "TTLIN1.VAL", "PCAP.ENABLE": "ONE"}
        self.at = 0  # position of all axes, in triggers since the machine was homed
        self.ticks = 0
        self.start = [1000 * n for n in range(4)]
        self.step = [10, -20, 30, 40]
        self.experiment = 0
        self.busy, self.completion, self.captured = False, "Ok", 0
        self.fields: list[str] = []
        self.rows: list[tuple[int, ...]] = []
        self.lost = 0
        self.arm_time = ""
        self.asked: list[str] = []
        self.answers: dict[str, str] = {}  # instead of the usual ones
        self.instead: bytes | None = None  # sent in the place of a header and what follows
        self.quiet_until = 0.0
        self.lock = threading.Condition()
        self.stopped = False
        self.clients: set[socket.socket] = set()
        self.listening: list[socket.socket] = []
        self.readers = 0
        self.threads: list[threading.Thread] = []
        self.port = 0
        self.plug()

    # -- the machine ------------------------------------------------------------------------

    def trigger(self, count: int) -> None:
        """Latch ``count`` samples, if a capture is armed; the machine moves in any case."""
        with self.lock:
            for _ in range(count):
                self.at += 1
                self.ticks += round(self.period / TICK_S)
                if not self.busy:
                    continue
                if not self.captured:
                    self.begun = self.ticks
                self.rows.append(tuple(self.value(name) for name in self.fields))
                self.captured += 1
            drop = max(len(self.rows) - self.room, 0)
            del self.rows[:drop]
            self.lost += drop
            self.lock.notify_all()

    def value(self, name: str) -> int:
        if name in TIMES:
            return self.ticks - self.begun + 7
        n = ENCODERS.index(name)
        raw = self.start[n] + self.step[n] * self.at
        return (raw + 2**31) % 2**32 - 2**31

    # -- faults -----------------------------------------------------------------------------

    def finish(self, completion: str) -> None:
        """End the capture for this reason."""
        with self.lock:
            self.busy, self.completion = False, completion
            self.lock.notify_all()

    def drop(self, seconds: float = 0.0) -> None:
        """Cut all connections and refuse new ones for a while; the capture goes on."""
        self.unplug()
        if seconds:
            time.sleep(seconds)
        self.plug()

    def power_cycle(self, seconds: float = 0.0) -> None:
        """Lose the capture and the positions of incremental encoders; the settings are saved."""
        self.unplug()
        with self.lock:
            self.busy, self.completion, self.captured = False, "Ok", 0
            self.rows, self.lost, self.at, self.ticks = [], 0, 0, 0
            self.start = [0, 0, 0, 0]
        if seconds:
            time.sleep(seconds)
        self.plug()

    def forget(self) -> None:
        """Lose the capture silently, as by a restart behind a switch."""
        with self.lock:
            self.experiment += 1
            self.busy, self.rows, self.lost, self.captured = False, [], 0, 0
            self.readers = 0

    def stall(self, seconds: float) -> None:
        """Send and answer nothing for a while."""
        self.quiet_until = time.monotonic() + seconds

    # -- the lines --------------------------------------------------------------------------

    def plug(self) -> None:
        while not self.listening:
            first = socket.create_server(("127.0.0.1", self.port))
            port = first.getsockname()[1]
            try:
                second = socket.create_server(("127.0.0.1", port + 1))
            except OSError:
                first.close()
                if self.port:
                    time.sleep(NEXT)
                continue
            self.port, self.listening = port, [first, second]
        for server, serve in zip(self.listening, (self.control, self.data), strict=True):
            self.run(self.accept, server, serve)

    def unplug(self) -> None:
        with self.lock:
            open_now, self.clients = self.clients, set()
            servers, self.listening = self.listening, []
            self.lock.notify_all()
        for each in (*servers, *open_now):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        for thread in self.threads:
            if thread is not threading.current_thread():
                thread.join(5.0)
        self.threads = [thread for thread in self.threads if thread.is_alive()]

    def close(self) -> None:
        self.stopped = True
        self.unplug()
        assert not self.threads

    def run(self, work, *arguments) -> None:
        thread = threading.Thread(target=work, args=arguments, daemon=True)
        self.threads.append(thread)
        thread.start()

    def accept(self, server: socket.socket, serve) -> None:
        with suppress(OSError):
            while True:
                client, _ = server.accept()
                with self.lock:
                    if server not in self.listening:
                        client.close()
                        return
                    self.clients.add(client)
                self.run(self.serve, client, serve)

    def serve(self, client: socket.socket, serve) -> None:
        try:
            with suppress(OSError), client.makefile("rb") as lines:
                serve(client, lines)
        finally:
            with self.lock:
                self.clients.discard(client)
            client.close()

    def patient(self) -> None:
        while time.monotonic() < self.quiet_until and not self.stopped:
            time.sleep(NEXT)

    # -- commands ---------------------------------------------------------------------------

    def control(self, client: socket.socket, lines) -> None:
        for line in lines:
            self.patient()
            with self.lock:
                said = line.decode().rstrip("\n")
                self.asked.append(said)
                answer = self.answers.get(said) or self.answer(said)
            client.sendall(answer.encode() + b"\n")

    def answer(self, said: str) -> str:
        if said == "*IDN?":
            return "OK =PandA SW: 4.1 FPGA: 4.1.0 816147d6 00000000 rootfs: PandA 4.1"
        if said == "*PCAP.COMPLETION?":
            return f"OK ={'Busy' if self.busy else self.completion}"
        if said == "*PCAP.STATUS?":
            return f"OK ={'Busy' if self.busy else 'Idle'} {self.readers} {self.readers}"
        if said == "*PCAP.CAPTURED?":
            return f"OK ={self.captured}"
        if said == "*PCAP.ARM=":
            return self.arm()
        if said == "*PCAP.DISARM=":
            self.finish("Disarmed")
            return "OK"
        if said == "*CAPTURE?":
            chosen = [f"!{name} {how}" for name, how in self.captures.items() if how != "No"]
            return "\n".join([*chosen, "."])
        if said.endswith("?") and said[:-1] in self.wiring:
            return f"OK ={self.wiring[said[:-1]]}"
        name, equals, value = said.partition(".CAPTURE=")
        if equals and name in self.captures:
            self.captures[name] = value
            return "OK"
        block = name.partition(".")[0].rstrip("0123456789")
        known = {"INENC", "PCAP", "COUNTER", "TTLIN"}
        return "ERR No such field" if block in known else "ERR No such block"

    def arm(self) -> str:
        if self.busy:
            return "ERR Data capture already in progress"
        if self.readers:
            return "ERR Data clients still taking data"
        chosen = [name for name, how in self.captures.items() if how != "No"]
        if not chosen:
            return "ERR Nothing configured for capture"
        self.fields, self.rows, self.lost, self.captured = chosen, [], 0, 0
        self.experiment += 1
        self.arm_time = f"2026-03-01T10:20:{self.experiment:02d}.123456789Z"
        self.busy = True
        self.lock.notify_all()
        return "OK"

    # -- data -------------------------------------------------------------------------------

    def data(self, client: socket.socket, lines) -> None:
        options = lines.readline().split()
        self.patient()
        if set(options) - {b"XML", b"FRAMED", b"SCALED"}:
            client.sendall(b"ERR Invalid option\n")
            return
        client.sendall(b"OK\n")
        done = self.experiment - self.busy
        while self.wait(client, lambda done=done: self.experiment > done and self.captured > 0):
            with self.lock:
                done, self.readers = self.experiment, self.readers + 1
            try:
                self.send_capture(client, done)
            finally:
                with self.lock:
                    self.readers = max(self.readers - 1, 0)

    def wait(self, client: socket.socket, until) -> bool:
        with self.lock:
            while not self.stopped and client in self.clients:
                if until():
                    return True
                self.lock.wait(0.2)
        return False

    def send_capture(self, client: socket.socket, mine: int) -> None:
        with self.lock:
            first = self.lost
        if self.instead is not None:
            client.sendall(self.instead)
            return
        client.sendall(self.header(first))
        at = first
        while self.wait(
            client, lambda at=at: self.experiment == mine and (self.captured > at or not self.busy)
        ):
            self.patient()
            with self.lock:
                if at < self.lost:
                    break
                rows = self.rows[at - self.lost :][:500]
                done = not rows and not self.busy
            if done:
                client.sendall(f"END {at - first} {self.completion}\n".encode())
                return
            packed = b"".join(self.packed(row) for row in rows)
            client.sendall(b"BIN " + struct.pack("<I", 8 + len(packed)) + packed)
            at += len(rows)
        else:
            return
        client.sendall(f"END {at - first} Data overrun\n".encode())

    def packed(self, row: tuple[int, ...]) -> bytes:
        values = []
        for name, raw in zip(self.fields, row, strict=True):
            scale, offset, _ = self.scales[name]
            values.append(scale * raw + offset)
        return struct.pack(f"<{len(values)}d", *values)

    def header(self, missed: int) -> bytes:
        lines = [
            "<header>",
            f'<data arm_time="{self.arm_time}" start_time="{self.arm_time}" missed="{missed}" '
            f'process="Scaled" format="Framed" sample_bytes="{8 * len(self.fields)}" />',
            "<fields>",
        ]
        for name in self.fields:
            scale, offset, units = self.scales[name]
            lines.append(
                f'<field name="{name}" type="double" capture="{self.captures[name]}" '
                f'scale="{scale:.12g}" offset="{offset:.12g}" units="{units}" />'
            )
        return "\n".join([*lines, "</fields>", "</header>", "", ""]).encode()
