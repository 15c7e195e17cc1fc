"""Does this calibration belong to these data?

A calibration holds for the probe's rate, exposure and averaging, for the machine and the
fixture it was made with. What differs is stated in full sentences; whoever corrects anyway
records them with the result.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from omsm_ros.core.calibration.calibration import PROBE, Calibration
from omsm_ros.core.streams.blocks import SAME_PERIOD
from omsm_ros.errors import CalibrationError

# Settings are written by people or read back as float32.
_SAME_VALUE = 1e-6


def objections(
    calibration: Calibration,
    *,
    sample_period: float | None = None,
    settings: Mapping[str, object] | None = None,
    probe: Sequence[Mapping[str, object]] = (),
    polarity: int | None = None,
) -> tuple[str, ...]:
    """Return why ``calibration`` should not be used; empty if nothing speaks against it.

    sample_period: of the data [s];  polarity: that the correction will use
    settings: as they are now; a name that both sides know must have the same value, one that
        the calibration was made with must not be missing
    probe: each state that the probe's driver reported; what both it and the calibration
        know must agree
    """
    found = [*_certificate(calibration, polarity)]
    expected = calibration.sample_period
    if sample_period is not None and abs(sample_period - expected) > SAME_PERIOD * expected:
        found.append(f"sample period is {sample_period!r} s, calibrated at {expected!r} s")
    if settings is not None:
        stated = {n: v for n, v in calibration.settings.items() if not n.startswith(PROBE)}
        found += _differences(stated, settings)
    for state in probe:
        known = {n: v for n, v in calibration.settings.items() if n in state}
        found += _differences(known, state)
    return tuple(dict.fromkeys(found))


def admit(calibration: Calibration, reasons: tuple[str, ...], override: bool) -> dict[str, object]:
    """Return what to record of the decision to use a calibration, as JSON values.

    Raises CalibrationError with all ``reasons`` unless there are none or ``override`` is set.
    """
    if reasons and not override:
        raise CalibrationError(
            f"calibration {calibration.id[:12]} does not belong to these data: "
            f"{'; '.join(reasons)}. Set the cell as it was, identify again, or use it all the same "
            "(--override; parameter override)"
        )
    return {"calibration": calibration.id, "objections": list(reasons), "overridden": bool(reasons)}


def _certificate(calibration: Calibration, polarity: int | None) -> list[str]:
    certificate = calibration.certificate
    found = []
    verdict = certificate.get("verdict")
    if verdict is None:
        found.append("its certificate states no verdict")
    elif not str(verdict).startswith("accepted"):
        found.append(f"its certificate says {verdict!r}{_reasons(certificate)}")
    certified = certificate.get("polarity")
    if polarity is not None and certified is not None and certified != polarity:
        moves = "rises" if certified == -1 else "falls"
        found.append(
            f"polarity is {polarity!r}, calibrated with {certified!r} (the distance {moves} as z "
            "rises): turn the sign of distance where both recordings come from (map, driver), or "
            f"state polarity {certified} (--polarity {certified})"
        )
    return found


def _reasons(certificate: Mapping[str, object]) -> str:
    reasons = certificate.get("reasons")
    return f" ({'; '.join(map(str, reasons))})" if isinstance(reasons, list) and reasons else ""


def _differences(then: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    found = []
    for name, value in sorted(then.items()):
        if name not in now:
            found.append(f"{name} is not known, calibrated with {value!r}")
        elif not _same(value, now[name]):
            found.append(f"{name} is {now[name]!r}, calibrated with {value!r}")
    return found


def _same(one: object, other: object) -> bool:
    if _is_number(one) and _is_number(other):
        return bool(np.isclose(one, other, rtol=_SAME_VALUE, atol=0.0))  # type: ignore[call-overload]
    return one == other


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
