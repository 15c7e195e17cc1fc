"""The normal equations against dense generalised least squares, and the blocks against sums."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from coverage import PRIORS
from plain_world import MIRROR, RADIUS_M, Machine

from omsm_ros.core.adjustment.adjust import _network
from omsm_ros.core.adjustment.blocks import SECTORS, block_begins
from omsm_ros.core.adjustment.evidence import evidence_of
from omsm_ros.core.adjustment.families import BEYOND_CENTRE, REFERENCE, families_of, ranges_of
from omsm_ros.core.adjustment.figures import (
    FormOf,
    _term_fit,
    effects_on_form,
    form_map,
    nodes_of,
    places_of,
)
from omsm_ros.core.adjustment.network import Factor, solve
from omsm_ros.core.adjustment.part_terms import part_model
from omsm_ros.core.adjustment.refutation import completed, probabilities, start_scales, walk_deviate
from omsm_ros.core.adjustment.scan_data import view_of, zero_of
from omsm_ros.core.adjustment.sources import Source, prior_sizes
from omsm_ros.core.streams.statistics import white_noise
from omsm_ros.core.surface.zernike_terms import terms_up_to, zernike_values


@pytest.fixture(scope="module")
def small():
    """Two short scans, their views and network."""
    machine = Machine(1, lag=20e-6, pitch=1.6e-3)
    scans = [machine.scan(60), machine.scan(-90, outward=True)]
    zero = zero_of(scans, MIRROR)
    views = [view_of(s, k, zero, MIRROR) for k, s in enumerate(scans)]
    network = _network(scans, views, PRIORS)
    sizes = prior_sizes(network.families, PRIORS)
    return views, network, sizes


def dense_rows(network):
    """All rows, one parameter at a time: the fitted heights are linear in the parameters."""
    return np.stack([network.fitted(row) for row in np.eye(network.size)], axis=1)


def columns_of(network, name):
    return network.blocks.columns[:, network.place[name]]


def test_eliminated_cells_equal_generalised_least_squares(small):
    """N = XᵀV⁻¹X with V = diag(noise) + s² for two blocks of one cell."""
    _, network, _ = small
    scales = start_scales(network, 1e-9)
    rows = dense_rows(network)
    cell = network.part.cell
    v = np.diag(1 / network.weights(scales)) + scales.cells * (cell[:, np.newaxis] == cell)
    expected = rows.T @ np.linalg.solve(v, rows)
    scale = 1 / np.sqrt(np.diag(expected) + 1e-300)
    got = network.normal_matrix(scales) * scale * scale[:, np.newaxis]
    np.testing.assert_allclose(got, expected * scale * scale[:, np.newaxis], atol=1e-8)
    y = network.blocks.deviation
    right = rows.T @ np.linalg.solve(v, y) * scale
    np.testing.assert_allclose(
        network.sums_by_column(network.pulled(scales, y)) * scale,
        right,
        atol=1e-7 * np.max(np.abs(right)),
    )


def test_the_line_of_a_position_is_the_scale_of_its_axis(small):
    """Errors of position over X have neither mean nor incline: centre and scale have them."""
    views, network, _ = small
    families = {f.name: f for f in network.families}
    view = views[0]
    by_centre = families["centre_x"].columns(view)[0]
    moved = families["positioning_x"].columns(view)[::2] / by_centre
    order = np.argsort(view.slide_x)
    even = np.linspace(*view.slide_x[order[[0, -1]]], 500)
    for curve in moved:
        over = np.interp(even, view.slide_x[order], curve[order])
        assert np.ptp(over) > 1e-3
        assert np.max(np.abs(np.polyfit(even / even[-1], over, 1))) < 0.02 * np.ptp(over)


def test_blocks_are_means_of_points(small):
    """Count, deviation and a column of each block, by a loop; the column by six of its points."""
    views, network, _ = small
    blocks, first = network.blocks, 0
    for view in views:
        edges = [*block_begins(view), len(view)]
        for k in range(0, len(edges) - 1, 37):
            part = slice(edges[k], edges[k + 1])
            sector = np.floor(view.c[part] * SECTORS / (2 * np.pi))
            assert np.ptp(sector) == 0
            assert blocks.count[first + k] == edges[k + 1] - edges[k]
            assert blocks.deviation[first + k] == pytest.approx(
                np.mean(view.deviation[part]), abs=1e-15
            )
            assert columns_of(network, "lag_change")[first + k, 0] == pytest.approx(
                np.mean(view.motion_rate[part]), rel=1e-3, abs=1e-8
            )
        first += len(edges) - 1
    assert first == len(blocks)


def test_terms_of_a_block_are_their_means_over_its_arc(small):
    """The factor sin(mφ/2)/(mφ/2) against the mean of the points."""
    views, network, _ = small
    view = views[0]
    begins = block_begins(view)
    count = np.diff(np.append(begins, len(view)))
    mean = np.add.reduceat(network.part.values(view.x, view.y), begins, axis=0)
    mean = mean / count[:, np.newaxis]
    blocks = network.blocks
    mine = np.flatnonzero(blocks.scan == 0)
    outer = mine[np.hypot(blocks.x, blocks.y)[mine] > 3e-3]
    outer = outer[count[outer] > 8]
    got = network.part.values(blocks.x[outer], blocks.y[outer], blocks.span[outer])
    bare = network.part.values(blocks.x[outer], blocks.y[outer])
    high = np.array([abs(t.m) >= 12 for t in network.part.terms])
    # Cone and rings stand behind the terms.
    high = np.append(high, np.zeros(got.shape[1] - len(high), bool))
    error = np.sqrt(np.mean((got - mean[outer])[:, high] ** 2))
    without = np.sqrt(np.mean((bare - mean[outer])[:, high] ** 2))
    assert error < 0.25 * without


def test_factor_inverts_rows_of_different_units():
    random = np.random.default_rng(0)
    rows = random.standard_normal((60, 8)) * 10.0 ** np.arange(-12, 12, 3)
    matrix = rows.T @ rows
    factor = Factor.of(matrix.copy())
    unit = np.sqrt(np.diag(matrix))
    expected = random.standard_normal(8) / unit
    np.testing.assert_allclose(
        factor.inverse() * unit * unit[:, np.newaxis],
        np.linalg.inv(matrix / unit / unit[:, np.newaxis]),
        rtol=1e-9,
    )
    np.testing.assert_allclose(factor.solve(matrix @ expected), expected, rtol=1e-9)
    half = factor.forward(matrix)
    np.testing.assert_allclose(half.T @ half / unit / unit[:, np.newaxis],
                               matrix / unit / unit[:, np.newaxis], atol=1e-9)  # fmt: skip


def test_score_of_a_family_equals_its_fit(small):
    """χ² of a family that takes no part is the misfit that it takes away when it does, freely."""
    _, network, sizes = small
    scales = start_scales(network, 1e-9)
    family = next(f for f in network.families if f.name == "spindle_axial/6")
    y = network.blocks.deviation + columns_of(network, family.name) @ np.array([4e-9, -3e-9])
    without = solve(network, y, scales, sizes)
    evidence = evidence_of(without, family)
    free = solve(network, y, scales, {**sizes, family.name: 1e-3})
    here = network.place[family.name]
    np.testing.assert_allclose(evidence.values, free.values[here], rtol=1e-4)
    np.testing.assert_allclose(evidence.uncertainty, free.uncertainty(family.name), rtol=1e-3)
    estimate = free.values[here]
    chi_square = estimate @ np.linalg.solve(free.covariance_of(here), estimate)
    assert evidence.chi_square == pytest.approx(chi_square, rel=1e-3)
    assert evidence.dof == 2


def test_a_smooth_part_does_not_tell_the_size_of_a_source(small):
    """The adjustment knows a source better where the part is smooth; the scans alone do not."""
    _, network, sizes = small
    family = next(f for f in network.families if f.name == "parallelism")
    scales, y = start_scales(network, 1e-9), network.blocks.deviation
    bands = [dict.fromkeys(scales.bands, height**2) for height in (1e-7, 1e-11)]
    rough, smooth = (solve(network, y, replace(scales, bands=b), sizes) for b in bands)
    left = [np.linalg.norm(evidence_of(s, family).free) for s in (rough, smooth)]
    assert left[1] < 0.6 * left[0]
    known = [effects_on_form(FormOf.of(s, MIRROR))[family.name].known for s in (rough, smooth)]
    np.testing.assert_allclose(*known, rtol=1e-6, atol=1e-6)


def test_white_noise_is_separated_from_a_slow_form():
    random = np.random.default_rng(3)
    time = np.arange(20_000) / 1000
    height = 1e-7 * np.sin(2 * np.pi * time) + 12e-9 * random.standard_normal(len(time))
    assert white_noise(height) == pytest.approx(12e-9, rel=0.03)


def test_cells_are_alike_in_area(small):
    """Points spread evenly over the disc fall into all cells alike."""
    _, network, _ = small
    random = np.random.default_rng(0)
    disc = network.part.disc
    radius = disc.radius * np.sqrt(random.random(200_000))
    angle = 2 * np.pi * random.random(200_000)
    cell = network.part.cell_of(disc.x + radius * np.cos(angle), disc.y + radius * np.sin(angle))
    count = np.bincount(cell, minlength=network.part.cells)
    assert len(count) == network.part.cells
    even = 200_000 / network.part.cells
    assert np.all(np.abs(count - even) < 6 * np.sqrt(even))


def test_the_map_reaches_the_peaks_at_the_rim():
    """A wave of 7 a turn that grows towards the rim, of a spiral with fewer blocks than cells.

    The spiral begins at the rim, and is a turn inside it where it comes round.
    """
    solution = spiral_of(42)
    assert 6 * solution.network.part.rings - 3 > SECTORS
    places = places_of(solution)
    wave = ((places.x + 1j * places.y) / RADIUS_M) ** 7
    turned = np.exp(1j * np.arange(0, 2 * np.pi, 0.1))[:, np.newaxis]
    assert np.min(np.ptp((wave * turned).real, axis=1)) > 0.997 * 2


def test_the_map_ends_with_the_points_where_the_part_does():
    """An ellipse, whose short ends lie inside the disc by many turns."""
    solution = spiral_of(42, lambda place: np.hypot(0.7 * place.real, place.imag) < 0.7 * RADIUS_M)
    places, blocks = places_of(solution), solution.network.blocks
    rim = places.area == 0
    assert np.max(np.abs(places.y)) == pytest.approx(np.max(np.abs(blocks.y)))
    beyond = np.hypot(places.x[rim], places.y[rim] / 0.7) - RADIUS_M
    assert np.max(beyond) < 1.5 * RADIUS_M / 42


def spiral_of(turns, seen=lambda place: np.full(len(place), True)):
    """Return a solution that knows where the blocks of a spiral inwards are, and no more."""
    share = np.arange(turns * SECTORS + 1) / SECTORS
    place = RADIUS_M * (1 - share / turns) * np.exp(2j * np.pi * share)
    kept = seen(place)
    place, turn = place[kept], np.floor(share[kept])
    blocks = SimpleNamespace(x=place.real, y=place.imag, turn=turn)
    return SimpleNamespace(network=SimpleNamespace(blocks=blocks, part=part_model(blocks, turns)))


@pytest.mark.parametrize("turns", [42, 127])
def test_terms_that_are_not_fitted_leave_the_reported_ones_alone(turns):
    """Less than a hundredth of terms of degree 9 to 14 passes; over centres of blocks 9 %."""
    solution = spiral_of(turns)
    nodes = nodes_of(solution)
    every, fit = _term_fit(solution, nodes)
    reported = [k for k, t in enumerate(every) if 2 <= t.n <= 4]
    further = [t for t in terms_up_to(14) if t.n > 8]
    disc = solution.network.part.disc
    passed = fit[reported] @ zernike_values(*disc.scaled(nodes.x, nodes.y), further).T
    assert np.max(np.abs(passed)) < 0.01


@pytest.mark.parametrize(
    "within",
    [
        lambda place: place.real,
        lambda place: np.abs(place) - 0.53 * RADIUS_M,
        lambda place: 0.7 * RADIUS_M - np.hypot(0.7 * place.real, place.imag),
    ],
)
def test_nodes_lie_where_the_part_was_scanned(within):
    """Half a disc, a disc with a hole and an ellipse: within half a ring of them."""
    solution = spiral_of(42, lambda place: within(place) > 0)
    nodes, part = nodes_of(solution), solution.network.part
    beyond = np.min(within(nodes.x + 1j * nodes.y))
    assert beyond > -0.5 * part.disc.radius / part.rings


def test_low_harmonics_of_the_form_reach_waves_of_two_millimetres_by_variances_of_their_own(small):
    """With 60 turns, to degree 40; what no family acts on is left to the cells."""
    blocks = small[1].blocks
    part = part_model(blocks, 60.0)
    fine = [t for t in part.terms if t.n > 24]
    assert max(t.n for t in fine) == 40
    assert {abs(t.m) for t in fine} == {1, 2, 3, 4}
    assert max(abs(t.m) for t in part.terms) == 12
    low, other = (
        {d for t, d in zip(part.terms, part.degrees, strict=False) if t.n > 6 and chosen(abs(t.m))}
        for chosen in (lambda m: 0 < m <= 4, lambda m: m > 4)
    )
    assert low.isdisjoint(other)
    # Few turns resolve no such waves, and their cells no high harmonics.
    assert max(abs(t.m) for t in part_model(blocks, 12.0).terms) == 24


def test_of_many_declarations_the_one_that_looks_wrong_by_chance_is_hardly_more_probable():
    """Odds of 12 : 1 for one of two and of forty, and two declarations that are one as another."""
    odds = 2 * np.log(12)
    of_two, of_forty = (probabilities([odds, *np.full(n - 1, -20.0)])[0] for n in (2, 40))
    assert of_two == pytest.approx(12 / (18 + 12), rel=1e-3)
    assert of_forty == pytest.approx(12 / (360 + 12), rel=1e-3)
    alike = probabilities([40.0, 40.0])
    np.testing.assert_allclose(alike, 0.5, rtol=1e-6)
    assert probabilities([]).size == 0


@pytest.mark.parametrize("ratio", [0.5, 6.0])
def test_a_declaration_that_the_scans_speak_against_may_be_wrong(small, ratio):
    """A steady drift without noise, whose rate agrees with the declared one or does not."""
    _, network, sizes = small
    scales = start_scales(network, 1e-10)
    family = next(f for f in network.families if f.name == "drift_rate")
    column = columns_of(network, "drift_rate")[:, 0]

    def solved(rate):
        return solve(network, rate * column, scales, sizes)

    rate = 1e-9 * ratio / np.sqrt(evidence_of(solved(1e-9), family).chi_square)
    before = solved(rate)
    after = completed(before)
    assert after.sizes["drift_rate"] == pytest.approx(max(ratio, 1.0) * sizes["drift_rate"])
    off, further = (
        abs(s.values[network.place["drift_rate"]][0] - rate) / s.uncertainty("drift_rate")[0]
        for s in (after, before)
    )
    assert (off < 0.6 * further) == (ratio > 1)


def test_a_part_may_cancel_an_error_that_its_form_shows(small):
    """A bend over Z of 300 nm on a part with power of the other sign: their sum has neither."""
    _, network, sizes = small
    still = np.zeros(len(network.blocks))
    made = FormOf.of(completed(solve(network, still, start_scales(network, 1e-9), sizes)), MIRROR)
    x, y, area = made.places.x, made.places.y, made.places.area
    lift = MIRROR.height(x, y)
    bend = made.free(300e-9 * ((2 * lift - np.max(lift) - np.min(lift)) / np.ptp(lift)) ** 2)
    u, v = network.part.disc.scaled(x, y)
    terms = terms_up_to(12, 2)
    sizes = np.random.default_rng(0).normal(size=len(terms)) / [t.n**1.5 for t in terms]
    part = made.free(zernike_values(u, v, terms).T @ sizes)
    part *= 30e-9 / np.sqrt(area @ part**2)
    power = made.free(u**2 + v**2)
    part -= 1.5 * power * ((area * bend) @ power) / (area @ power**2)
    assert (area * bend) @ (part + bend) < 0
    found = form_map(replace(made, height=part + bend), effects=effects_on_form(made))
    assert dict(found.resembled)["pitch"] > 0.5 * np.sqrt(area @ bend**2)


def test_a_pose_that_is_removed_is_no_uncertainty_of_the_terms(small):
    """The covariance of terms against the scatter of drawn forms, each without its own pose."""
    _, network, sizes = small
    still = np.zeros(len(network.blocks))
    # A part off by 8 µm looks astigmatic, by some tens of nanometres.
    sizes = sizes | {"decentre": 8e-6}
    solution = solve(network, still, start_scales(network, 1e-9), sizes)
    removed = ("piston", "tip", "tilt", "x", "y", "clocking")
    made = FormOf.of(solution, MIRROR, removed, nodes_of(solution))
    every, fit = _term_fit(solution, made.places)
    form = form_map(FormOf.of(solution, MIRROR, removed))
    drawn = fit[[every.index(t) for t in form.terms]] @ made.free(made.errors()[0])
    stated = np.sqrt(np.diag(form.term_covariance))
    # A standard deviation of 300 draws is known to 4 %.
    np.testing.assert_allclose(np.std(drawn, axis=1), stated, rtol=0.17)
    astigmatic = form.terms.index((2, -2))
    with_pose = form_map(FormOf.of(solution, MIRROR)).term_covariance
    assert stated[astigmatic] < 0.1 * np.sqrt(with_pose[astigmatic, astigmatic])


@pytest.mark.parametrize(("start", "shown_by"), [(0.0, BEYOND_CENTRE), (-0.3, REFERENCE)])
def test_what_scans_from_both_sides_leave_open_only_an_artefact_shows(start, shown_by):
    """Advice to scan beyond the centre would go round in a circle."""
    scan = Machine(1, pitch=1.6e-3).scan(60, start=start * RADIUS_M, end=RADIUS_M)
    views = [view_of(scan, 0, zero_of([scan], MIRROR), MIRROR)]
    by = {f.name: f.shown_by for f in families_of(ranges_of(views, (), (0,)), ())}
    assert {by[name] for name in ("centre_x", "squareness", "straightness_z")} == {shown_by}


def test_a_linearity_is_declared_at_its_half_range(small):
    """The column is one there, and its plausible size the same over the distances in use."""
    views, _, _ = small
    for end in (None, 50e-6):
        families = families_of(ranges_of(views, linearity(end), (0, 0)), linearity(end))
        for name, power in (("probe_square", 2), ("probe_linearity", 3)):
            family = next(f for f in families if f.name == name)
            used = max(float(np.max(np.abs(v.distance))) for v in views)
            ends = end or max(used, 10e-6)
            np.testing.assert_allclose(
                family.columns(views[0])[0], (views[0].distance / ends) ** power
            )
            assert family.wide * (max(used, 10e-6) / ends) ** power == pytest.approx(1e-7)


def linearity(end):
    return [Source(n, 3e-9, half_range=end) for n in ("probe_linearity", "probe_square")]


def walk_of(seen, noise, step):
    """Return a solution of moves that were ``seen`` (k,) with a variance of ``noise`` [m²]: their
    best walk [m²/s], and what is left of them and unknown by it."""
    walk = max(np.mean(seen**2) - noise, 1e-3 * noise) / step
    share = walk * step / (walk * step + noise)
    knots = np.arange(len(seen) + 1)
    return SimpleNamespace(
        scales=SimpleNamespace(walk=walk),
        network=SimpleNamespace(knots=[slice(0, len(knots))], steps=[step]),
        values=np.append(0.0, np.cumsum(share * seen)),
        covariance_of=lambda here: share * noise * np.minimum.outer(knots, knots),
    )


def test_a_declared_walk_is_refuted_as_rarely_as_stated():
    """Fifty moves of which the scans determine half: deviates of the declared walk are normal."""
    random, declared, step = np.random.default_rng(4), 1.2e-9, 0.5
    noise = declared**2 * step
    found = [
        walk_deviate(
            walk_of(np.sqrt(2 * noise) * random.standard_normal(50), noise, step), declared
        )
        for _ in range(600)
    ]
    assert abs(np.mean(found)) < 0.2
    assert np.std(found) == pytest.approx(1.0, abs=0.1)
    larger = walk_of(np.sqrt(5 * noise) * random.standard_normal(50), noise, step)
    assert walk_deviate(larger, declared) > 3.0
