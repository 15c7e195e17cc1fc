"""Figures of parts whose measured area is known to a step of the scan only, in closed form."""

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.form.analyse import analyse_form
from omsm_ros.core.form.deviation_map import DeviationMap
from omsm_ros.core.form.part_figures import Gaps, rms_of_part
from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.registration.register import register
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.area_weights import area_weights, errors_at_gaps
from omsm_ros.core.surface.nominal import Flat

R = 5e-3
POSE = ("piston", "tip", "tilt")


def lines(count, each, off):
    """Return a raster within a square of half length one, its first line ``off`` steps inside."""
    along = np.linspace(-1, 1, each) * np.where(np.arange(count) % 2, -1, 1)[:, np.newaxis]
    return along.ravel(), np.repeat(2 * (np.arange(count) + off) / count - 1, each)


def turns(count, each, off):
    """Return a spiral of radius one with ``each`` points a turn, which are ``off`` steps on."""
    step = np.arange(1, count * each + 1)
    turn = 2 * np.pi * (step - 1 + off) / each
    return step / count / each * np.array([np.cos(turn), np.sin(turn)])


def map_of(x, y, form, outline):
    return DeviationMap(x=x, y=y, deviation=form, area=area_weights(x, y, outline=outline),
                        effects=np.empty((0, len(x))), noise=0.0)  # fmt: skip


@pytest.mark.parametrize("off", [0.05, *soaked(0.5), 0.95])
def test_a_guessed_outline_is_off_by_up_to_half_a_track_at_either_edge(off):
    """A part curls up by 200 nm s⁶ towards two of its edges: mean 200 nm / 7, mean square / 13."""
    x, y = R * np.array(lines(40, 80, off))
    batch = PointBatch(x, y, 200e-9 * (y / R) ** 6, np.empty((0, len(x))))
    known, guessed = (
        analyse_form(Flat(), lambda: [batch], POSE, aperture=aperture).deviation
        for aperture in (Aperture.of("rectangle", R, R), None)
    )
    for name, true in (("rms", 200e-9 * (1 / 13 - 1 / 49) ** 0.5), ("peak_to_valley", 200e-9)):
        assert abs(guessed[name].value - true) <= 2 * guessed[name].uncertainty < 0.35 * true
        assert abs(known[name].value - true) <= 2 * known[name].uncertainty
        assert known[name].uncertainty < 0.6 * guessed[name].uncertainty


def test_the_border_of_a_gap_is_uncertain_by_a_step():
    """Points of all turns reach a missing sector at the same angles, anywhere within a step.

    The mean square of r² cos 2θ over the other angles is in closed form.
    """
    outline, off = Aperture(1.0), []
    for first in np.linspace(0, 1, 12, endpoint=False):
        x, y = turns(40, 150, first)
        there = np.abs(np.angle(x + 1j * y)) > 0.5
        x, y = x[there], y[there]
        map_ = map_of(x, y, 1e-7 * (x**2 - y**2), outline)
        gaps = Gaps.of(map_, outline, 1 / 40, uncovered=0.16)
        found = rms_of_part(map_, gaps.square(map_.deviation))
        mean = 0.5 + np.sin(4 * -0.5) / (8 * (np.pi - 0.5))
        off.append((found.value - 1e-7 * (mean / 3) ** 0.5) / found.uncertainty)
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.parametrize(("parallel", "both"), [(True, False), (False, False), (False, True)])
def test_the_area_at_a_gap_is_uncertain_by_a_step(parallel, both):
    """Lines end at a gap, or are parallel to its border; each area of a square step is 1/400.

    Two borders of a gap, or ends of lines to and fro, are off independently.
    """
    outline, (x, y) = Aperture.of("rectangle", 1.0, 1.0), lines(40, 40, 0.5)
    way = y if parallel else x
    there = (way < 0.1) | ((way > 0.6) & both)
    errors = errors_at_gaps(x[there], y[there], outline, 1 / 20)(np.ones(np.sum(there)))
    # A step of the border over the covered area is rectangular, so over √12.
    stated = 40 / np.sum(there) / 12**0.5
    factor = 2**0.5 if both else 1 if parallel else 0.5**0.5
    assert np.linalg.norm(errors) == pytest.approx(factor * stated, rel=0.05)


def test_the_rms_of_form_between_tracks_has_errors_as_large_as_stated():
    """A Gaussian ridge, a third of a track wide: its mean square over the square is w √π / 2."""
    outline, width, off = Aperture.of("rectangle", 1.0, 1.0), 0.35 / 30, []
    for place in np.linspace(-0.3, 0.3, 16):
        x, y = lines(60, 60, 0.5)
        map_ = map_of(x, y, 1e-7 * np.exp(-(((y - place) / width) ** 2) / 2), outline)
        found = rms_of_part(map_)
        true = 1e-7 * (width * np.pi**0.5 / 2) ** 0.5
        off.append((found.value - true) / found.uncertainty)
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.6


def test_form_that_turns_resolve_leaves_hardly_an_error():
    """A Gaussian ridge of two turns on astigmatism; the mean square over chords of the disc."""
    outline, width, off = Aperture(1.0), 2 / 60, []
    at = np.linspace(-1, 1, 20_001)
    chord, mean = 2 * np.sqrt(1 - at**2) / np.pi, at**2 - (1 - at**2) / 3
    for place in np.linspace(0.3, 0.6, 8):
        x, y = turns(60, 233, place)
        ridge, along = (np.exp(-(((v - place) / width) ** 2) / 2) for v in (x, at))
        found = rms_of_part(map_of(x, y, 1e-7 * (ridge + x**2 - y**2), outline))
        square = 1 / 6 + np.trapezoid(chord * (along**2 + 2 * along * mean), at)
        off.append((found.value - 1e-7 * square**0.5) / found.uncertainty)
        assert found.uncertainty < 0.05e-9
    assert 0.1 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_the_pose_of_a_part_with_a_gap_is_uncertain_by_its_border():
    """Tilts that 100 nm r² cos 2θ and its like have over the angles that are not missing."""
    off = []
    u, v = np.stack(np.meshgrid(*[(np.arange(1000) + 0.5) / 500 - 1] * 2)).reshape(2, -1)
    covered = (np.hypot(u, v) <= 1) & (np.abs(np.angle(u + 1j * v)) > 0.5)
    columns = np.stack([np.ones_like(u), u, v], 1)[covered]
    plane = np.linalg.lstsq(columns, 1e-7 * (u**2 - v**2 + u * v)[covered], rcond=None)[0]
    for first in (0.0, 0.3, 0.6, 0.9):
        x, y = turns(40, 150, first)
        there = np.abs(np.angle(x + 1j * y)) > 0.5
        x, y = R * x[there], R * y[there]
        height = 1e-7 * (x**2 - y**2 + x * y) / R**2
        batch = PointBatch(x, y, height, np.empty((0, len(x))))
        found = register(Flat(), lambda batch=batch: [batch], POSE, aperture=Aperture(R))
        pose, u = found.placement.pose, found.spread
        off += [(pose.piston - plane[0]) / u["piston"], (pose.tilt + plane[1] / R) / u["tilt"],
                (pose.tip - plane[2] / R) / u["tip"]]  # fmt: skip
    assert np.max(np.abs(off)) < 2.5
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.4
