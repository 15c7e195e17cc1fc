"""Sources of error: columns with one cause, and what is declared of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.adjustment.scan_data import ScanView
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.lti.frequency_response import relative_response_jacobian, spread_along
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError

FREE = ("tilt", "decentre", "clocking")
"""Families whose size is no statement about the machine: where the part lies."""
VIBRATION = "vibration"
"""Declared source of all lines in time, ``vibration/frequency@scan``."""

Columns = Callable[[ScanView], FloatArray]


@dataclass(frozen=True)
class Source:
    """A declared source: the prior of one family.

    name: of the family, such as ``"centre_x"`` or ``"spindle_axial/2"``
    uncertainty: standard uncertainty of each of its components [unit of the family]
    correlation_length: of an unknown curve over its axis [m]; None: 0.7 of the axis' range
    period: of a periodic error over Z or over the distance [m]
    half_range: distance at which a linearity error of the probe has its size [m]; None: the
        largest in use
    evaluated: True if a recording on this machine gave the figure; what is only declared, and not
        shown by the scans, cannot turn a verdict green

    Raises ConfigurationError for an uncertainty that is no finite number of zero or more.
    """

    name: str
    uncertainty: float
    correlation_length: float | None = None
    evaluated: bool = False
    period: float | None = None
    half_range: float | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.uncertainty < np.inf:
            raise ConfigurationError(
                f"{self.name}: standard uncertainty {self.uncertainty!r}, expected zero or more"
            )


@dataclass(frozen=True, eq=False)
class Family:
    """Columns with one cause.

    name, unit: of the source;  size: number of columns
    columns: change of the heights [m] per unit, (size, n)
    wide: size on a machine in need of repair, the prior once the family is refuted [unit]
    default: prior where nothing is declared [unit]; None: it takes part once it shows, and counts
        in the uncertainty with the probability that it is there
    shown_by: code of the scan that shows it best
    named: False for columns that detect, but have no cause of their own
    smooth: of a curve, what makes line, parabola and cubic of its columns (size, k)
    """

    name: str
    unit: str
    size: int
    columns: Columns
    wide: float
    shown_by: str
    default: float | None = None
    named: bool = True
    smooth: FloatArray | None = None


@dataclass(frozen=True)
class Contribution:
    """The source that contributes most to the uncertainty of PV.

    name, unit: of the source;  size: its standard uncertainty before the scans [unit]
    allowed: with which U is the accuracy, all else the same [unit]; NaN: U is larger without it
    rest: expanded uncertainty (k = 2) without the source [m]
    """

    name: str
    unit: str
    size: float
    allowed: float
    rest: float


def base_name(family: str) -> str:
    """Return the name of the declared source of ``family``, without number of a scan or "@waves".

    Lines in time have one declared source, at whatever frequency they stand.
    """
    name = family.split("@")[0]
    return VIBRATION if name.startswith(f"{VIBRATION}/") else name


def prior_sizes(families: Sequence[Family], priors: Sequence[Source]) -> dict[str, float]:
    """Return the standard deviations of the families that take part: declared, or by default."""
    stated = {p.name: p.uncertainty for p in priors}
    sizes = {}
    for family in families:
        size = stated.get(base_name(family.name), family.default)
        if size is not None:
            sizes[family.name] = size
    return sizes


# Sources whose uncertainty contains that of the calibration.
LAG_CHANGE, LAG_CURVATURE = "lag_change", "lag_curvature"
WITH_CALIBRATION = (LAG_CHANGE, LAG_CURVATURE)
# Where the gain's growth with the square of the frequency is read from its covariance [Hz].
_CURVATURE_HZ = 10.0


def with_dynamics(priors: Sequence[Source], calibration: Calibration) -> tuple[Source, ...]:
    """Return ``priors``, the uncertainty of ``calibration`` added to those of lag and curvature."""
    gain, _ = relative_response_jacobian(calibration.dynamics, np.array([_CURVATURE_HZ]))
    spread = float(spread_along(gain[0], calibration.covariance))
    lag = calibration.low_frequency_delay_uncertainty
    curvature = spread / (2 * np.pi * _CURVATURE_HZ) ** 2
    changed = (
        replace(p, uncertainty=float(np.hypot(p.uncertainty, lag)))
        if p.name == LAG_CHANGE else p
        for p in priors
    )  # fmt: skip
    return *changed, Source(LAG_CURVATURE, curvature, evaluated=True)
