"""Ablation of the constants of identification: ``python -m benchmarks.constants [name …]``.

Each constant is halved and doubled alone, and ten step tests of the twin are identified again: five
of clean machines, five of disturbed ones. The table is in docs/design/identification-ablation.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from benchmarks.disturbance_catalogue import CATALOGUE
from benchmarks.identification import record_once
from benchmarks.step_test import StepTest
from omsm_ros.core.calibration.intended_use import PAPER_USE
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import OmsmError
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant
from omsm_ros.units import NANOMETRE_M

# Not the seeds of any other study.
_SEED = 12_000
_DISTURBED = ("creep, 0.2 s", "base mode, 8 Hz", "backlash", "friction", "vibration, 13.7 Hz")
_MEDIUM = 1
_ESTIMATION = "omsm_ros.core.estimation"
_ROOT = "omsm_ros.core.model_errors"
_IDENTIFICATION = "omsm_ros.core.identification"
_PLACES = {
    "CLEARLY": f"{_ESTIMATION}.noise",
    "_INTERVAL": f"{_ESTIMATION}.noise",
    "_DAMPED_BEYOND": f"{_ESTIMATION}.model_order",
    "_LINEAR_ITERATIONS": f"{_ESTIMATION}.model_order",
    "_ADDED_POLE": f"{_ESTIMATION}.model_order",
    "_BRIDGE_S": f"{_ESTIMATION}.parallel_sections",
    "_SMOOTHING_BINS": f"{_ESTIMATION}.output_error",
    "FASTEST_CREEP_S": f"{_ROOT}.families",
    "_CREEPS_A_DECADE": f"{_ROOT}.families",
    "_DAMPINGS": f"{_ROOT}.families",
    "FASTEST_MODE_HZ": f"{_ROOT}.families",
    "_SLIDING_TRAVELS_M": f"{_ROOT}.families",
    "_FINER": f"{_ROOT}.families",
    "_GAPS_M": f"{_ROOT}.families",
    "_MOST_CYCLES": f"{_ROOT}.families",
    "_DRIFT_DEGREES": f"{_ROOT}.families",
    "_LINES_TRIED": f"{_ROOT}.families",
    "_NOISE_HALF_GAP": f"{_ROOT}.families",
    "_COLLINEAR_SHARE": f"{_ROOT}.residual_diagnostics",
    "_LEAST_LINES": f"{_ROOT}.residual_diagnostics",
    "_HALF_WIDTH": f"{_ROOT}.residual_diagnostics",
    "FALSE_ALARM": f"{_ROOT}.residual_diagnostics",
    "LAGS": f"{_ROOT}.residual_diagnostics",
    "_LEAST_LIKELY": f"{_ROOT}.undetected",
    "_LITTLE": f"{_ROOT}.undetected",
    "_MOST_ROUNDS": f"{_IDENTIFICATION}.model_error_search",
    "_PLAIN_POLES": f"{_IDENTIFICATION}.model_error_search",
}


class Case(NamedTuple):
    """A recording, and its true response."""

    name: str
    motion: MotionRecord
    truth: Any


class Outcome(NamedTuple):
    """First words of the verdict, and error of the response on the paper's scan [m]."""

    verdict: str
    error: float


def cases() -> list[Case]:
    """Return five clean machines and five disturbed ones."""
    omega = 2 * np.pi * 60
    clean = {
        "Eq. 12": Plant().dynamics,
        "delay": TransferFunction(np.ones(1), np.ones(1), 0.7e-3),
        "lag": TransferFunction.from_ascending([1.0], [1.0, 3e-3]),
        "60 Hz mode": TransferFunction.from_ascending([1.0], [1.0, 0.04 / omega, omega**-2]),
        "lag and delay": TransferFunction(np.ones(1), np.array([1.0, 1e-3]), 0.2e-3),
    }
    found = [Case(name, record_once(_SEED, plant=Plant(g)), g) for name, g in clean.items()]
    for name in _DISTURBED:
        cell = Cell(disturbances=CATALOGUE[name][_MEDIUM], seed=_SEED)
        made = record(cell, StepTest(), Flat(), stand_off=-49e-6)
        assert made.truth is not None
        found.append(Case(name, made.motion_record(), made.truth.response))
    return found


def outcomes(every: list[Case]) -> list[Outcome]:
    """Identify each case."""
    return [_outcome(case) for case in every]


def _outcome(case: Case) -> Outcome:
    try:
        found = identify(case.motion).calibration
    except OmsmError:
        return Outcome("refused", float("nan"))
    frequency, rms = PAPER_USE.frequencies_hz, PAPER_USE.rms_m
    verdict = str(found.certificate.verdict).partition(",")[0]
    off = found.dynamics.response(frequency) - case.truth.response(frequency)
    return Outcome(verdict, float(np.sqrt(np.sum((np.abs(off) * rms) ** 2))))


def changed(value: Any, factor: float) -> Any:
    """Return a constant times ``factor``; of a row of values, each; whole numbers stay whole."""
    if isinstance(value, tuple):
        parts = sorted({changed(part, factor) for part in value})
        # Degrees of a polynomial: offset and slope are in every fit already.
        return tuple(part for part in parts if part != 1)
    return max(round(value * factor), 1) if isinstance(value, int) else value * factor


@contextmanager
def set_to(name: str, value: Any) -> Iterator[None]:
    """Set a constant to ``value`` in its module and in every module that imported it."""
    before = getattr(sys.modules[_PLACES[name]], name)
    modules = [
        module
        for path, module in sorted(sys.modules.items())
        if path.startswith("omsm_ros.core")
        and getattr(module, name, None) is before
        # A private name of another module is another constant.
        and (not name.startswith("_") or path == _PLACES[name])
    ]
    for module in modules:
        setattr(module, name, value)
    try:
        yield
    finally:
        for module in modules:
            setattr(module, name, before)


def row(name: str, found: list[Outcome], usual: list[Outcome]) -> str:
    """Return a line of the table: largest change of an error, verdicts that changed."""
    changes = [abs(a.error - b.error) / NANOMETRE_M for a, b in zip(found, usual, strict=True)]
    verdicts = sum(a.verdict != b.verdict for a, b in zip(found, usual, strict=True))
    clean, disturbed = (float(np.nanmax(part)) for part in (changes[:5], changes[5:]))
    return f"| {name} | {clean:.2f} nm | {disturbed:.2f} nm | {verdicts} of {len(found)} |"


def main(show: Callable[[str], None] = print) -> None:
    """Print the table, for the constants named on the command line or for all."""
    wanted = sys.argv[1:] or list(_PLACES)
    every = cases()
    usual = outcomes(every)
    for case, outcome in zip(every, usual, strict=True):
        show(f"{case.name}: {outcome.verdict}, {outcome.error / NANOMETRE_M:.2f} nm")
    show("| changed | clean, by | disturbed, by | verdicts changed |\n|---|---|---|---|")
    for name in wanted:
        value = getattr(sys.modules[_PLACES[name]], name)
        for word, factor in (("halved", 0.5), ("doubled", 2.0)):
            with set_to(name, changed(value, factor)):
                show(row(f"`{name}` {word}", outcomes(every), usual))


if __name__ == "__main__":
    main()
