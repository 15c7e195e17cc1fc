"""Figures of a certificate: what is drawn is what was identified."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.calibration.certificate import CandidateFit
from omsm_ros.core.lti.frequency_response import FrequencyResponse
from omsm_ros.core.lti.transfer_function import Structure, TransferFunction
from omsm_ros.report.certificate import figures as certificate_figures


class TestFigures:
    def test_the_band_carries_the_estimate_without_a_model(self, calibration, fitted):
        made = certificate_figures.response_with_band(calibration, fitted.measured)
        gain = made.get_axes()[0]
        labels = {text.get_text() for text in gain.get_legend().get_texts()}
        assert labels == {"95 % band", "identified", "without a model, 95 %"}

    def test_a_phase_beyond_half_a_turn_lies_on_the_curve(self, calibration):
        late = replace(
            calibration, dynamics=TransferFunction([1.0], [1.0], 10e-3), covariance=np.zeros((2, 2))
        )
        frequency = np.array([5.0, 60.0, 130.0, 210.0])
        exact = np.full(4, 1e-4)
        seen = FrequencyResponse(frequency, late.dynamics.response(frequency), np.ones(4), exact)
        phase = certificate_figures.response_with_band(late, seen).get_axes()[1]
        points = phase.containers[0].lines[0]
        np.testing.assert_allclose(points.get_ydata(), -360.0 * frequency * 10e-3, atol=1e-6)

    def test_the_end_of_trust_is_written(self, calibration):
        def notes(valid):
            shown = replace(calibration, valid_up_to=valid)
            axes = certificate_figures.response_with_band(shown).get_axes()
            return [text.get_text() for text in axes[1].texts]

        assert notes(80.72) == ["80.7 Hz"]
        assert notes(500.0) == []

    def test_close_lines_are_averaged_and_better_known(self):
        frequency = np.arange(0.0, 500.0)
        random = np.random.default_rng(6)
        spread = np.where(frequency < 100, 0.01, 0.05)
        noise = spread * (random.normal(size=500) + 1j * random.normal(size=500))
        coherence = np.where(frequency < 400, 0.9, 0.1)
        seen = FrequencyResponse(frequency, 1 + noise, coherence, spread)
        thin = certificate_figures.thinned(seen)
        assert thin.frequency[0] == 1.0
        assert thin.frequency[-1] < 400
        assert len(thin.frequency) < 40
        pulls = np.abs(thin.response - 1) / thin.uncertainty
        assert np.mean(pulls**2) / 2 == pytest.approx(1.0, abs=0.5)
        assert thin.uncertainty[-1] < 0.05 / 3

    def test_the_mean_edge_is_missing_without_edges(self, fitted):
        def rows(shown):
            return len(certificate_figures.residual(shown, 10e-9).get_axes())

        assert (rows(fitted), rows(replace(fitted, edges=()))) == (3, 2)

    def test_the_chosen_candidate_is_marked(self):
        tried = [CandidateFit(Structure(n, 0, False), b, r) for n, r, b in
                 ((1, 30e-9, 9.0), (2, 11e-9, 1.0), (3, 10e-9, 2.0))]  # fmt: skip
        (axes,) = certificate_figures.order(tried, Structure(3, 0, False)).get_axes()
        marks = {line.get_label(): line.get_xydata()[0].tolist() for line in axes.get_lines()}
        assert marks["lowest BIC"] == pytest.approx([2, 11.0])
        assert marks["chosen"] == pytest.approx([3, 10.0])
