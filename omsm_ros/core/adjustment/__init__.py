"""Adjustment of several scans of one part: form and machine errors by one least-squares fit.

``adjust(scans, priors)`` returns the form with its covariance, each source declared against found,
how far the scans agree, and a verdict. ``plan_scans`` and ``posterior_uncertainty`` give the same
covariance before anything is scanned.
"""

from omsm_ros.core.adjustment.adjust import Adjustment, SourceFinding, adjust, corrected_heights
from omsm_ros.core.adjustment.figures import Figure, FormMap
from omsm_ros.core.adjustment.planning import (
    PlannedSet,
    PlannedUncertainty,
    ScanDesign,
    plan_scans,
    posterior_uncertainty,
    usual_sets,
)
from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.adjustment.sources import Source
from omsm_ros.core.adjustment.verdict import (
    CONTRADICTED,
    NOT_VERIFIED,
    TOO_UNCERTAIN,
    VERIFIED,
    Reason,
    Verdict,
)

__all__ = [
    "CONTRADICTED",
    "NOT_VERIFIED",
    "TOO_UNCERTAIN",
    "VERIFIED",
    "Adjustment",
    "Figure",
    "FormMap",
    "PlannedSet",
    "PlannedUncertainty",
    "Reason",
    "ScanData",
    "ScanDesign",
    "Source",
    "SourceFinding",
    "Verdict",
    "adjust",
    "corrected_heights",
    "plan_scans",
    "posterior_uncertainty",
    "usual_sets",
]
