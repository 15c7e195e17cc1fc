"""What a plan promises, an adjustment of such scans keeps."""

import numpy as np
import pytest
from coverage import PRIORS
from plain_world import MIRROR, RADIUS_M, Machine, form, rings
from soaked import soaked

from omsm_ros.core.adjustment import (
    ScanDesign,
    adjust,
    plan_scans,
    posterior_uncertainty,
    usual_sets,
)
from omsm_ros.core.adjustment.figures import POSE
from omsm_ros.core.adjustment.planning import additions, best_addition, design_of

FIRST = ScanDesign(rpm=30.0, start=RADIUS_M, end=0.0, pitch=0.4e-3)


@pytest.mark.parametrize("name", ["quick", *soaked("quick_beyond")])
def test_a_plan_foretells_the_uncertainty_of_pv(name):
    """That by which a verdict judges; where a form has its peaks, it is up to two times less."""
    designs = usual_sets(FIRST)[name]
    planned = posterior_uncertainty(designs, PRIORS, MIRROR)
    found = []
    for part in (form, rings):
        machine = Machine(1, part=part)
        scans = [
            machine.scan(d.rpm, start=d.start, end=d.end, clocking=d.clocking) for d in designs
        ]
        found.append(adjust(scans, PRIORS, nominal=MIRROR))
    reached = max(one.form.pv.uncertainty for one in found)
    assert reached < planned.pv < 1.6 * reached
    lag = found[0].source("lag_change").uncertainty[0]
    assert planned.sources["lag_change"][0] == pytest.approx(lag, rel=0.35)


def test_more_scans_leave_less_uncertain():
    sets = usual_sets(FIRST)
    single, quick, full, four = (
        posterior_uncertainty(sets[name], PRIORS, MIRROR)
        for name in ("single", "quick", "full", "full_4")
    )
    assert single.pv > 4 * quick.pv
    # The fourth scan helps less than draws scatter.
    assert quick.pv > full.pv > 0.9 * four.pv
    assert single.duration == pytest.approx(RADIUS_M / 0.4e-3 * 2.0)
    assert quick.duration == pytest.approx(single.duration * 1.5 + 20.0)


@pytest.mark.soak
def test_the_shortest_set_that_reaches_the_accuracy_is_first():
    sets = usual_sets(FIRST)
    plans = plan_scans(sets, PRIORS, MIRROR, 25e-9)
    assert plans[0].name == "quick"
    assert plans[0].designs == sets["quick"]
    assert plans[0].reaches
    assert not plans[-1].reaches
    assert plans[-1].designs == sets["single"]
    none = plan_scans(sets, PRIORS, MIRROR, 1e-10)
    assert not any(p.reaches for p in none)
    reached = [p.uncertainty.pv for p in none[:-1]]
    assert reached == sorted(reached)


@pytest.mark.parametrize("width", [1e-3, 20e-6])
def test_few_turns_far_from_the_axis_have_additions(width):
    """A scan beyond the centre at its feed has hundreds of turns; the few still have points."""
    first = ScanDesign(rpm=30.0, start=RADIUS_M, end=RADIUS_M - width, pitch=width / 4)
    sets = [[first, added] for added in additions(first).values()]
    reached = [posterior_uncertainty(designs, PRIORS, MIRROR).pv for designs in sets]
    assert np.all(np.isfinite(reached))
    assert min(reached) > 0


def test_a_repeated_track_does_not_show_a_lag():
    first, more = FIRST, additions(FIRST)
    again = posterior_uncertainty([first, more["repeated_track"]], PRIORS, MIRROR)
    faster = posterior_uncertainty([first, more["other_speed"]], PRIORS, MIRROR)
    reversed_ = posterior_uncertainty([first, more["other_direction"]], PRIORS, MIRROR)
    assert again.sources["lag_change"][0] > 5e-6
    assert max(faster.sources["lag_change"][0], reversed_.sources["lag_change"][0]) < 1e-6


def test_a_third_scan_has_a_third_speed_or_another_purpose():
    machine = Machine(1, pitch=1.6e-3)
    scans = [machine.scan(30), machine.scan(60, outward=True)]
    codes = [best_addition(scans[:n], PRIORS, MIRROR, POSE)[0] for n in (1, 2)]
    assert codes[1] != "other_speed"


def test_beyond_the_centre_straightness_is_separated_from_the_part():
    """Odd parts of a bend look like no part that is scanned from both sides."""
    bent = [p for p in PRIORS if p.name != "squareness"]
    inside, beyond = (
        posterior_uncertainty([FIRST, additions(FIRST)[code]], bent, MIRROR)
        for code in ("other_speed", "beyond_centre")
    )
    odd = np.linalg.norm(beyond.sources["parallelism"])
    assert odd < np.linalg.norm(inside.sources["parallelism"])


def test_the_design_of_a_scan_is_read_from_it():
    machine = Machine(1)
    design = design_of(machine.scan(-60, outward=True, clocking=0.5))
    assert design.rpm == pytest.approx(-60, rel=1e-3)
    assert design.start == pytest.approx(0.0, abs=1e-4)
    assert design.end == pytest.approx(RADIUS_M, rel=1e-2)
    assert design.pitch == pytest.approx(0.4e-3, rel=0.02)
    assert design.clocking == 0.5
    assert design.rate == pytest.approx(1000.0, rel=1e-3)


def test_a_design_goes_beyond_the_centre_as_its_scan_does():
    design = design_of(Machine(1).scan(60, start=-0.3 * RADIUS_M, end=RADIUS_M))
    assert design.start == pytest.approx(-0.3 * RADIUS_M, rel=1e-2)
    assert design.end == pytest.approx(RADIUS_M, rel=1e-2)


@pytest.mark.soak
def test_the_best_addition_is_the_best_of_all():
    machine = Machine(1)
    scan = machine.scan(30)
    code, reached = best_addition([scan], PRIORS, MIRROR, POSE)
    first = design_of(scan)
    alone = posterior_uncertainty([first], PRIORS, MIRROR, POSE).pv
    for added in additions(first).values():
        assert reached <= 2 * posterior_uncertainty([first, added], PRIORS, MIRROR, POSE).pv
    assert reached < 0.3 * 2 * alone
    assert code != "repeated_track"
