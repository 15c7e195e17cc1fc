"""A calibration in the Python interface, also from and to python-control."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omsm_ros.core.calibration.calibration import Calibration as _Calibration
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.core.lti.transfer_function import TransferFunction, to_control
from omsm_ros.errors import ConfigurationError
from omsm_ros.interface_results import Result
from omsm_ros.readable import measured, plain, quantity

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Result):
    """Identified dynamics from encoder to probe; ``core`` is what files and nodes share."""

    core: _Calibration

    @classmethod
    def from_control(
        cls,
        system: control.TransferFunction | control.StateSpace,
        period: float,
        delay: float = 0.0,
        static_gain: float = 1.0,
    ) -> Calibration:
        """Return a calibration without uncertainty and certificate from python-control.

        system: continuous, in rad/s; its gain at zero frequency multiplies ``static_gain``
        period: of the samples [s];  delay: of the probe [s], in addition to the system

        Raises ConfigurationError for a system that is sampled, or has no finite static gain.
        """
        import control as package

        rational = package.tf(system)
        numerator, denominator = (
            np.ravel(v[0][0])[::-1].astype(np.float64) for v in (rational.num, rational.den)
        )
        if rational.isdtime(strict=True) or not numerator[0] * denominator[0]:
            raise ConfigurationError(
                "the system must be continuous, with a static gain that is not zero or infinite"
            )
        gain = float(numerator[0] / denominator[0])
        dynamics = TransferFunction(numerator / numerator[0], denominator / denominator[0], delay)
        size = len(numerator) + len(denominator)
        return cls(
            _Calibration(
                dynamics=dynamics,
                static_gain=static_gain * gain,
                sample_period=period,
                valid_up_to=0.5 / period,
                covariance=np.zeros((size, size)),
            )
        )

    @property
    def lag(self) -> float:
        """Lag of the probe at low frequency [s]."""
        return self.core.dynamics.low_frequency_delay

    @property
    def lag_uncertainty(self) -> float:
        """Standard uncertainty of :attr:`lag` [s]."""
        return low_frequency_delay_uncertainty(self.core.dynamics, self.core.covariance)

    @property
    def verdict(self) -> str:
        """Verdict of the certificate, empty without one."""
        return self.core.certificate.verdict or ""

    def response(self, frequency: ArrayLike) -> NDArray[np.complex128]:
        """Return G at ``frequency`` [Hz], of its shape; G(0) = 1, without the static gain."""
        return self.core.dynamics.response(np.asarray(frequency, np.float64))

    def to_control(self, delay_order: int = 3) -> control.TransferFunction:
        """Return G as a python-control system in rad/s, its delay as a Padé approximant."""
        return to_control(self.core.dynamics, delay_order)

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield the printed lines."""
        yield "calibration", self.core.id[:12]
        yield "verdict", self.verdict or "no certificate"
        yield "lag", measured(self.lag, self.lag_uncertainty, "s")
        yield "static gain", plain(self.core.static_gain, 6)
        yield "valid up to", quantity(self.core.valid_up_to, "Hz")
        for reason in self.core.certificate.reasons[:5]:
            yield "reason", str(reason)

    def _figure(self) -> Figure:
        from omsm_ros.report.response_figures import bode

        return bode(self.core, None, self.core.sample_period)

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of the calibration, SI units; powers of s ascend."""
        return {
            "id": self.core.id,
            "verdict": self.verdict,
            "lag": self.lag,
            "lag_uncertainty": self.lag_uncertainty,
            "static_gain": self.core.static_gain,
            "valid_up_to": self.core.valid_up_to,
            "numerator": list(self.core.dynamics.numerator),
            "denominator": list(self.core.dynamics.denominator),
            "delay": self.core.dynamics.delay,
        }

    def save(self, path: Path | str) -> None:
        """Write ``CAL.json``, which commands and nodes read."""
        from omsm_ros.io.calibration_file import save_calibration

        save_calibration(path, self.core)
