"""Adjust scans of one part together: from bags to form, sources and verdict in one folder."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.adjustment import (
    NOT_VERIFIED,
    VERIFIED,
    Adjustment,
    FormMap,
    Reason,
    ScanData,
    Source,
    SourceFinding,
    Verdict,
    adjust,
)
from omsm_ros.core.adjustment.adjust import corrected_heights
from omsm_ros.core.adjustment.scan_data import within
from omsm_ros.core.adjustment.sources import Contribution
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.machine_sources import (
    NAMES,
    NOTHING_STATED,
    MachineSources,
    StatedSource,
)
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.correction.systematic import EVALUATED
from omsm_ros.core.form.deviation_map import Doubt, UncertainValue, conformity
from omsm_ros.core.kinematics.kinematics import Surface, workpiece_xy
from omsm_ros.core.streams.blocks import Account
from omsm_ros.core.surface.aperture import within_aperture
from omsm_ros.core.surface.deviation import mismatch
from omsm_ros.errors import BagError, ConfigurationError, Notice
from omsm_ros.io.files import REPORT, save_json, save_text
from omsm_ros.io.results import PlyWriter
from omsm_ros.io.topics import AnyBag
from omsm_ros.messages import sentence
from omsm_ros.messages.verdict import source_name
from omsm_ros.pipelines.correct import STRICT, Admission, CorrectedScan
from omsm_ros.pipelines.recording import Recording, scan_data
from omsm_ros.readable import now_text, number
from omsm_ros.report.tables import sized
from omsm_ros.units import RPM_RAD_S

SCHEMA = "omsm-adjustment/1"
ADJUSTMENT, ADJUSTED_CLOUD = "adjustment.json", "adjusted.ply"
# Between two scans whose stamps do not say how far they lie apart, as the part is approached anew.
_PAUSE_S = 20.0


@dataclass(frozen=True, kw_only=True)
class AdjustedScan:
    """One scan as it was read for the adjustment.

    bag: where it is from;  data: for the adjustment;  points: as corrected, in the part frame
    account: of every sample;  began_ns: ROS time of its first sample, None if it is not known
    doubts: mismatches with the calibration, which was used all the same, and with the nominal
        surface
    """

    bag: str
    data: ScanData
    points: SurfacePoints
    account: Account
    began_ns: int | None
    doubts: tuple[str, ...] = ()


def read_scan(
    bag: AnyBag,
    calibration: Calibration,
    options: CorrectionOptions,
    *,
    clocking: float = 0.0,
    clamping: int = 0,
    admission: Admission = STRICT,
) -> AdjustedScan:
    """Correct a bag, and return its points with the motion of the axes, time from zero.

    clocking: angle by which the part is turned on the chuck, from x towards y [rad]
    clamping: its number

    Raises BagError for a bag without a surface point.
    """
    with Recording(bag) as recording:
        scan = CorrectedScan(recording, calibration, options, admission=admission)
        axes, parts = scan.read()
    scan.check_points()
    data, made = scan_data(axes, parts, scan.sample_period, clocking, clamping)
    x, y = workpiece_xy(made.x, made.y, np.full(len(made), clocking))
    return AdjustedScan(
        bag=str(bag),
        data=data,
        points=replace(made, x=x, y=y),
        account=scan.account,
        began_ns=scan.recorded_ns,
        doubts=tuple(map(str, scan.reasons)),
    )


def on_one_clock(scans: Sequence[AdjustedScan]) -> list[AdjustedScan]:
    """Return ``scans`` in the order in which they were made, with times of one clock.

    Their stamps are used where they leave room for each scan; a time lapse does not, then each
    begins a pause after the one before, in the order of their stamps or as they were given.
    """
    began = [scan.began_ns for scan in scans]
    order = list(range(len(scans)))
    if all(stamp is not None for stamp in began):
        order.sort(key=lambda k: began[k] or 0)
    stamped = [((began[k] or 0) - (began[order[0]] or 0)) * 1e-9 for k in order]
    durations = [scans[k].data.duration for k in order]
    fits = all(
        after - before > duration
        for before, after, duration in zip(stamped, stamped[1:], durations, strict=False)
    )
    begin, found = 0.0, []
    for k, stamp, duration in zip(order, stamped, durations, strict=True):
        begin = stamp if fits else begin
        data = replace(scans[k].data, time=scans[k].data.time + begin)
        found.append(replace(scans[k], data=data))
        begin += duration + _PAUSE_S
    return found


# Declared names that the adjustment calls otherwise.
_RENAMED = {"probe_noise": "noise"}
# Names of those files for families that are declared by another name.
_DECLARED_AS = {"noise": "probe_noise", "probe_square": "probe_linearity"}
# Declared sources that no scan adjusts: those of single readings.
NOT_ADJUSTED = ("probe_resolution", "encoder_noise", "encoder_resolution", "discretisation")


def priors_of(stated: MachineSources, abbe_arm: float = 0.0) -> tuple[Source, ...]:
    """Return the declared sources as priors of the adjustment, but zeros and ``NOT_ADJUSTED``.

    abbe_arm: over which pitch acts, unless it is stated with its own [m]

    Raises ConfigurationError for pitch without an arm, which would count as evaluated.
    """
    found: dict[str, Source] = {}
    for source in stated.stated:
        # A zero is no figure of a machine: it evaluates and declares nothing.
        if source.source in NOT_ADJUSTED or not source.standard_uncertainty:
            continue
        prior = _prior(source, abbe_arm)
        before = found.get(prior.name, replace(prior, uncertainty=0.0))
        size = float(np.hypot(before.uncertainty, prior.uncertainty))
        found[prior.name] = replace(prior, uncertainty=size)
    if cubic := found.get("probe_linearity"):
        # A declared linearity error may be of any shape.
        found["probe_square"] = replace(cubic, name="probe_square")
    return tuple(found.values())


def _prior(source: StatedSource, abbe_arm: float) -> Source:
    name, size = _RENAMED.get(source.source, source.source), source.standard_uncertainty
    if "per_turn" in source.parameters:
        name = f"{name}/{source.parameters['per_turn']:.3g}"
    if name == "pitch":
        arm = source.parameters.get("arm", abbe_arm)
        if not arm:
            raise ConfigurationError(
                "source 'pitch' has no arm, over which it acts; state arm, the distance of the "
                "beam from the line of the Z encoder [m], or abbe_arm in --geometry"
            )
        size *= arm
    parameters = source.parameters
    return Source(name, size, parameters.get("correlation_length"), source.origin == EVALUATED,
                  parameters.get("period"), parameters.get("half_range"))  # fmt: skip


def adjust_bags(
    bags: Sequence[AnyBag],
    calibration: Calibration,
    *,
    nominal: Surface | None = None,
    options: CorrectionOptions | None = None,
    stated: MachineSources = NOTHING_STATED,
    clockings: Sequence[float] = (),
    clampings: Sequence[int] = (),
    accuracy: float | None = None,
    accepted: Collection[str] = (),
    admission: Admission = STRICT,
) -> tuple[Adjustment, list[AdjustedScan]]:
    """Return ``bags``, scans of one part, adjusted together, and the scans as they were read.

    nominal: of the part in the frame of the workpiece; None: a polynomial
    stated: declared sources, the priors;  accepted: found values that somebody has accepted
    clockings: of the part on the chuck in each scan [rad];  clampings: their numbers
    accuracy: asked for, k = 2 [m]

    Raises ConfigurationError unless clockings and clampings fit the bags, BagError for equal scans.
    """
    for name, given in (("clocking", clockings), ("clamping", clampings)):
        if given and len(given) != len(bags):
            raise ConfigurationError(
                f"{len(given)} values of {name} for {len(bags)} scans; give one for each scan"
            )
    options = options or CorrectionOptions()
    places = zip(clockings or [0.0] * len(bags), clampings or [0] * len(bags), strict=True)
    scans = [
        read_scan(bag, calibration, options, clocking=turn, clamping=again, admission=admission)
        for bag, (turn, again) in zip(bags, places, strict=True)
    ]
    scans = on_one_clock(_checked(scans, nominal))
    area = None if nominal is None else within_aperture(nominal, None)[1]
    return adjust(
        [within(scan.data, area) if area else scan.data for scan in scans],
        priors_of(stated, options.geometry.abbe_arm),
        calibration=calibration,
        nominal=nominal,
        accuracy=accuracy,
        accepted=accepted,
    ), scans  # fmt: skip


def _checked(scans: Sequence[AdjustedScan], nominal: Surface | None) -> list[AdjustedScan]:
    """Return the scans, with a doubt where one is not of ``nominal``; BagError for equal scans."""
    for one, other in combinations(scans, 2):
        if np.array_equal(one.points.height, other.points.height):
            raise BagError(
                f"{one.bag!r} and {other.bag!r} hold the same scan, which does not verify itself; "
                "give two scans of the part"
            )
    if nominal is None:
        return [*scans]
    unlike = (mismatch(s.points.x, s.points.y, s.points.height, nominal) for s in scans)
    return [
        replace(scan, doubts=(*map(str, doubt), *scan.doubts))
        for scan, doubt in zip(scans, unlike, strict=True)
    ]


def write_adjustment(
    out: Path,
    facts: dict[str, Any],
    found: Adjustment,
    scans: Sequence[AdjustedScan],
    title: str = "Form of the part",
    report: bool = True,
) -> None:
    """Write adjustment.json, the adjusted points of all scans, and report.html into ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    with PlyWriter(out / ADJUSTED_CLOUD) as cloud:
        for index, scan in enumerate(scans):
            height = corrected_heights(found, scan.data, index)
            cloud.write(replace(scan.points, height=height))
    facts["files"] = {"adjustment": ADJUSTMENT, "cloud": ADJUSTED_CLOUD}
    facts["files"] |= {"report": REPORT} if report else {}
    save_json(out / ADJUSTMENT, facts)
    if report:
        # Here, because drawing takes longer to load than scans to adjust.
        from omsm_ros.report.adjustment import render

        save_text(out / REPORT, render(title, facts, found, now_text()))


def adjustment_facts(
    found: Adjustment,
    scans: Sequence[AdjustedScan],
    calibration: Calibration,
    tolerance: float | None = None,
) -> dict[str, Any]:
    """Return what ``adjustment.json`` says; lengths in metres.

    tolerance: of the peak to valley [m], None: conformity is not assessed
    """
    recorded = dict.fromkeys(doubt for scan in scans for doubt in scan.doubts)
    facts: dict[str, Any] = {
        "schema": SCHEMA,
        "calibration": calibration.id,
        "verdict": verdict_entry(found.verdict, len(scans), recorded),
        "figures": figures_entry(found.form),
        "scans": [
            {
                "bag": scan.bag,
                "speed_rpm": scan.data.speed / RPM_RAD_S,
                "outward": scan.data.outward,
                "turns": scan.data.turns,
                "duration": scan.data.duration,
                "clocking": scan.data.clocking,
                "points": len(scan.data),
                "samples": scan.account.as_dict(),
            }
            for scan in scans
        ],
        "sources": [_source_entry(source) for source in found.sources],
        "agreement": [
            {"scan": a.scan, "peak_to_valley": a.pv, "rms": a.rms, "terms": a.terms.tolist()}
            for a in found.agreement
        ],
        "noise": found.noise.tolist(),
        "drift_walk": found.drift_walk,
    }
    if tolerance is not None:
        doubts = _of_dust(found.form)
        facts["conformity"] = conformity_entry(facts["figures"], tolerance, doubts)
    return facts


def _of_dust(form: FormMap) -> list[dict[str, Any]]:
    """Return what the figures do not contain: points that were left out, if they are defects."""
    if not len(form.dust):
        return []
    largest, height = np.max(np.abs(form.dust)), np.ptp(np.append(form.height, form.dust))
    reason = Notice("verdict.dust", count=len(form.dust), largest=float(largest))
    return [{"reason": reason, "peak_to_valley": float(height)}]


def conformity_entry(
    figures: Mapping[str, Any], tolerance: float, doubts: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any] | None:
    """Return whether the peak to valley holds the ``tolerance`` [m] within its uncertainty.

    figures: as :func:`figures_entry` returns them;  doubts: ``open`` of the registration
    """
    figure = UncertainValue(*figures["peak_to_valley"].values())
    judged = conformity(figure, tolerance, [Doubt(**doubt) for doubt in doubts])
    return None if judged is None else judged.entry()


def figures_entry(form: FormMap) -> dict[str, Any]:
    """Return PV, rms and Zernike terms of the form with their uncertainties, lengths in metres."""
    spread = np.sqrt(np.maximum(np.diag(form.term_covariance), 0.0))

    def figure(value: float, uncertainty: float) -> dict[str, float]:
        return {"value": float(value), "standard_uncertainty": float(uncertainty)}

    return {
        "peak_to_valley": figure(form.pv.value, form.pv.uncertainty),
        "rms": figure(form.rms.value, form.rms.uncertainty),
        "removed": list(form.removed),
        "left_out": {
            "points": len(form.dust),
            "largest": float(np.max(np.abs(form.dust), initial=0.0)),
        },
        "terms": [
            {"n": t.n, "m": t.m, **figure(value, size)}
            for t, value, size in zip(form.terms, form.coefficients, spread, strict=True)
        ],
    }


def _source_entry(source: SourceFinding) -> dict[str, Any]:
    return {
        "name": source.name,
        "text": source_name(source.name),
        "unit": source.unit,
        "declared": source.declared,
        "found": np.atleast_1d(source.found).tolist(),
        "uncertainty": np.atleast_1d(source.uncertainty).tolist(),
        "effect": number(source.effect),
        "effect_uncertainty": number(source.effect_uncertainty),
        "identifiable": source.shown,
        "identified_by": source.shown_by,
        "deviate": number(source.deviate),
        "refuted": source.refuted,
        "alike": list(source.alike),
    }


def verdict_entry(verdict: Verdict, scans: int = 1, doubts: Iterable[str] = ()) -> dict[str, Any]:
    """Return a verdict as JSON values: code, text, reasons, and the scan to add that helps most.

    doubts: sentences about the recordings, with which nothing is verified: the first reasons
    """
    code = verdict.code
    against = [{"code": "recording", "text": text} for text in doubts]
    if against and code == VERIFIED:
        code = NOT_VERIFIED
    entry: dict[str, Any] = {
        "code": code,
        "text": sentence(f"verdict.{code}", {"scans": scans}),
        "reasons": [
            *against,
            *(
                {
                    "code": reason.code,
                    "names": list(reason.names),
                    "value": number(reason.value),
                    "limit": number(reason.limit),
                    "text": sentence(f"verdict.{reason.code}", _values(reason)),
                }
                for reason in _grouped(verdict.reasons)
            ),
        ],
    }
    if verdict.rests_on:
        names = [source_name(name) for name, _, _ in verdict.rests_on]
        size = math.hypot(*(effect for _, effect, _ in verdict.rests_on))
        text = sentence("verdict.rests_on", {"value": size})
        for shown in dict.fromkeys(by for _, _, by in verdict.rests_on):
            group = [source_name(name) for name, _, by in verdict.rests_on if by == shown]
            values = {"names": ", ".join(group), "remedy": sentence(f"verdict.add_{shown}", {})}
            text += ". " + sentence("verdict.to_verify", values)
        entry["rests_on"] = {
            "names": [name for name, _, _ in verdict.rests_on],
            "effect": number(size),
            "text": text,
        }
        if code == VERIFIED:
            more = f" and {len(names) - 2} more" if len(names) > 2 else ""
            values = {"text": entry["text"], "names": ", ".join(names[:2]) + more}
            entry["text"] = sentence("verdict.except", values)
    if verdict.add:
        entry["add"] = {
            "code": verdict.add,
            "reached": number(verdict.reached),
            "text": sentence(f"verdict.add_{verdict.add}", {}),
        }
    return entry


def _grouped(reasons: Sequence[Reason]) -> list[Reason]:
    """Return the reasons, sources without evaluation that one scan would show as one."""
    found: list[Reason] = []
    open_ones: dict[tuple[str, str], list[Reason]] = {}
    for reason in reasons:
        if reason.code in _OPEN:
            open_ones.setdefault((reason.code, reason.names[1]), []).append(reason)
        else:
            found.append(reason)
    for (code, shown_by), group in open_ones.items():
        names = (*dict.fromkeys(r.names[0] for r in group), shown_by)
        largest = max(r.value for r in group)
        found.append(Reason(code, names, largest, group[0].limit))
    return found


# Reasons whose last name is the scan that would show the sources named before it.
_OPEN = ("not_evaluated", "declared_only", "looks_like")


def _values(reason: Reason) -> Mapping[str, Any]:
    scans = reason.code in ("scans_disagree", "wrong_sign")
    names, remedy = reason.names, ""
    if reason.code in _OPEN:
        names, remedy = names[:-1], sentence(f"verdict.add_{names[-1]}", {})
    # With the name that --accept knows, or that of a file of sources where one may be declared.
    files = reason.code in ("not_evaluated", "declared_only")
    known = [_in_file(n) if files else n for n in names]
    texts = [
        str(int(n) + 1) if scans else source_name(n) + (f" ({name})" if name else "")
        for n, name in zip(names, known, strict=True)
    ]
    joined = (", " if reason.code in _OPEN else " or ").join(texts)
    possible = ", ".join(dict.fromkeys(filter(None, known)))
    declare = sentence("verdict.declare", {"names": possible}) if possible else ""
    contribution = "" if reason.largest is None else "; " + contribution_text(reason.largest)
    return {"names": joined, "value": reason.value, "limit": reason.limit, "remedy": remedy,
            "declare": declare, "contribution": contribution}  # fmt: skip


def contribution_text(largest: Contribution) -> str:
    """Return which source contributes most to an uncertainty, and what would have to shrink."""
    code = "verdict.remain" if math.isnan(largest.allowed) else "verdict.shrink"
    size, allowed = (sized(v, largest.unit, 2) for v in (largest.size, largest.allowed))
    name = f"{source_name(largest.name)} ({largest.name})"
    parts = {"name": name, "size": size, "allowed": allowed, "rest": largest.rest}
    return sentence(code, parts)


def _in_file(family: str) -> str:
    """Return the name by which a file of sources declares ``family``, "" if it does not."""
    name = family.split("@")[0].split("/")[0]
    name = _DECLARED_AS.get(name, name)
    return name if name in NAMES else ""
