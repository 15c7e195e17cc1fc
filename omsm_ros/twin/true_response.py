"""The transfer function that an identification should find, with its parts told apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from omsm_ros.core.dynamics.transfer_function import ComplexArray, TransferFunction
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.structure import StructureErrors


@dataclass(frozen=True, eq=False)
class TrueResponse:
    """From encoder to probe reading, with a gain of 1 at rest; what is not linear is not in it."""

    dynamics: TransferFunction
    structure: StructureErrors
    probe: ProbeErrors

    def response(self, frequency: ArrayLike) -> ComplexArray:
        """G at ``frequency`` [Hz], of its shape: structure, latency and exposure."""
        f = np.asarray(frequency, np.float64)
        return self.structural_response(f) * self.probe_response(f)

    def structural_response(self, frequency: ArrayLike) -> ComplexArray:
        """The part by which only Z is late, of the shape of ``frequency`` [Hz]."""
        s = np.asarray(2j * np.pi * np.asarray(frequency, np.float64), np.complex128)
        return self.dynamics.at(s) * self.structure.response(s)

    def probe_response(self, frequency: ArrayLike) -> ComplexArray:
        """The part by which the reading is late, so X and C too, of ``frequency`` [Hz]."""
        f = np.asarray(frequency, np.float64)
        turning = np.exp(-2j * np.pi * f * self.probe.lag_s)
        return np.asarray(turning * np.sinc(f * self.probe.window_s), np.complex128)

    @property
    def latency_s(self) -> float:
        """How late the probe's reading is."""
        return self.probe.lag_s

    @property
    def latency_share(self) -> float:
        """Latency per whole lag [1]; creep and soft modes, which are slow, are not counted."""
        return self.latency_s / (self.latency_s + self.dynamics.low_frequency_delay)
