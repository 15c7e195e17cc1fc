"""Form goes, ripple stays, and what repeats with the spindle is kept apart."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.ripple.form_removal import FormFit
from omsm_ros.core.ripple.scan_signal import scan_signal
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.twin.scenario import Scenario, scan_of


def without_form(signal):
    return FormFit(signal).without()


def test_a_millimetre_of_mirror_leaves_its_nanometres(made):
    signal = made("A", [("t", 123.4, 5e-9)], rpm=60, feed=6e-4, seconds=20.0)
    angle = 2 * np.pi * signal.turn
    form = PAPER_MIRROR.height(signal.radius * np.cos(angle), -signal.radius * np.sin(angle))
    plain = without_form(signal).residual
    found = without_form(replace(signal, height=signal.height + form))
    assert np.ptp(form) > 1e-3
    assert np.std(found.residual - plain) < 0.3e-9
    assert found.degree > 2


def test_a_flat_part_needs_no_high_degree(made):
    signal = made("A", [("r", 1 / 80e-6, 5e-9)])
    found = without_form(signal)
    assert found.degree == 2
    assert np.std(found.residual) == pytest.approx(np.std(signal.height), rel=0.03)


def test_the_spindle_repeats_alike_at_every_radius_and_a_figure_does_not(made):
    signal = made("A", [("c", 3, 6e-9)], rpm=60, feed=6e-4, seconds=20.0)
    order = next(o for o in without_form(signal).orders if o.frequency == 3)
    assert order.amplitude == pytest.approx(6e-9, abs=4 * order.amplitude_uncertainty + 0.1e-9)
    figure = 40e-9 * (signal.radius / 12.7e-3) ** 3 * np.cos(6 * np.pi * signal.turn)
    order = next(
        o for o in without_form(replace(signal, height=signal.height + figure)).orders
        if o.frequency == 3
    )  # fmt: skip
    assert order.amplitude == pytest.approx(6e-9, rel=0.15)


def test_the_twins_mirror_is_left_with_the_probes_noise():
    recording = scan_of(Scenario(start_radius=4e-3, feed_per_turn=4e-4))
    axes, sample = recording.axes, np.arange(len(recording.axes))
    height = recording.surface_height + np.random.default_rng(1).normal(0, 1e-9, len(sample))
    signal = scan_signal("A", 1e-3, (sample, height), (sample, axes.x, axes.y, axes.c))
    assert np.std(without_form(signal).residual) < 3.5e-9  # 8 nm of ripple, peak to valley


def test_less_than_a_turn_is_a_polynomial_of_time(made):
    signal = made("A", [("t", 40.0, 5e-9)], rpm=0.14, feed=0.0)
    curved = replace(signal, height=signal.height + 3e-6 * np.cos(2 * np.pi * signal.turn * 5))
    found = without_form(curved)
    assert found.orders == ()
    assert np.std(found.residual) == pytest.approx(np.hypot(5e-9, 5e-9 / 2**0.5), rel=0.03)
