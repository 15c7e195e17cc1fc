"""Compare the causes that a certificate names with the disturbance that was made."""

from __future__ import annotations

from collections.abc import Iterable

from omsm_ros.core.calibration.certificate import Finding

RIGHT, UNKNOWN, WRONG = "right", "unknown", "wrong"

# The causes that a finding names, each a possible one; other findings name none.
_NAMED = {
    "backlash": ("backlash",),
    "friction": ("friction",),
    "linearity": ("linearity",),
    "periodic": ("periodic",),
    "vibration": ("vibration",),
    "drift": ("drift", "creep"),
    "creep": ("creep",),
    "mode": ("mode",),
    "stiffening": ("stiffening",),
    "timing_scatter": ("timing",),
    "axis_timing_scatter": ("timing",),
    "residual_of_axis_timing": ("timing",),
    "dependent_by_timing": ("timing",),
    "late_encoder": ("late encoder",),
    "late_probe": ("latency",),
    "scale": ("scale",),
    "exchanged_channels": ("exchanged channels",),
    "late_reference": ("late reference",),
    "two_clocks": ("clocks",),
}
# The causes in a disturbance, by how its name in the catalogue begins. Any cause that is named of
# another disturbance is a wrong one.
_MADE = {
    "linearity, cubic": ("linearity",),
    "linearity, periodic": ("periodic",),
    "creep": ("creep",),
    "logarithmic creep": ("creep",),
    "base mode": ("mode",),
    "isolator": ("mode",),
    "backlash": ("backlash",),
    "friction": ("friction",),
    "hardening": ("stiffening",),
    # B that swings once a second moves the probe once a second.
    "B swinging": ("vibration",),
    "drift": ("drift",),
    "vibration": ("vibration",),
    "encoder interpolation": ("periodic",),
    "pitch, steady": ("periodic",),
    "trigger jitter": ("timing",),
    "probe jitter": ("timing",),
    "probe clock offset": ("latency", "late encoder"),
    "probe clock drift": ("drift", "clocks"),
    "Z latched late": ("late encoder",),
    "reference late": ("late reference",),
    "latency": ("latency",),
    "exposure": ("latency",),
    "averaging": ("latency",),
}


# Causes of a finding that names several.
_WORDS = {"nonlinear scale of the probe": "linearity", "periodic error": "periodic"}


def _causes(finding: Finding) -> tuple[str, ...]:
    """Return the causes that a finding names as possible ones, none for others."""
    subject = finding.code.partition(".")[2]
    if subject == "undecided":
        causes = finding.values["causes"]
        assert isinstance(causes, list)
        return tuple(_WORDS.get(cause, cause) for cause in causes)
    return _NAMED.get(subject, ())


def judged(name: str, findings: Iterable[Finding]) -> str:
    """Return whether the causes that ``findings`` name are those of the disturbance ``name``.

    name: of the catalogue; a pair has " + " between its two names

    RIGHT if every finding names a cause that was made, WRONG if one does not. UNKNOWN if no finding
    names a cause.
    """
    made = {
        cause
        for part in name.split(" + ")
        for start, causes in _MADE.items()
        if part.startswith(start)
        for cause in causes
    }
    named = [causes for finding in findings if (causes := _causes(finding))]
    if not named:
        return UNKNOWN
    return RIGHT if all(made.intersection(causes) for causes in named) else WRONG
