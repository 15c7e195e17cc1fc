"""Machines with all errors at once, each drawn from its stated distribution.

A size that is stated as a standard uncertainty is drawn from a normal distribution. An error that
is stated as an unknown curve, but has one law in the twin, is drawn with the stated rms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.correction.machine_sources import MachineSources, StatedSource
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.model_errors.families import CREEP, MODE
from omsm_ros.core.surface.nominal import PAPER_MIRROR_RADIUS_M
from omsm_ros.twin.disturbances import Disturbances, VibrationLine
from omsm_ros.twin.machine_errors import Drift, Harmonic, MachineErrors, SpindleError, Straightness
from omsm_ros.twin.part import PartPose
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.sensors import ClockErrors, EncoderErrors, Pitch
from omsm_ros.twin.structure import Creep, SoftMode, StructureErrors
from omsm_ros.units import PPM

LATENCY_S, LATENCY_UNCERTAINTY_S = 50e-6, 2e-6
ABBE_ARM_M, _EXPOSURE_S = 0.05, 20e-6
# Depth of the middle half of the paper's mirror.
_Z_TRAVEL_M = 1e-3
_OMEGA_RAD_S = np.pi
_C_LATCH_S = 10e-6

SIZES: dict[str, tuple[float, dict[str, float]]] = {
    "tilt": (1e-6, {}),
    "decentre": (0.1e-6, {}),
    # The part's clocking, and the late latch of C.
    "clocking": (float(np.hypot(50e-6, _C_LATCH_S * _OMEGA_RAD_S)), {}),
    "centre_x": (0.05e-6, {}),
    "centre_y": (0.05e-6, {}),
    "beam": (2e-4, {}),
    "spindle_axial": (5e-9, {"per_turn": 2}),
    "spindle_radial": (20e-9, {"per_turn": 2}),
    "spindle_tilt": (0.2e-6, {"per_turn": 1}),
    "straightness_x": (10e-9, {}),
    "straightness_z": (20e-9, {}),
    "pitch": (0.05e-6, {}),
    "encoder_scale": (2 * PPM, {}),
    "encoder_interpolation": (1e-9, {"period": 4e-6}),
    "encoder_resolution": (1e-9, {}),
    "probe_linearity": (10e-9, {"half_range": 50e-6}),
    "probe_periodic": (2e-9, {"period": 10e-6}),
    "probe_slope": (0.1e-6, {}),
    "probe_slope_square": (0.1e-6, {}),
    "drift_walk": (1e-9, {}),
    "drift_rate": (0.1e-9, {}),
    "drift": (3e-9, {"correlation_time": 10.0}),
    "vibration": (6e-9, {}),
    "lag_change": (5e-6, {}),
}
"""Plausible standard uncertainties of a sound machine, in SI, with their parameters."""


PRIORS = {CREEP: 1e-5, MODE: 1e-5}
"""Prior knowledge of the structure, which reduces the undetected model error tenfold."""


def stated() -> MachineSources:
    """Return the stated sources from which each machine is drawn."""
    return MachineSources(
        tuple(
            StatedSource(source=name, value=size, reason="drawn from this", parameters=parameters)
            for name, (size, parameters) in SIZES.items()
        )
    )


@dataclass(frozen=True)
class Drawn:
    """One machine and part.

    quiet: disturbances of the step test, without drift;  scan: of the scan
    """

    quiet: Disturbances
    scan: Disturbances


def drawn(machine: int, seed: int) -> Drawn:
    """Return a machine and a part, drawn from the stated sources.

    machine: seed of the errors that step test and scan share;  seed: of all others
    """
    quiet, draw = _of_both(_Draw(1_000_000 + machine)), _Draw(seed)
    probe = replace(
        quiet.probe,
        cubic_m=draw.size("probe_linearity"),
        periodic_m=draw.wave_size("probe_periodic"),
        slope_error_m_per_rad=draw.size("probe_slope"),
        slope_error_m_per_rad2=draw.size("probe_slope_square"),
        dropout_probability=0.01,
        intensity_slope_rad=0.6,
    )
    scan = replace(
        quiet,
        probe=probe,
        machine=_machine(draw),
        encoder=_encoder(draw),
        clocks=replace(
            quiet.clocks,
            z_latch_late_s=draw.size("lag_change"),
            c_latch_late_s=draw.normal(_C_LATCH_S),
        ),
        vibration=tuple(
            VibrationLine(amplitude_m=SIZES["vibration"][0], frequency_hz=frequency)
            for frequency in (13.7, 680.0)
        ),
    )
    return Drawn(quiet, scan)


class _Draw:
    """Draw sizes from their stated distributions."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(1000 + seed)

    def normal(self, spread: float) -> float:
        return float(self._random.normal(0.0, spread))

    def size(self, name: str) -> float:
        return self.normal(SIZES[name][0])

    def wave_size(self, name: str) -> float:
        """Return the amplitude of one wave, whose stated rms is that of both phases."""
        return float(np.sqrt(2.0)) * self.size(name)

    def harmonic(self, name: str) -> Harmonic:
        along, across = self.size(name), self.size(name)
        return Harmonic(
            amplitude=float(np.hypot(along, across)),
            per_turn=int(SIZES[name][1]["per_turn"]),
            phase_rad=float(np.arctan2(across, along)),
        )


def _of_both(draw: _Draw) -> Disturbances:
    """Draw the errors that step test and scan share."""
    return Disturbances(
        servo_bandwidth_hz=float(np.exp(np.log(100.0) + draw.normal(0.2))),
        probe=ProbeErrors(
            # Latency and half of the exposure together are the stated latency.
            latency_s=LATENCY_S - _EXPOSURE_S / 2 + draw.normal(LATENCY_UNCERTAINTY_S),
            exposure_s=_EXPOSURE_S,
        ),
        structure=StructureErrors(
            creep=(Creep(fraction=draw.normal(PRIORS[CREEP]), time_constant_s=5.0),),
            soft_modes=(
                SoftMode(
                    frequency_hz=8.0, damping_ratio=0.05, participation=draw.normal(PRIORS[MODE])
                ),
            ),
            backlash_m=abs(draw.normal(1e-9)),
        ),
        clocks=ClockErrors(trigger_jitter_s=1e-6, probe_jitter_s=1e-6),
    )


def _machine(draw: _Draw) -> MachineErrors:
    return MachineErrors(
        pose=PartPose(
            x_m=draw.size("decentre"),
            y_m=draw.size("decentre"),
            tilt_x_rad=draw.size("tilt"),
            tilt_y_rad=draw.size("tilt"),
            clocking_rad=draw.normal(50e-6),
        ),
        mount=Geometry(
            centre_x=draw.size("centre_x"),
            centre_y=draw.size("centre_y"),
            beam_x=draw.size("beam"),
            beam_y=draw.size("beam"),
        ),
        spindle=SpindleError(
            axial_m=(draw.harmonic("spindle_axial"),),
            radial_m=(draw.harmonic("spindle_radial"),),
            tilt_rad=(draw.harmonic("spindle_tilt"),),
            axial_noise_m=3e-9,
        ),
        x_slide_along_z=Straightness(
            bow_m=draw.size("straightness_x"), half_travel_m=PAPER_MIRROR_RADIUS_M
        ),
        z_slide_along_x=Straightness(bow_m=draw.size("straightness_z"), half_travel_m=_Z_TRAVEL_M),
        drift=Drift(
            ramp_m_per_s=draw.size("drift_rate"),
            exponential_m=draw.wave_size("drift"),
            time_constant_s=SIZES["drift"][1]["correlation_time"],
            random_walk_m_per_root_s=SIZES["drift_walk"][0],
        ),
    )


def _encoder(draw: _Draw) -> EncoderErrors:
    return EncoderErrors(
        scale_ppm=draw.size("encoder_scale") / PPM,
        interpolation_m=draw.wave_size("encoder_interpolation"),
        signal_period_m=SIZES["encoder_interpolation"][1]["period"],
        resolution_m=SIZES["encoder_resolution"][0],
        pitch=Pitch(arm_m=ABBE_ARM_M, rad_per_m=draw.size("pitch") / _Z_TRAVEL_M),
    )
