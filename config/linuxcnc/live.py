"""The twin behind LinuxCNC while it runs: read the commands, send what encoders and probe read.

    python live.py FROM TO [flat|mirror [DRIVERS]]

FROM and TO are ports of this computer: that of `start.py`, and that for DRIVERS (one, or one for
the axes and one for the probe). The lines have the same columns on both sides. They are late by
0.2 s; noise is new in each piece.
"""

import socket
import sys
import time
from dataclasses import replace

import numpy as np
from behind import CommandedMotion

from omsm_ros.core.streams.blocks import AxisBlock
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.instruments.linuxcnc.device import COLUMNS
from omsm_ros.instruments.six_channel.protocol import CsvDecoder
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.scenario import Scenario
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M, NANOMETRE_M, NANOSECOND_S

UNITS = {n: DEGREE_RAD if n in "bc" else MILLIMETRE_M for n in "xyzbc"}
# Cycles that are simulated again before each piece, until the machine has settled; after each
# piece as many as the curve through the commands needs; and of a piece.
BEFORE, AFTER, PIECE = 500, 20, 200


class Twin:
    """Answers rows of commands (n,) with rows of readings, piece by piece.

    rows have the columns of LinuxCNC's lines
    """

    def __init__(self, cell, part, stand_off):
        """stand_off: height of the zero of the probe above the zero of Z [m]."""
        self.cell, self.part, self.stand_off = cell, part, stand_off
        self.rows, self.done, self.pieces = None, 0, 0

    def answer(self, rows):
        """Return the rows that ``rows`` complete; none may be complete."""
        follows = self.rows is not None and len(rows)
        if follows and rows["sequence"][0] != self.rows["sequence"][-1] + 1:
            self.rows = None  # after a restart or a gap the machine is taken to have stood still
        if self.rows is None:
            self.rows, self.done = rows, 0
        else:
            self.rows = np.concatenate([self.rows, rows])
        if len(self.rows) - self.done < PIECE + AFTER:
            return rows[:0]
        end = len(self.rows) - AFTER
        found = self.readings(self.rows)[self.done : end]
        kept = max(0, end - BEFORE)
        self.rows, self.done = self.rows[kept:], end - kept
        return found

    def readings(self, rows):
        """Return the readings at the commands of ``rows`` (n,)."""
        period = float(rows["device_time"][0] / rows["sequence"][0]) * NANOSECOND_S
        commands = AxisBlock(
            stamp_ns=0,
            first_sample=0,
            sample_period=period,
            **{name: rows[name] * unit for name, unit in UNITS.items()},
        )
        cell = replace(self.cell, sample_period=period, seed=self.cell.seed + self.pieces)
        self.pieces += 1
        seen = record(cell, CommandedMotion(commands), self.part, stand_off=self.stand_off)
        read = rows.copy()
        for name, unit in UNITS.items():
            read[name] = getattr(seen.axes, name) / unit
        measured = seen.distance.ok
        read["distance"] = np.where(measured, seen.distance.distance / NANOMETRE_M, 0.0)
        read["status"] = np.where(rows["status"] != 0, rows["status"], seen.distance.status)
        return read


def lines(rows):
    """Return the bytes of rows (n,)."""
    return "".join(" ".join(f"{v:.17g}" for v in row) + "\n" for row in rows.tolist()).encode()


def connected(port, patience=30.0):
    """Return a connection to ``port``, which may be opened within ``patience`` [s]."""
    end = time.monotonic() + patience
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port))
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


def serve(commands, readings, twin, drivers):
    """Send the readings to ``drivers`` drivers until LinuxCNC ends; wait for one that is gone."""
    decoder = CsvDecoder(COLUMNS.split())
    with socket.create_server(("127.0.0.1", readings)) as server, connected(commands) as source:
        clients = [server.accept()[0] for _ in range(drivers)]
        while data := source.recv(1 << 16):
            sent = lines(twin.answer(decoder.feed(data)))
            for k, client in enumerate(clients):
                try:
                    client.sendall(sent)
                except OSError:  # LinuxCNC keeps its samples meanwhile; those on the way are lost
                    clients[k] = server.accept()[0]


if __name__ == "__main__":
    on_mirror = sys.argv[3:4] == ["mirror"]
    part = Scenario().part if on_mirror else Flat()
    number = int(sys.argv[4]) if len(sys.argv) > 4 else 1
    serve(int(sys.argv[1]), int(sys.argv[2]), Twin(Cell(), part, 0.0), number)
