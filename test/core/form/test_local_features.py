"""Peak to valley of a part with a local defect, against the defect itself; plain numpy."""

import numpy as np
import pytest
from soaked import always, soaked

from omsm_ros.core.form.analyse import ZERNIKES, optical_terms
from omsm_ros.core.form.deviation_map import DeviationMap
from omsm_ros.core.form.part_extents import extents_of_parts
from omsm_ros.core.form.part_figures import Gaps, SmoothTerms, rms_of_part
from omsm_ros.core.form.zernike_fit import RimStrip, fit_zernikes
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.area_weights import area_weights

R, NOISE = 12.7e-3, 10e-9


def gaps_of(map_, outline, spacing):
    """Return the gaps of the map with the strip along its rim."""
    places = np.stack([map_.x, map_.y])
    strip = RimStrip.of(places, map_.area, outline, spacing, ZERNIKES[:1], outline.disc)
    return Gaps.of(map_, outline, spacing, strip)


X, Y = (v.ravel() for v in np.meshgrid(*[np.linspace(-R, R, 200)] * 2))
INSIDE = np.hypot(X, Y) <= R
X, Y = X[INSIDE], Y[INSIDE]
FORMS = {
    "smooth": 0 * X,
    "groove": -60e-9 * (np.abs(0.6 * X + 0.8 * Y - 2e-3) < 0.25e-3),
    "pip": 150e-9 * np.exp(-(((X - 1e-3) / 0.4e-3) ** 2) - (Y / 0.4e-3) ** 2),
    "scratch": -150e-9 * ((np.abs(X - 3e-3) < 0.1e-3) & (np.abs(Y) < 4e-3)),
    "rolled edge": -400e-9 * np.clip((np.hypot(X, Y) - 0.9 * R) / (0.1 * R), 0, None) ** 3,
}


@pytest.mark.parametrize("name", always("scratch", of=FORMS))
def test_the_whole_peak_to_valley_contains_local_defects(name):
    form = 20e-9 * (X**2 - Y**2) / R**2 + FORMS[name]
    held = 0
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(0, NOISE, len(X))
        map_ = DeviationMap(x=X, y=Y, deviation=form + noise, area=np.ones(len(X)),
                            effects=np.empty((0, len(X))), noise=NOISE)  # fmt: skip
        whole, _ = extents_of_parts([map_], Aperture(R))[0]
        held += abs(whole.value - np.ptp(form)) <= 2 * whole.uncertainty
        assert whole.value + 2 * whole.uncertainty > 0.9 * np.ptp(form)
        assert whole.value > 0.8 * np.ptp(form)
    assert held >= 3


@pytest.mark.parametrize("noise", [5e-9, 14e-9])
def test_waves_too_fine_for_any_mean_widen_the_figure(noise):
    """A fingerprint about the highest place of a part, of 2.3 points a wave, below twice the noise.

    The scatter of its points exceeds the noise, whatever its mean.
    """
    form = 50e-9 * (Y**2 - X**2) / R**2
    form += 25e-9 * np.cos(2 * np.pi * X / 0.293e-3) * (np.hypot(X, Y - 0.8 * R) < 0.2 * R)
    for seed in range(3):
        scatter = np.random.default_rng(seed).normal(0, noise, len(X))
        map_ = DeviationMap(x=X, y=Y, deviation=form + scatter, area=np.ones(len(X)),
                            effects=np.empty((0, len(X))), noise=noise)  # fmt: skip
        whole = extents_of_parts([map_], Aperture(R))[0][0]
        assert abs(whole.value - np.ptp(form)) <= 2 * whole.uncertainty
        assert whole.uncertainty < 0.2 * np.ptp(form)


@pytest.mark.parametrize("turns", [60, 100])
def test_a_rolled_edge_beyond_the_last_whole_turn_belongs_to_the_figures(turns):
    """A spiral reaches the rim at one place only; the rest of it is up to a turn further in.

    Points of 100 turns are farther apart along a turn than the turns.

    Truth over the whole disc, in closed form: the rms of 500 nm ((r - 0.9 R) / 0.1 R)².
    """

    def rolled(r):
        return -500e-9 * np.clip((r / R - 0.9) / 0.1, 0, None) ** 2

    share = np.linspace(1, 0, 12_000)
    x, y = (R * share * f(2 * np.pi * turns * share) for f in (np.cos, np.sin))
    outline, spacing = Aperture(R), R / turns
    # With s = (r/R - 0.9) / 0.1 the mean square is 2 (0.1) ∫ s⁴ (0.9 + 0.1 s) ds.
    true = 500e-9 * np.sqrt(0.2 * (0.9 / 5 + 0.1 / 6))
    noise = np.random.default_rng(0).normal(0, 2e-9, len(x))
    map_ = DeviationMap(x=x, y=y, deviation=rolled(R * share) + noise, noise=2e-9,
                        area=area_weights(x, y, outline=outline),
                        effects=np.empty((0, len(x))))  # fmt: skip
    gaps = gaps_of(map_, outline, spacing)
    whole = extents_of_parts([map_], outline, gaps)[0][0]
    rms = rms_of_part(map_, gaps.square(map_.deviation))
    assert abs(whole.value - 500e-9) <= 2 * whole.uncertainty
    assert whole.uncertainty < 30e-9
    assert abs(rms.value - true) <= 2 * rms.uncertainty
    assert rms.uncertainty < 0.016 * true
    # The total rms of a drawing is without piston, 500 nm (0.2) ∫ s² (0.9 + 0.1 s) ds.
    fit = fit_zernikes(x, y, map_.deviation, ZERNIKES, outline, weights=map_.area)
    total = optical_terms(SmoothTerms.of(map_, outline, ZERNIKES), fit, gaps)["iso10110_RMSt"]
    known = np.sqrt(true**2 - (500e-9 * 0.2 * (0.3 + 0.025)) ** 2)
    assert abs(total.value - known) <= 2 * total.uncertainty
    assert total.uncertainty < 0.018 * known


def test_an_edge_that_flattens_towards_the_rim_is_continued_to_it():
    """The edge is Gaussian, and lowest where the last track is most of a track within the rim."""

    def form(r, angle):
        return -300e-9 * np.exp(-(((r - 1) / 0.26) ** 2)) - 40e-9 * r**3 * np.cos(angle - 0.35)

    share, turns = np.linspace(1, 1e-3, 10_000), 45
    turn = 2 * np.pi * turns * share
    x, y = (R * share * f(turn) for f in (np.cos, np.sin))
    noise, outline = np.random.default_rng(0).normal(0, 0.5e-9, len(x)), Aperture(R)
    map_ = DeviationMap(x=x, y=y, deviation=form(share, turn) + noise, noise=0.5e-9,
                        area=area_weights(x, y, outline=outline),
                        effects=np.empty((0, len(x))))  # fmt: skip
    whole = extents_of_parts([map_], outline, gaps_of(map_, outline, R / turns))[0][0]
    true = np.ptp(form(*np.meshgrid(np.linspace(0, 1, 400), np.linspace(0, 2 * np.pi, 400))))
    assert abs(whole.value - true) < 2 * whole.uncertainty < 12e-9


@pytest.mark.parametrize("corner", [(1, 1), (-1, 1), (-1, -1), (1, -1)])
def test_form_that_is_highest_in_a_corner_reaches_it(corner):
    """A spiral passes the corners of a rectangle within one of its turns."""
    share, turns, size = np.linspace(1, 0, 16_000), 60, np.array([[R], [0.7 * R]])
    turn = 2 * np.pi * turns * share + 0.3
    x, y = 1.45 * size * share * np.array([np.cos(turn), np.sin(turn)])
    outline = Aperture.of("rectangle", R, 0.7 * R)
    places = np.stack([x, y])[:, outline.holds(x, y)]
    form = 200e-9 * np.clip(corner @ (places / size) / 2, 0, None) ** 3
    map_ = DeviationMap(x=places[0], y=places[1], deviation=form, noise=1e-12,
                        area=area_weights(*places, outline=outline),
                        effects=np.empty((0, len(form))))  # fmt: skip
    gaps = gaps_of(map_, outline, 1.45 * 0.7 * R / turns)
    whole = extents_of_parts([map_], outline.disc, gaps)[0][0]
    assert abs(whole.value - 200e-9) <= 2 * whole.uncertainty < 10e-9


@pytest.mark.parametrize("angle", [0.4, *soaked(2.0, 3.6)])
def test_points_far_apart_along_steep_tracks_are_no_dust(angle):
    """Coma is steepest at the rim, where the points of a turn are two tracks apart."""
    way, turns = np.linspace(1, 0, 30_000), 100
    x, y = (1.01 * R * way * f(2 * np.pi * turns * (1 - way)) for f in (np.cos, np.sin))
    within = np.hypot(x, y) <= R
    x, y, outline = x[within], y[within], Aperture(R)
    form = 20e-9 * (3 * (x**2 + y**2) / R**2 - 2) * (x * np.cos(angle) + y * np.sin(angle)) / R
    map_ = DeviationMap(x=x, y=y, deviation=form, area=area_weights(x, y, outline=outline),
                        effects=np.empty((0, len(x))), noise=1e-12)  # fmt: skip
    whole = extents_of_parts([map_], outline, gaps_of(map_, outline, R / turns))[0][0]
    assert np.ptp(form) - 1e-12 < whole.value < 40e-9 + 2 * whole.uncertainty


@pytest.mark.parametrize("missing", [0.0, 0.25])
def test_the_rms_is_of_the_covered_part_of_the_rim(missing):
    """Astigmatism of 100 nm at the rim has a mean square of (100 nm)² / 6 on any such sector.

    A missing sector of the rim is no form that the tracks miss.
    """
    share = np.linspace(1, 0, 30_000)
    turn = 2 * np.pi * 60 * share
    x, y = (R * share * f(turn) for f in (np.cos, np.sin))
    form = 100e-9 * share**2 * np.cos(2 * turn)
    there = turn % (2 * np.pi) >= 2 * np.pi * missing
    outline = Aperture(R)
    map_ = DeviationMap(x=x[there], y=y[there], deviation=form[there], noise=0.0,
                        area=area_weights(x[there], y[there], outline=outline),
                        effects=np.empty((0, int(np.sum(there)))))  # fmt: skip
    rim = gaps_of(map_, outline, R / 60).square(map_.deviation)
    assert rms_of_part(map_, rim).value == pytest.approx(100e-9 / 6**0.5, rel=5e-3)


def test_a_rolled_edge_on_a_dense_map_is_no_higher_than_it_is():
    """Terms up to order 12 swing about an edge that falls within an eighth of the radius."""
    line = np.linspace(-R, R, 220)
    x, y = (v.ravel() for v in np.meshgrid(line, line))
    x, y = (v[np.hypot(x, y) <= R] for v in (x, y))
    far, random = np.hypot(x, y) / R, np.random.default_rng(3)
    form = (
        -170e-9 * np.clip((far - 0.875) / 0.125, 0, None) ** 1.44 + 20e-9 * (x * x - y * y) / R**2
    )
    off, disc = [], Aperture(float(np.hypot(x, y).max()))
    for _ in range(3):
        map_ = DeviationMap(x=x, y=y, deviation=form + random.normal(0, 3e-9, len(x)), noise=3e-9,
                            area=np.ones(len(x)), effects=np.empty((0, len(x))))  # fmt: skip
        whole = extents_of_parts([map_], disc, gaps_of(map_, disc, line[1] - line[0]))[0][0]
        # From the flank of the saddle within the fall to its other side at the rim.
        off.append((whole.value - 205.3e-9) / whole.uncertainty)
        assert whole.uncertainty < 3e-9
    assert np.sqrt(np.mean(np.square(off))) < 2


@pytest.mark.parametrize(
    ("along", "off", "bow"),
    [(1.0, 0.0, 0.0), (3.0, 0.25, 0.0), (1.0, 0.5, 250e-9), *soaked((3.0, 0.5, 0.0))],
)
def test_a_summit_between_two_tracks_belongs_to_the_figure(along, off, bow):
    """The neighbours across the tracks show how steep it is, also that of a ridge along them.

    off: of the summit from a track, along: its length over its width, in distances of the tracks
    bow: height of the ends of the part [m], above the highest point of the summit on a track
    """
    lines, points = np.linspace(-R, R, 81), np.linspace(-R, R, 240)
    x, y = (v.ravel() for v in np.meshgrid(points, lines))
    pitch, height = lines[1] - lines[0], 300e-9
    away = ((y - (3 + off) * pitch) / (0.9 * pitch)) ** 2 + (x / (0.9 * along * pitch)) ** 2
    noise = np.random.default_rng(0).normal(0, 1e-9, len(x))
    map_ = DeviationMap(x=x, y=y, noise=1e-9, area=np.ones(len(x)), effects=np.empty((0, len(x))),
                        deviation=height * np.exp(-away) + bow * (x / R) ** 2 + noise)  # fmt: skip
    square = Aperture(1.5 * R, outline="rectangle", sizes=(R, R))
    whole = extents_of_parts([map_], Aperture(1.5 * R), gaps_of(map_, square, pitch))[0][0]
    assert abs(whole.value - height) <= 2 * whole.uncertainty
    assert whole.uncertainty < 0.25 * height


@pytest.mark.parametrize("seed", [0, *soaked(1, 2)])
def test_a_pip_that_the_cells_divide_belongs_to_the_figure(seed):
    """A pip in the middle of four points, where the cells of any size about the middle meet.

    Four times the noise above the form at its nearest points, and half as high again between them.
    """
    lines = np.linspace(-R, R, 100)
    x, y = (v.ravel() for v in np.meshgrid(lines, lines))
    step = lines[1] - lines[0]
    pip = 60e-9 * np.exp(-(x**2 + y**2) / (1.1 * step) ** 2)
    form = 20e-9 * (x**2 - y**2) / R**2 + pip
    noise = np.random.default_rng(seed + 90).normal(0, NOISE, len(x))
    map_ = DeviationMap(x=x, y=y, deviation=form + noise, area=np.ones(len(x)),
                        effects=np.empty((0, len(x))), noise=NOISE)  # fmt: skip
    square = Aperture.of("rectangle", R, R)
    whole = extents_of_parts([map_], Aperture(1.5 * R), gaps_of(map_, square, step))[0][0]
    truth = 60e-9 + 20e-9
    assert abs(whole.value - truth) <= 2 * whole.uncertainty
    assert whole.uncertainty < 0.3 * truth


def test_the_peak_to_valley_of_fine_rings_is_not_stated_too_high():
    """10 nm of rings, seven to twelve turns of a spiral apart: thousands of points compete."""
    turns, score = 80, []
    way = np.sqrt(np.linspace(1e-4, 1, 20_000))
    r, angle = R * way, 2 * np.pi * turns * way
    x, y = r * np.cos(angle), r * np.sin(angle)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        period, phase = rng.uniform(7, 12) * R / turns, rng.uniform(0, 2 * np.pi)
        form = 10e-9 * np.cos(2 * np.pi * r / period + phase)
        form += rng.normal(0, 10e-9) * (x**2 - y**2) / R**2
        map_ = DeviationMap(x=x, y=y, deviation=form + rng.normal(0, 2e-9, len(x)),
                            area=np.ones(len(x)), effects=np.empty((0, len(x))),
                            noise=2e-9)  # fmt: skip
        whole = extents_of_parts([map_], Aperture(R), gaps_of(map_, Aperture(R), R / turns))[0][0]
        score.append((whole.value - np.ptp(form)) / whole.uncertainty)
    assert np.mean(score) < 1.3
    assert np.sum(np.abs(score) <= 2) >= 7


@pytest.mark.parametrize("off", [0.25, 0.5])
def test_the_apex_of_a_cone_between_the_points_belongs_to_the_figure(off):
    """A Gaussian through the points is flat where the apex is; the slope of the cone is not.

    off: of the apex from a track, and from a point along it, in distances of the tracks
    """
    lines = np.linspace(-R, R, 101)
    x, y = (v.ravel() for v in np.meshgrid(lines, lines))
    pitch, height = lines[1] - lines[0], 150e-9
    away = np.hypot(x - (3 + off) * pitch, y - (5 + off) * pitch) / (3.5 * pitch)
    noise = np.random.default_rng(1).normal(0, 1e-9, len(x))
    form = height * np.clip(1 - away, 0, None)
    map_ = DeviationMap(x=x, y=y, noise=1e-9, area=np.ones(len(x)), deviation=form + noise,
                        effects=np.empty((0, len(x))))  # fmt: skip
    square = Aperture.of("rectangle", R, R)
    whole = extents_of_parts([map_], Aperture(1.5 * R), gaps_of(map_, square, pitch))[0][0]
    assert abs(whole.value - height) <= 2 * whole.uncertainty
    assert whole.uncertainty < 0.12 * height


@pytest.mark.parametrize("draws", [5, *soaked(12)])
def test_undetected_terms_belong_to_the_uncertainty_at_a_corner(draws):
    """Form of orders 5 to 8 that no test shows is highest where the rim meets a missing sector."""
    share, off = np.linspace(1, 0, 20_000), []
    turn, outline = 2 * np.pi * 60 * share, Aperture(R)
    r, angle = np.stack([share, turn])[:, turn % (2 * np.pi) >= np.pi / 2]
    x, y = R * r * np.cos(angle), R * r * np.sin(angle)
    everywhere = np.meshgrid(np.linspace(0, 1, 200), np.linspace(np.pi / 2, 2 * np.pi, 600))
    for seed in range(draws):
        random = np.random.default_rng(seed)
        terms = [(n, m, random.normal(0, 0.2e-9), random.uniform(0, 6))
                 for n in (5, 6, 7, 8) for m in range(n, -1, -2)]  # fmt: skip

        def form(r, angle, terms=terms):
            rest = sum(a * r**n * np.cos(m * angle + phase) for n, m, a, phase in terms)
            return 15e-9 * r**2 * np.cos(2 * angle) + rest

        deviation = form(r, angle) + random.normal(0, 4e-9, len(x))
        map_ = DeviationMap(x=x, y=y, deviation=deviation, noise=4e-9,
                            area=area_weights(x, y, outline=outline),
                            effects=np.empty((0, len(x))))  # fmt: skip
        whole = extents_of_parts([map_], outline, gaps_of(map_, outline, R / 60))[0][0]
        off.append((whole.value - np.ptp(form(*everywhere))) / whole.uncertainty)
    assert np.sqrt(np.mean(np.square(off))) < 1.4


def spiral(turns, per_turn):
    """Return x, y of a spiral whose points of all turns lie on the same ``per_turn`` rays."""
    share = np.linspace(0, 1, turns * per_turn)
    return tuple(R * share * f(2 * np.pi * turns * share) for f in (np.cos, np.sin))


def test_a_bump_between_two_rays_of_a_spiral_belongs_to_the_figure():
    """Points of a fast spiral are four turns apart along a turn."""
    (x, y), outline = spiral(160, 125), Aperture(R)
    away = x + 1j * y - 0.55 * R * np.exp(2j * np.pi * 0.75 / 125)
    form = 300e-9 * np.exp(-((np.abs(away) / (0.02 * R)) ** 2)) + 20e-9 * (x**2 - y**2) / R**2
    noise = np.random.default_rng(0).normal(0, 1e-9, len(x))
    map_ = DeviationMap(x=x, y=y, deviation=form + noise, noise=1e-9,
                        area=area_weights(x, y, outline=outline),
                        effects=np.empty((0, len(x))))  # fmt: skip
    spacing = R * np.sqrt(np.pi / len(x))
    whole = extents_of_parts([map_], outline, gaps_of(map_, outline, spacing))[0][0]
    # The summit lies on the hillside of the saddle.
    true = 300e-9 + 20e-9 * (0.55**2 + 1)
    assert abs(whole.value - true) <= 2 * whole.uncertainty
    assert whole.uncertainty < 0.2 * true


@pytest.mark.parametrize("draws", [3, *soaked(6)])
def test_waves_are_continued_to_the_rim_with_their_noise(draws):
    """Plane waves of 60 nm cross the rim of a spiral, highest where the last turn has no point."""
    (x, y), outline, off, noise = spiral(120, 250), Aperture(R), [], 1e-9
    rim = R * np.exp(2j * np.pi * np.linspace(0, 1, 3600))
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        wave = 2 * np.pi * np.exp(1j * rng.uniform(0, 2 * np.pi)) / rng.uniform(0.2, 0.3) / R
        phase = rng.uniform(0, 2 * np.pi)

        def form(z, wave=wave, phase=phase):
            """Return waves that grow outwards, so that the highest place is at the rim."""
            return 60e-9 * (np.abs(z) / R) ** 6 * np.cos((z * np.conj(wave)).real + phase)

        deviation = form(x + 1j * y) + rng.normal(0, noise, len(x))
        map_ = DeviationMap(x=x, y=y, deviation=deviation, noise=noise,
                            area=area_weights(x, y, outline=outline),
                            effects=np.empty((0, len(x))))  # fmt: skip
        spacing = R * np.sqrt(np.pi / len(x))
        whole = extents_of_parts([map_], outline, gaps_of(map_, outline, spacing))[0][0]
        off.append((whole.value - np.ptp(form(rim))) / whole.uncertainty)
        assert whole.uncertainty < 4 * noise + 0.5e-9
    assert np.sqrt(np.mean(np.square(off))) < 1.4
