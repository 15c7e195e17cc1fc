"""Which numbers make two measurements agree, differ, or leave it open, and what is said of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.core.comparison.agreement import (
    TERMS,
    ComparedFigure,
    ComparedTerm,
    ComparisonAgreement,
)
from omsm_ros.core.comparison.compare import AGREE, CANNOT_TELL, DIFFER, verdict_of

COMPARED_M = 100e-9


class Compared:
    """Matched heights of 100 nm rms, as input of a verdict."""

    a = COMPARED_M * np.array([1.0, -1.0, 1.0, -1.0])
    b = 0.5 * a

    @staticmethod
    def without_fit(values):
        return values


def terms(scores=None, expanded=5e-9):
    """All terms of one expanded uncertainty, E_n zero but for the ``scores``."""
    scores = scores or {}
    return tuple(
        ComparedTerm(
            n=n, m=m, difference=scores.get((n, m), 0.0) * expanded, uncertainty=expanded / 3,
            expanded=expanded, e_n=scores.get((n, m), 0.0),
        )
        for n, m in TERMS
    )  # fmt: skip


AGREED = ComparisonAgreement(
    figures={name: ComparedFigure(1e-7, 1e-7, 1e-8, 0.1) for name in ("peak_to_valley", "rms")},
    terms=terms({(2, 0): 0.4, (3, -1): -0.7}),
    probability=0.5,
    within=0.96,
    uncertainty=np.full(4, 1e-9),
    farthest=3.0,
    allowed=4.0,
    at=(1e-3, -2e-3),
    aperture=(5e-3, 0.0, 0.0),
)


def judged(shared=1.0, unknown=(), **changes):
    agreement = replace(AGREED, **changes) if changes else AGREED
    verdict, reasons = verdict_of(Compared(), agreement, unknown, shared)
    return SimpleNamespace(verdict=verdict, reasons=reasons)


def test_within_all_they_state_they_agree_and_the_largest_term_is_reported():
    found = judged()
    assert found.verdict == AGREE
    assert str(found.reasons[0]) == (
        f"all {len(TERMS)} Zernike terms: the largest |E_n| is 0.700, of coma in y Z(3, -1)"
    )
    assert "p = 0.5" in str(found.reasons[1])
    assert "96.0 % of the area" in str(found.reasons[2])


def test_the_most_uncertain_terms_are_reported_with_the_error_they_may_mask():
    broad = [replace(t, expanded=9e-9) if (t.n, t.m) == (2, 0) else t for t in AGREED.terms]
    found = judged(terms=tuple(broad))
    assert "up to 9.00 nm of power Z(2, 0)" in str(found.reasons[3])


@pytest.mark.parametrize(
    ("score", "probability", "verdict"),
    [
        (0.99, 0.5, AGREE),
        (1.1, 0.5, CANNOT_TELL),
        (-1.1, 0.5, CANNOT_TELL),
        (1.1, 0.04, DIFFER),
        (1.3, 0.5, DIFFER),
        (-1.3, 0.5, DIFFER),
        (0.9, 0.04, AGREE),
        (0.9, 0.005, DIFFER),
    ],
)
def test_one_term_and_all_together_make_the_verdict(score, probability, verdict):
    """A term plainly beyond one, or a little and all unlikely, or all very unlikely."""
    found = judged(terms=terms({(2, 2): score}), probability=probability)
    assert found.verdict == verdict


def test_the_term_that_differs_is_named_with_its_size_and_what_explains_it():
    found = judged(terms=terms({(2, 2): 2.0, (4, 0): 1.4}))
    assert str(found.reasons[0]) == (
        "astigmatism Z(2, 2) differs by 10.0 nm, expanded uncertainty 5.00 nm: E_n = 2.00"
    )
    found = judged(terms=terms({(5, -3): -3.0}))
    assert str(found.reasons[0]).startswith("Z(5, -3) differs by -15.0 nm")


def test_the_joint_test_is_reported_where_it_decides():
    found = judged(probability=1e-3)
    assert found.verdict == DIFFER
    assert len(found.reasons) == 1
    assert str(found.reasons[0]).startswith("all terms together: p = 0.001")


@pytest.mark.parametrize(("farthest", "verdict"), [(4.9, AGREE), (5.1, DIFFER)])
def test_a_place_plainly_beyond_the_most_to_expect_differs_and_is_named(farthest, verdict):
    found = judged(farthest=farthest)
    assert found.verdict == verdict
    if verdict == DIFFER:
        assert "at x = 1.00 mm, y = -2.00 mm the difference is 5.10 standard" in str(
            found.reasons[0]
        )
        assert "at most 4.00 are expected" in str(found.reasons[0])


def test_a_figure_alone_makes_no_difference_but_a_doubt():
    figures = {**AGREED.figures, "rms": ComparedFigure(2e-7, 1e-7, 5e-8, 2.0)}
    found = judged(figures=figures)
    assert found.verdict == CANNOT_TELL
    assert "E_n = 2.00, too close to 1 for a decision" in str(found.reasons[0])
    # With a term that differs the figure is reported, too.
    found = judged(figures=figures, terms=terms({(2, 2): 2.0}))
    assert found.verdict == DIFFER
    assert str(found.reasons[-1]).endswith(": E_n = 2.00")


def test_a_figure_that_was_not_evaluated_says_nothing():
    found = judged(figures={"rms": ComparedFigure(1e-7, 2e-7, None, None)})
    assert found.verdict == AGREE


@pytest.mark.parametrize(("expanded", "verdict"), [(99e-9, AGREE), (101e-9, CANNOT_TELL)])
def test_terms_less_known_than_all_that_is_compared_tell_nothing(expanded, verdict):
    found = judged(terms=terms(expanded=expanded))
    assert found.verdict == verdict
    if verdict == CANNOT_TELL:
        assert "101 nm or more, which exceeds all that is compared, 100 nm rms" in str(
            found.reasons[0]
        )


def test_a_few_uncertain_terms_do_not_mask_the_others():
    broad = [replace(t, expanded=1e-5) if t.n == 2 else t for t in AGREED.terms]
    assert judged(terms=tuple(broad)).verdict == AGREE


@pytest.mark.parametrize(("shared", "verdict"), [(0.5, AGREE), (0.49, CANNOT_TELL)])
def test_of_half_the_smaller_area_and_more_there_is_a_verdict(shared, verdict):
    found = judged(shared=shared)
    assert found.verdict == verdict
    if verdict == CANNOT_TELL:
        assert [*map(str, found.reasons)] == [
            "they share 49 % of the smaller area, expected 50 % or more"
        ]


def test_little_overlap_masks_a_difference():
    assert judged(shared=0.2, terms=terms({(2, 2): 9.0})).verdict == CANNOT_TELL


def test_without_an_uncertainty_nothing_is_reported_but_why():
    verdict, reasons = verdict_of(Compared(), None, ("map carries none",), 0.3)
    assert verdict == CANNOT_TELL
    assert reasons[0] == "map carries none"
    assert "30 % of the smaller area" in str(reasons[1])
