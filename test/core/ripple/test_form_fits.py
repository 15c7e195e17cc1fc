"""Removal of form, against Zernike polynomials and harmonics in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.ripple.form_removal import FormFit
from omsm_ros.core.ripple.scan_signal import ScanSignal

NM = 1e-9
COUNT = 6000


def without_form(signal):
    return FormFit(signal).without()


def scan(turns=30.0, inner=0.0, height=None, seed=1, noise=1 * NM):
    """From 10 mm in to a part ``inner`` of it."""
    at = np.linspace(0, 1, COUNT)
    random = np.random.default_rng(seed).normal(0, noise, COUNT)
    return ScanSignal(
        name="A", period=1e-3, sample=np.arange(COUNT),
        height=random if height is None else height, path=at, radius=10e-3 * (1 - (1 - inner) * at),
        turn=turns * at,
    )  # fmt: skip


def place(signal):
    return signal.radius / 10e-3, 2 * np.pi * signal.turn


def zernikes(rho, angle):
    """Up to the fourth degree, as they stand in any table."""
    return {
        "tilt": rho * np.cos(angle),
        "defocus": 2 * rho**2 - 1,
        "astigmatism": rho**2 * np.sin(2 * angle),
        "coma": (3 * rho**3 - 2 * rho) * np.cos(angle),
        "trefoil": rho**3 * np.cos(3 * angle),
        "spherical": 6 * rho**4 - 6 * rho**2 + 1,
        "secondary astigmatism": (4 * rho**4 - 3 * rho**2) * np.cos(2 * angle),
        "tetrafoil": rho**4 * np.sin(4 * angle),
    }


NAMES = list(zernikes(np.ones(1), np.ones(1)))


class TestForm:
    @pytest.mark.parametrize("name", NAMES)
    def test_each_term_of_the_fourth_degree_goes_and_the_noise_stays(self, name):
        signal = scan()
        form = 1e-6 * zernikes(*place(signal))[name]
        found = without_form(replace(signal, height=signal.height + form))
        assert found.degree <= 4
        plain = FormFit(signal)
        plain._degree = found.degree
        np.testing.assert_allclose(found.residual, plain.without().residual, atol=1e-4 * NM)
        assert found.removed == pytest.approx(np.std(form), rel=0.01)
        assert not found.on_circle

    def test_a_drift_as_a_cubic_of_time_goes_as_well(self):
        signal = scan()
        at = np.linspace(-1, 1, COUNT)
        drift = 1e-7 * (at**3 - 2 * at**2 + at)
        found = without_form(replace(signal, height=signal.height + drift))
        np.testing.assert_allclose(found.residual, without_form(signal).residual, atol=1e-4 * NM)

    def test_what_is_left_is_at_right_angles_to_what_was_taken(self):
        signal = scan(height=1e-6 * np.random.default_rng(2).normal(size=COUNT))
        left = without_form(signal).residual
        for column in list(zernikes(*place(signal)).values())[:3]:
            cosine = left @ column / np.linalg.norm(left) / np.linalg.norm(column)
            assert abs(cosine) < 1e-9
        assert abs(np.mean(left)) < 1e-9 * np.std(left)

    def test_units_shifts_and_signs_change_nothing_else(self):
        signal = scan()
        plain = without_form(signal)
        other = without_form(replace(signal, height=5.0 - 1e3 * signal.height))
        np.testing.assert_allclose(other.residual, -1e3 * plain.residual, atol=1e-12)
        assert other.degree == plain.degree

    @pytest.mark.parametrize(
        ("degree", "form"),
        [
            (6, lambda rho, angle: rho**6 * np.cos(6 * angle)),
            (10, lambda rho, angle: rho**6 * np.sin(6 * angle) + rho**9 * np.cos(9 * angle)),
            (6, lambda rho, angle: (6 * rho**6 - 5 * rho**4) * np.cos(4 * angle)),
        ],
    )
    def test_lobes_that_no_lower_degree_shows_are_form_too(self, degree, form):
        signal = scan()
        found = without_form(replace(signal, height=signal.height + 1e-6 * form(*place(signal))))
        assert np.std(found.residual) < 1.1 * NM
        assert found.degree == degree

    def test_what_is_not_worth_a_degree_stays(self):
        signal = scan()
        rho, angle = place(signal)
        small = 0.3 * NM * rho**6 * np.cos(6 * angle)
        assert without_form(replace(signal, height=signal.height + small)).degree == 2

    @pytest.mark.parametrize("turns", [0.0, 1.4])
    def test_with_fewer_turns_it_is_a_polynomial_of_time(self, turns):
        signal = scan(turns=turns)
        at = np.linspace(-1, 1, COUNT)
        found = without_form(replace(signal, height=signal.height + 1e-6 * at**6))
        expected = np.polynomial.Legendre.fit(at, signal.height + 1e-6 * at**6, found.degree)
        assert found.degree == 6
        np.testing.assert_allclose(
            found.residual, signal.height + 1e-6 * at**6 - expected(at), atol=1e-5 * NM
        )
        assert found.orders == ()


class TestOrders:
    def test_what_repeats_with_the_spindle_is_found_with_its_phase(self):
        signal = scan()
        _, angle = place(signal)
        wave = 5 * NM * np.cos(7 * angle) - 12 * NM * np.sin(7 * angle)
        found = without_form(replace(signal, height=signal.height + wave))
        (order,) = [one for one in found.orders if one.frequency == 7]
        assert order.cosine == pytest.approx(5 * NM, abs=4 * order.amplitude_uncertainty)
        assert order.sine == pytest.approx(-12 * NM, abs=4 * order.amplitude_uncertainty)
        assert order.amplitude == pytest.approx(13 * NM, abs=4 * order.amplitude_uncertainty)

    def test_its_uncertainty_is_its_scatter(self):
        found = []
        for seed in range(14):
            orders = without_form(scan(seed=seed)).orders
            found.append(next(one for one in orders if one.frequency == 9))
        pulls = [
            [one.cosine / one.amplitude_uncertainty, one.sine / one.amplitude_uncertainty]
            for one in found
        ]
        assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.25)

    def test_on_one_circle_figure_and_spindle_are_one_and_two_waves_are_form(self):
        signal = scan(inner=0.999)
        _, angle = place(signal)
        found = without_form(replace(signal, height=signal.height + 9 * NM * np.cos(3 * angle)))
        assert found.on_circle
        assert min(one.frequency for one in found.orders) == 3
        (order,) = [one for one in found.orders if one.frequency == 3]
        assert order.cosine == pytest.approx(9 * NM, abs=4 * order.amplitude_uncertainty)
        # For white noise on a circle the bound is that of a sum of cosines.
        assert order.amplitude_uncertainty == pytest.approx(
            1 * NM * np.sqrt(2 / COUNT), rel=0.1, abs=0
        )

    def test_an_order_that_only_cancels_form_on_a_narrow_ring_is_form(self):
        """With a bump on the part, order and form of two waves a turn are 140 nm with two signs."""
        signal = scan(inner=0.97)
        rho, angle = place(signal)
        away = (rho * np.cos(angle) - 0.67) ** 2 + (rho * np.sin(angle)) ** 2
        bump = 300 * NM * np.exp(-away / (2 * 0.33**2))
        found = without_form(replace(signal, height=signal.height + bump))
        assert max(one.amplitude for one in found.orders) < 40 * NM

    def test_orders_go_to_twelve(self):
        assert {one.frequency for one in without_form(scan()).orders} <= set(range(2, 13))


class TestFormNextToLines:
    def test_a_line_that_is_known_stays_in_whole(self):
        """Near an order it would lose a part to it."""
        signal = scan(turns=12.0)
        at = np.linspace(0, 1, COUNT)
        wave = np.column_stack([np.cos(2 * np.pi * 59.3 * at), np.sin(2 * np.pi * 59.3 * at)])
        with_line = replace(signal, height=signal.height + 20 * NM * wave[:, 0])
        alone = FormFit(with_line).without().residual
        adjacent = FormFit(with_line).without(lambda chosen: wave[chosen]).residual
        kept = [2 * np.mean(left * wave[:, 0]) for left in (alone, adjacent)]
        assert abs(kept[1] - 20 * NM) < 0.2 * NM
        assert abs(kept[1] - 20 * NM) < 0.2 * abs(kept[0] - 20 * NM)

    def test_once_the_lines_are_known_less_form_is_worth_it(self):
        signal = scan(noise=0.3 * NM)
        rho, _ = place(signal)
        at = np.linspace(0, 1, COUNT)
        # The tenth degree over the disc, by its closed form.
        high = np.polynomial.legendre.legval(2 * rho**2 - 1, [0.0] * 5 + [1.0])
        line = 30 * NM * np.sin(2 * np.pi * 700 * at)
        fit = FormFit(replace(signal, height=signal.height + line + 2 * NM * high))
        before = fit.without()
        fit.refine(line)
        after = fit.without()
        assert before.degree < 10 <= after.degree
        assert np.std(after.residual - line) < 0.5 * NM < np.std(before.residual - line)

    def test_refining_never_lowers_the_degree(self):
        signal = scan()
        spherical = 1e-6 * zernikes(*place(signal))["spherical"]
        fit = FormFit(replace(signal, height=signal.height + spherical))
        before = fit.without().degree
        fit.refine(spherical)
        assert fit.without().degree >= before == 4


class TestOwned:
    def test_each_order_owns_the_bandwidth_of_its_radial_functions(self):
        reserved = dict(FormFit(scan()).reserved_orders())
        assert set(reserved) == {float(k) for k in range(1, 13)}
        # Second degree: one radial function of one and of two waves, none of three.
        assert reserved[2.0] == pytest.approx(reserved[12.0] + 0.5)
        assert reserved[3.0] == reserved[12.0]

    def test_without_turns_nothing_is_owned(self):
        assert FormFit(scan(turns=1.0)).reserved_orders() == []
