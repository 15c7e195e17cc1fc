"""Ranges of the numbers of disturbances, and whether a disturbance is switched on."""

from typing import Any

from omsm_ros.quantities import Quantity

ANY = Quantity("number", "", -1e300, 1e300)
NOT_NEGATIVE = Quantity("number", "", 0.0, 1e300)
WIDTH = Quantity("length", "m", 1e-12, 10.0)
SIZE = Quantity("length", "m", 0.0, 10.0)
DURATION = Quantity("time", "s", 1e-9, 1e6)
# The simulation starts earlier by the largest delay of a sample.
LAG = Quantity("delay", "s", 0.0, 1.0)
OFFSET = Quantity("delay", "s", -LAG.high, LAG.high)
# Accelerometers measure up to 100 kHz.
SENSOR_PERIOD = Quantity("sample period", "s", 5e-6, 1e6)
FREQUENCY = Quantity("frequency", "Hz", 1e-9, 1e6)
RATE = Quantity("frequency", "Hz", 0.0, 1e6)
ANGLE = Quantity("angle", "rad", -10.0, 10.0)
ANGLE_NOISE = Quantity("angle", "rad", 0.0, 10.0)
SLOPE_LIMIT = Quantity("angle", "rad", 1e-9, 10.0)
PARTS_PER_MILLION = Quantity("relative error", "ppm", -1e5, 1e5)
DAMPING = Quantity("damping ratio", "", 1e-9, 100.0)


def is_default(record: Any) -> bool:
    """Return True if a record equals its default, so that nothing is switched on."""
    return bool(record == type(record)())
