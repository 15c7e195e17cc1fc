"""Make a motion record of plain arrays, for tests and benchmarks."""

import numpy as np

from omsm_ros.core.lti.modes import TwoMass
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord


def two_mass_response(masses: TwoMass, *, collocated: bool) -> TransferFunction:
    """Return the motion of the driven m1, or of m2 (Eq. 7), scaled to G(0) = 1."""
    return TransferFunction.from_ascending(*masses.polynomials(collocated=collocated)).normalised()


def record_from_arrays(
    sample_period: float,
    z: FloatArray,
    distance: FloatArray,
    ok: BoolArray | None = None,
    reference: FloatArray | None = None,
) -> MotionRecord:
    """Return a record of arrays (n,); NaN in any channel marks a lost sample."""
    z, distance = np.asarray(z, np.float64), np.asarray(distance, np.float64)
    known, index = np.isfinite(z), np.arange(len(z))
    usable = known & np.isfinite(distance) & (True if ok is None else ok)
    return MotionRecord(
        sample_period=sample_period,
        z=np.interp(index, index[known], z[known]) if np.any(known) else np.zeros(len(z)),
        distance=distance,
        ok=usable,
        reference=None if reference is None else np.asarray(reference, np.float64),
        z_lost=None if np.all(known) else ~known,
        counts={
            "received": len(z),
            "missing_axis": int(np.sum(~known)),
            "not_ok": int(np.sum(known & ~usable)),
            "paired": int(np.sum(usable)),
        },
    )
