"""Collects what a browser shows of a running scan: map, errors, states, calibration."""

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import ACCEPTED, REJECTED, RESERVED
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.ripple.density import density
from omsm_ros.core.streams.blocks import AccelerationBlock, FloatArray, IntArray
from omsm_ros.errors import DataError
from omsm_ros.quantities import LENGTH
from omsm_ros.report.verdict import verdict_text
from omsm_ros.units import NANOMETRE_M

# Smaller than any aperture, since the first points may coincide [m].
_LEAST_SPAN_M = 1e-5
# Up to this number of points the grid is laid out again around all of them, since the first turns
# of a spiral do not show its size; later it doubles.
_EARLY_POINTS = 20_000
_MARGIN = 1.05


@dataclass(frozen=True, slots=True)
class MapGrid:
    """A grid of ``cells`` by ``cells`` cells of ``pitch`` [m] from ``left``, ``bottom`` [m].

    generation: changes whenever the cells are laid out again
    """

    left: float
    bottom: float
    pitch: float
    cells: int
    generation: int


class RunningMap:
    """Means of values in the cells of a square grid, whose pitch doubles for points beyond it.

    Memory does not depend on the number of points. Each change of a cell has a version, so that
    readers can get the changes since their last version.

    grid: the present one, None before the first point;  version: of the newest change
    """

    def __init__(self, values: int, cells: int = 400) -> None:
        """values: number for each point;  cells: along a side, even."""
        self._values, self._cells = values, cells
        self.grid: MapGrid | None = None
        self.version, self._generations = 0, count()
        self._early: list[tuple[FloatArray, FloatArray, FloatArray]] | None = []
        self._clear()

    def _clear(self) -> None:
        cells = self._cells
        self._count = np.zeros((cells, cells), np.int64)
        self._sum = np.zeros((cells, cells, self._values))
        self._changed = np.zeros((cells, cells), np.int64)

    def restart(self) -> None:
        """Remove all points, as before another scan."""
        self._clear()
        self.version += 1
        self.grid, self._early = None, []

    def add(self, x: FloatArray, y: FloatArray, values: FloatArray) -> int:
        """Add ``values`` (n, k) at ``x``, ``y`` (n,) [m]; return the number of finite ones."""
        good = np.isfinite(x) & np.isfinite(y) & np.all(np.isfinite(values), axis=1)
        x, y, values = x[good], y[good], values[good]
        if not len(x):
            return 0
        self._keep_recent(x, y, values)
        if self.grid is None or not self._in_range(x, y):
            if self._early is not None:
                self._lay_out()
                return len(x)
            while not self._in_range(x, y):
                self._double(x, y)
        self._enter(x, y, values)
        return len(x)

    def _keep_recent(self, x: FloatArray, y: FloatArray, values: FloatArray) -> None:
        if self._early is None:
            return
        if self.grid is not None and sum(len(part) for part, *_ in self._early) > _EARLY_POINTS:
            self._early = None
            return
        self._early.append((x, y, values))

    def _enter(self, x: FloatArray, y: FloatArray, values: FloatArray) -> None:
        column = ((x - self.grid.left) / self.grid.pitch).astype(np.intp)
        row = ((y - self.grid.bottom) / self.grid.pitch).astype(np.intp)
        self.version += 1
        np.add.at(self._count, (row, column), 1)
        np.add.at(self._sum, (row, column), values)
        self._changed[row, column] = self.version

    def _lay_out(self) -> None:
        x, y, values = (np.concatenate(parts) for parts in zip(*self._early, strict=True))
        span = max(float(np.ptp(x)), float(np.ptp(y)), _LEAST_SPAN_M) * _MARGIN
        left = (float(x.min()) + float(x.max()) - span) / 2
        bottom = (float(y.min()) + float(y.max()) - span) / 2
        self.grid = MapGrid(left, bottom, span / self._cells, self._cells, next(self._generations))
        self._clear()
        self._enter(x, y, values)

    def _in_range(self, x: FloatArray, y: FloatArray) -> bool:
        size = self.grid.pitch * self._cells
        right, top = self.grid.left + size, self.grid.bottom + size
        return bool(
            x.min() >= self.grid.left
            and y.min() >= self.grid.bottom
            and x.max() < right
            and y.max() < top
        )

    def _double(self, x: FloatArray, y: FloatArray) -> None:
        """Merge groups of four cells into one quarter of the grid, so that the new points fit."""
        old = self.grid
        half, size = self._cells // 2, old.pitch * self._cells
        to_left = bool(x.min() < old.left)
        below = bool(y.min() < old.bottom)
        points = self._count.reshape(half, 2, half, 2).sum(axis=(1, 3))
        total = self._sum.reshape(half, 2, half, 2, self._values).sum(axis=(1, 3))
        self._clear()
        rows = slice(half, None) if below else slice(0, half)
        columns = slice(half, None) if to_left else slice(0, half)
        self._count[rows, columns], self._sum[rows, columns] = points, total
        self.version += 1
        self._changed[rows, columns] = np.where(points > 0, self.version, 0)
        self.grid = MapGrid(
            old.left - size * to_left,
            old.bottom - size * below,
            2 * old.pitch,
            self._cells,
            next(self._generations),
        )

    def since(self, version: int) -> tuple[IntArray, NDArray[np.float32]]:
        """Return the cells that changed after ``version``: place (m,), row by row; means (m, k).

        With another generation of the grid, ``version`` must be 0.
        """
        place = np.flatnonzero(self._changed.ravel() > version)
        means = self._sum.reshape(-1, self._values)[place]
        means /= self._count.ravel()[place][:, np.newaxis]
        return place, means.astype(np.float32)


LAYERS = ("height", "dynamic_error", "uncertainty")
"""Values of a cell, in this order; ``height`` is the deviation from a nominal surface, if any."""

# Half an hour, with one entry a second.
_SERIES_ENTRIES = 1800
_SERIES_STEP_S = 1.0
_SPECTRUM_SAMPLES = 4096
_SPECTRUM_LINES = 512
_SEVERITY = ("OK", "WARN", "STALE", "ERROR")
# A node without a message for this time is gone [s].
_STALE_S = 10.0
# Limits for the states of a cell's nodes, since any program may publish on /diagnostics.
_MOST_NODES = 64
_MOST_NAME, _MOST_MESSAGE, _MOST_VALUE = 200, 500, 5000
# Header of the binary part: cells along a side, generation, changed cells, version.
_HEADER = struct.Struct("<IIIQ")


class LiveView:
    """Collects messages of nodes, and returns the changes since a browser's last; thread-safe."""

    def __init__(
        self, nominal: Surface | None = None, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        """nominal: surface from which deviations are shown; None shows heights."""
        self._nominal, self._monotonic = nominal, monotonic
        self._lock = threading.Lock()
        self._map = RunningMap(len(LAYERS))
        self._points = self._left_out = 0
        self._series: deque[tuple[float, float, float, float]] = deque(maxlen=_SERIES_ENTRIES)
        self._bin: list[tuple[float, float, float]] = []
        self._bin_start = monotonic()
        self._nodes: dict[str, tuple[float, dict[str, Any]]] = {}
        self._calibration: dict[str, Any] = {}
        self._acceleration: NDArray[np.float64] = np.empty((0, 3))
        self._acceleration_period = 0.0

    def add_points(self, cloud: NDArray[np.void]) -> None:
        """Add points (n,) with the fields of the contract."""
        if not len(cloud):
            return
        x, y = (np.asarray(cloud[name], np.float64) for name in "xy")
        height = np.asarray(cloud["height"], np.float64)
        # A point beyond any machine would enlarge the map until the part is one cell.
        x, y, height = (LENGTH.nan_if_implausible(column) for column in (x, y, height))
        if self._nominal is not None:
            height = height - self._nominal.height(x, y)
        error, spread = (
            LENGTH.nan_if_implausible(np.asarray(cloud[name], np.float64))
            for name in ("dynamic_error", "uncertainty")
        )
        known = np.isfinite(error) & np.isfinite(spread)
        with self._lock:
            taken = self._map.add(x, y, np.column_stack([height, error, spread]))
            self._points += len(cloud)
            self._left_out += len(cloud) - taken
            if known.any():
                error, spread = error[known], spread[known]
                self._bin.append((float(error.min()), float(error.max()), float(np.median(spread))))
                self._close_bin()

    def _close_bin(self) -> None:
        now = self._monotonic()
        if now - self._bin_start < _SERIES_STEP_S:
            return
        least, greatest, spreads = np.transpose(self._bin)
        middle = float(np.median(spreads))
        self._series.append((now, float(least.min()), float(greatest.max()), middle))
        self._bin, self._bin_start = [], now

    def add_state(self, name: str, level: str, message: str, values: Mapping[str, str]) -> None:
        """Enter a node's state: "OK", "WARN", "STALE" or "ERROR"; DataError for too many nodes."""
        name = name[:_MOST_NAME]
        kept = {key[:_MOST_NAME]: value[:_MOST_VALUE] for key, value in values.items()}
        message = message[:_MOST_MESSAGE]
        state = {"name": name, "level": level, "message": message, "values": kept}
        with self._lock:
            if name not in self._nodes and len(self._nodes) >= _MOST_NODES:
                raise DataError(
                    f"states of more than {_MOST_NODES} nodes, all of this cell: {name!r} is not "
                    "shown; end the other publisher of /diagnostics, and start the viewer again"
                )
            self._nodes[name] = (self._monotonic(), state)

    def set_calibration(self, calibration: Calibration) -> None:
        """Enter the calibration in force; a new one begins a new map."""
        with self._lock:
            if self._calibration and self._calibration["id"] != calibration.id:
                self._restart()
            self._calibration = {
                "id": calibration.id,
                "verdict": verdict_text(calibration),
                "reasons": [str(reason) for reason in calibration.certificate.reasons[:10]],
                "delay": calibration.dynamics.low_frequency_delay,
            }

    def add_acceleration(self, block: AccelerationBlock) -> None:
        """Add a block of the accelerometer to the spectrum."""
        rows = np.column_stack([block.x, block.y, block.z])
        with self._lock:
            if block.sample_period != self._acceleration_period:
                self._acceleration = np.empty((0, 3))
                self._acceleration_period = block.sample_period
            kept = np.concatenate([self._acceleration, rows])
            self._acceleration = kept[-_SPECTRUM_SAMPLES:]

    def _restart(self) -> None:
        self._map.restart()
        self._series.clear()
        self._points = self._left_out = 0

    def news(self, generation: int, version: int) -> tuple[bytes, int, int] | None:
        """Return the changes of the map since a browser's generation and version; None without any.

        They are a binary message: header, places (m) as uint32, then each layer (m) as float32 in
        nm; and the generation and version of the browser after it.
        """
        with self._lock:
            grid = self._map.grid
            if grid is None:
                return None
            since = version if generation == grid.generation else 0
            newest = self._map.version
            if generation == grid.generation and newest == version:
                return None
            place, means = self._map.since(since)
        content = _HEADER.pack(grid.cells, grid.generation, len(place), newest)
        layers = (means / np.float32(NANOMETRE_M)).T
        packed = content + place.astype("<u4").tobytes() + layers.astype("<f4").tobytes()
        return packed, grid.generation, newest

    def state(self) -> dict[str, Any]:
        """Return all but the map, as JSON values."""
        with self._lock:
            now = self._monotonic()
            nodes = [
                {**state, "silent": now - when > _STALE_S} for when, state in self._nodes.values()
            ]
            ended = next((n for n in nodes if _ENDED in n["values"]), None)
            light = _traffic_light_entry(nodes, self._calibration)
            grid = self._map.grid
            return {
                "points": self._points,
                "left_out": self._left_out,
                "compared": self._nominal is not None,
                "grid": None if grid is None else asdict(grid),
                "light": _result_entry(ended) if ended else light,
                "ended": ended is not None,
                "nodes": nodes,
                "calibration": self._calibration,
                "series": [(when - now, *rest) for when, *rest in self._series],
                "spectrum": self._spectrum(),
            }

    def _spectrum(self) -> dict[str, Any] | None:
        rows, period = self._acceleration, self._acceleration_period
        if not len(rows) or not np.all(np.isfinite(rows)):
            return None
        try:
            found = [density(column - column.mean(), period) for column in rows.T]
        except DataError:  # too few samples
            return None
        total = np.sqrt(np.sum([one.density for one in found], axis=0))
        # The greatest of neighbouring values, so that no line is lost.
        cuts = np.unique(np.linspace(0, len(total), _SPECTRUM_LINES, endpoint=False).astype(int))
        peaks = np.maximum.reduceat(total, cuts)
        return {"frequency": found[0].frequency[cuts].tolist(), "amplitude": peaks.tolist()}


_ENDED = "measurement_ended"
"""Value in the state of a node with which a measurement has ended; other nodes may then be gone."""
_COLOURS = {"verified": "green", "not_verified": "amber"}


def _result_entry(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the light after a measurement: its result, or that it is being evaluated."""
    values = state["values"]
    if "verdict" not in values:
        return {"colour": "amber", "word": "Evaluating", "reasons": [state["message"]]}
    reasons = [values.get("verdict_text", ""), *values.get("verdict_next", "").split("; ")]
    colour = _COLOURS.get(values["verdict"], "red")
    return {"colour": colour, "word": state["message"], "reasons": [*filter(None, reasons)]}


def _traffic_light_entry(
    nodes: list[dict[str, Any]], calibration: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the worst of: states of nodes, calibration, and what the corrector measures.

    Green only if each node is OK, the calibration was accepted without reservation, and the verdict
    on the measurement, which a corrector reports, is green.
    """
    reasons = [f"{n['name']}: {n['message']}" for n in nodes if n["level"] != "OK"]
    reasons += [f"{n['name']}: no message for {_STALE_S:.0f} s" for n in nodes if n["silent"]]
    worst = max((n["level"] for n in nodes), key=_SEVERITY.index, default="STALE")
    if not nodes:
        reasons.append("no message of any node yet")
    against = _against(calibration)
    reasons += [against] * bool(against)
    measured = [n["values"] for n in nodes if n["values"].get("verdict", "verified") != "verified"]
    for values in measured:
        reasons.append(f"measurement: {values.get('verdict_text', '')}")
        reasons += [f"measurement: {why}" for why in values.get("verdict_next", "").split("; ")]
    red = worst == "ERROR" or any(n["silent"] for n in nodes)
    red = red or calibration.get("verdict") == REJECTED
    red = red or any(values["verdict"] != "not_verified" for values in measured)
    colour = "red" if red else "amber" if reasons else "green"
    word = {"green": "In order", "amber": "With reservations", "red": "Not valid"}[colour]
    if worst == "STALE" and not red:
        word = "Waiting for samples"
    return {"colour": colour, "word": word, "reasons": reasons[:20]}


def _against(calibration: Mapping[str, Any]) -> str:
    """Return the objection to the calibration in force; empty without one."""
    if not calibration:
        return "no calibration yet"
    verdict = str(calibration["verdict"])
    if verdict == REJECTED:
        return "the calibration was rejected"
    if not verdict.startswith(ACCEPTED) or verdict.startswith(RESERVED):
        return f"the calibration is {verdict or 'not judged'}"
    return ""
