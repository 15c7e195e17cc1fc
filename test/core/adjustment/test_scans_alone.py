"""Scans without a step test that say what no machine does."""

from __future__ import annotations

import numpy as np

from .test_resolved_calibration import UNITS, of_scans


def test_scans_alone_in_which_z_follows_the_probe_are_rejected() -> None:
    """As with the other sign of the distance, or a wrong static gain."""
    found = of_scans(np.array([-3.5e-3, 0.0, 0.0, 0.0]), known=np.array([1, 1, 0, 0], np.bool_))
    (said,) = map(str, found.certificate.reasons)
    assert "Z would have to move 3.50 ms after" in said
    assert "polarity" in said
    assert found.certificate.verdict == "rejected"
    within = of_scans(np.array([-1.0 * UNITS[0], 0.0, 0.0, 0.0]))
    assert within.certificate.reasons == ()
