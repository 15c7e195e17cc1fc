"""A mode at 804 Hz from edges sampled at 1 kHz, against closed forms of axis and mode."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from soaked import soaked

from omsm_ros.core.estimation.equivalent_time import fast_mode
from omsm_ros.core.streams.motion_record import MotionRecord

OMEGA, AXIS = 2 * np.pi * 804.0, 2 * np.pi * 200.0
POLE = OMEGA * complex(-0.19, np.sqrt(1 - 0.19**2))


def axis_step(t):
    """Return the step response of 1/(1 + s/ω)² at ``t`` [s]."""
    t = np.maximum(t, 0.0)
    return 1 - (1 + AXIS * t) * np.exp(-AXIS * t)


def mode_step(t):
    """Return that of the axis and ω²/(s² + 2ζωs + ω²) together, by partial fractions."""
    t = np.maximum(t, 0.0)
    # Y = A²Ω²/(s (s + A)² (s - p)(s - p*)): residues at 0, -A (double), p and p*.
    total = np.ones(len(t))
    a, size = -AXIS, AXIS**2 * OMEGA**2

    def rest(s):  # without the double pole
        return size / (s * (s - POLE) * (s - POLE.conjugate()))

    h = 1e-3 * AXIS
    slope = (rest(a + h) - rest(a - h)).real / (2 * h)
    total += (rest(a).real * t + slope) * np.exp(a * t)
    residue = size / (POLE * (POLE - a) ** 2 * (POLE - POLE.conjugate()))
    return total + 2 * (residue * np.exp(POLE * t)).real


def test_the_closed_form_starts_at_rest():
    t = np.array([0.0, 1e-6, 0.1])
    assert mode_step(t) == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)


def step_test(
    dither=1.0, response=mode_step, axis=axis_step, edges=20, dwell=100, seed=4, rounded=False
):
    """A step test; ``rounded``: an encoder without noise in whole nanometres."""
    random = np.random.default_rng(seed)
    time = np.arange((edges + 1) * dwell) * 1e-3
    z, seen = np.zeros(len(time)), np.zeros(len(time))
    for k in range(edges):
        since = time - ((k + 1) * dwell + dither * ((k * 0.618034) % 1.0)) * 1e-3
        height = 9e-6 if k < edges / 2 else -9e-6
        z += height * axis(since)
        seen += height * response(since)
    return MotionRecord(
        sample_period=1e-3,
        z=np.round(z, 9) if rounded else z + random.normal(0, 0.4e-9, len(z)),
        distance=-seen + random.normal(0, 10e-9, len(z)),
        ok=np.ones(len(z), bool),
    )


@pytest.mark.parametrize(
    ("rounded", "late", "dwell"), [(False, 0.23e-3, 60), *soaked((True, 0.0, 100))]
)
def test_sharp_edges_show_the_mode_at_804_hz_also_of_a_late_probe(rounded, late, dwell):
    made = step_test(rounded=rounded, dwell=dwell, response=lambda t: mode_step(t - late))
    found = fast_mode(made)
    assert found.finding.code == "estimation.fast_mode"
    assert found.frequency == pytest.approx(804.0, abs=4 * found.frequency_uncertainty)
    assert found.damping == pytest.approx(0.19, abs=4 * found.damping_uncertainty)
    assert found.frequency_uncertainty < 3.0


@pytest.mark.soak
def test_no_mode_is_found_where_there_is_none():
    """The probe follows the axis by 0.34 ms of a real pole."""
    rate = 1 / 0.34e-3

    fine = np.arange(0, 0.06, 2e-6)
    moved = lfilter([rate * 2e-6], [1, rate * 2e-6 - 1], axis_step(fine))

    def lagging(t):
        return np.where(t > 0.055, 1.0, np.interp(t, fine, moved))

    found = fast_mode(step_test(response=lagging))
    assert found.finding.code == "estimation.no_fast_mode"


def test_edges_that_start_with_a_sample_show_nothing():
    assert fast_mode(step_test(dither=0.0)).finding.code == "estimation.not_dithered"
    assert fast_mode(step_test(edges=6)).finding.code == "estimation.few_edges"


@pytest.mark.soak
def test_soft_edges_show_nothing():
    def slow(t):
        return axis_step(t * 0.1)

    codes = fast_mode(step_test(response=lambda t: slow(t - 0.3e-3), axis=slow)).finding.code
    assert codes in ("estimation.no_fast_mode", "estimation.other_axis")


def test_edges_without_a_reading_of_the_probe_do_not_count():
    blind = step_test()
    nothing = np.full(len(blind.z), np.nan)
    finding = fast_mode(replace(blind, distance=nothing, ok=np.isfinite(nothing))).finding
    assert finding.code == "estimation.few_edges"
