"""Light modes about as slow as the steps follow each other: poles, or in the band, and no lines."""

import numpy as np
import pytest
from late_steps import LAG, LATE, PERIOD, TIME, late_record
from scipy import signal

from omsm_ros.core.departures.families import MODE, VIBRATION
from omsm_ros.core.dynamics.response_band import response_band
from omsm_ros.core.fitting.preparation import prepare
from omsm_ros.core.identification.departure_search import search
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.identification.model_choice import model_from_start


def ringing(participation, frequency, damping):
    omega = 2 * np.pi * frequency
    mode = signal.cont2discrete(([omega**2], [1, 2 * damping * omega, omega**2]), PERIOD, "foh")
    return participation * (signal.lfilter(mode[0].ravel(), mode[1], LATE - LATE[0]) - LATE)


@pytest.mark.parametrize(("seed", "modelled"), [(1, False), (2, True)])
def test_a_slow_mode_that_the_steps_keep_ringing_is_in_the_response_or_in_the_band(seed, modelled):
    """By a nanometre it looks like a line, and is tenfold in the response at its frequency."""
    size, frequency, damping = 1e-4, 0.5, 0.05
    calibration = identify(late_record(-ringing(size, frequency, damping), seed)).calibration
    families = {d["family"] for d in calibration.certificate["departures"]}
    assert families == ({MODE} if modelled else set())
    lines = np.array([0.5, 1.0, 1.5])
    ratio = 1j * lines / frequency
    mode = 1 / (1 + 2 * damping * ratio + ratio**2)
    truth = np.exp(-2j * np.pi * lines * LAG) * (1 + size * (mode - 1))
    band = response_band(calibration.dynamics, calibration.covariance, lines)
    off = np.abs(np.log(calibration.dynamics.response(lines) / truth))
    assert np.all(off < 3 * np.hypot(band.gain, band.phase))


def test_a_slow_line_of_vibration_is_no_mode():
    line = 1.5e-9 * np.sin(2 * np.pi * 0.73 * TIME + 1.0)
    found = search(prepare(late_record(line), "encoder"), model_from_start)
    assert {modelled.term.family for modelled in found.beside} == {VIBRATION}
    assert not found.in_response
