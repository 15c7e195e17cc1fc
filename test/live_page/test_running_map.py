import numpy as np
import pytest

from omsm_ros.live_page.live_view import RunningMap


def points_of(running):
    return int(running._count.sum())


def whole(running):
    """All cells of a map by their middle: {(x, y): means}."""
    grid = running.grid
    place, means = running.since(0)
    row, column = np.divmod(place, grid.cells)
    x = grid.left + (column + 0.5) * grid.pitch
    y = grid.bottom + (row + 0.5) * grid.pitch
    return x, y, means


def test_a_cell_holds_the_mean_of_its_points_wherever_they_came():
    random = np.random.default_rng(1)
    x, y = random.uniform(-0.01, 0.01, (2, 20_000))
    values = np.column_stack([3 * x + y, np.full_like(x, 7e-9)])
    running = RunningMap(2, cells=50)
    for part in np.array_split(np.arange(len(x)), 37):
        assert running.add(x[part], y[part], values[part]) == len(part)
    assert points_of(running) == 20_000
    at_x, at_y, means = whole(running)
    grid = running.grid
    for i in random.integers(0, len(at_x), 40):
        near = (abs(x - at_x[i]) <= grid.pitch / 2) & (abs(y - at_y[i]) <= grid.pitch / 2)
        assert means[i, 0] == pytest.approx(np.mean(values[near, 0]), rel=1e-5, abs=1e-9)
    assert means[:, 1] == pytest.approx(7e-9)


@pytest.mark.parametrize("way", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_it_grows_to_every_side_and_loses_nothing(way):
    running = RunningMap(1, cells=20)
    far = np.geomspace(1e-4, 0.05, 200)
    for r in far:
        running.add(np.array([way[0] * r]), np.array([way[1] * r]), np.array([[r]]))
    assert points_of(running) == 200
    x, y, _ = whole(running)
    grid = running.grid
    assert abs(max(abs(x)) - 0.05) <= grid.pitch
    assert abs(max(abs(y)) - 0.05) <= grid.pitch
    assert grid.pitch * grid.cells < 1.1 * 0.05


def test_a_spiral_inwards_fills_the_side():
    c = np.linspace(0, 2 * np.pi * 100, 50_000)
    r = np.linspace(12.7e-3, 0, 50_000)
    running = RunningMap(1)
    for part in np.array_split(np.arange(50_000), 500):
        running.add(r[part] * np.cos(c[part]), r[part] * np.sin(c[part]), r[part, np.newaxis])
    assert running.grid.pitch * 400 == pytest.approx(2 * 12.7e-3, rel=0.06)
    assert points_of(running) == 50_000


def test_a_raster_far_from_the_axis_fills_the_side_within_a_doubling():
    running = RunningMap(1, cells=100)
    for y in np.linspace(0.05, 0.06, 400):
        x = np.linspace(0.03, 0.04, 200)
        running.add(x, np.full(200, y), np.ones((200, 1)))
    assert points_of(running) == 80_000
    assert running.grid.pitch * 100 < 2.2 * 0.01


def test_a_reader_gets_what_is_new_to_it_and_no_more():
    running = RunningMap(1, cells=10)
    running.add(np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.array([[1.0], [2.0]]))
    known = running.version
    assert len(running.since(known)[0]) == 0
    running.add(np.array([0.0]), np.array([0.0]), np.array([[3.0]]))
    place, means = running.since(known)
    assert len(place) == 1
    assert means[0, 0] == 2.0
    assert len(running.since(0)[0]) == 2


def test_what_is_no_number_is_left_out():
    running = RunningMap(1, cells=10)
    x = np.array([0.0, np.nan, 0.5, 0.5])
    assert running.add(x, np.zeros(4), np.array([[1.0], [1.0], [np.inf], [1.0]])) == 2
    assert running.add(np.array([np.nan]), np.zeros(1), np.ones((1, 1))) == 0


def test_a_restart_forgets_and_is_another_generation():
    running = RunningMap(1, cells=10)
    running.add(np.zeros(1), np.zeros(1), np.ones((1, 1)))
    before = running.grid.generation
    running.restart()
    assert running.grid is None
    assert points_of(running) == 0
    running.add(np.ones(1), np.ones(1), np.ones((1, 1)))
    assert running.grid.generation > before


def test_memory_does_not_grow_with_points():
    running = RunningMap(3, cells=64)
    random = np.random.default_rng(2)
    for _ in range(50):
        xy = random.normal(0, 1e-2, (2, 20_000))
        running.add(*xy, np.ones((20_000, 3)))
    assert running._sum.nbytes + running._count.nbytes + running._changed.nbytes < 64 * 64 * 50
