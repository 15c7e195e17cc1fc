"""Test sampled models of long records: choice on a part, fit to the whole, cost."""

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation import sampled_choice
from omsm_ros.core.estimation.sampled_choice import (
    CHOSEN_ON,
    choose_sampled_long,
    most_exciting_part,
)
from omsm_ros.core.estimation.sampled_fit import ZeroOrderHoldProblem
from omsm_ros.core.identification.sampled_identification import identify_samples
from omsm_ros.errors import IdentificationError

LINES = np.geomspace(1e-3, 0.1, 12)


def telegraph(samples, hold=4, seed=1):
    levels = np.random.default_rng(seed).choice([-1.0, 1.0], samples // hold + 1)
    return np.repeat(levels, hold)[:samples]


def response(b, a, lines=LINES):
    return signal.freqz(b, a, worN=2 * np.pi * lines)[1]


MANY = CHOSEN_ON + 3000


def test_the_response_of_a_long_record_is_the_true_one_within_its_uncertainty():
    b, a = [0.0, 0.142, 0.135], [1.0, -1.584, 0.861]
    u = telegraph(MANY)
    y = signal.lfilter(b, a, u) + np.random.default_rng(2).normal(0, 0.05, len(u))
    model = identify_samples(u, y, 1.0)
    band = model.discrete.band(LINES, 1.0)
    off = np.log(model.discrete.response(LINES, 1.0) / response(b, a))
    assert np.max(np.abs(off.real) / band.gain) < 4
    assert np.max(np.abs(off.imag) / band.phase) < 4
    # White noise determines the static gain to σ/√n; the other parameters widen it.
    assert band.gain[0] < 4 * 0.05 / np.sqrt(MANY)
    assert model.certificate["samples"]["compared"] > MANY - 10


def test_a_plant_slower_than_the_part_is_found_on_the_whole():
    slow = np.exp(-1 / 8000)
    u = telegraph(32_000, hold=1900, seed=4)
    y = signal.lfilter([0.0, 1 - slow], [1.0, -slow], u)
    y += np.random.default_rng(3).normal(0, 0.02, len(u))
    model = identify_samples(u, y, 1.0)
    assert CHOSEN_ON < 8000
    assert model.certificate["verdict"].startswith("accepted")
    lines = np.array([2e-4, 4e-4, 8e-4])
    ratio = model.discrete.response(lines, 1.0) / response([0.0, 1 - slow], [1.0, -slow], lines)
    np.testing.assert_allclose(np.abs(ratio - 1), 0, atol=0.02)


def test_an_order_that_is_asked_for_is_kept():
    u = telegraph(MANY)
    y = signal.lfilter([0.0, 0.3], [1.0, -0.7], u) + np.random.default_rng(5).normal(0, 0.1, MANY)
    choice = choose_sampled_long(u, y, np.ones(MANY, bool), 1.0, order=3)
    assert choice.chosen.order == 3
    assert choice.free.order == 1
    assert len(choice.chosen.fit.residual) == MANY


def test_the_part_is_one_in_which_the_input_moves():
    u = np.zeros(5 * CHOSEN_ON)
    u[-CHOSEN_ON:] = telegraph(CHOSEN_ON)
    used = np.ones(len(u), bool)
    part = most_exciting_part(u, used)
    assert part.start <= 4 * CHOSEN_ON
    assert part.stop > 4 * CHOSEN_ON
    used[::3] = False
    part = most_exciting_part(u, used)
    assert np.sum(used[part]) == CHOSEN_ON
    assert np.ptp(u[part]) > 0


def test_a_change_of_the_plant_beyond_the_part_is_seen():
    """The first third follows the input, the rest does not: no free run predicts that."""
    u = telegraph(9000)
    y = signal.lfilter([0.0, 0.3], [1.0, -0.7], u)
    y[3000:] = np.cumsum(np.random.default_rng(6).normal(0, 1, 6000))
    assert identify_samples(u, y, 1.0).certificate["verdict"] == "rejected"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda u, y: (0 * u, y), "never changes"),
        (lambda u, y: (np.where(u > 0, u, np.inf), y), "not finite"),
        (lambda u, y: (np.cos(0.1 * np.arange(len(u))), y), "excites"),
    ],
)
def test_long_records_are_refused_as_short_ones_are(change, says):
    u = telegraph(MANY)
    u, y = change(u, u.copy())
    with pytest.raises(IdentificationError, match=says):
        choose_sampled_long(u, y, np.ones(MANY, bool), 1.0, order=4)


def test_five_times_as_long_costs_no_more_than_so_many_times_as_much(monkeypatch):
    """In numbers computed; all orders on all parts would be five times as much and more."""
    spent = [0]
    plain = ZeroOrderHoldProblem.project

    def counted(self, scaled, nonlinear):
        spent[0] += int(np.sum(self.used)) * (2 * scaled.structure.poles + 3)
        return plain(self, scaled, nonlinear)

    monkeypatch.setattr(ZeroOrderHoldProblem, "project", counted)
    costs = []
    monkeypatch.setattr(sampled_choice, "CHOSEN_ON", 1000)  # else it takes ten seconds
    for samples in (1000, 5000):
        u, spent[0] = telegraph(samples), 0
        y = np.tanh(2 * signal.lfilter([0.0, 0.142, 0.135], [1.0, -1.584, 0.861], u))
        choose_sampled_long(u, y, np.ones(samples, bool), 1.0)
        costs.append(spent[0])
    assert costs[1] < 3 * costs[0]
