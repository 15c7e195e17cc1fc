import numpy as np

from omsm_ros.core.form.deviation_map import DeviationMap
from omsm_ros.core.form.part_figures import SECOND_ORDER, SmoothTerms, best_fit
from omsm_ros.core.surface.aperture import Aperture


def test_the_second_order_goes_and_nothing_else():
    """Against weighted least squares of the whole matrix; an effect goes the same way."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-0.25, 0.25, 4000), rng.uniform(0.01, 0.04, 4000)
    area = rng.uniform(0.1, 2, 4000)
    rest = 1e-8 * np.sin(60 * x) * np.cos(300 * y)
    curved = 1e-6 * (1 + x - 3 * y + 4 * x * x - x * y + 9 * y * y)
    map_ = DeviationMap(x=x, y=y, deviation=rest + curved, area=area,
                        effects=np.stack([curved, rest]), noise=1e-9)  # fmt: skip
    found = SmoothTerms.of(map_, Aperture(0.25), SECOND_ORDER).without(SECOND_ORDER)
    design = np.stack([x**i * y**j for i in range(3) for j in range(3 - i)], axis=1)
    root = np.sqrt(area)
    fitted = np.linalg.lstsq(design * root[:, np.newaxis], rest * root, rcond=None)[0]
    np.testing.assert_allclose(found.deviation, rest - design @ fitted, atol=1e-16)
    np.testing.assert_allclose(found.effects[0], 0, atol=1e-16)
    np.testing.assert_allclose(found.effects[1], found.deviation, atol=1e-16)


def test_a_profile_has_a_second_order_too():
    x = np.linspace(-1e-2, 1e-2, 500)
    map_ = DeviationMap(x=x, y=0 * x, deviation=1e-9 + 3 * x**2, area=np.ones(500),
                        effects=np.empty((0, 500)), noise=0.0)  # fmt: skip
    found = SmoothTerms.of(map_, Aperture(1e-2), SECOND_ORDER).without(SECOND_ORDER)
    np.testing.assert_allclose(found.deviation, 0, atol=1e-15)


def test_where_it_fits_best_a_part_has_no_move_and_keeps_all_else():
    """Moves in any unit, one of them of no size; what an error does beside a move stays."""
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-1e-2, 1e-2, (2, 3000))
    form = 1e-8 * np.cos(500 * x) * np.cos(400 * y)
    moves = np.stack([1e-15 * x, 3e-9 + 0 * y, 0 * x])
    map_ = DeviationMap(x=x, y=y, deviation=form + 5e-7 * x + 2e-7, area=np.ones(3000),
                        effects=np.stack([moves[0], form, *moves[1:]]), noise=0.0,
                        moves=np.array([0, 2, 3]))  # fmt: skip
    found = best_fit(map_)
    design = np.stack([x, np.ones_like(x)], axis=1)
    rest = form - design @ np.linalg.lstsq(design, form, rcond=None)[0]
    np.testing.assert_allclose(found.deviation, rest, atol=1e-18)
    np.testing.assert_allclose(found.effects[1], rest, atol=1e-18)
    np.testing.assert_allclose(found.effects[[0, 2, 3]], 0, atol=1e-20)
