"""The Python interface: arrays in, results out, the same numbers as the commands."""

import subprocess
import sys

import control
import numpy as np
import pytest

import omsm_ros as omsm
from omsm_ros import api
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.pipelines.record_twin import write_recording
from omsm_ros.twin.plant import PAPER_DYNAMICS
from omsm_ros.twin.scenario import Scenario, planned_test_of, scan_of

PUBLIC = {
    "Adjusted", "Calibration", "Form", "Points", "Recording", "Spectrum", "adjust", "correct",
    "form", "identify", "load", "read", "simulate", "spectrum", "surface",
}  # fmt: skip


@pytest.fixture(scope="module")
def identified():
    return omsm.identify(omsm.simulate("step_test"))


@pytest.fixture(scope="module")
def points(identified):
    return omsm.correct(omsm.simulate("scan"), identified)


def test_the_public_names_stay():
    assert set(api.__all__) == PUBLIC
    assert set(dir(omsm)) >= PUBLIC
    assert all(getattr(omsm, name).__doc__ for name in PUBLIC)
    with pytest.raises(AttributeError, match="nothing_of_ours"):
        omsm.nothing_of_ours  # noqa: B018


def test_importing_the_package_loads_neither_numpy_nor_ros():
    code = (
        "import sys, omsm_ros; print(*{'numpy', 'scipy', 'rclpy', 'matplotlib'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_the_lag_is_that_of_the_simulated_machine(identified):
    truth = PAPER_DYNAMICS.low_frequency_delay
    assert abs(identified.lag - truth) < 3 * identified.lag_uncertainty
    assert identified.lag_uncertainty < 0.02 * truth
    assert identified.verdict.startswith("accepted")


def test_arrays_give_the_same_as_a_recording(identified):
    made = omsm.simulate("step_test")
    again = omsm.identify(made.z, made.distance, made.period)
    assert again.core.id == identified.core.id
    with pytest.raises(ConfigurationError, match="distance and period"):
        omsm.identify(made.z)


def test_a_bag_is_read_as_it_was_written(tmp_path):
    made = scan_of(Scenario(start_radius=5e-4))
    back = omsm.read(write_recording(tmp_path / "scan.mcap", made))
    assert np.array_equal(back.z, made.axes.z)
    assert np.array_equal(back.distance, made.distance.distance, equal_nan=True)
    assert back.period == made.axes.sample_period


def test_corrected_heights_are_those_of_the_surface(points):
    truth = scan_of(Scenario(start_radius=2e-3)).surface_height[points.sample]
    off = points.height - truth
    off -= off.mean()
    assert np.std(off) < 1.1 * np.median(points.uncertainty)
    received = points.counted["axes"]["received"]
    left_out = sum(points.counted["axes"]["counted"].values())
    assert len(points) == received - left_out


def test_a_control_system_goes_out_and_back(identified):
    system = identified.to_control()
    frequency = np.array([0.5, 2.0, 10.0])
    np.testing.assert_allclose(
        system(2j * np.pi * frequency), identified.response(frequency), rtol=1e-9
    )
    back = omsm.Calibration.from_control(control.tf([3.0], [2e-3, 3.0]), 1e-3)
    assert back.lag == pytest.approx(2e-3 / 3, rel=1e-12)


def test_the_spectrum_holds_the_mean_square():
    values = np.random.default_rng(1).normal(size=4096)
    found = omsm.spectrum(values, 1e-3)
    assert found.rms() == pytest.approx(np.std(values), rel=0.1)
    line = omsm.spectrum(np.sin(2 * np.pi * 50 * np.arange(4000) * 1e-3), 1e-3)
    assert line.rms(45, 55) == pytest.approx(0.5**0.5, rel=1e-3)


def test_results_print_in_a_few_lines_and_draw(identified, points):
    form = omsm.form(points, api.surface("off_axis_paraboloid", parent_focal_length=25.4e-3,
                                         off_axis_distance=50.8e-3))  # fmt: skip
    for result in (identified, points, form, omsm.simulate("scan"), omsm.spectrum(points.x, 1.0)):
        lines = str(result).splitlines()
        assert 0 < len(lines) <= 15
        assert result._repr_html_().count("<tr>") == len(lines)
        assert result.plot().axes
        assert result.to_dict()


def test_what_cannot_be_is_refused():
    with pytest.raises(DataError, match="shape"):
        omsm.Recording(z=np.zeros(3), distance=np.zeros(4), period=1e-3)
    with pytest.raises(ConfigurationError, match="unknown"):
        omsm.simulate("waltz")


def test_a_saved_calibration_is_loaded(identified, tmp_path):
    identified.save(tmp_path / "cal.json")
    assert omsm.load(tmp_path / "cal.json").core.id == identified.core.id


def test_the_step_test_is_that_of_the_twin():
    made = omsm.simulate("step_test", seed=4)
    assert np.array_equal(made.z, planned_test_of(Scenario(seed=4, start_radius=2e-3)).axes.z)
