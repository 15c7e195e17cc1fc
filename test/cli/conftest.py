"""The true calibration as a file fixture."""

import pytest

from omsm_ros.io import calibration_file


@pytest.fixture(scope="session")
def calibration(tmp_path_factory, true_calibration):
    path = tmp_path_factory.mktemp("calibration") / "cal.json"
    calibration_file.save_calibration(path, true_calibration)
    return path
