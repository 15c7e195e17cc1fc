"""The page of a measurement that was corrected earlier, drawn from what lies in its folder."""

from __future__ import annotations

from pathlib import Path

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.surface.deviation import RunningStatistics, deviation
from omsm_ros.errors import CalibrationError, ConfigurationError
from omsm_ros.jobs.correct_bag import MOST_DRAWN
from omsm_ros.jobs.publish import CloudView, figures_of, map_of, publish, view_of
from omsm_ros.readable import quantity
from omsm_ros.storage.cloud_file import CloudFile
from omsm_ros.storage.files import CLOUD, REPORT, SUMMARY
from omsm_ros.storage.summary_file import read_summary

# What points evenly chosen, of a longer cloud, may say differently of all.
_SAME_RMS = 0.05


def report_again(result: Path, calibration: Calibration, nominal: Surface | None = None) -> Path:
    """Write ``report.html`` into the folder ``result`` of ``omsm correct``; return its path.

    Nothing is computed anew: every figure comes from the summary there, every map from its cloud.
    Raises FileError for a folder that holds no measurement, CalibrationError for another
    calibration than the one it was corrected with, ConfigurationError where it had a nominal
    surface and none is given, or another one.
    """
    summary = read_summary(result / SUMMARY)
    used = summary.get("calibration")
    if used != calibration.id:
        raise CalibrationError(
            f"{str(result)!r} was corrected with calibration {str(used)[:12]!r}, given is "
            f"{calibration.id[:12]!r}; give the one that it was corrected with"
        )
    if nominal is None and "deviation" in summary:
        raise ConfigurationError(
            f"{str(result)!r} was corrected with a nominal surface, from which its figures "
            "deviate; give it (--nominal)"
        )
    # Another than the calibration's where that was overridden; older summaries do not say it.
    period = summary.get("sample_period", calibration.sample_period)
    view = view_of(CloudFile(result / CLOUD).read(MOST_DRAWN), period)
    if nominal is not None and "deviation" in summary:
        _check_nominal(view, nominal, summary["deviation"]["corrected"]["rms"])
    figures = figures_of(view, calibration, nominal, period)
    title = f"Surface of {Path(str(summary.get('bag', result))).name}"
    publish(result, title, summary, calibration, figures, map_of(view, nominal, result))
    return result / REPORT


def _check_nominal(view: CloudView | None, nominal: Surface, rms: float) -> None:
    """Raise ConfigurationError where the cloud does not deviate from ``nominal`` by ``rms`` [m]."""
    if view is None:
        return
    found = RunningStatistics()
    found.add(view.x, view.y, deviation(view.x, view.y, view.height, nominal))
    here = found.statistics().rms
    if abs(here - rms) > _SAME_RMS * max(here, rms):
        raise ConfigurationError(
            f"the cloud deviates from this nominal surface by {quantity(here, 'm')} rms, by "
            f"{quantity(rms, 'm')} from the one that it was corrected with; give that one"
        )
