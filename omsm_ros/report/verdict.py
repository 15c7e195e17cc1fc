"""The verdict on a measurement, with every reason against it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.readable import count, expanded, quantity
from omsm_ros.report.tables import part


@dataclass(frozen=True, slots=True)
class PageVerdict:
    """Verdict of a page.

    level: "good", "care", "bad", "unknown" or "neutral";  word: as text;  reasons: for it
    """

    level: str
    word: str
    reasons: tuple[str, ...]


def verdict_text(calibration: Calibration) -> str:
    """Return the verdict of the certificate and the band that it holds for; empty without one."""
    certificate = calibration.certificate
    if not certificate.accepted:
        return certificate.verdict or ""
    low, high = certificate.validity.from_hz, quantity(calibration.valid_up_to, "Hz")
    start = f"from {quantity(low, 'Hz', 2)} to" if low else "up to"
    return f"{certificate.verdict}, valid {start} {high}"


_LEVELS = {"verified": "good", "not_verified": "care"}
"""Level of a page by the code of its verdict; of all other codes "bad"."""


def page_verdict(verdict: Mapping[str, Any], more: Iterable[str] = ()) -> PageVerdict:
    """Return a verdict, as adjustment and summary hold it, for a page.

    more: further reasons, with which nothing is verified
    """
    level, text = _LEVELS.get(verdict["code"], "bad"), verdict["text"]
    steps = [*more, *next_steps(verdict)]
    if more and level == "good":
        level = "care"
    return PageVerdict(level, text[:1].upper() + text[1:], tuple(steps))


def next_steps(verdict: Mapping[str, Any]) -> list[str]:
    """Return what to do next, first of all, and the reasons against green.

    This is a doubt about the recordings, else the scan that helps most, but for heights that are
    contradicted what contradicts them.
    """
    steps = [reason["text"] for reason in verdict["reasons"]]
    doubts = sum(reason["code"] == "recording" for reason in verdict["reasons"])
    if (add := verdict.get("add")) is not None and verdict["code"] != "contradicted":
        then = ""
        if add["reached"] is not None:
            then = f": then U of PV is about {quantity(add['reached'], 'm', 2)} (k = 2)"
        steps.insert(doubts, f"next: {add['text']}, and run 'omsm adjust' with all scans{then}")
    if verdict["code"] == "verified":
        steps.append("the scans agree, and no declared source is refuted")
        if (resting := verdict.get("rests_on")) is not None:
            steps.append(resting["text"])
    return steps


def verdict_on_measurement(summary: Mapping[str, Any]) -> PageVerdict:
    """Return the verdict of a scan's summary, with the warnings of the measurement.

    Samples without account make it invalid; a summary of an earlier version holds no verdict.
    """
    warnings = [*map(str, part(summary, "warnings") or ())]
    against = []
    for name, stream in (part(summary, "samples") or {}).items():
        seen = stream["corrected"] + stream.get("pending", 0) + sum(stream["counted"].values())
        if seen != stream["received"]:
            lost = count(abs(stream["received"] - seen))
            against.append(f"{name}: {lost} samples unaccounted for")
    if against:
        return PageVerdict("bad", "Measurement not valid", tuple(against))
    verdict = part(summary, "verdict")
    if not verdict:
        return PageVerdict("unknown", "Not verified", ("correct the scan again", *warnings))
    return page_verdict(verdict, warnings)


_CONFORMITY = {"holds": "tolerance held", "fails": "tolerance exceeded"}
_OPEN = "conformity open: the tolerance lies within the uncertainty"
_INCOMPLETE = "conformity open: parts of the surface are in no figure"


def covered(form: Mapping[str, Any] | None) -> str:
    """Return the words behind an extent if some of the aperture has no points, else none."""
    found = part(form or {}, "open") or ()
    return " of the covered part" * any(doubt["peak_to_valley"] is None for doubt in found)


def registered_figures(form: Mapping[str, Any]) -> dict[str, Any]:
    """Return PV and rms of a registered form, as an adjustment states them; none without both."""
    found: dict[str, Any] = {
        key: {"value": one["value"], "standard_uncertainty": one["uncertainty"]}
        for key in ("peak_to_valley", "rms")
        if (one := part(form, "deviation", key)) and one["value"] is not None
    }
    removed = part(form, "removed", "fitted") or ()
    return {**found, "removed": removed, "terms": []} if len(found) == 2 else {}


def headline(facts: Mapping[str, Any]) -> str:
    """Return the result in one line: "PV 175 nm ± 12 nm (k = 2), tolerance held"."""
    pv = facts["figures"]["peak_to_valley"]
    text = (
        f"PV {expanded(pv['value'], pv['standard_uncertainty'], 'm')}{covered(facts.get('form'))}"
    )
    if (left_out := facts["figures"].get("left_out") or {}).get("points"):
        text += f" without {count(left_out['points'])} points"
        text += f" left out as dust, up to {quantity(left_out['largest'], 'm', 2)} off"
    if (judged := facts.get("conformity")) is not None:
        open_ = _INCOMPLETE if judged.get("reasons") else _OPEN
        text += f", {_CONFORMITY.get(judged['verdict'], open_)}"
    return text
