"""Scans adjusted together against the truth of the machine that made them."""

from dataclasses import replace

import numpy as np
import pytest
from coverage import CLOCKING_RAD, LAG_S, PRIORS, drawn, normalised, true_form
from plain_world import MIRROR, RADIUS_M, Machine, rings
from soaked import always, soaked

from omsm_ros.core.adjustment import (
    CONTRADICTED,
    NOT_VERIFIED,
    TOO_UNCERTAIN,
    VERIFIED,
    ScanData,
    Source,
    adjust,
    corrected_heights,
)
from omsm_ros.core.adjustment.verdict import INVALID, WRONG_SENSE
from omsm_ros.core.calibration.certificate import REJECTED
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import ConfigurationError, DataError

FIELDS = ("time", "x", "y", "height", "distance", "motion", "removed", "c")


def exact_priors():
    """Return declarations of a part that does not move between the scans."""
    exact = [Source(*p, evaluated=True) for p in (("part_shift", 1e-9), ("part_turn", 1e-8))]
    priors = [p for p in PRIORS if p.name not in ("part_shift", "part_turn")]
    # Two scans to the centre leave it open.
    return [*priors, *exact, Source("expansion", 2e-7, evaluated=True)]


@pytest.fixture(scope="module")
def table():
    """One to three scans of the machine of the design: 35 µs of lag that nobody knows."""
    machine = Machine(7, lag=35e-6)
    scans = [
        machine.scan(30),
        machine.scan(60, outward=True),
        machine.scan(30, clocking=np.deg2rad(80)),
    ]
    priors = exact_priors()
    found = [adjust(scans[:n], priors, nominal=MIRROR, accuracy=25e-9) for n in (1, 2, 3)]
    return machine, scans, found


def test_a_second_speed_takes_away_what_one_scan_cannot(table):
    """Form error within what is stated: 75 nm of one scan, 5 of two."""
    machine, _, found = table
    for adjustment, least, most in zip(found, (20e-9, 0, 0), (80e-9, 5.2e-9, 4.4e-9), strict=True):
        *_, error = normalised(machine, adjustment)
        assert least < adjustment.form.mean_uncertainty < most
        assert error < 2 * adjustment.form.mean_uncertainty


def test_dust_is_left_out(table):
    """400 nm under sixty points of each scan: figures, sources and verdict as without it."""
    (_, scans, (_, two, _)), priors = table, exact_priors()
    random, seen = np.random.default_rng(5), []
    for scan in scans[:2]:
        dust = np.zeros(len(scan))
        dust[random.choice(len(scan), 60, replace=False)] = 400e-9
        seen.append(replace(scan, height=scan.height + dust, distance=scan.distance + dust))
    found = adjust(seen, priors, nominal=MIRROR, accuracy=25e-9)
    assert len(found.form.dust) == 120
    assert found.verdict.code == VERIFIED
    assert not found.refutations
    assert found.form.pv.value == pytest.approx(two.form.pv.value, abs=2e-9)


def test_a_grain_that_the_tracks_of_one_scan_alone_confirm_is_left_out(table):
    """400 nm over 0.4 mm, where the scan from beyond the centre crosses it on both sides."""
    machine, (inwards, *_), _ = table
    beyond = machine.scan(60, start=-0.3 * RADIUS_M, end=RADIUS_M)
    seen = []
    for scan in (inwards, beyond):
        grain = 400e-9 * (np.abs(scan.x + 1j * scan.y - 1e-3 * np.exp(1j)) < 200e-6)
        seen.append(replace(scan, height=scan.height + grain, distance=scan.distance + grain))
    found = adjust(seen, exact_priors(), nominal=MIRROR, accuracy=25e-9)
    assert not found.refutations
    assert found.verdict.code == NOT_VERIFIED
    pv, _, _, _, error = normalised(machine, found)
    assert abs(pv) < 2
    assert error < 2 * found.form.mean_uncertainty < 10e-9


def test_what_three_speeds_show_is_advised_after_two(table):
    """Twice the speed was scanned already: a lag that depends on it needs yet another one."""
    _, _, (one, two, _) = table
    assert one.source("lag_rate").shown_by == "other_speed"
    assert two.source("lag_speed").shown_by == two.source("lag_rate").shown_by == "new_speed"


def test_a_circle_is_no_spiral(table):
    """C turns and X does not move: neither form nor a scan to add follows from it."""
    _, (scan, *_), _ = table
    assert scan.is_spiral
    circle = replace(scan, x=RADIUS_M * np.cos(scan.c), y=-RADIUS_M * np.sin(scan.c))
    assert not circle.is_spiral
    with pytest.raises(DataError, match="scan 2 is no spiral") as refused:
        adjust([scan, circle], PRIORS, nominal=MIRROR)
    assert refused.value.code == "adjustment.no_spiral"


def test_the_lag_is_found_to_a_fifth_of_a_microsecond(table):
    """A tenth of it is how little is declared of a lag that differs with the speed."""
    _, _, (one, two, _) = table
    lag = two.source("lag_change")
    assert lag.uncertainty[0] < 0.2e-6
    assert abs(lag.found[0] - 35e-6) < 3 * lag.uncertainty[0]
    assert one.source("lag_change").uncertainty[0] > 0.9 * LAG_S


def test_the_effect_of_a_source_is_that_of_its_found_value(table):
    """A lag acts by the rate of Z; pitch counts by its declaration, not by the scans alone."""
    _, scans, (_, two, _) = table
    rate = np.concatenate([s.removed for s in scans[:2]]) / 340e-6
    lag, pitch = two.source("lag_change"), two.source("pitch")
    size = np.sqrt(np.mean(rate**2))
    assert lag.effect == pytest.approx(lag.found[0] * size, rel=0.02)
    assert lag.effect_uncertainty == pytest.approx(lag.uncertainty[0] * size, rel=0.02)
    assert pitch.effect <= 3 * pitch.effect_uncertainty < 6e-9


def test_one_scan_is_too_uncertain_and_names_the_scan_to_add(table):
    _, _, (one, two, three) = table
    assert one.verdict.code == TOO_UNCERTAIN
    assert {"not_redundant", "uncertainty"} <= {r.code for r in one.verdict.reasons}
    assert one.verdict.add in ("other_speed", "other_direction", "beyond_centre", "reclocked")
    assert one.verdict.reached < 0.4 * 2 * one.form.mean_uncertainty
    assert two.verdict.code == three.verdict.code == VERIFIED
    assert not two.verdict.reasons
    assert all(a.largest < a.limit for a in three.agreement)


def test_what_a_default_leaves_open_is_in_the_uncertainty(table):
    """Two scans to the centre leave the expansion open; its default is wide, and named."""
    _, scans, (_, two, _) = table
    found = adjust(scans[:2], PRIORS, nominal=MIRROR, accuracy=25e-9)
    assert found.verdict.code == VERIFIED
    assert "expansion" in [name for name, *_ in found.verdict.rests_on]
    assert found.form.mean_uncertainty > two.form.mean_uncertainty


def test_a_reclocked_scan_shows_the_spindle(table):
    """Found cos 2c: 12 nm of the world, and nearer to it than before."""
    _, _, (_, two, three) = table
    before, after = (a.source("spindle_axial/2") for a in (two, three))
    assert after.uncertainty[0] < 0.7 * before.uncertainty[0]
    error = after.found - np.array([12e-9, 0.0])
    assert np.all(np.abs(error) < 3 * after.uncertainty)


def test_corrected_heights_are_the_part(table):
    """Every point less all that was found: the nominal surface, the form and a pose."""
    machine, scans, (_, two, _) = table
    scan = scans[1]
    heights = corrected_heights(two, scan, 1)
    left = heights - MIRROR.height(scan.x, scan.y) - machine.truth(scan.x, scan.y)
    pose = np.stack([np.ones(len(scan)), scan.x, scan.y], axis=1)
    left -= pose @ np.linalg.lstsq(pose, left, rcond=None)[0]
    raw = scan.height - MIRROR.height(scan.x, scan.y) - machine.truth(scan.x, scan.y)
    raw -= pose @ np.linalg.lstsq(pose, raw, rcond=None)[0]
    assert np.std(left) == pytest.approx(12e-9, rel=0.1)
    assert np.std(raw) > 3 * np.std(left)


def test_accuracy_beyond_reach_is_too_uncertain(table):
    """The verdict then says which scan helps, although two scans verify each other."""
    _, scans, _ = table
    found = adjust(scans[:2], PRIORS, nominal=MIRROR, accuracy=2e-9)
    assert found.verdict.code == TOO_UNCERTAIN
    reason = found.verdict.reasons[-1]
    assert reason.code == "uncertainty"
    assert reason.value == pytest.approx(2 * found.form.pv.uncertainty)
    assert found.verdict.add
    assert 0.5 * reason.value < found.verdict.reached < reason.value


@pytest.mark.soak
def test_what_a_rejected_calibration_corrected_is_not_valid(table, true_calibration):
    """Two scans that agree verify nothing where the step test was rejected."""
    _, scans, _ = table
    certificate = replace(true_calibration.certificate, verdict=REJECTED)
    rejected = replace(true_calibration, certificate=certificate)
    found = adjust(scans[:2], PRIORS, calibration=rejected, nominal=MIRROR, accuracy=25e-9)
    assert found.verdict.code == INVALID
    assert found.verdict.reasons[0].code == REJECTED


@pytest.mark.soak
def test_an_uncertainty_too_large_names_the_number_that_has_to_shrink(table):
    """With the size that is named, U is the accuracy or less; no size reaches 1 nm."""
    _, scans, _ = table
    rest = [p for p in PRIORS if p.name != "straightness_x"]

    def expanded(size, accuracy):
        stated = [*rest, Source("straightness_x", size, correlation_length=0.01)]
        found = adjust(scans[:2], stated, nominal=MIRROR, accuracy=accuracy)
        return 2 * found.form.pv.uncertainty, found.verdict.reasons[-1].largest

    before, largest = expanded(90e-9, 40e-9)
    assert (largest.name, largest.unit, largest.size) == ("straightness_x", "m", 90e-9)
    after, smaller = expanded(largest.allowed, 1e-9)
    assert before > 50e-9
    # The effect of other sources in its place shrinks with it.
    assert 0.8 * 40e-9 < after < 1.02 * 40e-9
    # Without the source U is the same, whatever its size was.
    np.testing.assert_allclose(largest.rest, smaller.rest, rtol=0.1)
    assert np.isnan(smaller.allowed)


def test_what_is_only_declared_does_not_turn_green(table):
    """The same figures, stated without a recording, for what no spiral to the centre shows."""
    _, scans, _ = table
    stated = [Source(p.name, p.uncertainty) for p in PRIORS]
    found = adjust(scans[:2], stated, nominal=MIRROR, accuracy=25e-9)
    assert found.verdict.code == NOT_VERIFIED
    names = {r.names[0]: r for r in found.verdict.reasons if r.names}
    assert names["straightness_x"].code == "declared_only"
    assert names["straightness_x"].names[1] == "reference_artefact"


@pytest.mark.parametrize("name", always("clocking", of=["clocking", "expansion", "straightness_z"]))
def test_one_declaration_without_evaluation_is_enough(table, name):
    """A pose, a size below the default, and a source that may change PV by more than the rms."""
    _, scans, _ = table
    sizes = {p.name: p for p in (*PRIORS, Source("expansion", 2e-7, evaluated=True))}
    stated = (sizes | {name: replace(sizes[name], evaluated=False)}).values()
    found = adjust(scans[:2], list(stated), nominal=MIRROR, accuracy=40e-9)
    assert found.verdict.code == NOT_VERIFIED
    (reason,) = found.verdict.reasons
    assert (reason.code, reason.names[0]) == ("declared_only", name)
    assert reason.value > reason.limit == 40e-9
    # Nor is it a test of C.
    assert (found.source("c_error/1").uncertainty[0] > 1e-5) == (name == "clocking")


@pytest.mark.soak
def test_what_is_not_even_declared_is_missing_or_seen(table):
    _, scans, _ = table
    nothing = adjust(scans[:2], (), nominal=MIRROR, accuracy=25e-9)
    missing = {r.names[0]: r.code for r in nothing.verdict.reasons if r.names}
    assert missing["straightness_x"] == missing["encoder_scale"] == "not_evaluated"
    # 12, 9 and 5 nm of the spindle, which nobody declared, are seen all the same.
    assert missing["spindle_axial/2"] == missing["spindle_axial/3"] == "undeclared_effect"


@pytest.mark.soak
def test_a_turned_part_shows_that_c_counts_the_other_way(table):
    """The mirror image of the mirror, whose clocking then has the other sign."""
    _, scans, _ = table
    assert len({s.clocking for s in scans}) == 2
    right = adjust(scans, PRIORS, nominal=MIRROR)
    assert "sense_of_c" not in [name for name, *_ in right.verdict.rests_on]
    reflected = [replace(s, y=-s.y, c=-s.c) for s in scans]
    found = adjust(reflected, PRIORS, nominal=MIRROR)
    assert found.verdict.code == CONTRADICTED
    assert found.verdict.reasons[0].code == WRONG_SENSE


def test_two_scans_of_one_speed_and_direction_are_not_redundant():
    machine = Machine(3, lag=20e-6, pitch=0.8e-3)
    scans = [machine.scan(30), machine.scan(30, outward=True)]
    found = adjust(scans, PRIORS, nominal=MIRROR)
    assert found.verdict.code == NOT_VERIFIED
    # In and out differ by the feed alone, 0.2 mm/s of 40.
    assert found.source("lag_change").uncertainty[0] > 5e-6


@pytest.mark.soak
def test_spindle_reversed_shows_the_lag():
    machine = Machine(4, lag=35e-6)
    scans = [machine.scan(40), machine.scan(-40, outward=True)]
    found = adjust(scans, PRIORS, nominal=MIRROR, accuracy=30e-9)
    lag = found.source("lag_change")
    assert abs(lag.found[0] - 35e-6) < 3 * lag.uncertainty[0] < 1.5e-6
    # A lag that differs with the direction, or falls with the speed, would look like the part.
    names = {n for r in found.verdict.reasons for n in r.names}
    assert "lag_direction" in names
    codes = {r.code for r in found.verdict.reasons}
    # The lag was declared without an evaluation.
    assert codes == {"not_evaluated", "declared_only", "uncertainty"}


@pytest.mark.soak
def test_a_pose_is_projected_out_of_the_form():
    """A tilted and lifted part has the same map, and the pose comes out."""
    machine = Machine(5, pitch=0.8e-3)
    scans = [machine.scan(30), machine.scan(60, outward=True)]
    lifted = [
        ScanData(**{n: getattr(s, n) for n in FIELDS if n != "height"},
                 height=s.height + 3e-7 + 2e-5 * s.x - 1e-5 * s.y)
        for s in scans
    ]  # fmt: skip
    plain, posed = (adjust(s, PRIORS, nominal=MIRROR) for s in (scans, lifted))
    np.testing.assert_allclose(posed.form.height, plain.form.height, atol=0.6e-9)
    np.testing.assert_allclose(posed.form.pose - plain.form.pose, [3e-7, -1e-5, -2e-5], rtol=1e-2)
    ones = np.ones(len(plain.form.x))
    assert np.sqrt(plain.form.area @ (plain.form.covariance @ (ones * plain.form.area)) ** 2) < (
        1e-6 * plain.form.mean_uncertainty**2
    )


@pytest.mark.parametrize("seeds", [(0,), *soaked(range(12))])
def test_stated_noise_and_walk_are_replaced_by_what_the_scans_show(seeds):
    """Declared 1.2 nm/√s and 12 nm; the machine has five and three times as much."""
    errors, stated = [], []
    for seed in seeds:
        machine, scans = drawn(seed, 2, pitch=0.8e-3, noise=36e-9, walk=6e-9)
        found = adjust(scans, PRIORS, nominal=MIRROR, accuracy=25e-9)
        assert found.noise == pytest.approx(36e-9, rel=0.05)
        assert found.drift_walk == pytest.approx(6e-9, rel=0.35)
        assert ("refuted", "drift_walk") in {(r.code, *r.names[:1]) for r in found.verdict.reasons}
        truth = true_form(machine, found.form)
        errors.append(found.form.area @ (found.form.height - truth) ** 2)
        stated.append(found.form.mean_uncertainty**2)
    assert 0.3 < np.mean(errors) / np.mean(stated) < 2.0


@pytest.mark.soak
def test_a_part_without_nominal_surface_shows_the_lag_too():
    machine = Machine(6, lag=35e-6, pitch=0.6e-3)
    found = adjust([machine.scan(30), machine.scan(60, outward=True)], PRIORS)
    lag = found.source("lag_change")
    assert abs(lag.found[0] - 35e-6) < 3 * lag.uncertainty[0] < 3e-6


@pytest.mark.soak
def test_a_remounted_part_is_placed_by_the_adjustment():
    """Shifted by 10 µm and turned by 0.3 mrad in another clamping: found, and form unharmed."""
    machine = Machine(8, lag=10e-6)
    scans = [
        machine.scan(30),
        machine.scan(60, outward=True),
        machine.scan(60, clocking=np.deg2rad(80), clamping=1, moved=(1e-5, -4e-6), turned=3e-4),
    ]
    priors = [p for p in PRIORS if p.name not in ("part_shift", "part_turn")]
    found = adjust(scans, priors, nominal=MIRROR, accuracy=40e-9)
    *_, error = normalised(machine, found)
    assert error < 2 * found.form.mean_uncertainty < 12e-9
    shift = found.source("part_shift@2")
    assert np.all(np.abs(shift.found - np.array([1e-5, -4e-6])) < 4 * shift.uncertainty + 5e-8)
    assert not found.refutations


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(3))
def test_a_turned_part_with_rings_keeps_its_form(seed):
    """Z follows the nominal surface, so that the distance is the form.

    Nothing of the probe, and no cone or centre, may take it away.
    """
    machine, scans = drawn(seed, 2, pitch=0.4e-3, part=rings)
    found = adjust(scans, PRIORS, nominal=MIRROR, accuracy=25e-9)
    pv, rms, _, terms, error = normalised(machine, found)
    assert not found.refutations
    assert error < 2 * found.form.mean_uncertainty < 12e-9
    assert max(abs(pv), abs(rms)) < 3
    assert np.max(np.abs(terms)) < 4
    alone = adjust(scans[:1], PRIORS, nominal=MIRROR, accuracy=25e-9)
    assert not alone.refutations


def test_rings_of_a_few_turns_are_no_drift():
    """Both scans cross them, one inwards and one outwards: the walk stays the declared one."""

    def turned(x, y):
        return rings(x, y) + 4e-9 * np.cos(2 * np.pi * np.hypot(x, y) / 2.4e-3)

    _, scans = drawn(1, 2, pitch=0.8e-3, part=turned)
    found = adjust(scans, PRIORS, nominal=MIRROR)
    assert found.drift_walk < 1.2 * 1.2e-9
    assert "contradicted" not in found.verdict.code


@pytest.mark.soak
def test_a_pose_that_is_only_declared_counts_in_the_form():
    """A part off by 8 µm looks astigmatic; declared so, the uncertainty holds it."""
    machine = Machine(9, lag=10e-6, pitch=0.8e-3)
    moved = (8e-6, -4e-6)
    scans = [machine.scan(30, moved=moved), machine.scan(60, outward=True, moved=moved)]
    plain = adjust(scans, PRIORS, nominal=MIRROR)
    priors = [*PRIORS, Source("decentre", 8e-6)]
    stated = adjust(scans, priors, nominal=MIRROR)
    *_, error = normalised(machine, plain)
    assert error > 3 * plain.form.mean_uncertainty
    assert error < 2 * stated.form.mean_uncertainty
    fitted = adjust(scans, priors, nominal=MIRROR, removed=("piston", "tip", "tilt", "x", "y"))
    assert fitted.form.mean_uncertainty < 0.2 * stated.form.mean_uncertainty


def test_no_scan_and_unknown_sources_are_refused():
    with pytest.raises(DataError, match="no scan"):
        adjust([])
    scan = Machine(1, pitch=2e-3).scan(60)
    with pytest.raises(ConfigurationError, match="moon_phase"):
        adjust([scan], [Source("moon_phase", 1.0)])
    with pytest.raises(ConfigurationError, match="-1"):
        Source("centre_x", -1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": np.zeros(3)}, "x has shape"),
        ({"height": "nan"}, "not finite"),
        ({"time": "still"}, "does not grow"),
    ],
)
def test_malformed_scans_are_refused(change, message):
    scan = Machine(1, pitch=3e-3).scan(60)
    values = {n: getattr(scan, n) for n in FIELDS}
    for name, value in change.items():
        if isinstance(value, str):
            value = np.where(np.arange(len(scan)) == 7, np.nan if value == "nan" else -1.0,
                             values[name])  # fmt: skip
        values[name] = value
    with pytest.raises(DataError, match=message):
        ScanData(**values)


def test_world_and_declarations_are_what_the_tests_say():
    """The mirror solved by Newton is the mirror in closed form; clocking is 0.1 arc seconds."""
    angle = np.linspace(0, 2 * np.pi, 721)
    rim = RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle)
    np.testing.assert_allclose(MIRROR.height(*rim), PAPER_MIRROR.height(*rim), atol=1e-15)
    assert pytest.approx(np.deg2rad(0.1 / 3600), rel=0.05) == CLOCKING_RAD
