"""The Bode plot and the step response show the numbers they are given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.report import style
from omsm_ros.report.response_figures import bode, step_response
from omsm_ros.twin.plant import PAPER_EQ_12


def line(axes, label):
    (found,) = [one for one in axes.get_lines() if one.get_label() == label]
    return found.get_xdata(), found.get_ydata()


def labels(axes):
    return {text.get_text() for text in axes.get_legend().get_texts()}


class TestBode:
    def test_shows_the_reference_figures(self, certified):
        """Gain and phase of Eq. 12, its static gain taken out."""
        gain, phase, _ = bode(certified, None, 1e-3).get_axes()
        for frequency, expected_gain, expected_phase in (
            (1.0, 0.992125, -0.12230),
            (15.0, 0.991804, -1.83556),
            (100.0, 0.977985, -12.5635),
        ):
            at, value = line(gain, "identified")
            assert np.interp(frequency, at, value) == pytest.approx(
                expected_gain / PAPER_EQ_12.dc_gain, abs=1e-4
            )
            at, value = line(phase, "identified")
            assert np.interp(frequency, at, value) == pytest.approx(expected_phase, abs=0.01)

    def test_ends_at_the_nyquist_frequency_of_the_scan(self, certified):
        for sample_period in (1e-3, 1e-4):
            shown = bode(certified, None, sample_period).get_axes()
            assert shown
            for axes in shown:
                assert axes.get_xlim() == pytest.approx((0.1, 0.5 / sample_period))

    def test_the_band_holds_95_percent_of_what_the_covariance_allows(self, certified):
        gain = bode(certified, None, 1e-3).get_axes()[0]
        (band,) = [c for c in gain.collections if c.get_label() == "95 % band"]
        edge = band.get_paths()[0].vertices
        random = np.random.default_rng(1)
        sigma = np.sqrt(np.diag(certified.covariance))[: len(certified.dynamics.numerator)]
        drawn = certified.dynamics.numerator + sigma * random.normal(size=(2000, len(sigma)))
        for frequency in (50.0, 200.0):
            near = edge[np.argsort(abs(edge[:, 0] - frequency))[:2], 1]
            s = 2j * np.pi * frequency
            bottom = np.polynomial.polynomial.polyval(s, certified.dynamics.denominator)
            values = abs(drawn @ s ** np.arange(len(sigma)) / bottom)
            inside = np.mean((values > near.min()) & (values < near.max()))
            assert inside == pytest.approx(0.95, abs=0.03)

    def test_no_band_without_uncertainty(self, certified):
        exact = replace(certified, covariance=np.zeros_like(certified.covariance))
        shown = bode(exact, None, 1e-3).get_axes()
        assert shown
        for axes in shown:
            assert not axes.collections

    def test_the_truth_is_drawn_where_known(self, certified):
        true = TransferFunction.from_ascending([1.0], [1.0, 1e-4])
        gain, phase, error = bode(certified, true, 1e-3).get_axes()
        at, value = line(gain, "true")
        assert value == pytest.approx(abs(true.response(at)))
        at, value = line(phase, "true")
        assert value == pytest.approx(-np.degrees(np.arctan(2 * np.pi * at * 1e-4)))
        at, value = line(error, "corrected, true")
        left = true.response(at) - certified.dynamics.response(at)
        assert value == pytest.approx(np.maximum(1e3 * abs(left), 1e-4))
        assert "true" not in labels(bode(certified, None, 1e-3).get_axes()[0])

    def test_error_before_is_that_of_the_motion(self, certified):
        at, value = line(bode(certified, None, 1e-3).get_axes()[2], "uncorrected")
        assert value == pytest.approx(1e3 * abs(1 - certified.dynamics.response(at)))

    def test_says_where_trust_ends(self, certified):
        def notes(calibration):
            return [t.get_text() for t in bode(calibration, None, 1e-3).get_axes()[0].texts]

        assert notes(certified) == ["not valid"]
        assert notes(replace(certified, valid_up_to=500.0)) == []

    def test_a_calibration_without_dynamics_is_drawn(self, certified):
        still = replace(
            certified, dynamics=TransferFunction([1.0], [1.0]), covariance=np.zeros((2, 2))
        )
        style.png(bode(still, still.dynamics, 1e-3), dpi=40)


class TestStepResponse:
    TIME = 1e-3 * np.arange(3000)

    def recorded(self):
        """Return two edges, the second steeper; the probe lags by 5 ms with an offset of 7 µm."""
        encoder = 5e-6 * np.clip((self.TIME - 0.5) / 0.1, 0, 1)
        encoder = encoder + 10e-6 * np.clip((self.TIME - 2.0) / 0.02, 0, 1)
        late = np.r_[np.full(5, encoder[0]), encoder[:-5]]
        return encoder, late + 7e-6, late

    def test_shows_the_steepest_edge_from_its_start(self):
        encoder, probe, predicted = self.recorded()
        upper, lower = step_response(self.TIME, encoder, probe, predicted).get_axes()
        at, value = line(upper, "axis (encoder)")
        assert np.ptp(value) == pytest.approx(10.0, rel=0.01)
        assert np.interp(10.0, at, value) == pytest.approx(5.0, abs=0.6)
        at, value = line(lower, "probe − axis")
        # 5 ms late on 0.5 µm/ms.
        assert value.min() == pytest.approx(-2500, rel=0.01)

    def test_a_right_prediction_leaves_nothing_whatever_the_offset(self):
        lower = step_response(self.TIME, *self.recorded()).get_axes()[1]
        _, value = line(lower, "probe − axis through $G_m$")
        assert np.abs(value).max() < 1e-6

    def test_the_prediction_may_be_missing(self):
        encoder, probe, _ = self.recorded()
        upper, lower = step_response(self.TIME, encoder, probe).get_axes()
        assert labels(upper) == {"axis (encoder)", "probe"}
        assert labels(lower) == {"probe − axis"}

    def test_the_twin_step_test(self, step_test, true_calibration):
        """With the true dynamics only the probe's 10 nm of noise are left."""
        z = step_test.axes.z
        g = true_calibration.dynamics
        b, a = signal.bilinear(g.numerator[::-1], g.denominator[::-1], 1 / 1e-3)
        predicted = signal.lfilter(b, a, z - z[0]) + z[0]
        probe = -step_test.distance.distance / true_calibration.static_gain
        time = 1e-3 * np.arange(len(z))
        _, lower = step_response(time, z, probe, predicted).get_axes()
        _, before = line(lower, "probe − axis")
        _, after = line(lower, "probe − axis through $G_m$")
        assert np.abs(before).max() > 200
        assert np.std(after) < 15
