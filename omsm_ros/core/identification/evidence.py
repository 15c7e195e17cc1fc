"""Everything that the checks of an identification use."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from omsm_ros.core.calibration.certificate import PartsCompared, Undetected
from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse
from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.identification.covariance_terms import ReferenceLag
from omsm_ros.core.identification.model_choice import ChosenModel
from omsm_ros.core.identification.model_error_search import SearchResult
from omsm_ros.core.identification.residual_tests import (
    ResidualTests,
    residual_tests,
    response_difference,
)
from omsm_ros.core.identification.response_uncertainty import ResponseUncertainty
from omsm_ros.core.lti.frequency_response import ResponseLimits
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import MotionRecord


@dataclass(frozen=True, eq=False)
class IdentificationEvidence:
    """The record, the problem fitted, the chosen model, and how well it is known.

    limits: of the 95 % band, within which the response is trusted
    searched: the model errors that were looked for;  undetected: those that may be left
    contrasts: differences between parts of the test
    reference: lag of the reference sensor, where it is the input
    use: the scans that the calibration is for
    """

    record: MotionRecord
    prepared: Prepared
    model: ChosenModel
    known: ResponseUncertainty
    limits: ResponseLimits
    searched: SearchResult
    undetected: Undetected = field(default_factory=Undetected)
    contrasts: Sequence[PartsCompared] = ()
    reference: ReferenceLag | None = None
    use: IntendedUse = PAPER_USE

    @property
    def fit(self) -> Fit:
        """The fit that is certified."""
        return self.model.chosen.fit

    @property
    def dynamics(self) -> TransferFunction:
        """G(s) with G(0) = 1."""
        return self.fit.dynamics

    @cached_property
    def residual(self) -> ResidualTests:
        """Tests of the residual."""
        return residual_tests(self.prepared.problem, self.fit, self.prepared.steps)

    @cached_property
    def lag_in_residual(self) -> tuple[float, float]:
        """Lag that a search left in the residual where it was cut short, and its noise [s]."""
        problem, residual = self.prepared.problem, self.fit.residual
        rate = self.fit.gain * np.gradient(problem.motion, problem.period)[problem.used]
        power = float(rate @ rate)
        return -float(residual @ rate) / power, float(np.std(residual) / np.sqrt(power))

    @cached_property
    def response_difference(self) -> float | None:
        """Mean square difference from the response without a model, over its variance."""
        return response_difference(self.prepared.problem, self.fit, self.known.valid_up_to)
