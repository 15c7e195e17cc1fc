"""The parameters of the corrector, and the options of the correction made of them."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from omsm_ros import quantities
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.machine_sources import MachineSources, declared_sources
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.streams.trigger_slips import TWO_DRIVERS_S, CommonTrigger
from omsm_ros.io.descriptions import load_sources
from omsm_ros.nodes.topics import FRAME_PREFIX
from omsm_ros.quantities import Parameter

_FROM_CALIBRATION = _NOT_REQUESTED = -1.0

TRIGGER = (
    Parameter(
        "counter_offset",
        0,
        "added to the distance's trigger count, it gives the axes' count [samples]",
        quantities.COUNTER_OFFSET,
    ),
    Parameter(
        "stamp_tolerance",
        TWO_DRIVERS_S,
        "by how much axes and probe may stamp one trigger differently [s]",
        quantities.STAMP_TOLERANCE,
    ),
)


def _folders(name: str, read: str) -> Parameter:
    return Parameter(
        name,
        "~:.:/tmp",
        f"folders from which {read}, separated by ':'; ~ = home, . = where the node was started; "
        "empty = any folder",
    )


BAG_FOLDERS = _folders("bag_folders", "a service may read bags")


def _numbers(prefix: str, record: type, text: str) -> list[Parameter]:
    return [
        Parameter(f"{prefix}.{field.name}", 0.0, text, field.metadata["quantity"])
        for field in fields(record)
    ]


PARAMETERS = (
    Parameter("calibration", "", "calibration file to start with; empty = wait for one"),
    _folders("calibration_folders", "load_calibration may read"),
    BAG_FOLDERS,
    Parameter("follow_calibrator", True, "use calibrations from the topic calibration"),
    Parameter("settings", "", "JSON object of the cell's settings; empty = not compared"),
    Parameter("override", False, "ignore a mismatch of settings (shown in each cloud's frame)"),
    Parameter("polarity", 1, "+1: distance falls as z rises; -1: reversed", choices=(1, -1)),
    Parameter(
        "probe_latency",
        _FROM_CALIBRATION,
        "of the probe against X and C [s]; -1 = as calibrated",
        quantities.LAG,
        unset=_FROM_CALIBRATION,
    ),
    *TRIGGER,
    Parameter("workpiece_frame", "workpiece", "frame of the points"),
    Parameter("machine_frame", "machine", "frame of the axes"),
    Parameter("probe_frame", "probe", "frame of the distance"),
    FRAME_PREFIX,
    *_numbers("geometry", Geometry, "of the probe, see `omsm align`"),
    Parameter(
        "accuracy",
        _NOT_REQUESTED,
        "accuracy required by the user, k = 2 [m]: limit of the verdict; -1 = not stated",
        quantities.BUDGET,
        unset=_NOT_REQUESTED,
    ),
    Parameter("nominal", "", "SURFACE.yaml, for the effect of lateral errors; '' = slopes unknown"),
    Parameter("sources_file", "", "SOURCES.yaml: uncertainties of the machine; '' = none stated"),
    *_numbers(
        "sources", ErrorSources, "standard uncertainty, k = 1; 0 = what the certificate states"
    ),
)


def options_of(values: Mapping[str, Any]) -> CorrectionOptions:
    """Return the options of the correction."""
    lag = values["probe_latency"]
    return CorrectionOptions(
        polarity=values["polarity"],
        accept_other_rate=values["override"],
        probe_latency=None if lag == _FROM_CALIBRATION else lag,
        trigger=trigger_of(values),
        geometry=Geometry(**{f.name: values[f"geometry.{f.name}"] for f in fields(Geometry)}),
    )


def trigger_of(values: Mapping[str, Any]) -> CommonTrigger:
    """Return the settings of the trigger that probe and axes count."""
    return CommonTrigger(
        counter_offset=values["counter_offset"], stamp_tolerance=values["stamp_tolerance"]
    )


def sources_of(values: Mapping[str, Any]) -> MachineSources:
    """Return the uncertainties of the machine, from the parameters, else from the file."""
    sizes = {f.name: values[f"sources.{f.name}"] for f in fields(ErrorSources)}
    by_parameter = declared_sources({name: size for name, size in sizes.items() if size})
    by_file = load_sources(values["sources_file"] or None)
    others = (said for said in by_file.stated if not by_parameter.of(said.source))
    return MachineSources((*by_parameter.stated, *others))


def accuracy_of(values: Mapping[str, Any]) -> float | None:
    """Return the accuracy required, k = 2 [m], or None."""
    asked: float = values["accuracy"]
    return None if asked == _NOT_REQUESTED else asked
