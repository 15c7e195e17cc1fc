"""Dust on parts with real defects, from an independent generator in plain numpy."""

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.registration.register import register
from omsm_ros.core.surface.nominal import Flat

R, NOISE, POINTS = 12.7e-3, 10e-9, 40_000


def spiral():
    r, c = np.linspace(R, 0, POINTS), np.linspace(0, 200 * np.pi, POINTS)
    return r * np.cos(c), r * np.sin(c)


def raster():
    across = np.linspace(-R, R, 226)
    x, y = np.meshgrid(across, across)
    x[1::2] = x[1::2, ::-1]
    inside = np.hypot(x, y) <= R
    return x[inside], y[inside]


def rolled_edge(x, y):
    return -400e-9 * np.clip((np.hypot(x, y) - 0.9 * R) / (0.1 * R), 0, None) ** 3


def groove(x, y):
    return -60e-9 * (np.abs(0.6 * x + 0.8 * y - 2e-3) < 0.2e-3)


def pip(x, y):
    return 80e-9 * np.exp(-((x / 0.25e-3) ** 2) - (y / 0.25e-3) ** 2)


def scratch(x, y):
    along, across = 0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y
    return -200e-9 * ((np.abs(across) < 0.06e-3) & (np.abs(along) < 4e-3))


def nothing(x, y):
    return np.zeros_like(x)


def registered(path, defect, share, rule="isolated", seed=1):
    rng = np.random.default_rng(seed)
    x, y = path()
    dusty = rng.random(len(x)) < share
    height = 50e-9 * (x**2 - y**2) / R**2 + defect(x, y) + rng.normal(0, NOISE, len(x))
    height[dusty] += rng.lognormal(np.log(1e-6), 1.0, int(dusty.sum()))
    batch = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tip", "tilt"), dust=rule)
    return found, np.flatnonzero(dusty), height


@pytest.mark.parametrize(
    ("path", "defect"),
    [
        (spiral, scratch),
        (raster, groove),
        *soaked(*((spiral, defect) for defect in (rolled_edge, groove, pip))),
        *soaked(*((raster, defect) for defect in (rolled_edge, pip, scratch))),
    ],
)
def test_form_stays_and_dust_goes(path, defect):
    found, dusty, height = registered(path, defect, 1e-3)
    lost = np.setdiff1d(found.dust, dusty)
    assert len(lost) <= 2
    kept = np.setdiff1d(dusty, found.dust)
    # Grains as small as the limit are no outliers.
    assert np.all(np.abs(height[kept]) < 4 * found.limit)


@pytest.mark.parametrize("path", [spiral, *soaked(raster)])
def test_dense_dust_does_not_confirm_itself(path):
    found, dusty, height = registered(path, nothing, 1e-2)
    kept = np.setdiff1d(dusty, found.dust)
    assert np.all(np.abs(height[kept]) < 3 * found.limit)
    assert len(found.dust) > 0.9 * len(dusty)


@pytest.mark.soak
def test_the_rule_none_leaves_out_nothing_and_a_number_limits_the_cluster():
    assert not len(registered(spiral, pip, 1e-3, "none")[0].dust)
    few, more = (len(registered(raster, pip, 1e-3, n)[0].dust) for n in (1, 100))
    assert few < more


def test_the_ends_of_a_profile_stay():
    x = np.linspace(-0.1, 0.1, 400)
    height = 1e-9 * np.sin(300 * x) - 60e-9 * (np.abs(x) > 0.097)
    height[200] += 80e-9
    batch = PointBatch(x, np.zeros_like(x), height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tilt"))
    assert found.dust.tolist() == [200]


@pytest.mark.parametrize("seed", [0, *soaked(1, 2)])
def test_a_grain_on_a_defect_is_dust_and_the_defect_stays(seed):
    """Five grains of 0.4 µm on a pip of 80 nm in the centre of a spiral, where all turns meet."""
    rng = np.random.default_rng(seed)
    x, y = spiral()
    grains = rng.choice(np.flatnonzero(np.hypot(x, y) < 0.2e-3), 5, replace=False)
    height = pip(x, y) + rng.normal(0, 3e-9, len(x))
    height[grains] += 400e-9
    batch = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tip", "tilt"))
    assert set(found.dust.tolist()) == set(grains.tolist())


@pytest.mark.parametrize("seed", [0, *soaked(1, 2)])
def test_a_groove_as_narrow_as_the_steps_along_a_track_stays(seed):
    """Points at random places of its steep sides confirm no other; there is no dust elsewhere."""
    rng = np.random.default_rng(seed)
    share = np.linspace(1, 0, 12_000)
    x, y = (10e-3 * share * f(120 * np.pi * share) for f in (np.cos, np.sin))
    groove = -450e-9 * np.exp(-(((0.8 * x + 0.6 * y - 3e-3) / 0.25e-3) ** 4))
    height = groove + rng.normal(0, 1e-9, len(x))
    batch = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tip", "tilt"))
    assert np.sum(np.abs(groove) > 50e-9) > 400
    assert not len(found.dust)


def test_a_rolled_edge_stays_where_steps_are_longer_than_the_tracks_are_apart():
    """Only the outer two turns are far from the form; points of one turn follow each other."""
    share = np.linspace(1, 0, 12_000)
    x, y = (10e-3 * share * f(140 * np.pi * share) for f in (np.cos, np.sin))
    rolled = -500e-9 * np.clip((share - 0.96) / 0.04, 0, None) ** 2
    height = rolled + np.random.default_rng(1).normal(0, 10e-9, len(x))
    batch = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tip", "tilt"))
    assert np.sum(rolled < -100e-9) > 200
    assert len(found.dust) < 5


@pytest.mark.parametrize(("share", "width"), [(0, 0.6), (1e-3, 1.0)])
def test_an_edge_that_rolls_off_between_the_last_points_of_lines_stays(share, width):
    """On a raster of 90 lines; width: of the cubic roll-off in distances of the lines."""
    rng = np.random.default_rng(3)
    lines, steps = np.linspace(-9e-3, 9e-3, 90), np.arange(-12e-3, 12e-3, 80e-6)
    x, y = np.meshgrid(steps, lines)
    x[1::2] = x[1::2, ::-1]
    x = x + rng.uniform(0, 80e-6, (90, 1))
    rim = np.hypot(x / 12e-3, y / 9e-3)
    x, y, rim = x[rim <= 1], y[rim <= 1], rim[rim <= 1]
    height = -80e-9 * np.clip(1 - (1 - rim) * 12e-3 / (width * 202e-6), 0, None) ** 3
    dusty = rng.random(len(x)) < share
    height += rng.normal(0, 2e-9, len(x)) + rng.lognormal(np.log(1e-6), 1, len(x)) * dusty
    batch = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tip", "tilt"))
    assert np.sum(height < -30e-9) > 30
    assert len(np.setdiff1d(found.dust, np.flatnonzero(dusty))) <= 2
    assert np.all(np.abs(height[np.setdiff1d(np.flatnonzero(dusty), found.dust)]) < 4 * found.limit)


def sparse(heights):
    """Register a spiral with steps of twice the distance of its 100 tracks, noise of 3 nm."""
    r, c = np.linspace(R, 0, 12_000), np.linspace(0, 200 * np.pi, 12_000)
    x, y = r * np.cos(c), r * np.sin(c)
    height = np.random.default_rng(2).normal(0, 3e-9, len(x)) + heights(x, y)
    batch = PointBatch(x, y, height, np.empty((0, len(x))))
    return register(Flat(), lambda: [batch], ("piston", "tip", "tilt"))


def test_a_pit_of_the_size_of_the_track_distance_stays_where_there_is_no_dust():
    """It shows on three tracks, with a third of its depth on two of them."""
    found = sparse(
        lambda x, y: -150e-9 * np.exp(-((x - x[4000]) ** 2 + (y - y[4000]) ** 2) / 0.12e-3**2)
    )
    assert not len(found.dust)


def test_a_scratch_at_a_small_angle_to_the_lines_stays():
    """Three lines cross it 1.6 mm apart, each for less than the lines are apart."""

    def thin(x, y):
        along, across = x * np.cos(0.125) + y * np.sin(0.125), y * np.cos(0.125) - x * np.sin(0.125)
        end = np.clip(np.abs(along) - 2e-3, 0, None)
        return -500e-9 * np.exp(-(across**2 + end**2) / 12e-6**2)

    def lines():
        x, y = np.meshgrid(np.linspace(-R, R, 600), np.linspace(-R, R, 126))
        x[1::2] = x[1::2, ::-1]
        return x.ravel(), y.ravel()

    found, _, height = registered(lines, thin, 0.0)
    assert height.min() < -300e-9
    assert not len(found.dust)


def test_much_dust_of_one_size_is_no_form():
    """One point in a hundred: each grain has others within three distances of the lines."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-R, R, 300), np.linspace(-R, R, 100))
    x[1::2] = x[1::2, ::-1]
    x, y = (v[np.hypot(x, y) <= R] for v in (x, y))
    dusty = rng.random(len(x)) < 0.01
    height = 50e-9 * (x**2 - y**2) / R**2 + rng.normal(0, 2e-9, len(x)) + 1e-6 * dusty
    batch = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tip", "tilt"))
    assert np.array_equal(found.dust, np.flatnonzero(dusty))


def test_two_grains_of_one_size_are_no_scratch():
    """They lie three tracks apart among thirty others of all sizes."""
    grains = np.arange(100, 11_900, 400)
    made = np.zeros(12_000)
    made[grains] = np.geomspace(60e-9, 9e-6, len(grains))
    made[grains[15] + 360] = 1.02 * made[grains[15]]
    assert set(np.flatnonzero(made)) == set(sparse(lambda x, y: made).dust)


def test_two_grains_side_by_side_on_a_rolled_edge_are_dust():
    """The edge shows on the outer turn only, whose points lie far closer than the tracks."""
    share = np.sqrt(np.linspace(1, 0, 40_000))
    x, y = (R * share * f(160 * np.pi * share) for f in (np.cos, np.sin))
    rolled = 150e-9 * np.clip((share - 0.98) / 0.02, 0, None)
    grains = np.append(np.arange(1500, 40_000, 150), [400, 402])
    height = rolled + np.random.default_rng(1).normal(0, 4e-9, len(x))
    height[grains] += np.append(np.geomspace(200e-9, 9e-6, len(grains) - 2), [700e-9, 1200e-9])
    batch = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tip", "tilt"))
    assert set(found.dust) == set(grains)


def spiral_with(grains, form, turns=92, points=50_000):
    """Register a spiral with a noise of 1 nm and grains, by index; return the dust."""
    share = np.linspace(1, 0, points)
    x, y = (R * share * f(2 * np.pi * turns * share) for f in (np.cos, np.sin))
    height = form(x, y) + np.random.default_rng(3).normal(0, 1e-9, points)
    height[list(grains)] += list(grains.values())
    batch = PointBatch(x, y, height, np.empty((0, points)))
    return set(register(Flat(), lambda: [batch], ("piston", "tip", "tilt")).dust.tolist())


def other_grains(points=50_000):
    """Make dust all over the part, of which every second grain covers two points."""
    places = range(150, points, 150)
    sizes = np.random.default_rng(4).permutation(np.geomspace(150e-9, 15e-6, len(places)))
    grains = dict(zip(places, sizes, strict=True))
    return grains | {k + 1: 1.2 * grains[k] for k in places[::2]}


@pytest.mark.parametrize(
    ("first", "steps"), [(18_060, (0, 2, 3)), (18_060, (0, 1, 3, 4)), (4060, (0, 1, 2))]
)
def test_grains_in_line_are_no_form_along_the_track(first, steps):
    """They reach over the distance of the tracks; the surface between them is smooth."""
    chain = {first + k: (500 + 40 * k) * 1e-9 for k in steps}
    grains = other_grains() | chain
    assert set(grains) - spiral_with(grains, nothing) == set()


def test_two_grains_of_two_points_on_neighbouring_tracks_are_no_form():
    share = np.linspace(1, 0, 50_000)
    turn = 2 * np.pi * 92 * share
    at = 4001
    near = int(np.argmin(np.abs(turn - (turn[at] - 2 * np.pi))))
    pairs = dict(zip((at, at + 1, near, near + 1), (0.3e-6, 2e-6, 1.9e-6, 0.4e-6), strict=True))
    few = {k: v for k, v in other_grains().items() if k % 900 < 2}
    grains = few | pairs
    assert set(grains) - spiral_with(grains, nothing) == set()


def test_three_grains_side_by_side_at_the_end_of_ripple_do_not_excuse_each_other():
    """The ripple is far from the smooth form, and would make them form, too."""

    def ripple(x, y):
        at = np.hypot(x - 5e-3, y)
        return 40e-9 * (1 + np.cos(2 * np.pi * at / 0.9e-3)) * (at < 4e-3)

    share = np.linspace(1, 0, 30_000)
    x, y = (R * share * f(2 * np.pi * 92 * share) for f in (np.cos, np.sin))
    near = np.argsort(np.hypot(x - 8.85e-3, y))[:3]
    grains = other_grains(30_000) | dict(zip(near.tolist(), (2.8e-6, 9.8e-6, 13e-6), strict=True))
    assert not set(near.tolist()) - spiral_with(grains, ripple, points=30_000)


def test_a_pit_on_three_tracks_stays_among_much_dust():
    def pit(x, y):
        return -400e-9 * np.exp(-((((x - 6e-3) ** 2 + y**2) / 0.25e-3**2) ** 2))

    share = np.linspace(1, 0, 50_000)
    x, y = (R * share * f(2 * np.pi * 92 * share) for f in (np.cos, np.sin))
    grains = {k: v for k, v in other_grains().items() if np.hypot(x[k] - 6e-3, y[k]) > 1e-3}
    found = spiral_with(grains, pit)
    assert not [k for k in found - set(grains) if pit(x[k], y[k]) < -200e-9]
