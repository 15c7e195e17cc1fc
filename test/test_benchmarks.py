"""Tests of the benchmarks: the bound and the shares."""

import ast
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from certified import certified_by

from benchmarks.against_truth import band_held, coverage
from benchmarks.cramer_rao import response_bounds
from benchmarks.offline import save_paper_calibration
from benchmarks.parts import PARTS, measure
from benchmarks.parts import __file__ as parts_file
from benchmarks.row import at_least, at_most, between, shown
from omsm_ros.core.calibration.certificate import REJECTED
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.io.calibration_file import load_calibration

PERIOD, NOISE, GAIN = 1e-3, 1e-8, 0.99
TRUTH = TransferFunction.from_ascending([1.0, 1e-3], [1.0, 3e-3, 1e-5])


def moved(truth, input_):
    """Return the steady output to a periodic input, without its mean."""
    frequency = np.fft.rfftfreq(len(input_), PERIOD)
    return np.fft.irfft(np.fft.rfft(input_ - np.mean(input_)) * truth.response(frequency))


def to_and_fro(samples=2000):
    smooth = np.convolve(
        np.random.default_rng(1).normal(size=samples + 40), np.hanning(41), "valid"
    )
    return 1e-6 * smooth * np.hanning(samples)


@pytest.mark.parametrize("delay", [0.0, 4e-4])
def test_the_bound_is_the_scatter_of_an_efficient_estimate(delay):
    """Compare with a linear fit about the truth, by finite differences, over 2000 draws."""
    truth, input_ = TransferFunction(TRUTH.numerator, TRUTH.denominator, delay), to_and_fro()
    frequency = np.array([2.0, 20.0])
    values = np.array([1e-3, 3e-3, 1e-5, delay, GAIN])[[0, 1, 2, 4] if not delay else slice(None)]

    def model(v):
        g = TransferFunction([1.0, v[0]], [1.0, v[1], v[2]], v[3] if delay else 0.0)
        return g, v[-1] * moved(g, input_)

    steps = 1e-5 * values
    columns, responses = [], []
    for k, step in enumerate(steps):
        shift = np.zeros(len(values))
        shift[k] = step
        (up, high), (down, low) = model(values + shift), model(values - shift)
        columns.append((high - low) / (2 * step))
        ratio = np.log(up.response(frequency) / down.response(frequency))
        responses.append(ratio / (2 * step))
    n = len(input_)
    every = np.column_stack([*columns, np.ones(n), np.linspace(-1, 1, n)])
    scale = np.linalg.norm(every, axis=0)
    noise = np.random.default_rng(2).normal(0.0, NOISE, (n, 2000))
    off = np.linalg.lstsq(every / scale, noise, rcond=None)[0] / scale[:, np.newaxis]
    errors = np.array(responses).T @ off[: len(values)]
    gain, phase = response_bounds(truth, GAIN, input_, PERIOD, NOISE, frequency)
    # 2000 draws give a standard deviation to 1.6 %.
    np.testing.assert_allclose(np.std(errors.real, axis=1), gain, rtol=0.06)
    np.testing.assert_allclose(np.std(errors.imag, axis=1), phase, rtol=0.06)


def test_every_row_is_json():
    rows = [
        between("x", np.float64(1.0), "nm", np.float64(0.5), np.float64(1.5)),
        at_most("x", np.float64(1.0), "nm", np.float64(0.5), runs=3),
        at_least("x", 1.0, "nm", 0.5),
        shown("x", 1, "nm"),
    ]
    back = json.loads(json.dumps(rows))
    assert [row["holds"] for row in back] == [True, False, True, None]


def test_rejected_runs_do_not_count_as_covered():
    held = np.array([True, True, False, False, False])
    accepted = np.array([True, True, True, True, False])
    row = coverage("x", held, accepted)
    assert row["value"] == 50.0
    assert row["runs"] == 4
    assert row["holds"] is False
    nothing = coverage("x", held, np.zeros(5, bool))
    assert nothing["holds"] is None
    assert np.isnan(nothing["value"])


@pytest.mark.parametrize(("held", "holds"), [(19, True), (18, True), (17, False)])
def test_the_bar_of_a_share_is_what_chance_leaves_of_it(held, holds):
    """With 20 runs at 95 %, 19 are expected; 17 or fewer have a probability of 8 %."""
    assert coverage("x", np.arange(20) < held, np.ones(20, bool))["holds"] is holds


def test_a_band_too_narrow_fails_however_many_runs_are_rejected(true_calibration):
    dynamics = true_calibration.dynamics
    off = TransferFunction(dynamics.numerator, dynamics.denominator, 1e-4)
    size = len(true_calibration.covariance)

    def calibrations(count, verdict, variance):
        covariance = np.zeros((size, size))
        covariance[-1, -1] = variance
        certificate = {"verdict": verdict}
        one = replace(
            true_calibration,
            dynamics=off,
            covariance=covariance,
            certificate=certified_by(certificate),
        )
        return [one] * count

    narrow, broad = (1e-5) ** 2, (1e-3) ** 2
    found = calibrations(4, "accepted", narrow) + calibrations(6, REJECTED, broad)
    rows = {row["name"]: row for row in band_held("it", found, dynamics)}
    assert rows["rejected, it"]["value"] == 60.0
    assert rows["band held where accepted, it"]["value"] == 0.0
    assert rows["band held where accepted, it"]["holds"] is False
    assert rows["band held where rejected, it"]["runs"] == 6


def test_a_part_that_fails_costs_its_own_figures_alone(monkeypatch, capsys):
    def rows(full):
        yield shown("before", 1.0, "1")
        raise RuntimeError("no such peer")

    monkeypatch.setitem(sys.modules, "benchmarks.broken", SimpleNamespace(rows=rows))
    found = measure("broken", False).rows
    assert [row["holds"] for row in found] == [None, False]
    assert found[1]["peer"] == "RuntimeError: no such peer"
    assert "no such peer" in capsys.readouterr().err


@pytest.mark.parametrize("part", PARTS)
def test_every_part_has_rows(part):
    """The files are parsed, as some parts need packages that `make bench` installs."""
    tree = ast.parse(Path(parts_file).with_name(f"{part}.py").read_text(encoding="utf-8"))
    (rows,) = [n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == "rows"]
    assert [argument.arg for argument in rows.args.args] == ["full"]


def test_the_calibration_of_live_and_offline_figures_can_be_used(tmp_path):
    save_paper_calibration(tmp_path / "cal.json", rate=70e3)
    found = load_calibration(tmp_path / "cal.json")
    assert found.sample_period == pytest.approx(1 / 70e3)
    assert found.certificate.accepted
