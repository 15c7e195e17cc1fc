"""Named conversion factors; everything inside the package is SI.

Multiply to enter SI (``5 * MICROMETRE_M``), divide to leave it for a reader
(``height / NANOMETRE_M``).
"""

import math

MILLIMETRE_M = 1e-3
MICROMETRE_M = 1e-6
NANOMETRE_M = 1e-9
MILLISECOND_S = 1e-3
MICROSECOND_S = 1e-6
NANOSECOND_S = 1e-9
NANOSECONDS_PER_S = 1_000_000_000
DAY_S = 86_400.0
RPM_RAD_S = 2 * math.pi / 60
RPM_HZ = 1 / 60
PPM = 1e-6
DEGREE_RAD = math.pi / 180
