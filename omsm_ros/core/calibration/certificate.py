"""The certificate of a calibration: how it was obtained, what was found, and whether to trust it.

All values are SI, the names of the fields are those in the calibration file. A field that is None
or empty is not known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import lru_cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from omsm_ros.core.calibration.intended_use import IntendedUse
from omsm_ros.core.calibration.latency import Latency
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.errors import CalibrationError, OmsmError, text_of
from omsm_ros.quantities import GAIN_UNCERTAINTY, UNCERTAINTY, CheckedRecord

REJECTS, RESERVATION, WARNING, NOTE = "rejects", "reservation", "warning", "note"
SEVERITIES = (REJECTS, RESERVATION, WARNING, NOTE)

TEXT = "calibration.text"
"""Code of a finding that was stored as a sentence, in files of version 1."""

CERTIFICATE_SCHEMA = "omsm-certificate/2"
REJECTED, ACCEPTED = "rejected", "accepted"
RESERVED = "accepted with reservations"
VERDICTS = (ACCEPTED, RESERVED, REJECTED)
_UNDETECTED_CODES = {
    "creep": "calibration.undetected_creep",
    "soft mode": "calibration.undetected_mode",
    "stiffening": "calibration.undetected_stiffening",
}


@dataclass(frozen=True)
class Finding:
    """One statement about a calibration.

    code: ``room.subject``, the key of its sentence in :mod:`omsm_ros.messages`
    severity: "rejects", "reservation" (covered by the model or by a wider band), "warning" or
        "note"
    values: JSON values that the sentence names, SI;  limits: what they are compared with

    ``str(finding)`` is the sentence. Raises CalibrationError for another severity.
    """

    code: str
    severity: str
    values: Mapping[str, object] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.severity not in SEVERITIES:
            raise CalibrationError(
                "calibration.severity", severity=self.severity, known=", ".join(SEVERITIES)
            )

    def __str__(self) -> str:
        return text_of(self.code, {**self.limits, **self.values})


def of_severity(findings: Iterable[Finding], severity: str) -> tuple[Finding, ...]:
    """Return those of ``findings`` that have ``severity``, in their order."""
    return tuple(finding for finding in findings if finding.severity == severity)


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Origin of a calibration: machine, probe, operator, method and time.

    recorded_ns: when the recording began [ns, ROS time]
    input: of the identification, "encoder" or "reference"
    traceability: of encoder, reference sensor and artefacts
    software: name and version;  temperature_c: of the machine [°C];  target: what the probe read
    made_from: id of the file of version 1 that this was read from
    """

    machine: str | None = None
    probe: str | None = None
    probe_serial_number: str | None = None
    target: str | None = None
    temperature_c: float | None = None
    operator: str | None = None
    laboratory: str | None = None
    customer: str | None = None
    method: str | None = None
    traceability: str | None = None
    software: str | None = None
    input: str | None = None
    recorded_ns: int | None = None
    made_from: str | None = None


@dataclass(frozen=True, kw_only=True)
class Validity(CheckedRecord):
    """The band in which the response may be used, with ``valid_up_to`` of the calibration.

    from_hz: below it the response is taken as the static gain
    excited_up_to_hz: beyond it the motion would show no error of the response
    gain, phase_rad: greatest half-widths of the 95 % band, relative and [rad]
    use: what the verdict was made for
    """

    from_hz: float | None = UNCERTAINTY.of_field(None)
    excited_up_to_hz: float | None = None
    gain: float | None = None
    phase_rad: float | None = None
    use: IntendedUse | None = None
    error = CalibrationError


@dataclass(frozen=True)
class CandidateFit:
    """A structure that was fitted: its Bayesian information criterion and rms residual [m]."""

    structure: Structure
    bic: float
    rms_m: float


@dataclass(frozen=True, kw_only=True)
class Residual(CheckedRecord):
    """Statistics of the residual of the fitted model.

    rms_m: of the residual;  noise_m: standard deviation of a reading where the axis rests
    chi_square: mean square residual where the axis moves over that of the noise
    whiteness_p: of the test of Ljung;  independence_p: least of the tests against the motion
    response_agreement: mean square difference from the response estimated without a model, over
        its variance
    timing_scatter_s, axis_timing_scatter_s: standard deviation of the times of readings
    encoder_noise_m: noise of Z that the probe does not show
    """

    rms_m: float | None = None
    noise_m: float | None = UNCERTAINTY.of_field(None)
    chi_square: float | None = None
    edges: int | None = None
    whiteness_p: float | None = None
    independence_p: float | None = None
    response_agreement: float | None = None
    timing_scatter_s: float | None = None
    axis_timing_scatter_s: float | None = None
    encoder_noise_m: float | None = None
    samples: Mapping[str, int] = field(default_factory=dict)
    error = CalibrationError


@dataclass(frozen=True, kw_only=True)
class TwoMassModel:
    """The model of two masses that agrees with the response (Eq. 6 and 7).

    table_mass_kg: as stated; where None, ``model`` is per mass of the table
    model: masses [kg], stiffnesses [N/m], dampings [N·s/m] by name
    relative_uncertainty: of those fitted [1];  misfit: root of the reduced χ²
    collocated: whether the probe is on the driven mass
    """

    table_mass_kg: float | None = None
    model: Mapping[str, float]
    relative_uncertainty: Mapping[str, float]
    misfit: float
    collocated: bool


@dataclass(frozen=True, kw_only=True)
class Response:
    """Properties of the identified response.

    low_frequency_delay_s: of slow motion, with its standard uncertainty
    inter_sample_delay_bound_s: bound on its bias from motion between the samples
    reference_lag_s: of the reference sensor behind the encoder, with its standard uncertainty
    shape: frequencies [Hz] and gains [1] of what stands out;  modes: poles as terms of Eq. 8
    modal_remainder: share of the greatest gain that the modes do not describe
    """

    low_frequency_delay_s: float | None = None
    low_frequency_delay_uncertainty_s: float | None = None
    inter_sample_delay_bound_s: float | None = None
    reference_lag_s: float | None = None
    reference_lag_uncertainty_s: float | None = None
    shape: Mapping[str, float | None] = field(default_factory=dict)
    modes: tuple[Mapping[str, float | None], ...] = ()
    modal_remainder: float | None = None
    two_mass: TwoMassModel | None = None


@dataclass(frozen=True)
class GainEstimate:
    """A ratio of travels [1] and its standard uncertainty."""

    value: float
    uncertainty: float


@dataclass(frozen=True, kw_only=True)
class StaticGain:
    """How well the static gain is known, and the ratios of travel between plateaus.

    polarity: 1 where the distance falls when Z rises, -1 where it rises
    """

    uncertainty: float | None = None
    polarity: int | None = None
    probe_per_encoder: GainEstimate | None = None
    probe_per_reference: GainEstimate | None = None
    reference_per_encoder: GainEstimate | None = None

    def __post_init__(self) -> None:
        if self.uncertainty is not None:
            GAIN_UNCERTAINTY.checked(self.uncertainty, CalibrationError, "static_gain_uncertainty")


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """A deviation from a linear, steady response that was found and modelled.

    parameter: time constant [s], frequency [Hz] or length [m] of its family
    size_m, uncertainty_m: None where it became a part of the response
    """

    family: str
    parameter: float | None = None
    size_m: float | None = None
    uncertainty_m: float | None = None


@dataclass(frozen=True, kw_only=True)
class ModelErrors(CheckedRecord):
    """All deviations that were modelled, and what they cost.

    motion_error_m: standard uncertainty of a height of a scan from them
    """

    modelled: tuple[ModelError, ...] = ()
    motion_error_m: float | None = UNCERTAINTY.of_field(None)
    backlash_m: float | None = None
    drift_m_s: float | None = None
    error = CalibrationError


@dataclass(frozen=True, kw_only=True)
class UndetectedEntry:
    """A model error of one family that the test could not detect.

    parameter: time constant [s] or frequency [Hz]
    size, uncertainty: estimated;  missed: largest size missed with 5 % probability
    carried: standard uncertainty of the size that the covariance carries;  prior: as declared
    effect_on_scan_m, missed_effect_on_scan_m: rms on the intended scan
    """

    family: str
    parameter: float
    size: float
    uncertainty: float
    missed: float | None = None
    carried: float
    prior: float | None = None
    effect_on_scan_m: float
    missed_effect_on_scan_m: float | None = None

    @property
    def code(self) -> str:
        """Code of its name in words, which takes ``parameter``."""
        return _UNDETECTED_CODES.get(self.family, "calibration.undetected_other")


@dataclass(frozen=True, kw_only=True)
class Undetected:
    """Model errors that the test could not detect.

    gain_u: standard uncertainty that they leave in the dynamic gain relative to the static gain
    plateau_s: time from edge to edge of the test;  plateau_needed_s: one that would show them
    slowest_creep_s, lowest_mode_hz: beyond which none is assumed to exist
    """

    terms: tuple[UndetectedEntry, ...] = ()
    gain_u: float | None = None
    plateau_s: float | None = None
    plateau_needed_s: float | None = None
    slowest_creep_s: float | None = None
    lowest_mode_hz: float | None = None

    @property
    def largest(self) -> UndetectedEntry | None:
        """The term with the largest effect on the intended scan."""
        return max(self.terms, key=lambda term: term.effect_on_scan_m, default=None)


@dataclass(frozen=True, kw_only=True)
class PartsCompared:
    """The difference between two parts of a test, the first less the second.

    gain_difference: relative [1];  p: probability of such differences by chance
    """

    parts: str
    gain_difference: float | None = None
    gain_difference_uncertainty: float | None = None
    lag_difference_s: float | None = None
    lag_difference_uncertainty_s: float | None = None
    p: float | None = None


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """How a calibration was obtained, what was found, and whether to trust it.

    verdict: one of ``VERDICTS``, None where it was not judged
    findings: reasons for the verdict, reservations and warnings
    limits: all numbers that values were compared with, so that a reader can repeat the verdict
    latency: None where nothing is stated
    noise_covariance: (p, p) row by row, by which repeated tests of one machine scatter; empty
        where the covariance of the calibration does not separate it
    self_calibration: JSON values of the scans that the calibration was made from
    further: entries of a file of version 1 that have no place here

    Raises CalibrationError for another verdict.
    """

    verdict: str | None = None
    findings: tuple[Finding, ...] = ()
    limits: Mapping[str, float] = field(default_factory=dict)
    origin: Origin = Origin()
    validity: Validity = Validity()
    latency: Latency | None = None
    structure: Structure | None = None
    candidates: tuple[CandidateFit, ...] = ()
    residual: Residual = Residual()
    response: Response = Response()
    static_gain: StaticGain = StaticGain()
    model_errors: ModelErrors = ModelErrors()
    undetected: Undetected = Undetected()
    consistency: tuple[PartsCompared, ...] = ()
    noise_covariance: tuple[float, ...] = ()
    self_calibration: Mapping[str, object] = field(default_factory=dict)
    further: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.verdict is not None and self.verdict not in VERDICTS:
            raise CalibrationError(
                "calibration.verdict", verdict=repr(self.verdict)[:80], known=", ".join(VERDICTS)
            )

    @property
    def accepted(self) -> bool:
        """Whether the calibration may be used, with reservations or without."""
        return self.verdict in (ACCEPTED, RESERVED)

    @property
    def reasons(self) -> tuple[Finding, ...]:
        """Findings that reject."""
        return of_severity(self.findings, REJECTS)

    @property
    def reservations(self) -> tuple[Finding, ...]:
        """Findings that the model or a wider band covers."""
        return of_severity(self.findings, RESERVATION)

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that a user has to know and that change no verdict."""
        return of_severity(self.findings, WARNING)

    def judged(self, findings: Iterable[Finding] = ()) -> Certificate:
        """Return the certificate with ``findings`` added, and the verdict that all support.

        One that was rejected before stays so.
        """
        every = (*self.findings, *findings)
        verdict = REJECTED if self.verdict == REJECTED else verdict_of(every)
        return replace(self, findings=every, verdict=verdict)

    def content(self) -> dict[str, Any]:
        """Return the certificate as JSON values; empty where nothing is known."""
        found: dict[str, Any] = to_json(self)
        return {"schema": CERTIFICATE_SCHEMA, **found} if found else {}

    @classmethod
    def from_content(cls, content: Mapping[str, Any]) -> Certificate:
        """Return the inverse of :meth:`content`; raise CalibrationError if it is malformed."""
        values = {key: value for key, value in content.items() if key != "schema"}
        found: Certificate = from_json(cls, values, "certificate")
        return found


def verdict_of(findings: Iterable[Finding]) -> str:
    """Return the verdict that ``findings`` support."""
    severities = {finding.severity for finding in findings}
    if REJECTS in severities:
        return REJECTED
    return RESERVED if RESERVATION in severities else ACCEPTED


# Dataclasses to JSON values and back, each value checked against the type of its field.

_SCALARS = {str: "a text", bool: "true or false", int: "a whole number", float: "a finite number"}


def to_json(value: Any) -> Any:
    """Return ``value`` as JSON values; fields that are None or empty are left out."""
    if is_dataclass(value):
        found = ((field.name, to_json(getattr(value, field.name))) for field in fields(value))
        return {name: item for name, item in found if item is not None and item not in ([], {}, "")}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [to_json(item) for item in value] if isinstance(value, tuple | list) else value


def from_json(kind: Any, content: Any, name: str) -> Any:
    """Return the dataclass or type ``kind`` of JSON values; messages call it ``name``.

    Raises CalibrationError for a missing, unknown or mistyped field.
    """
    if kind in (Any, object):
        return content
    if is_dataclass(kind):
        return _read_fields(kind, content, name)
    outer, inner = get_origin(kind), get_args(kind)
    if outer in (Union, UnionType):
        wanted = next(part for part in inner if part is not NoneType)
        return None if content is None else from_json(wanted, content, name)
    if outer is tuple:
        _check(isinstance(content, list | tuple), content, name, "a list")
        return tuple(from_json(inner[0], item, f"{name}[{i}]") for i, item in enumerate(content))
    if outer is not None and issubclass(outer, Mapping):
        _check(isinstance(content, Mapping), content, name, "an object")
        return {str(key): from_json(inner[1], v, f"{name}.{key}") for key, v in content.items()}
    whole = kind is float and type(content) is int
    fits = (whole or type(content) is kind) and (kind is not float or math.isfinite(content))
    _check(fits, content, name, _SCALARS[kind])
    return kind(content)


def _read_fields(kind: Any, content: Any, name: str) -> Any:
    _check(isinstance(content, Mapping), content, name, "an object")
    types, required = _form(kind)
    if unknown := content.keys() - types.keys():
        raise CalibrationError("calibration.unknown_field", name=f"{name}.{min(unknown)}")
    if missing := required - content.keys():
        raise CalibrationError("calibration.missing_field", name=f"{name}.{min(missing)}")
    values = {key: from_json(types[key], item, f"{name}.{key}") for key, item in content.items()}
    try:
        return kind(**values)
    except CalibrationError:
        raise
    except OmsmError as err:
        raise CalibrationError("calibration.wrong_field", name=name, why=str(err)) from err


@lru_cache
def _form(kind: Any) -> tuple[Mapping[str, Any], frozenset[str]]:
    required = (
        f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING
    )
    hints = get_type_hints(kind)
    return {f.name: hints[f.name] for f in fields(kind)}, frozenset(required)


def _check(right: bool, content: object, name: str, expected: str) -> None:
    if not right:
        raise CalibrationError(
            "calibration.mistyped", name=name, value=repr(content)[:80], expected=expected
        )
