import dataclasses
import struct

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.correction.surface_points import POINT_DTYPE
from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import DataError
from omsm_ros.live_page.live_view import LiveView


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def cloud(x, y, height, error=1e-9, spread=2e-9):
    points = np.zeros(len(x), POINT_DTYPE)
    points["x"], points["y"], points["height"] = x, y, height
    points["dynamic_error"], points["uncertainty"] = error, spread
    return points


def unpacked(news):
    """A browser's reading of the binary message, by its documented layout."""
    content, _, _ = news
    cells, generation, count, version = struct.unpack_from("<IIIQ", content)
    places = np.frombuffer(content, "<u4", count, 20)
    layers = np.frombuffer(content, "<f4", 3 * count, 20 + 4 * count).reshape(3, count)
    assert len(content) == 20 + 16 * count
    return cells, generation, version, places, layers


def test_heights_are_reported_in_nanometres_and_once(clock):
    view = LiveView(monotonic=clock)
    assert view.news(-1, 0) is None
    view.add_points(cloud([0.0, 1e-3], [0.0, 1e-3], [5e-9, -7e-9]))
    news = view.news(-1, 0)
    *_, places, layers = unpacked(news)
    assert sorted(layers[0].tolist()) == pytest.approx([-7.0, 5.0])
    assert layers[1:].tolist() == [pytest.approx([1.0, 1.0]), pytest.approx([2.0, 2.0])]
    assert len(places) == 2
    assert view.news(news[1], news[2]) is None
    view.add_points(cloud([0.0], [0.0], [15e-9]))
    *_, places, layers = unpacked(view.news(news[1], news[2]))
    assert layers[0].tolist() == pytest.approx([10.0])


def test_with_a_nominal_surface_it_is_the_deviation(clock):
    view = LiveView(PAPER_MIRROR, clock)
    x, y = np.random.default_rng(1).uniform(-5e-3, 5e-3, (2, 500))
    x, y = x.astype(np.float32).astype(float), y.astype(np.float32).astype(float)
    view.add_points(cloud(x, y, PAPER_MIRROR.height(x, y) + 3e-9))
    *_, layers = unpacked(view.news(-1, 0))
    assert layers[0] == pytest.approx(np.full(layers.shape[1], 3.0), abs=1e-3)
    assert view.state()["compared"]


def test_the_error_over_time_is_kept_by_the_second(clock):
    view = LiveView(monotonic=clock)
    for second in range(1900):
        clock.now = 100.0 + second
        view.add_points(cloud([0.0, 0.0], [0.0, 0.0], 0.0, error=[-1e-9, second * 1e-9]))
    series = view.state()["series"]
    assert len(series) == 1800
    when, low, high, spread = series[-1]
    assert (when, low, high) == (0.0, pytest.approx(-1e-9), pytest.approx(1899e-9))
    assert spread == pytest.approx(2e-9)


def test_eight_hours_of_points_stay_in_bounded_memory(clock):
    import sys

    view = LiveView(monotonic=clock)
    random = np.random.default_rng(1)
    for second in range(200):
        clock.now = 100.0 + second
        x, y = random.normal(0, 5e-3, (2, 20_000))
        view.add_points(cloud(x, y, 1e-9))
    arrays = (view._map._sum, view._map._count, view._map._changed)
    assert sum(array.nbytes for array in arrays) < 10e6
    assert view._map._early is None
    assert sys.getsizeof(view._bin) < 5e6
    assert view.state()["points"] == 4_000_000


def test_the_light_is_green_only_if_all_is_well(clock, true_calibration):
    view = LiveView(monotonic=clock)
    assert view.state()["light"]["colour"] == "amber"
    view.add_state("/omsm/corrector", "OK", "correcting", {})
    assert view.state()["light"]["reasons"] == ["no calibration yet"]
    view.set_calibration(true_calibration)
    assert view.state()["light"] == {"colour": "green", "word": "In order", "reasons": []}
    view.add_state("/omsm/driver", "WARN", "just now: lost 3", {})
    light = view.state()["light"]
    assert light == {
        "colour": "amber",
        "word": "With reservations",
        "reasons": ["/omsm/driver: just now: lost 3"],
    }
    view.add_state("/omsm/driver", "ERROR", "gone", {})
    assert view.state()["light"]["colour"] == "red"


def test_the_light_of_the_measurement_is_part_of_it(clock, true_calibration):
    """A cell that runs well does not say that its numbers are good."""
    view = LiveView(monotonic=clock)
    view.set_calibration(true_calibration)
    said = {"verdict": "not_verified", "verdict_text": "not verified", "verdict_next": "next: scan"}
    view.add_state("/omsm/corrector", "OK", "correcting", said)
    assert view.state()["light"] == {
        "colour": "amber",
        "word": "With reservations",
        "reasons": ["measurement: not verified", "measurement: next: scan"],
    }
    view.add_state("/omsm/corrector", "OK", "correcting", said | {"verdict": "contradicted"})
    assert view.state()["light"]["colour"] == "red"
    view.add_state(
        "/omsm/corrector", "OK", "correcting", {"verdict": "verified", "verdict_next": ""}
    )
    assert view.state()["light"] == {"colour": "green", "word": "In order", "reasons": []}


@pytest.mark.parametrize(
    ("verdict", "colour"),
    [
        ("accepted, supported by data from 0.0055 Hz to 62.6 Hz", "green"),
        ("accepted with reservations, supported by data from 1 Hz to 60 Hz", "amber"),
        ("rejected", "red"),
        ("", "amber"),
    ],
)
def test_the_light_reads_the_verdict_of_a_certificate(clock, true_calibration, verdict, colour):
    view = LiveView(monotonic=clock)
    view.add_state("/omsm/corrector", "OK", "correcting", {})
    certificate = {"verdict": verdict} if verdict else {}
    view.set_calibration(
        dataclasses.replace(true_calibration, certificate=certified_by(certificate))
    )
    assert view.state()["light"]["colour"] == colour


def test_a_node_that_falls_silent_turns_it_red(clock, true_calibration):
    view = LiveView(monotonic=clock)
    view.set_calibration(true_calibration)
    view.add_state("/omsm/corrector", "OK", "correcting", {})
    clock.now += 11
    light = view.state()["light"]
    assert light["colour"] == "red"
    assert light["reasons"] == ["/omsm/corrector: no message for 10 s"]


def test_another_calibration_begins_another_map(clock, true_calibration):
    view = LiveView(monotonic=clock)
    view.set_calibration(true_calibration)
    view.add_points(cloud([0.0], [0.0], [1e-9]))
    view.set_calibration(true_calibration)
    assert view.state()["points"] == 1
    view.set_calibration(dataclasses.replace(true_calibration, static_gain=0.9))
    assert view.state()["points"] == 0
    assert view.news(-1, 0) is None


def test_a_line_of_vibration_stands_where_it_is(clock):
    view = LiveView(monotonic=clock)
    assert view.state()["spectrum"] is None
    time = np.arange(8000) * 5e-4
    for part in np.array_split(time, 40):
        wave = np.sin(2 * np.pi * 320 * part)
        block = AccelerationBlock(
            stamp_ns=0, first_sample=0, sample_period=5e-4, x=wave, y=0 * wave, z=0 * wave
        )
        view.add_acceleration(block)
    reported = view.state()["spectrum"]
    peak = reported["frequency"][int(np.argmax(reported["amplitude"]))]
    assert peak == pytest.approx(320, abs=2.5)


def test_points_that_are_no_numbers_are_counted(clock):
    view = LiveView(monotonic=clock)
    view.add_points(cloud([0.0, np.nan], [0.0, 0.0], [1e-9, 1e-9]))
    state = view.state()
    assert (state["points"], state["left_out"]) == (2, 1)


def test_a_point_on_no_machine_neither_stretches_the_map_nor_spoils_a_cell(clock):
    view = LiveView(monotonic=clock)
    good = (np.linspace(-1e-3, 1e-3, 500), np.zeros(500), np.full(500, 5e-9))
    view.add_points(cloud(*good))
    before = view.state()["grid"]["pitch"]
    for far in ([3e38, 0.0, 1e-9], [0.0, -1e30, 1e-9], [0.0, 0.0, 1e300]):
        view.add_points(cloud(*([value] for value in far)))
    view.add_points(cloud([0.0], [0.0], [5e-9], error=np.float32(3e38)))
    state = view.state()
    assert state["left_out"] == 4
    assert state["grid"]["pitch"] == before
    *_, layers = unpacked(view.news(-1, 0))
    assert np.isfinite(layers).all()


def add_states(view, count):
    for k in range(count):
        view.add_state(f"/omsm/{k}", "OK", "x" * 10_000, {"k" * 10_000: "v" * 100_000})


def test_a_stranger_with_any_number_of_names_fills_no_memory(clock):
    view = LiveView(monotonic=clock)
    view.add_state("/omsm/corrector", "OK", "correcting", {})
    with pytest.raises(DataError, match=r"more than 64 nodes.*diagnostics"):
        add_states(view, 1000)
    view.add_state("/omsm/corrector", "WARN", "no calibration", {})
    state = view.state()
    assert len(state["nodes"]) == 64
    assert len(str(state)) < 64 * 10_000
    assert state["nodes"][0]["message"] == "no calibration"


def test_after_the_measurement_the_light_is_its_result(clock, true_calibration):
    """Nodes that have ended by then are no fault."""
    view = LiveView(monotonic=clock)
    view.set_calibration(true_calibration)
    view.add_state("/omsm/corrector", "OK", "correcting", {})
    ended = {"measurement_ended": "yes"}
    view.add_state("/omsm/cell_demo", "OK", "being adjusted", ended)
    clock.now += 60.0
    assert view.state()["light"]["word"] == "Evaluating"
    assert view.state()["light"]["colour"] == "amber"
    found = ended | {
        "verdict": "contradicted",
        "verdict_text": "contradicted",
        "verdict_next": "a; b",
    }
    view.add_state("/omsm/cell_demo", "OK", "PV 1 µm", found)
    light = view.state()["light"]
    assert light == {"colour": "red", "word": "PV 1 µm", "reasons": ["contradicted", "a", "b"]}
