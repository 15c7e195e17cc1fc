"""Worlds repeat by seed, hold what they declare, and every kind of the catalogue does something."""

import csv
import functools
import json

import numpy as np
import pytest
from soaked import always

from benchmarks.worlds.catalogue import GROUPS, KINDS, SCOPES
from benchmarks.worlds.figure import Figure, noll, truth_of, zernike
from benchmarks.worlds.files import write_world
from benchmarks.worlds.scans import steps
from benchmarks.worlds.sources import declared
from benchmarks.worlds.world import World

COARSE = 2e-3
LAG_OF_EQ_12_S = 1.22e8 / 1.27e12 + 3.07e8 / 1.26e12
CHANNELS = ("x", "z", "c", "distance")


def test_noll_order():
    assert [noll(j) for j in range(1, 12)] == [
        (0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3), (4, 0),
    ]  # fmt: skip


def test_truth_of_one_term():
    """Terms have unit rms; PV of defocus is 2√3, and levelling takes off the tilt alone."""
    truth = truth_of(lambda x, y: 1e-8 * zernike(4, x, y) + 3e-8 * zernike(2, x, y), 1.0)
    np.testing.assert_allclose(truth.zernike[[1, 3]], [3e-8, 1e-8], rtol=1e-12)
    assert truth.rms == pytest.approx(np.sqrt(10) * 1e-8)
    assert truth.rms_levelled == pytest.approx(1e-8)
    assert truth.pv_levelled == pytest.approx(2 * np.sqrt(3) * 1e-8)


def test_drawn_figure_has_its_terms():
    figure = Figure.draw(3, 0.0127, rings=0.0, marks=0.0)
    truth = truth_of(figure.height, 0.0127)
    assert truth.rms == pytest.approx(35e-9)
    np.testing.assert_allclose(truth.zernike[3:], [figure.terms[j] for j in range(4, 16)])


def test_catalogue_is_large_and_consistent():
    errors = [kind for kind in KINDS.values() if kind.group != "benign"]
    assert len(errors) >= 60
    assert {kind.group for kind in KINDS.values()} == set(GROUPS)
    assert {kind.scope for kind in KINDS.values()} <= set(SCOPES)


@functools.cache
def recordings(world):
    path = steps((10e-6,), count=2, dwell=0.2)
    return {"scan": world.scan(feed=COARSE), "test": world.step_test(path)}


NAMES = sorted(set(KINDS) - {"none"})


@pytest.mark.parametrize("name", always(*NAMES[::12], of=NAMES))
def test_each_kind_changes_its_recordings_alone(name):
    """The error acts where its scope says, beside the same chances as without it."""
    world = World(name, 2, seed=5)
    for where, bad in recordings.__wrapped__(world).items():
        good = recordings(world.clean)[where]
        acts = KINDS[name].scope in (where, "both")
        same = all(
            np.array_equal(getattr(bad, k), getattr(good, k), equal_nan=True) for k in CHANNELS
        )
        assert same is not acts, where


def test_same_seed_same_world():
    a, b, other = (World("air", seed=s).scan(feed=COARSE) for s in (1, 1, 2))
    np.testing.assert_array_equal(a.distance, b.distance)
    assert not np.array_equal(a.distance, other.distance)


def test_raw_height_is_height_lag_and_latency():
    """Without the declared errors, h = S − τ_p dS/dt + (τ_p + τ_s) dz/dt and 10 nm of noise."""
    r = World(share=0.0).scan(feed=COARSE)
    latency = declared()["latency"]
    moved = (latency + LAG_OF_EQ_12_S) * np.gradient(r.z, 1e-3)
    expected = r.height + moved - latency * np.gradient(r.height, 1e-3)
    left = (r.raw_height - expected)[5:-5]
    assert np.std(left) == pytest.approx(10e-9, rel=0.03)
    assert abs(np.mean(left)) < 5e-9


def test_reclocked_scan_measures_the_same_part():
    """The deviation of the clocked part is read at its own coordinates."""
    r = World(share=0.0).scan(clocking=1.2, feed=COARSE)
    part = World(share=0.0).part
    np.testing.assert_allclose(r.height, part.height(r.part_x, r.part_y), atol=1e-14)
    np.testing.assert_allclose(r.deviation, part.deviation(r.part_x, r.part_y), atol=1e-20)


def test_kept_back_source():
    """An undeclared centre_y is missing beside centre_x; a broken declaration stands."""
    names = [row["source"] for row in World("centre_y").declared()["sources"]]
    assert "centre_x" in names
    assert "centre_y" not in names
    assert "centre_x" in [row["source"] for row in World("centre_x").declared()["sources"]]


def test_files(tmp_path):
    """Files carry millimetres, degrees and micrometres; a lost reading is an empty cell."""
    world = World("no_reading", 2)
    truth = write_world(world, [(60.0, "out", 0.0)], tmp_path, feed=COARSE, wrapped=True)
    expected = world.scan(60.0, "out", feed=COARSE)
    with (tmp_path / "scan_0.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(expected.t)
    assert "" in {row["distance_um"] for row in rows}
    read = np.array([float(row["distance_um"] or "nan") for row in rows])
    np.testing.assert_allclose(read, expected.distance * 1e6, atol=1e-4)
    z = np.array([float(row["z_mm"]) for row in rows])
    np.testing.assert_allclose(z, expected.z * 1e3, atol=1e-7)
    assert max(float(row["c_deg"]) for row in rows) <= 360
    assert json.loads((tmp_path / "truth.json").read_text()) == json.loads(json.dumps(truth))
    names = [
        row["source"] for row in json.loads((tmp_path / "sources.json").read_text())["sources"]
    ]
    assert {"centre_y", "drift_walk", "lag_change"} <= set(names)
