"""Compare errors of identified responses with their stated uncertainties."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.row import Row, at_least, between, not_compared, shown
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import REJECTED
from omsm_ros.core.lti.frequency_response import COVERAGE_FACTOR, response_band
from omsm_ros.core.lti.modes import FITTED, TwoMass, fit_two_mass, known_modes
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import BoolArray, FloatArray


def mode_errors(
    found: Sequence[Calibration], truth: TransferFunction, index: int
) -> list[tuple[FloatArray, FloatArray]]:
    """Return relative errors of the nearest mode's frequency and damping, and those stated.

    Each is (runs,).
    """
    mode, errors = known_modes(truth)[index], []
    known = [
        min(
            known_modes(c.dynamics, c.covariance),
            key=lambda m: abs(np.log(m.frequency / mode.frequency)),
        )
        for c in found
    ]
    for name in ("frequency", "damping"):
        exact = getattr(mode, name)
        values = np.array([getattr(m, name) for m in known])
        stated = np.array([getattr(m, f"{name}_uncertainty") for m in known])
        errors.append((values / exact - 1, stated / exact))
    return errors


class MassErrors(NamedTuple):
    """Errors of m2, k1, k2, c1, c2 per m1, (runs where they were recognised, 5).

    over_stated: over the stated uncertainty, which includes undetected model errors
    over_noise: of a fit that accounts for noise only, over its own uncertainty
    """

    over_stated: FloatArray
    over_noise: FloatArray


def mass_errors(found: Sequence[Calibration], truth: TwoMass, *, collocated: bool) -> MassErrors:
    """Compare the two-mass models of ``found`` with the true one."""
    exact = np.log([getattr(truth, name) / truth.m1 for name in FITTED])
    stated, noise = [], []
    for calibration in found:
        certificate = calibration.certificate
        entry = certificate.response.two_mass
        if entry is None or entry.collocated is not collocated:
            continue
        model, relative = entry.model, entry.relative_uncertainty
        off = np.log([model[name] / model["m1"] for name in FITTED]) - exact
        stated.append(off / [relative[name] for name in FITTED])
        size = len(calibration.covariance)
        fitted = fit_two_mass(
            calibration.dynamics,
            np.reshape(certificate.noise_covariance, (size, size)),
            table_mass=1.0,
            collocated=collocated,
            frequencies=np.linspace(0.025, 1.0, 40) * calibration.valid_up_to,
        )
        off = np.log([getattr(fitted.model, name) for name in FITTED]) - exact
        noise.append(off / fitted.uncertainty)
    shape = (len(stated), len(FITTED))
    return MassErrors(np.reshape(stated, shape), np.reshape(noise, shape))


def worst(errors: tuple[FloatArray, FloatArray]) -> float:
    """Return the largest error."""
    return float(np.max(np.abs(errors[0])))


def over_stated(errors: tuple[FloatArray, FloatArray]) -> float:
    """Return the largest error over its standard uncertainty."""
    return float(np.max(np.abs(errors[0]) / errors[1]))


def rejected(found: Sequence[Calibration]) -> BoolArray:
    """Return which calibrations their certificates reject, (runs,)."""
    return np.array([c.certificate.verdict == REJECTED for c in found])


def coverage(name: str, held: BoolArray, accepted: BoolArray) -> Row:
    """Return the share of accepted runs whose 95 % interval ``held`` (runs,) the true value.

    Rejected runs are counted separately. The limits are 95 % ± two standard deviations of the
    share over this number of runs.
    """
    runs = int(np.sum(accepted))
    if not runs:
        return not_compared(name, "%", "", "every run was rejected")
    off = 2 * _scatter(runs)
    value = 100 * float(np.mean(held[accepted]))
    return between(name, value, "%", round(95 - off, 1), min(round(95 + off, 1), 100), runs=runs)


def inside(name: str, found: Sequence[Calibration], off: FloatArray, stated: FloatArray) -> Row:
    """Return the share of accepted runs whose 95 % interval contains the true value."""
    held = np.abs(off) < COVERAGE_FACTOR * stated
    return coverage(f"inside 95 %: {name}", held, ~rejected(found))


def band_held(name: str, found: Sequence[Calibration], truth: TransferFunction) -> list[Row]:
    """Return the least share over frequency of accepted runs whose 95 % band holds the truth.

    Also return the share of rejected runs, and for information how often their bands hold.
    """
    held, refused = _held(found, truth), rejected(found)
    runs = int(np.sum(~refused))
    rows = [shown(f"rejected, {name}", 100 * float(np.mean(refused)), "%", runs=len(found))]
    if runs:
        # The least of ten shares is expected to be lower than each of them.
        bar = round(95 - 3.5 * _scatter(runs), 1)
        value = 100 * float(np.min(np.mean(held[~refused], axis=0)))
        rows.append(at_least(f"band held where accepted, {name}", value, "%", bar, runs=runs))
    if np.any(refused):
        value = 100 * float(np.min(np.mean(held[refused], axis=0)))
        count = len(found) - runs
        rows.append(shown(f"band held where rejected, {name}", value, "%", runs=count))
    return rows


def _scatter(runs: int) -> float:
    """Return the standard deviation [%] of a share of ``runs`` trials of probability 95 %."""
    return float(100 * np.sqrt(0.95 * 0.05 / runs))


def _held(found: Sequence[Calibration], truth: TransferFunction) -> BoolArray:
    """Return whether the band holds the truth, (runs, 10): gain and phase at five frequencies."""
    held = []
    for calibration in found:
        lines = calibration.valid_up_to * np.array([0.1, 0.3, 0.6, 0.9, 1.0])
        band = response_band(calibration.dynamics, calibration.covariance, lines)
        error = np.log(calibration.dynamics.response(lines) / truth.response(lines))
        held.append(
            [
                *(np.abs(error.real) < COVERAGE_FACTOR * band.gain),
                *(np.abs(error.imag) < COVERAGE_FACTOR * band.phase),
            ]
        )
    return np.array(held)
