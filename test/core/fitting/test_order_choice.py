"""Which structures are tried, and which is chosen."""

import math
from types import SimpleNamespace

import numpy as np

from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.order_choice import (
    Candidate,
    cancels,
    choose,
    explore,
    information,
    structures,
)


def fitted(structure, sum_of_squares, samples=1000):
    return SimpleNamespace(
        structure=structure,
        size=structure.size,
        sum_of_squares=sum_of_squares,
        samples=samples,
        dynamics=TransferFunction([1.0], [1.0, 1e-3]),
    )


def candidate(structure, sum_of_squares):
    fit = fitted(structure, sum_of_squares)
    return Candidate(fit, information(fit))


def test_there_are_always_fewer_zeros_than_poles():
    for poles in range(1, 7):
        assert all(s.zeros < s.poles == poles for s in structures(poles))


def test_information_charges_each_parameter_log_n():
    small, large = Structure(1, 0, False), Structure(2, 0, False)
    difference = information(fitted(large, 1.0)) - information(fitted(small, 1.0))
    assert math.isclose(difference, math.log(1000))


def test_the_chosen_one_contains_the_smallest_and_is_one_larger():
    candidates = [
        candidate(Structure(1, 0, False), 2.0),
        candidate(Structure(2, 0, False), 1.0),
        candidate(Structure(1, 0, True), 1.5),
        candidate(Structure(2, 1, False), 0.999),
        candidate(Structure(3, 2, True), 0.998),
    ]
    chosen, scored = choose(candidates, lambda fit: 1.0)
    assert chosen.fit.structure == Structure(2, 1, False)
    assert sum(np.isfinite(c.held_out) for c in scored) == 2


def test_held_out_edges_veto_what_does_worse_on_them():
    candidates = [candidate(Structure(2, 0, False), 1.0), candidate(Structure(2, 1, False), 0.999)]
    chosen, _ = choose(candidates, lambda fit: 1.0 + 0.2 * fit.structure.zeros)
    assert chosen.fit.structure == Structure(2, 0, False)


def test_a_zero_on_a_pole_is_no_richer():
    small = candidate(Structure(1, 0, False), 1.0)
    dipole = candidate(Structure(2, 1, False), 0.9999)
    dipole.fit.dynamics = TransferFunction([1.0, 1.0001e-2], [1.0, 1.1e-2, 1e-5])
    assert cancels(dipole.fit.dynamics)
    chosen, _ = choose([small, dipole], lambda fit: 1.0)
    assert chosen.fit is small.fit


def test_poles_and_zeros_apart_do_not_cancel():
    assert not cancels(TransferFunction([1.0, 5e-3], [1.0, 1.1e-2, 1e-5]))
    assert not cancels(TransferFunction([1.0], [1.0, 1.1e-2, 1e-5]))


def costs(needed):
    """A sum of squares that stops falling at ``needed`` poles."""

    def fit_structure(structure, smaller):
        return fitted(structure, 10.0 ** -min(structure.poles, needed))

    return fit_structure


def test_the_search_stops_two_poles_after_the_last_gain():
    tried = explore(costs(3), 0, 0)
    assert max(c.fit.structure.poles for c in tried) == 5


def test_the_search_goes_as_far_as_the_singular_values_ask():
    tried = explore(costs(1), 5, 0)
    assert max(c.fit.structure.poles for c in tried) >= 5


def test_a_forced_order_is_the_only_one():
    tried = explore(costs(3), 0, 2)
    assert {c.fit.structure.poles for c in tried} == {2}


def test_hopeless_structures_are_not_fitted():
    tried = explore(costs(0), 4, 0)
    assert sum(c.fit.structure.poles == 4 for c in tried) == 1
