"""True transfer function of a simulated cell, the reference for identification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.probe import Probe


@dataclass(frozen=True, eq=False)
class TrueResponse:
    """Linear response from encoder to reading of the probe, at position 0 and time 0.

    Stiffness along Z or X, periodic pitch and drift of a clock are not included.
    """

    plant_dynamics: TransferFunction
    disturbances: Disturbances
    probe: Probe

    def response(self, frequency: ArrayLike) -> ComplexArray:
        """Return G at ``frequency`` [Hz], of its shape, with a static gain of 1."""
        f = np.asarray(frequency, np.float64)
        return self.structural_response(f) * self.probe_response(f)

    def structural_response(self, frequency: ArrayLike) -> ComplexArray:
        """Return the mechanical part, which delays Z only, of the shape of ``frequency`` [Hz]."""
        s = np.asarray(2j * np.pi * np.asarray(frequency, np.float64), np.complex128)
        moved = self.plant_dynamics.normalised().at(s) * self.disturbances.structure.response(s)
        seen = self.disturbances.encoder.response(s) / self._encoder_gain
        return np.asarray(moved / seen, np.complex128)

    def probe_response(self, frequency: ArrayLike) -> ComplexArray:
        """Return the part of the reading, a delay relative to all axes, at ``frequency`` [Hz]."""
        f = np.asarray(frequency, np.float64)
        turning = np.exp(-2j * np.pi * f * self.latency_s)
        return np.asarray(turning * np.sinc(f * self.disturbances.probe.window_s), np.complex128)

    @property
    def static_gain(self) -> float:
        """Static gain: reading over travel of the encoder [1]."""
        return self.probe.scale * self.plant_dynamics.dc_gain / self._encoder_gain

    @property
    def _encoder_gain(self) -> float:
        return float(self.disturbances.encoder.response(np.zeros(1, np.complex128))[0].real)

    @property
    def latency_s(self) -> float:
        """Delay of the reading relative to the encoder of Z, at time 0."""
        return self.disturbances.probe.lag_s + self.disturbances.clocks.lag_s

    @property
    def latency_share(self) -> float:
        """Share of latency in the total lag [1], without creep and soft modes."""
        return self.latency_s / (self.latency_s + self.plant_dynamics.low_frequency_delay)
