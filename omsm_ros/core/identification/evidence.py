"""Everything that the checks of an identification may look at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from omsm_ros.core.estimation.output_error import Fit
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.identification.model_choice import ChosenModel
from omsm_ros.core.identification.model_error_search import SearchResult
from omsm_ros.core.identification.residual_tests import ResidualTests, residual_tests
from omsm_ros.core.identification.response_uncertainty import ResponseUncertainty
from omsm_ros.core.lti.frequency_response import ResponseLimits
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import MotionRecord


@dataclass(frozen=True, eq=False)
class IdentificationEvidence:
    """The record, the problem fitted, the chosen model, and how well it is known.

    limits: of the 95 % band, within which the response is trusted
    searched: departures from a steady linear response that were looked for
    """

    record: MotionRecord
    prepared: Prepared
    model: ChosenModel
    known: ResponseUncertainty
    limits: ResponseLimits
    searched: SearchResult

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
