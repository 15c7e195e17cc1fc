import numpy as np
import pytest
from scipy.integrate import trapezoid

from omsm_ros.core.lti.transfer_function import TransferFunction, to_control
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.plant import PAPER_DYNAMICS, PAPER_EQ_12

FREQUENCY = np.geomspace(0.1, 500, 50)


def test_response_and_poles_are_the_same():
    system = to_control(PAPER_EQ_12)
    np.testing.assert_allclose(
        system(2j * np.pi * FREQUENCY), PAPER_EQ_12.response(FREQUENCY), rtol=1e-10
    )
    np.testing.assert_allclose(
        np.sort_complex(system.poles()), np.sort_complex(PAPER_EQ_12.poles()), rtol=1e-6
    )


def test_step_response_settles_at_the_static_gain():
    import control  # takes a second to load

    time = np.linspace(0, 0.02, 20_001)
    response = control.step_response(to_control(PAPER_DYNAMICS), time)
    assert response.outputs[-1] == pytest.approx(1.0, abs=1e-6)
    # The area above the response to a step is the lag of a slow motion.
    area = trapezoid(1 - np.asarray(response.outputs), time)
    assert area == pytest.approx(PAPER_DYNAMICS.low_frequency_delay, rel=1e-3)


def test_a_delay_is_approximated_where_it_matters():
    late = TransferFunction([1.0], [1.0, 1e-3], delay=0.7e-3)
    band = FREQUENCY[FREQUENCY < 200]
    np.testing.assert_allclose(
        to_control(late)(2j * np.pi * band), late.response(band), rtol=0, atol=1e-5
    )
    with pytest.raises(ConfigurationError, match="delay_order"):
        to_control(late, 0)
