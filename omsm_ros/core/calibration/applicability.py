"""Decide whether a calibration applies to a recording.

A calibration holds for the rate, exposure and averaging of the probe, the machine and the fixture
that it was made with. Each difference is an objection; a user who corrects anyway has them
recorded with the result.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from omsm_ros.core.calibration.calibration import PROBE, Calibration
from omsm_ros.core.streams.blocks import SAME_PERIOD
from omsm_ros.errors import CalibrationError, Notice

# Settings are written by people, or read back as float32.
_SAME_VALUE = 1e-6


def objections(
    calibration: Calibration,
    *,
    sample_period: float | None = None,
    settings: Mapping[str, object] | None = None,
    probe: Sequence[Mapping[str, object]] = (),
    polarity: int | None = None,
) -> tuple[Notice, ...]:
    """Return why ``calibration`` should not be used; empty if there is no reason against it.

    sample_period: of the data [s];  polarity: that the correction will use
    settings: as they are now; a name that both sides know must have the same value, one that
        the calibration was made with must not be missing
    probe: each state that the probe's driver reported; what both it and the calibration
        know must agree
    """
    found = [*_certificate(calibration, polarity)]
    expected = calibration.sample_period
    if sample_period is not None and abs(sample_period - expected) > SAME_PERIOD * expected:
        found.append(Notice("calibration.other_period", period=sample_period, calibrated=expected))
    if settings is not None:
        stated = {n: v for n, v in calibration.settings.items() if not n.startswith(PROBE)}
        found += _differences(stated, settings)
    for state in probe:
        known = {n: v for n, v in calibration.settings.items() if n in state}
        found += _differences(known, state)
    return tuple(dict.fromkeys(found))


def admit(
    calibration: Calibration, reasons: tuple[Notice, ...], override: bool
) -> dict[str, object]:
    """Return what to record of the decision to use a calibration, as JSON values.

    Raises CalibrationError with all ``reasons`` unless there are none or ``override`` is set.
    """
    if reasons and not override:
        raise CalibrationError(
            "calibration.not_applicable",
            id=calibration.id[:12],
            reasons="; ".join(map(str, reasons)),
        )
    return {
        "calibration": calibration.id,
        "objections": [str(reason) for reason in reasons],
        "overridden": bool(reasons),
    }


def _certificate(calibration: Calibration, polarity: int | None) -> list[Notice]:
    certificate = calibration.certificate
    found = []
    if certificate.verdict is None:
        found.append(Notice("calibration.not_judged"))
    elif not certificate.accepted:
        reasons = "; ".join(map(str, certificate.reasons))
        found.append(Notice("calibration.was_rejected", reasons=f" ({reasons})" if reasons else ""))
    certified = certificate.static_gain.polarity
    if polarity is not None and certified is not None and certified != polarity:
        rises, falls = "calibration.other_polarity_rises", "calibration.other_polarity_falls"
        code = rises if certified == -1 else falls
        found.append(Notice(code, polarity=polarity, certified=certified))
    return found


def _differences(then: Mapping[str, object], now: Mapping[str, object]) -> list[Notice]:
    found = []
    for name, value in sorted(then.items()):
        if name not in now:
            found.append(Notice("calibration.unknown_setting", name=name, calibrated=value))
        elif not _same(value, now[name]):
            found.append(
                Notice("calibration.other_setting", name=name, value=now[name], calibrated=value)
            )
    return found


def _same(one: object, other: object) -> bool:
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in (one, other)):
        return bool(np.isclose(one, other, rtol=_SAME_VALUE, atol=0.0))  # type: ignore[call-overload]
    return one == other
