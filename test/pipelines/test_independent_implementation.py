"""The paper's method a second time, in plain numpy, against the cloud of the package.

Nothing of the core decides a number here: the coefficients of the calibration's file and the
samples of a recording go through the bilinear filter of ``plain_method``.
"""

import json

import numpy as np
import pytest
from plain_method import bilinear, plain_height, recursion

import omsm_ros as omsm


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    path = tmp_path_factory.mktemp("second") / "cal.json"
    calibration = omsm.identify(omsm.simulate("step_test"))
    calibration.save(path)
    scan = omsm.simulate("scan", radius=1.5e-3)
    return json.loads(path.read_text()), scan, omsm.correct(scan, calibration)


def test_both_clouds_are_one(measured):
    """To 0.1 nm rms, where the package interpolates nothing and the filter here is bilinear."""
    stored, scan, points = measured
    height = plain_height(stored, scan.period, scan.z, scan.distance)
    off = height[points.sample] - points.height
    assert np.std(off) < 0.1e-9
    assert abs(np.mean(off)) < 1e-9
    # Without the filter the false form is 170 times as large.
    raw = scan.z + scan.distance / stored["static_gain"]
    assert np.std(raw[points.sample] - points.height) > 2e-9


def test_the_printed_recursion_scales_the_probe(measured):
    """Eq. 13 as printed feeds x_c back: it is filtered by 1/A(z), whose gain is not one."""
    stored, scan, points = measured
    b, a = bilinear((stored["numerator"], stored["denominator"]), scan.period)
    x_c = scan.distance / stored["static_gain"]
    printed = recursion(b, a, scan.z, inside=x_c)[points.sample]
    wrong = printed - points.height
    gain = 1 / np.sum(a)
    assert abs(gain - 1) > 0.02
    # The slow part of the reading is scaled by that gain, which makes false form.
    slow = np.convolve(wrong - (gain - 1) * x_c[points.sample], np.ones(500) / 500, "valid")
    assert np.ptp(slow) < 0.1 * abs(gain - 1) * np.ptp(x_c)
    assert np.ptp(np.convolve(wrong, np.ones(500) / 500, "valid")) > 5e-9
