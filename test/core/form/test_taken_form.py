"""Form that the fit took for a move is missing from the deviations, and may lie elsewhere.

Parts are seen by a model of their own: heights of a biconic by its closed form, turned and moved
point by point.
"""

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.form.analyse import analyse_form
from omsm_ros.core.form.deviation_map import DeviationMap
from omsm_ros.core.form.part_extents import extents_of_parts
from omsm_ros.core.form.part_figures import rms_of_part
from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.aspheres import Biconic

RADIUS = 5e-3
_TERMS = {(2, 2): 1.0, (2, -2): 1.0, (3, 1): 0.4, (3, -1): 0.4, (3, 3): 0.4, (4, 2): 0.2}


def spiral(points=6000):
    r, angle = RADIUS * np.sqrt(np.linspace(1, 1e-6, points)), np.linspace(0, 200 * np.pi, points)
    return r * np.cos(angle), r * np.sin(angle)


def term(n, m, x, y):
    r, angle = np.hypot(x, y) / RADIUS, np.arctan2(y, x)
    radial = {2: r**2, 3: r**3 if abs(m) == 3 else 3 * r**3 - 2 * r, 4: 4 * r**4 - 3 * r**2}[n]
    return radial * (np.cos(m * angle) if m > 0 else np.sin(-m * angle))


def measured(curvature, conic, size, rng):
    """Return points of a biconic with form of about ``size`` [m], off in all six; and its form."""
    of_form = {key: size * share * rng.standard_normal() for key, share in _TERMS.items()}
    (a, b), (k, q) = curvature, conic

    def height(x, y):
        root = np.sqrt(1 - (1 + k) * (a * x) ** 2 - (1 + q) * (b * y) ** 2)
        return (a * x**2 + b * y**2) / (1 + root)

    x, y = spiral()
    step = 1e-7
    slopes = np.stack([
        height(x + step, y) - height(x - step, y), height(x, y + step) - height(x, y - step),
        np.full(len(x), -2 * step),
    ])  # fmt: skip
    form = sum(value * term(*key, x, y) for key, value in of_form.items())
    part = np.stack([x, y, height(x, y)]) - slopes / np.linalg.norm(slopes, axis=0) * form
    # A turn about the vertex by 3 to 9 mrad about x, y and z in turn.
    for axis, turn in enumerate(rng.uniform(3e-3, 9e-3, 3) * rng.choice([-1, 1], 3)):
        one, other = [k for k in range(3) if k != axis][:: -1 if axis == 1 else 1]
        c, s = np.cos(turn), np.sin(turn)
        part[one], part[other] = c * part[one] - s * part[other], s * part[one] + c * part[other]
    part += rng.uniform(-4e-4, 4e-4, 3)[:, np.newaxis]
    noisy = part[2] + 5e-9 * rng.standard_normal(len(x))
    return PointBatch(part[0], part[1], noisy, np.empty((0, len(x)))), (x, y, form)


# Radii of curvature 118 and -174 mm, and 197 and 79 mm: on both the first fit went to and fro by
# millimetres, for what a move of that size does is less than the form.
CASES = [
    ((8.5, -5.75), (-0.74, -1.01), 1),
    *soaked(
        ((5.08, 12.67), (-1.54, -0.89), 2),
        ((-6.1, 13.4), (0.9, -1.5), 3),
        ((12.5, -20.0), (-1.4, 0.96), 4),
    ),
]


@pytest.mark.parametrize(("curvature", "conic", "seed"), CASES)
def test_figures_of_a_biconic_clamped_askew_hold_its_form(curvature, conic, seed):
    rng = np.random.default_rng(seed)
    portion, (x, y, true) = measured(curvature, conic, 50e-9, rng)
    nominal = Biconic(1 / curvature[0], 1 / curvature[1], *conic)
    found = analyse_form(nominal, lambda: [portion], ("auto",), aperture=Aperture(RADIUS))
    # Points are as dense as their area.
    for name, truth in (("peak_to_valley", np.ptp(true)), ("rms", np.sqrt(np.mean(true**2)))):
        figure = found.deviation[name]
        assert abs(figure.value - truth) < 2.5 * figure.uncertainty, name
        # Not because nothing is known.
        assert figure.uncertainty < 30 * truth, name
    fit = found.zernike
    own = np.stack([term(*key, x, y) for key in _TERMS])
    shares = np.linalg.lstsq(own.T, true, rcond=None)[0]
    places = {(t.n, t.m): k for k, t in enumerate(fit.terms)}
    for key, share in zip(_TERMS, shares, strict=True):
        k = places[key]
        assert abs(fit.coefficients[k] - share) < 3 * fit.uncertainty[k], key


def test_form_that_was_taken_away_is_added_again_on_the_average():
    """Astigmatism of which a fit leaves half: E f² = E m² + E (f - m)² where m = E (f | data)."""
    rng = np.random.default_rng(5)
    x, y = spiral(2000)
    shape = term(2, 2, x, y)
    squares, reported = [], []
    for _ in range(200):
        kept, lost = 30e-9 * rng.standard_normal(2)
        seen = DeviationMap(
            x=x, y=y, deviation=kept * shape, area=np.ones(len(x)), noise=0.0,
            effects=30e-9 * shape[np.newaxis], taken=np.eye(1),
        )  # fmt: skip
        squares.append(np.mean(((kept + lost) * shape) ** 2))
        reported.append(rms_of_part(seen).value ** 2)
    assert np.mean(reported) == pytest.approx(np.mean(squares), rel=0.25, abs=0)
    whole, _ = extents_of_parts([seen], Aperture(RADIUS))[0]
    # The extent of c times the last shape is twice c.
    assert whole.value == pytest.approx(2 * np.hypot(kept, 30e-9), rel=0.15)
