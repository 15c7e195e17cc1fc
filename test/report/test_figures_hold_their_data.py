"""Figures draw the given arrays in the units of their axes."""

from __future__ import annotations

import io
from datetime import datetime
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.image import imread

from omsm_ros.core.calibration.verification import PathCheck
from omsm_ros.core.comparison.agreement import ComparedTerm
from omsm_ros.core.comparison.compare import compare_measurements_of_part
from omsm_ros.core.comparison.stated_errors import ComparedMeasurement as Measured
from omsm_ros.core.kinematics.trajectories import Chirp
from omsm_ros.core.ripple.density import density
from omsm_ros.core.ripple.ripple_guard import NamedLine
from omsm_ros.core.ripple.scan_signal import PATH, TIME, ScanSignal
from omsm_ros.core.ripple.source_hypotheses import KINDS, PART, VIBRATION
from omsm_ros.core.ripple.spectral_line import SpectralLine
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.pipelines import paper_experiments as experiment_figures
from omsm_ros.report import campaign, style
from omsm_ros.report import campaign as campaign_page
from omsm_ros.report import difference as difference_figures
from omsm_ros.report import spectrum as spectrum_figures

DAY_NS = 86_400 * 10**9


def points_of(axes, label=None):
    """The lines of axes that have points, of one label."""
    lines = [line for line in axes.get_lines() if len(line.get_xdata())]
    return [line for line in lines if label is None or line.get_label() == label]


@pytest.fixture
def drawn(monkeypatch):
    """The figures that become pictures."""
    made, real = [], style.png
    monkeypatch.setattr(
        style, "png", lambda figure, dpi=40: made.append(figure) or real(figure, 20)
    )
    return made


# Two measurements.


@pytest.fixture(scope="module")
def found():
    at = np.linspace(-5e-3, 5e-3, 41)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    inside = np.hypot(x, y) < 5e-3
    x, y = x[inside], y[inside]

    def one(name, size, seed):
        noise = np.random.default_rng(seed).normal(0, 1e-9, len(x))
        height = size * (x**3 - 3 * x * y**2) / 5e-3**3 + noise
        points = MeasuredPoints(x=x, y=y, height=height)
        return Measured(name=name, points=points, common=2e-9)

    return compare_measurements_of_part(one("a", 300e-9, 0), one("b", 260e-9, 1))


@pytest.mark.parametrize("name", ["profile_x", "profile_y", "profile_radius"])
def test_the_difference_below_is_a_less_b_above(found, name):
    upper, lower = difference_figures.profiles(found)[name].axes
    (a,), (b,), (left,) = (points_of(upper, "A"), points_of(upper, "B"), points_of(lower, "A − B"))
    assert upper.get_ylabel() == "height [nm]"
    assert lower.get_ylabel() == "A − B [nm]"
    for line in (b, left):
        np.testing.assert_array_equal(line.get_xdata(), a.get_xdata())
    np.testing.assert_allclose(left.get_ydata(), a.get_ydata() - b.get_ydata(), atol=1e-6)
    assert np.all(np.diff(a.get_xdata()) > 0)


def test_a_profile_is_the_mean_of_the_points_along_its_line(found):
    """Compare with a loop: each value is within the range of its neighbours on the line."""
    lower = difference_figures.profiles(found)["profile_x"].axes[1]
    (line,) = points_of(lower, "A − B")
    matched = found.matched
    side = matched.grid.dx
    y = matched.y - (matched.y.min() + matched.y.max()) / 2
    near = np.abs(y) <= 1.5 * side * (1 + 1e-9)
    x = matched.x - (matched.x.min() + matched.x.max()) / 2
    for at, value in zip(line.get_xdata(), line.get_ydata(), strict=True):
        adjacent = matched.difference[near & (np.abs(x - at * 1e-3) <= 1.5 * side)] * 1e9
        assert adjacent.min() <= value <= adjacent.max()
        assert value == pytest.approx(np.mean(adjacent), abs=np.ptp(adjacent) / 2)
    (band,) = lower.collections
    heights = band.get_paths()[0].vertices[:, 1]
    spread = found.agreement.uncertainty[near] * 1e9
    assert 2 * spread.min() - 1e-6 <= heights.max() <= 2 * spread.max() + 1e-6
    assert heights.min() == pytest.approx(-heights.max())


def test_every_term_is_a_bar_of_its_e_n_and_beyond_one_it_is_red():
    e_n = [0.3, -0.9, 1.2, -4.0, 0.0]
    numbers = [ComparedTerm(n, n - 2, 1e-9, 1e-9, 1e-9, v) for n, v in enumerate(e_n, 2)]
    (axes,) = difference_figures.terms(numbers).axes
    assert [bar.get_height() for bar in axes.patches] == e_n
    red = [to_hex(bar.get_facecolor()).upper() == style.BEFORE for bar in axes.patches]
    assert red == [abs(v) > 1 for v in e_n]
    assert [t.get_text() for t in axes.get_xticklabels()] == ["2,0", "3,1", "4,2", "5,3", "6,4"]
    bounds = {float(line.get_ydata()[0]) for line in axes.get_lines()}
    assert {-1.0, 0.0, 1.0} == bounds
    assert axes.get_ylim()[1] >= 4.0


# A campaign, and months of machines.


def bag(k, rms, days=None):
    summary = {"figures": {"rms": {"value": rms}, "peak_to_valley": {"value": 5 * rms}}}
    return campaign_page.CampaignEntry(
        f"{k}.mcap", "done", "", None if days is None else int(days * DAY_NS), "", summary
    )


@pytest.mark.parametrize("timed", [True, False])
def test_a_campaign_is_drawn_over_its_days_or_its_order(drawn, true_calibration, timed):
    rms = 20e-9 + 1e-9 * np.sin(np.arange(12.0))
    rms[7] = 90e-9
    days = np.sort(np.random.default_rng(4).uniform(100, 130, 12)) if timed else [None] * 12
    reported = [bag(k, *pair) for k, pair in enumerate(zip(rms, days, strict=True))]
    campaign_page.render("C", reported, true_calibration)
    (figure,) = drawn
    first, second = figure.axes
    place = np.asarray(days, float) - days[0] if timed else np.arange(12.0)
    for axes, scale in ((first, 1e9), (second, 5e9)):
        usual, outlying = points_of(axes)
        assert outlying.get_xdata() == pytest.approx([place[7]], abs=1e-6)
        assert outlying.get_ydata() == pytest.approx([rms[7] * scale])
        assert usual.get_xdata() == pytest.approx(np.delete(place, 7), abs=1e-6)
        assert usual.get_ydata() == pytest.approx(np.delete(rms, 7) * scale)
        assert axes.get_ylabel() == "nm"
        assert axes.get_ylim()[0] <= 0
    if timed:
        assert second.get_xlabel() == "days since the first recording"
    else:
        named = zip(second.get_xticks(), second.get_xticklabels(), strict=True)
        assert all(text.get_text() == reported[int(place)].name for place, text in named)


def calibrated(k, verdict="accepted", delay=3.4e-4):
    day = datetime(2026, 1, 1 + k)
    return {
        "verdict": verdict, "delay": delay, "delay_uncertainty": 1e-6, "static_gain": 0.99 + k,
        "static_gain_uncertainty": None, "recorded_at": day, "added_at": day,
    }  # fmt: skip


def test_each_machine_has_its_colour_and_a_rejected_calibration_is_a_cross(drawn):
    machines = [
        {
            "machine": "one $x$",
            "calibrations": [calibrated(0), calibrated(1, "rejected", 5e-4),
                             calibrated(2, delay=None)],
            "measurements": [{"deviation_rms": 21e-9, "deviation_rms_uncertainty": 3e-9,
                              "recorded_at": None,
                              "added_at": datetime(2026, 2, 3)}],
        },
        {"machine": "", "calibrations": [calibrated(3)], "measurements": []},
    ]  # fmt: skip
    png = campaign.draw(machines)
    assert imread(io.BytesIO(png)).shape[2] == 4
    lag, gain, form = drawn[0].axes
    marks = [(line.get_marker(), line.get_ydata().tolist()) for line in points_of(lag)]
    assert [(m, pytest.approx(v)) for m, v in marks if m in "ox"] == [
        ("o", [340.0]), ("x", [500.0]), ("o", [340.0]),
    ]  # fmt: skip
    # Two standard uncertainties to either side, in microseconds.
    bars = [c.get_segments()[0] for c in lag.collections]
    assert [np.ptp(bar[:, 1]) for bar in bars] == pytest.approx([4.0] * 3)
    assert sorted(v for line in points_of(gain) for v in line.get_ydata()) == pytest.approx(
        [0.99, 1.99, 2.99, 3.99]
    )
    (dot,) = points_of(form)
    assert dot.get_ydata() == pytest.approx([21.0])
    assert dot.get_xdata()[0] == datetime(2026, 2, 3)
    labels = [text.get_text() for text in lag.get_legend().get_texts()]
    assert labels == [r"one \$x\$", "not named"]
    colours = {line.get_color() for line in points_of(lag)}
    assert len(colours) == 2


def test_a_history_of_nothing_is_a_picture(drawn):
    assert campaign.draw([]).startswith(b"\x89PNG")
    assert drawn[0].axes[0].get_legend() is None


# A free path.


def test_errors_and_lags_of_a_free_path_are_those_of_their_bands():
    rng = np.random.default_rng(5)
    count, bands = 4000, ((2.0, 3.0), (7.0, 8.0))
    frequency = rng.uniform(0, 10, count)
    columns = {name: rng.normal(0, 1e-8, count) for name in ("error_before", "error_after")}
    columns |= {name: rng.normal(0.1, 0.01, count) for name in ("lag_before", "lag_after")}
    check = PathCheck(frequency=frequency, rms_before=1.0, rms_after=1.0, excited=bands, **columns)
    time = np.arange(count) * 1e-3
    made = SimpleNamespace(
        axes=SimpleNamespace(sample_period=1e-3, z=time * 1e-3),
        distance=SimpleNamespace(distance=-time * 1e-3),
    )
    _, over, rms, lag = experiment_figures.chirp_figure(made, check, np.array([0.1, 0.2])).axes
    # The motion states its frequency; the lag is that at the frequency of the Hilbert transform.
    true = np.linspace(0.0, Chirp().end_frequency, count)
    for side in ("before", "after"):
        (line,), (angle,) = points_of(rms, side), points_of(lag, side)
        assert line.get_xdata().tolist() == angle.get_xdata().tolist() == [2.5, 7.5]
        for k, (low, high) in enumerate(bands):
            inside = [i for i, f in enumerate(frequency) if low <= f < high]
            swept = columns[f"error_{side}"][(true >= low) & (true < high)]
            squares = list(swept**2)
            mean = sum(columns[f"lag_{side}"][i] for i in inside) / len(inside)
            assert line.get_ydata()[k] == pytest.approx(1e9 * (sum(squares) / len(squares)) ** 0.5)
            assert angle.get_ydata()[k] == pytest.approx(np.degrees(mean))
    (of_model,) = points_of(lag, "true response")
    assert of_model.get_ydata() == pytest.approx(np.degrees([0.1, 0.2]))
    for side in ("before", "after"):
        (line,) = points_of(over, side)
        assert line.get_ydata() == pytest.approx(1e9 * columns[f"error_{side}"])


# Spectra.


def studied(name="scan", count=4096, speed=0.01, seed=0, tone=None):
    """Return white noise of 2 nm on a scan with constant speed along its path."""
    sample = np.arange(count)
    path = sample * 1e-3 * speed
    values = np.random.default_rng(seed).normal(0, 2e-9, count)
    if tone:
        values += tone[1] * np.sin(2 * np.pi * tone[0] * sample * 1e-3)
    signal = ScanSignal(
        name=name,
        period=1e-3,
        sample=sample,
        height=values,
        path=path,
        radius=np.full(count, 5e-3),
        turn=sample * 5e-4,
    )
    return SimpleNamespace(
        signal=signal, coordinates={PATH: None} if speed else {},
        density=lambda axis: density(values, 1e-3 if axis == TIME else 1e-3 * speed),
    )  # fmt: skip


def named(kind, amplitude, **possible):
    line = SpectralLine(
        coordinate=TIME, frequency=1.0, cosine=amplitude, sine=0.0, possible=possible
    )
    return NamedLine(line=line, kind=kind)


def test_white_noise_stands_at_its_density_over_time_and_along_the_path():
    """One-sided, σ²·2T: 2 nm at 1 kHz are 0.0894 nm/√Hz; at 10 µm a sample 0.283 nm·√mm."""
    one = studied()
    (axes,) = spectrum_figures.densities([(one, [])], TIME).axes
    (curve,) = points_of(axes)
    inside = (curve.get_xdata() > 20) & (curve.get_xdata() < 480)
    level = np.sqrt(np.mean(curve.get_ydata()[inside] ** 2))
    assert level == pytest.approx(2 * np.sqrt(2e-3), rel=0.1)
    (axes,) = spectrum_figures.densities([(one, [])], PATH).axes
    curve, limit = points_of(axes)
    assert limit.get_xdata()[0] == pytest.approx(20.0)
    inside = (curve.get_xdata() > 22) & (curve.get_xdata() < 500)
    assert np.sqrt(np.mean(curve.get_ydata()[inside] ** 2)) == pytest.approx(
        2 * np.sqrt(2 * 0.01), rel=0.1
    )


def test_a_line_is_marked_where_and_as_high_as_it_stands():
    one = studied(tone=(100.0, 50e-9))
    lines = [named(VIBRATION, 50e-9, **{TIME: 100.0}), named(PART, 8e-9, **{PATH: 2e4})]
    (axes,) = spectrum_figures.densities([(one, lines)], TIME).axes
    curve, dot, *_ = points_of(axes)
    duration = len(one.signal) * 1e-3
    assert dot.get_xdata() == pytest.approx([100.0])
    # Amplitude a has the power a²/2, in one resolution 1/T.
    assert dot.get_ydata() == pytest.approx([50 * np.sqrt(duration / 2)])
    assert to_hex(dot.get_color()).upper() == spectrum_figures.COLOURS[VIBRATION]
    peak = curve.get_xdata()[np.argmax(curve.get_ydata())]
    assert peak == pytest.approx(100.0, rel=0.05)
    (axes,) = spectrum_figures.densities([(one, lines)], PATH).axes
    _, dot, _ = points_of(axes)
    assert dot.get_xdata() == pytest.approx([50.0])
    assert dot.get_ydata() == pytest.approx([8 * np.sqrt(one.signal.path[-1] * 1e3 / 2)])
    assert to_hex(dot.get_color()).upper() == spectrum_figures.COLOURS[PART]


def test_a_scan_that_stands_still_has_no_path():
    assert spectrum_figures.densities([(studied(speed=0.0), [])], PATH) is None
    both = [(studied(speed=0.0), []), (studied("moves"), [])]
    (axes,) = spectrum_figures.densities(both, PATH).axes
    assert axes.get_title("left") == "moves, along the path"
    assert len(spectrum_figures.densities(both, TIME).axes) == 2


def test_evidence_has_each_scan_on_its_row_and_each_line_at_its_frequency():
    scans = [
        (
            studied("a_1"),
            [named(VIBRATION, 1e-9, **{TIME: 50.0}), named(PART, 1e-9, **{PATH: 3.0})],
        ),
        (studied("b"), [named(PART, 1e-9, **{TIME: 80.0})]),
    ]
    (axes,) = spectrum_figures.evidence(scans).axes
    found = [
        (line.get_xdata()[0], np.mean(line.get_ydata()), to_hex(line.get_color()).upper())
        for line in axes.get_lines()
    ]
    colours = spectrum_figures.COLOURS
    assert found == [(50.0, 0.0, colours[VIBRATION]), (80.0, 1.0, colours[PART])]
    assert [t.get_text() for t in axes.get_yticklabels()] == ["a_1", "b"]
    assert axes.yaxis_inverted()
    assert spectrum_figures.evidence([(studied(), [named(PART, 1.0, **{PATH: 3.0})])]) is None


def test_kinds_have_colours_of_their_own():
    assert set(spectrum_figures.COLOURS) == set(KINDS)
    assert len(set(spectrum_figures.COLOURS.values())) == len(KINDS)


def test_the_motion_is_grey_from_where_nothing_is_calibrated():
    moved = density(1e-6 * np.sin(0.1 * np.arange(2000)), 1e-3)
    (axes,) = spectrum_figures.motion([("a $b$", moved)], 62.0).axes
    (span,) = axes.patches
    left, right = span.get_x(), span.get_x() + span.get_width()
    assert (left, right) == pytest.approx((62.0, moved.frequency[-1]))
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == [r"a \$b\$", "not calibrated"]
    (curve,) = points_of(axes, r"a \$b\$")
    peak = curve.get_xdata()[np.argmax(curve.get_ydata())]
    assert peak == pytest.approx(0.1 / (2 * np.pi * 1e-3), rel=0.05)
    assert not spectrum_figures.motion([("a", moved)], None).axes[0].patches
