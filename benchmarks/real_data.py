"""Identification of measured data against the peers: ``python -m benchmarks.real_data``.

Each method identifies the first half of a DaISy record (De Moor et al., KU Leuven). It then
simulates the second half from its state at the end of the first. The score is the variance
accounted for in the second half.
Peers are optional: ``pip install nfoursid sippy_unipi ctrlsys pandas``; Octave with its control
package (``apt install octave octave-control``), whose seconds include those it takes to start.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import io as scipy_io
from scipy import linalg, signal

from benchmarks.row import Row, at_least, at_most, shown
from omsm_ros import cli
from omsm_ros.core.estimation.parallel_sections import ParallelSections
from omsm_ros.core.estimation.sampled_fit import SampledRecord
from omsm_ros.core.estimation.sampled_model import free_run
from omsm_ros.core.identification.sampled_identification import identify_samples
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.pipelines.identify import load_model

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "daisy"
MIRROR = DATA.parent / "fsm_cubespec"
PERIODS_S = {"robotArm": 1.0, "hairdryer": 0.08, "ballbeam": 0.1}
ORDERS = (2, 3, 4, 5, 6)
_BLOCK_ROWS = 20
_DIVERGED = -1e3

StateSpace = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
Method = Callable[[FloatArray, FloatArray, int], StateSpace]


@dataclass(frozen=True)
class Record:
    """name; input and output (n,) without their mean over the first half; period [s]."""

    name: str
    command: FloatArray
    seen: FloatArray
    period: float

    @property
    def half(self) -> int:
        return len(self.seen) // 2


def load(name: str) -> Record:
    """A DaISy record; raises FileNotFoundError where the data are absent."""
    content = scipy_io.loadmat(DATA / f"{name}.mat")
    (values,) = (v for k, v in content.items() if not k.startswith("_"))
    half = len(values) // 2
    command, seen = (np.asarray(values[:, i], float) - values[:half, i].mean() for i in (0, 1))
    return Record(name, command, seen, PERIODS_S[name])


def accounted_for(seen: FloatArray, predicted: FloatArray) -> float:
    """Variance of ``seen`` accounted for [%]; may be far below zero, -inf after an overflow."""
    value = float(100 * (1 - np.var(seen - predicted) / np.var(seen)))
    return value if np.isfinite(value) else -np.inf


def ours(command: FloatArray, seen: FloatArray, order: int, period: float) -> StateSpace:
    """Run ``omsm identify RECORD.csv --hold zero-order`` on a table, 0 = free order."""
    with tempfile.TemporaryDirectory() as folder:
        table, out = Path(folder, "record.csv"), Path(folder, "model.json")
        both = np.column_stack([command, seen])
        np.savetxt(table, both, fmt="%.17g", delimiter=",", header="u,y", comments="")
        arguments = ["--input", "u", "--output", "y", "--period", period, "--order", order]
        arguments += ["--hold", "zero-order", "--out", out, "--json"]
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            cli.main(["identify", str(table), *(str(a) for a in arguments)])
        # A rejected model has another file name.
        (path,) = Path(folder).glob("model*.json")
        a, b, c, d = _state_space(load_model(path).sections)
    # One more constant state for the operating point.
    return linalg.block_diag(a, 1.0), np.vstack([b, [[0.0]]]), np.hstack([c, [[1.0]]]), d


def _state_space(sections: ParallelSections) -> StateSpace:
    """Return sections of one held input, and their delay, as one state space."""
    parts = []
    for (d1, d2), (b0, b1) in zip(sections.denominators, sections.numerators[0], strict=True):
        down = np.trim_zeros([d2, d1, 1.0], "f")
        system = signal.tf2ss([b1, b0][-len(down) :], down)
        parts.append(signal.cont2discrete(system, sections.period, "bilinear")[:4])
    late = round(float(sections.delays[0]) / sections.period)
    a = linalg.block_diag(*(p[0] for p in parts), np.eye(late, k=-1))
    b = np.concatenate([np.zeros((0, 1)), *(p[1] for p in parts)])
    c = np.concatenate([np.zeros((1, 0)), *(p[2] for p in parts)], axis=1)
    d = np.reshape(sections.direct + sum(p[3].item() for p in parts), (1, 1))
    if not late:
        return a, b, c, d
    # The last of the delayed inputs drives the sections.
    a[: len(b), -1:], pulse = b, np.zeros((len(a), 1))
    pulse[len(b)] = 1.0
    return a, pulse, np.hstack([c, np.zeros((1, late - 1)), d]), np.zeros((1, 1))


def score(method: Method, record: Record, order: int) -> float:
    """Simulate a peer's state-space model, its initial state fitted to the first half."""
    half = record.half
    a, b, c, d = method(record.command[:half], record.seen[:half], order)
    driven = _simulate(a, b, c, d, record.command)
    free = np.empty((len(record.seen), len(a)))
    row = np.asarray(c, float).reshape(1, -1)
    for k in range(len(free)):
        free[k] = row
        row = row @ a
    state = np.linalg.lstsq(free[:half], (record.seen - driven)[:half], rcond=None)[0]
    with np.errstate(all="ignore"):
        return accounted_for(record.seen[half:], (driven + free @ state)[half:])


def _simulate(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, command: FloatArray
) -> FloatArray:
    state, output = np.zeros(len(a)), np.empty(len(command))
    b, c, direct = np.ravel(b), np.ravel(c), float(np.ravel(d)[0])
    with np.errstate(all="ignore"):
        for k, u in enumerate(command):
            output[k] = c @ state + direct * u
            state = a @ state + b * u
    return output


def _nfoursid() -> Method:
    pandas = importlib.import_module("pandas")
    module = importlib.import_module("nfoursid.nfoursid")

    def method(u: FloatArray, y: FloatArray, order: int) -> StateSpace:
        frame = pandas.DataFrame({"u": u, "y": y})
        found = module.NFourSID(
            frame, output_columns=["y"], input_columns=["u"], num_block_rows=_BLOCK_ROWS
        )
        found.subspace_identification()
        model, _ = found.system_identification(rank=order)
        return model.a, model.b, model.c, model.d

    return method


def _sippy(name: str) -> Callable[[], Method]:
    def make() -> Method:
        module = importlib.import_module("sippy_unipi")

        def method(u: FloatArray, y: FloatArray, order: int) -> StateSpace:
            with contextlib.redirect_stdout(io.StringIO()):
                found = module.system_identification(
                    y[np.newaxis],
                    u[np.newaxis],
                    name,
                    SS_f=_BLOCK_ROWS,
                    SS_p=_BLOCK_ROWS,
                    SS_fixed_order=order,
                    SS_D_required=True,
                )
            return found.A, found.B, found.C, found.D

        return method

    return make


def _slicot(name: str, by_simulation: bool) -> Callable[[], Method]:
    """ib01ad and ib01bd; ``by_simulation`` takes B and D of least output error from ib01cd."""

    def make() -> Method:
        module = importlib.import_module("ctrlsys")

        def method(u: FloatArray, y: FloatArray, order: int) -> StateSpace:
            # Copies, for the routines overwrite what they are given.
            uf, yf = (np.array(v[:, np.newaxis], order="F", copy=True) for v in (u, y))
            rows = _BLOCK_ROWS
            data = (name, "O", "N", "N", rows, 1, 1, uf.copy(), yf.copy(), 0.0, -1.0)
            _, r, _, _, info = module.ib01ad(name, "Q", *data)
            found = module.ib01bd(name, "A", "N", rows, order, 1, 1, len(u), r, 0.0)
            if info or found[-1]:
                raise RuntimeError(f"info {info!r}, {found[-1]!r}")
            a, c, b, d = (np.asfortranarray(m) for m in found[:4])
            if by_simulation:
                kept = a.copy(order="F")
                again = module.ib01cd("X", "C", "D", order, 1, 1, a, b, c, d, uf, yf, 0.0)
                a, b, d = kept, again[1], again[2]
            return a, b, c, d

        return method

    return make


_OCTAVE_SCRIPT = """
pkg load control
load('data.mat');
model = {name}(iddata(y, u, 1), {order}, 's', {rows});
[a, b, c, d] = ssdata(model);
save('-6', 'model.mat', 'a', 'b', 'c', 'd');
"""


def _octave(name: str) -> Callable[[], Method]:
    def make() -> Method:
        program = shutil.which("octave-cli")
        if program is None or _run([program, "--norc", "--eval", "pkg load control"]).returncode:
            raise ImportError("octave-cli with its control package is not on the PATH")

        def method(u: FloatArray, y: FloatArray, order: int) -> StateSpace:
            script = _OCTAVE_SCRIPT.format(name=name, order=order, rows=_BLOCK_ROWS)
            with tempfile.TemporaryDirectory() as folder:
                data = {"u": u[:, np.newaxis], "y": y[:, np.newaxis]}
                scipy_io.savemat(Path(folder, "data.mat"), data)
                done = _run([program, "--norc", "--eval", script], folder)
                if done.returncode:
                    raise RuntimeError(done.stderr.strip())
                model = scipy_io.loadmat(Path(folder, "model.mat"))
            return model["a"], model["b"], model["c"], model["d"]

        return method

    return make


def _run(command: list[str], folder: str | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


PEERS: dict[str, Callable[[], Method]] = {
    "nfoursid": _nfoursid,
    "SIPPY N4SID": _sippy("N4SID"),
    "SIPPY MOESP": _sippy("MOESP"),
    "SIPPY CVA": _sippy("CVA"),
    "SLICOT N4SID": _slicot("N", False),
    "SLICOT MOESP": _slicot("M", False),
    "SLICOT N4SID sim": _slicot("N", True),
    "SLICOT MOESP sim": _slicot("M", True),
    "Octave moen4": _octave("moen4"),
    "Octave n4sid": _octave("n4sid"),
}


def _timed(run: Callable[[], float]) -> tuple[float, float]:
    start = time.perf_counter()
    return run(), time.perf_counter() - start


def table() -> list[dict[str, object]]:
    """Rows {record, order, method, score, seconds}; order 0 is chosen automatically.

    A model has as many poles as ``order`` says; 0 leaves the choice to the method. Peers choose
    no order by themselves: at order 0 theirs is the best score at any order, which only
    hindsight could have picked.
    """
    rows: list[dict[str, object]] = []
    methods = dict(_installed())
    for name in PERIODS_S:
        record = load(name)
        for order in (*ORDERS, 0):
            value, seconds = _timed(
                lambda: score(partial(ours, period=record.period), record, order)  # noqa: B023
            )
            rows.append(_row(name, order, "omsm_ros", value, seconds))
            for peer, method in methods.items():
                if order == 0:
                    past = [r for r in rows if r["record"] == name and r["method"] == peer]
                    if past:
                        best = max(past, key=lambda r: float(str(r["score"])))
                        rows.append({**best, "order": 0})
                    continue
                try:
                    value, seconds = _timed(lambda: score(method, record, order))  # noqa: B023
                except Exception as error:
                    print(f"{peer} failed on {name} at order {order}: {error}")
                    continue
                rows.append(_row(name, order, peer, value, seconds))
    return rows


# Linear model of 28 states for each level (Floren et al. 2024), mean over outputs, periods and
# realisations of the test set [%].
MIRROR_BASELINES = {"100mV": 8.38, "200mV": 7.95, "300mV": 5.63}
_MIRROR_PERIOD_S, _MIRROR_POLES, _MIRROR_RECORDS = 1 / 6400, 28, 2
_BANDS_HZ = (0, 50, 100, 200, 300, 400, 500, 700, 1000, 1300, 1600, 3000)


def mirror_error(level: str) -> tuple[float, float]:
    """Return errors of the mirror's test set [%]: of three inputs to each output, 28 poles each.

    The second is that of the best linear approximation of all training records, line by line
    without a model: what is left there is noise and nonlinear distortion.
    """
    names = [f"{v}_{level}_{part}" for part in ("train", "test") for v in "uy"]
    u, y, given, seen = (np.load(MIRROR / f"{name}.npy") for name in names)
    free, free_y, test = (np.fft.rfft(np.mean(v, axis=3), axis=0) for v in (u, y, given))
    # At each line the response is the least squares over the realisations.
    response = free_y @ np.linalg.pinv(free)
    response[np.mean(np.abs(free), axis=(1, 2)) < 1e-3 * np.max(np.abs(free))] = 0.0
    line_by_line = np.fft.irfft(response @ test, len(given), axis=0)
    scores, limits, every = [], [], np.ones(len(u), np.bool_)
    for output in range(seen.shape[1]):
        records = [
            SampledRecord(np.mean(u[:, :, r], axis=2), np.mean(y[:, output, r], axis=1), every)
            for r in range(_MIRROR_RECORDS)
        ]
        model = identify_samples(records, _MIRROR_PERIOD_S, hold="zero-order", order=_MIRROR_POLES)
        for r, p in np.ndindex(seen.shape[2:]):
            target = seen[:, output, r, p]
            scores.append(free_run(model, given[:, :, r, p], target).rms / np.std(target))
            limits.append(np.std(target - line_by_line[:, output, r]) / np.std(target))
    return 100 * float(np.mean(scores)), 100 * float(np.mean(limits))


def mirror_distortion(level: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return lines [Hz] and mean powers over outputs [m²] of distortion and output at each, (k,).

    At each line three responses are fitted to six realisations; the rest, less the noise from
    period to period, is distortion.
    """
    u, y = (np.load(MIRROR / f"{v}_{level}_train.npy") for v in "uy")
    amplitude = np.sqrt(2) / len(u)
    given, seen = (amplitude * np.fft.rfft(v, axis=0) for v in (u, y))
    mean_given, mean_seen = np.mean(given, axis=3), np.mean(seen, axis=3)
    size = np.mean(np.abs(mean_given), axis=(1, 2))
    lines = size > 1e-3 * np.max(size)
    mean_given, mean_seen = mean_given[lines], mean_seen[lines]
    inputs, realisations = mean_given.shape[1:]
    rest = mean_seen - mean_seen @ np.linalg.pinv(mean_given) @ mean_given
    noise = np.mean(np.abs(seen[lines, ..., 0] - seen[lines, ..., 1]) ** 2, axis=2) / 4
    total = np.sum(np.abs(rest) ** 2, axis=2) / (realisations - inputs)
    power = np.mean(np.abs(mean_seen) ** 2, axis=(1, 2))
    frequency = np.fft.rfftfreq(len(u), _MIRROR_PERIOD_S)[lines]
    return frequency, np.mean(np.maximum(total - noise, 0.0), axis=1), power


def _distortion_rows() -> list[Row]:
    """Print the distortion of bands of lines at each level; return how often it rises."""
    found = {level: mirror_distortion(level) for level in MIRROR_BASELINES}
    print("distortion of the mirror, mean of three outputs [nm rms, % of the output there]")
    print(f"{'lines':>16}" + "".join(f"{level:>18}" for level in found))
    for low, high in pairwise(_BANDS_HZ):
        cells = ""
        for frequency, distortion, power in found.values():
            inside = (frequency >= low) & (frequency < high)
            levels = [np.sqrt(np.sum(p[inside])) for p in (distortion, power)]
            cells += f"{1e9 * levels[0]:9.2f} ({100 * levels[0] / levels[1]:5.2f})"
        print(f"{low:6d} to {high:4d} Hz {cells}")
    smooth = [np.convolve(one[1], np.ones(15) / 15, "same") for one in found.values()]
    return [
        shown(f"lines of more distortion, {after} than {before}", 100 * float(np.mean(b > a)), "%",
              "mean of 15 neighbours")
        for (before, a), (after, b) in pairwise(zip(found, smooth, strict=True))
    ]  # fmt: skip


def _mirror_rows() -> list[Row]:
    found = _distortion_rows()
    for level, bar in MIRROR_BASELINES.items():
        error, limit = mirror_error(level)
        text = f"published linear model; {limit:.2f} % line by line without a model"
        found.append(at_most(f"mirror, 3 inputs, {level}", error, "%", bar, text))
    return found


def rows(full: bool) -> list[Row]:
    """Yield scores of the automatically chosen order and of the best peer at its best order.

    full: with the fine steering mirror, which takes ten minutes
    """
    if not DATA.is_dir():
        print(f"real data: skipped, {DATA} is absent")
        return []
    found = table()
    mirror = _mirror_rows() if full and MIRROR.is_dir() else []
    return mirror + [
        _against_peers([r for r in found if (r["record"], r["order"]) == (name, 0)])
        for name in PERIODS_S
    ]


def _against_peers(same: list[dict[str, object]]) -> Row:
    """All scores of one record as one row.

    Where every peer is worse than the mean of the record, the mean is the bar.
    """
    (own,) = (r for r in same if r["method"] == "omsm_ros")
    name, value = f"{own['record']}, automatic order", float(str(own["score"]))
    peers = [r for r in same if r is not own]
    if not peers:
        return shown(name, value, "%", "no peer")
    best = max(peers, key=lambda r: float(str(r["score"])))
    bar, peer = max((float(str(best["score"])), str(best["method"])), (0.0, "the mean"))
    return at_least(name, value, "%", bar, peer)


def _row(record: str, order: int, method: str, value: float, seconds: float) -> dict[str, object]:
    return {"record": record, "order": order, "method": method, "score": value, "seconds": seconds}


def _cell(score: float, seconds: float) -> str:
    """Return a score as text; "diverged" below the limit."""
    shown = f"{score:.2f}" if score > _DIVERGED else "diverges"
    return f"{shown} ({seconds:.2f})"


def _installed() -> list[tuple[str, Method]]:
    found = []
    for name, make in PEERS.items():
        try:
            found.append((name, make()))
        except ImportError as error:
            print(f"{name}: skipped, {error}")
    return found


def main() -> None:
    if not DATA.is_dir():
        print(f"real data: skipped, {DATA} is absent")
        return
    rows = table()
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    print("variance accounted for on the second half [%] (seconds)")
    print("record     order " + " ".join(f"{m:>20}" for m in methods))
    for name in PERIODS_S:
        for order in (*ORDERS, 0):
            cells = {
                str(r["method"]): _cell(float(str(r["score"])), float(str(r["seconds"])))
                for r in rows
                if r["record"] == name and r["order"] == order
            }
            label = "auto" if order == 0 else str(order)
            print(f"{name:10} {label:>5} " + " ".join(f"{cells.get(m, '-'):>20}" for m in methods))


if __name__ == "__main__":
    main()
