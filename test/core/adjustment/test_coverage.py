"""Stated uncertainties hold, and clean machines raise no alarm: machines drawn as declared."""

from dataclasses import replace

import numpy as np
import pytest
from coverage import AS_DRAWN, drawn, normalised
from plain_world import MIRROR

from omsm_ros.core.adjustment import VERIFIED, adjust
from omsm_ros.core.adjustment.verdict import DISAGREE

SEEDS, FEW_SEEDS, PITCH_M = 32, 2, 0.8e-3


def of_two_scans(seeds):
    rows, found = [], []
    for seed in seeds:
        machine, scans = drawn(seed, 2, PITCH_M)
        found.append(adjust(scans, AS_DRAWN, nominal=MIRROR, accuracy=25e-9))
        rows.append(normalised(machine, found[-1]))
    return rows, found


@pytest.fixture(scope="module")
def two_scans():
    return of_two_scans(range(SEEDS))


@pytest.mark.soak
def test_few_clean_machines_are_verified_and_covered():
    """No family of two machines is refuted; PV, rms, lag and 48 terms are off as stated."""
    rows, found = of_two_scans(range(FEW_SEEDS))
    assert [f.verdict.code for f in found] == [VERIFIED] * FEW_SEEDS
    assert not any(f.refutations for f in found)
    assert np.max(np.abs([row[:3] for row in rows])) < 4
    off = np.abs([row[3] for row in rows])
    assert np.mean(off <= 2) >= 0.85
    assert np.max(off) < 4.5


def test_a_scan_without_the_rim_agrees_where_both_have_points():
    """PV and rms of scans are compared over what all of them saw."""
    _, (first, second) = drawn(1, 2, PITCH_M)
    inside = np.hypot(second.x, second.y) < 8e-3
    columns = {n: v[inside] for n, v in vars(second).items() if isinstance(v, np.ndarray)}
    found = adjust([first, replace(second, **columns)], AS_DRAWN, nominal=MIRROR, accuracy=25e-9)
    assert not any(reason.code == DISAGREE for reason in found.verdict.reasons)


@pytest.mark.soak
def test_figures_lie_within_their_uncertainty(two_scans):
    """Of 32 PV, rms and lags at least 28 lie within k = 2 (P = 0.996 at 95 %)."""
    rows, _ = two_scans
    for place in range(3):
        off = np.abs([row[place] for row in rows])
        assert np.sum(off <= 2) >= 28
        assert np.max(off) < 4


@pytest.mark.soak
def test_terms_lie_within_their_uncertainty(two_scans):
    """Of 384 Zernike terms 93 to 98 % lie within k = 2."""
    rows, _ = two_scans
    off = np.abs([row[3] for row in rows])
    assert 0.93 <= np.mean(off <= 2) <= 0.985
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, abs=0.15)


@pytest.mark.soak
def test_form_errors_are_as_large_as_stated(two_scans):
    rows, found = two_scans
    off = [row[4] / f.form.mean_uncertainty for row, f in zip(rows, found, strict=True)]
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.15


@pytest.mark.soak
def test_clean_machines_are_verified(two_scans):
    """At least 93 % are verified; the drawn errors of the others are large by chance."""
    _, found = two_scans
    assert sum(bool(f.refutations) for f in found) == 0
    assert sum(f.verdict.code == VERIFIED for f in found) >= 0.93 * SEEDS
    assert np.median([2 * f.form.pv.uncertainty for f in found]) < 12e-9


@pytest.mark.soak
def test_single_clean_scans_refute_nothing():
    rows = []
    for seed in range(100, 120):
        machine, scans = drawn(seed, 1, PITCH_M)
        found = adjust(scans, AS_DRAWN, nominal=MIRROR, accuracy=25e-9)
        assert not found.refutations
        assert not found.wrong_sign
        rows.append(normalised(machine, found))
    off = np.abs([row[3] for row in rows])
    assert 0.92 <= np.mean(off <= 2) <= 0.99
