"""Forms that follow one column of the machine, and what is named; no scan is needed."""

from dataclasses import replace

import numpy as np

from omsm_ros.core.adjustment.evidence import Evidence
from omsm_ros.core.adjustment.part_terms import FormTerms
from omsm_ros.core.adjustment.refutation import Refutation, explained
from omsm_ros.core.adjustment.sources import Family
from omsm_ros.core.adjustment.verdict import looks_like, reasons_of

DEGREES = np.repeat(np.arange(2, 9), np.arange(3, 10))
SYMMETRIC = np.zeros(len(DEGREES), np.bool_)
UNKNOWN = np.zeros((1, 1))


def drawn(seed, added=0.0):
    """Terms that fall with the degree, of 30 nm in all, and ``added`` of a known column."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=len(DEGREES)) / DEGREES**1.5
    values *= 30e-9 / np.linalg.norm(values)
    column = np.zeros((len(DEGREES), 1))
    column[[0, 1, 7, 9], 0] = 0.8, 0.4, 0.4, 0.2
    known = np.eye(len(DEGREES)) * (0.5e-9) ** 2
    return FormTerms(values + added * column[:, 0], known, DEGREES, SYMMETRIC), column


def test_a_form_of_chance_looks_like_no_column():
    gains = [form.looks_like(1e-7 * column, UNKNOWN)[0] for form, column in map(drawn, range(12))]
    assert np.median(gains) < 0
    assert max(gains) < 10


def test_a_form_that_follows_a_column_is_found_with_its_size():
    for seed in range(4):
        form, column = drawn(seed, 600e-9)
        gain, (value,) = form.looks_like(1e-7 * column, UNKNOWN)
        assert gain > 10
        # The part itself has some 15 nm of the column.
        assert abs(1e-7 * value - 600e-9) < 60e-9


def test_a_size_that_the_scans_exclude_is_not_found():
    """The same form, where the scans know the column to 20 nm."""
    form, column = drawn(0, 600e-9)
    gain, (value,) = form.looks_like(1e-7 * column, np.full((1, 1), 25.0))
    assert gain < 5
    assert abs(1e-7 * value) < 60e-9


def test_what_the_adjustment_leaves_open_is_no_evidence():
    """The same terms with an uncertainty of their size along the column."""
    form, column = drawn(0, 600e-9)
    unsure = form.covariance + (1e-6) ** 2 * column @ column.T
    known = FormTerms(form.values, unsure, DEGREES, SYMMETRIC)
    assert known.looks_like(1e-7 * column, UNKNOWN)[0] < 1


def test_terms_that_a_small_scan_leaves_open_are_no_evidence():
    """Three directions of 42 are known, the rest by rounding; nothing looks like the machine."""
    rng = np.random.default_rng(3)
    known = rng.normal(size=(len(DEGREES), 3)) * 1e-7
    # A pose that is removed leaves a rounding of its own size.
    covariance = known @ known.T - 1e-24 * np.eye(len(DEGREES))
    terms = FormTerms(known @ [0.3, -0.2, 0.1], covariance, DEGREES, SYMMETRIC)
    gain, values = terms.looks_like(1e-7 * rng.normal(size=(len(DEGREES), 1)), UNKNOWN)
    assert gain < 2
    assert np.all(np.isfinite(values))


def cause(name, deviate, explains=True, alike=()):
    """A family that the scans show beyond its declaration."""
    family = Family(name, "m", 1, lambda view: view.x[np.newaxis], 1e-6, "reclocked")
    found = Evidence(family, np.ones(1), deviate**2, 1, 1e-8, deviate**2,
                     np.eye(1), declared=True)  # fmt: skip
    others = tuple(cause(other, deviate).evidence for other in alike)
    return Refutation(found, others, explains=explains)


def test_nothing_is_named_beside_a_cause_that_no_family_explains():
    causes = [cause("centre_x", 20.0), cause("spindle_axial/6", 9.0)]
    named = reasons_of(causes, {"centre_x"}, (), (), (0.0, 0.0), ())
    assert [(r.code, r.names) for r in named] == [
        ("refuted", ("centre_x",)),
        ("undeclared_effect", ("spindle_axial/6",)),
    ]
    causes[0] = replace(causes[0], explains=False)
    (one,) = reasons_of(causes, {"centre_x"}, (), (), (0.0, 0.0), ())
    assert (one.code, one.names) == ("unidentified", ())
    assert one.value == max(c.evidence.deviate for c in causes)


def test_what_the_model_of_the_form_may_have_made_has_no_name():
    """A cause of 10 nm beside a form of which 1 % is more than that."""
    (one,) = reasons_of([cause("lag_motion", 11.0)], (), (), (), (0.0, 0.0), (), 11e-9)
    assert (one.code, one.names, one.value) == ("unidentified", (), 11.0)
    (one,) = reasons_of([cause("lag_motion", 11.0)], (), (), (), (0.0, 0.0), (), 9e-9)
    assert one.names == ("lag_motion",)


def test_a_source_far_beyond_its_plausible_size_explains_nothing():
    """A probe whose scale would be off by 12 %, where 1 % is a probe in need of repair."""
    best = cause("c_lost@0", 20.0).evidence
    scale = cause("static_gain", 19.0).evidence
    assert explained(replace(scale, values=np.array([2e-6])), best) == 361 / 400
    assert explained(replace(scale, values=np.array([12e-6])), best) == 0


def test_a_form_that_looks_like_a_source_counts_by_what_that_may_do():
    family = cause("pitch", 1.0).evidence.family
    found = looks_like([("pitch", 21e-9), ("pitch", 19e-9)], [family], (), 20e-9)
    assert [(r.names, r.value) for r in found] == [(("pitch", "reclocked"), 21e-9)]
    assert not looks_like([("pitch", 21e-9)], [family], ["pitch"], 20e-9)


def test_what_explains_two_causes_alone_is_one_and_is_named_first():
    causes = [cause("part_bow_speed", 5.0, alike=("creep", "drift_rate")),
              cause("drift", 6.0, alike=("creep",))]  # fmt: skip
    (one,) = reasons_of(causes, {"drift"}, (), (), (0.0, 0.0), ())
    assert one.names == ("creep", "part_bow_speed", "drift_rate", "drift")
    assert (one.code, one.value) == ("undeclared_effect", 6.0)
    # Whichever of them is the cause, its found value is accepted.
    assert not reasons_of(causes, {"drift"}, (), (), (0.0, 0.0), ("creep",))


def test_what_is_smaller_than_an_undeclared_walk_may_be_made_by_it():
    """A harmonic of 10 nm beside heights that wander by 90 nm in a second, of 1 nm declared."""
    causes = [cause("spindle_axial/1.33", 14.0)]
    walk = (90e-9, 40.0)
    (one,) = reasons_of(causes, {"drift_walk"}, (), (), walk, ())
    assert one.code == "refuted"
    assert {"drift_walk", "spindle_axial/1.33"} <= set(one.names)
    assert one.value == 40.0
    (one,) = reasons_of(causes, {"drift_walk"}, (), (), (2e-9, 20.0), ())
    assert one.names == ("spindle_axial/1.33",)
