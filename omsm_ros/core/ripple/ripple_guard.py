"""What is each line of a scan: on the part, a vibration, folded, the spindle, an artefact?

A kind is named only where some scan separates it from all others: its line is there, where no other
kind would put it, and is missing in no scan that would have to show it; or where the accelerometer
feels it; or where the scan's own pace changed, so that it is sharp in one kind only. Else it is
undecided.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.ripple.accelerometer import AccelerationLine, AccelerationLines
from omsm_ros.core.ripple.coordinates import Coordinate
from omsm_ros.core.ripple.density import aliased_frequency, significance
from omsm_ros.core.ripple.form_removal import FormFit, FormRemoved, SpindleOrder
from omsm_ros.core.ripple.lines import LEAST_SIGMA, LineSpectrum, find_lines
from omsm_ros.core.ripple.scan_signal import PATH, RADIUS, TIME, TURN, ScanSignal
from omsm_ros.core.ripple.source_hypotheses import (
    ARTEFACT,
    FOLDED,
    PART,
    SYNCHRONOUS,
    UNDECIDED,
    VIBRATION,
    Attribution,
    Key,
    LineEvidence,
    SourceHypothesis,
    StudiedScan,
    attribute_lines,
    attribution_evidence,
    is_ring_or_spindle,
    spread_of,
    unexplained_partner_amplitude,
    whole_order,
)
from omsm_ros.core.ripple.spectral_line import SpectralLine, sum_of, texture, waves_of
from omsm_ros.readable import count, quantity

# The words in which the ripple guard says what it saw, and what would decide.

RATE = "an accelerometer, or a scan at another sampling rate, tells"
# A line of fifty waves is one wave elsewhere at another pace; by less it may not have moved.
_SAME_PACE = 0.02


def along(coordinate: str) -> str:
    """Return in words along what a wavelength is measured."""
    return {PATH: "along the path", RADIUS: "from ring to ring"}.get(
        coordinate, f"over {coordinate}"
    )


def images(frequency: float, rate: float) -> str:
    """Return the lowest frequencies beyond ``rate`` / 2 [Hz] that fold to ``frequency``."""
    return ", ".join(hertz(f) for f in (rate - frequency, rate + frequency)) + ", …"


def hertz(frequency: float) -> str:
    """Return a frequency [Hz] in words; lines differ in their sixth digit."""
    return quantity(frequency, "Hz", 6)


def missing_evidence(
    scans: Sequence[StudiedScan], own: int, line: SpectralLine, kinds: set[str]
) -> str:
    """Return what would decide between the kinds that are left."""
    scan, found = scans[own], []
    others = [s for k, s in enumerate(scans) if k != own]
    if not any(_other_pace(scan, s, line) for s in others):
        found.append("a second scan of the part at another speed or feed")
    elif PART in kinds or SYNCHRONOUS in kinds:
        found.append("a further scan at yet another speed")
    else:
        found.append("a slower scan that resolves finer texture")
    if scan.acceleration_lines is None:
        found.append("an accelerometer in the bag")
    return "needs " + " or ".join(found)


def _other_pace(scan: StudiedScan, other: StudiedScan, line: SpectralLine) -> bool:
    """Return True if any coordinate of the line runs at another pace in ``other``."""
    for name in line.possible:
        if name != TIME and name in other.coordinates:
            here, there = scan.coordinates[name].pace, other.coordinates[name].pace
            if abs(here - there) > _SAME_PACE * here:
                return True
    return False


# What an accelerometer feels moves the height by this part of a/ω² at least, and at most.
_LEAST_AMPLITUDE_RATIO, _GREATEST_AMPLITUDE_RATIO = 0.1, 30.0
# In resolutions: as uncertain is the frequency of a line that is taken for an order.
_OF_AN_ORDER = 0.25
# So near, in resolutions, a line and an order are not fitted apart.
_LEAKS_BINS = 1.5
# The first makes a line's frequency right, the second its amplitude.
_TURNS_OF_FITTING = 2
# So many felt lines would agree with a line of the scan by chance that they say nothing.
_GREATEST_CHANCE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedLine:
    """A line and what it is.

    kind: one of :data:`omsm_ros.core.ripple.source_hypotheses.KINDS`;  evidence: what says so
    needs: what would decide, if undecided
    frequency: true, of a vibration [Hz], None where it is not known or meant
    wavelength: of what is on the part [m];  order: waves a turn, of the spindle
    also: another kind that the same line holds besides
    """

    line: SpectralLine
    kind: str
    evidence: tuple[str, ...] = ()
    needs: str = ""
    frequency: float | None = None
    wavelength: float | None = None
    order: int | None = None
    also: str = ""


def analyse_scan(
    signal: ScanSignal,
    acceleration_lines: AccelerationLines | None = None,
    textures: Sequence[tuple[float, float]] = (),
) -> StudiedScan:
    """Take form and lines of one scan apart.

    textures: waves along the path [1/m] that are known to be there, too fine to be searched for,
        and how well they are known
    """
    formless, spectrum = _apart(signal, textures)
    return StudiedScan(
        signal=signal,
        formless=formless,
        spectrum=spectrum,
        lines=(*spectrum.lines, *_order_lines(formless, spectrum)),
        acceleration_lines=acceleration_lines,
    )


def analyse_scans(
    scans: Sequence[tuple[ScanSignal, AccelerationLines | None]],
) -> list[StudiedScan]:
    """Study scans of one part: first each by itself, then with the textures of the others.

    Where the pace changes, a texture finer than twice the sampling distance has no image that
    is a line; it is seen all the same, where one knows to look.
    """
    studied = [analyse_scan(signal, acceleration_lines) for signal, acceleration_lines in scans]
    return [
        analyse_scan(one.signal, one.acceleration_lines, finer)
        if (finer := _finer(one, studied))
        else one
        for one in studied
    ]


def _finer(one: StudiedScan, studied: Sequence[StudiedScan]) -> list[tuple[float, float]]:
    """Return waves that ``one`` cannot resolve and their uncertainty, the best known first."""
    path = one.coordinates.get(PATH)
    if path is None or path.proportional_to_time:
        return []
    found = sorted(
        (spread_of(other, line, PATH), line.possible[PATH])
        for other in studied
        for line in other.lines
        if other is not one and PATH in line.possible and line.possible[PATH] > path.highest
    )
    kept: list[tuple[float, float]] = []
    for spread, wave in found:
        if all(abs(wave - known) > spread + other for known, other in kept):
            kept.append((wave, spread))
    return kept


def _apart(
    signal: ScanSignal, textures: Sequence[tuple[float, float]]
) -> tuple[FormRemoved, LineSpectrum]:
    """Form and lines, fitted beside each other: a line near an order leaks into it."""
    form = FormFit(signal)
    formless = form.without()
    known = [texture(signal, formless.residual, wave, spread) for wave, spread in textures]
    spectrum = find_lines(signal, formless.residual, known, form.owned())
    if not spectrum.lines:
        return formless, spectrum
    form.refine(sum_of(spectrum.lines, spectrum.coordinates, len(signal)))
    for _ in range(_TURNS_OF_FITTING):
        formless = form.without(waves_of(spectrum.lines, spectrum.coordinates))
        spectrum = find_lines(signal, formless.residual, spectrum.lines, form.owned())
        if not spectrum.lines:
            break
    return formless, spectrum


def _order_lines(formless: FormRemoved, spectrum: LineSpectrum) -> Iterable[SpectralLine]:
    """Return the significant orders as lines over turns, and over what is proportional to turns."""
    coordinates = spectrum.coordinates
    for found in formless.orders:
        ratio = np.array(found.amplitude**2 / (2 * found.uncertainty**2))
        sigma = float(significance(ratio, len(formless.orders)))
        turn = coordinates[TURN]
        if sigma < LEAST_SIGMA or _near_stronger_line(found, spectrum, turn):
            continue
        possible = {TURN: float(found.order)} | {
            name: found.order * turn.pace / c.pace
            for name, c in coordinates.items()
            if c.like == turn.like and name != TURN
        }
        yield SpectralLine(
            coordinate=TURN,
            frequency=float(found.order),
            cosine=found.cosine,
            sine=found.sine,
            # A line so near to a whole number of waves a turn is taken for one.
            frequency_uncertainty=_OF_AN_ORDER * turn.resolution,
            amplitude_uncertainty=found.uncertainty,
            significance=sigma,
            possible=possible,
        )


def _near_stronger_line(order: SpindleOrder, spectrum: LineSpectrum, turn: Coordinate) -> bool:
    """Return True if a stronger line is so near that the order may be its leakage."""
    return any(
        abs(line.possible[TURN] - order.order) < _LEAKS_BINS * turn.resolution
        and line.amplitude > order.amplitude
        for line in spectrum.lines
        if TURN in line.possible
    )


def name_lines(scans: Sequence[StudiedScan]) -> list[list[NamedLine]]:
    """Say of each line of each scan what it is, in the order of the scans and of their lines."""
    evidence = attribution_evidence(scans)
    done = attribute_lines(scans, evidence)
    named = {key: _named(done, key, found) for key, found in evidence.items()}
    named = {key: _with_true_frequency(scans, named, key) for key in named}
    return [[named[own, k] for k in range(len(scan.lines))] for own, scan in enumerate(scans)]


def _named(done: Attribution, key: Key, evidence: LineEvidence) -> NamedLine:
    scan, line = done.scans[key[0]], evidence.line
    claim = done.claim.get(key)
    own = None if claim is None else _by_claim(done, key, claim)
    also = done.also.get(key)
    if own is not None and claim is not None and also is not None:
        second = _by_claim(done, key, also)
        text = (
            f"coincides here with a line that is {second.kind}: elsewhere this has "
            f"{quantity(unexplained_partner_amplitude(done, [claim]), 'm')}, "
            f"the other {quantity(unexplained_partner_amplitude(done, [also]), 'm')}"
        )
        own = replace(own, evidence=(*own.evidence, text), also=second.kind)
    one = _matching_acceleration_lines(scan, line)
    if one is None:
        return own or _name_from_single_scan(done, key, evidence)
    acceleration_as = _acceleration_text(scan, line, one)
    if own is None or claim is None or own.kind == VIBRATION or own.kind == FOLDED:
        return acceleration_as
    size = unexplained_partner_amplitude(done, [claim])
    if size > one.displacement and size > 0.5 * line.amplitude:
        return replace(
            own, evidence=(*own.evidence, *acceleration_as.evidence), also=acceleration_as.kind
        )
    text = f"coincides here with {quantity(size, 'm')} {own.kind}"
    return replace(acceleration_as, evidence=(*acceleration_as.evidence, text), also=own.kind)


def _by_claim(done: Attribution, key: Key, claim: SourceHypothesis) -> NamedLine:
    scans, line = done.scans, done.evidence[key].line
    where = ", ".join(scans[own].signal.name for own, _ in claim.partners)
    h = claim.hypothesis
    if claim.kind == PART:
        text = f"the same wavelength {along(h.coordinate)} in {where}"
        return NamedLine(line=line, kind=PART, evidence=(text,), wavelength=1 / h.frequency)
    if claim.kind == ARTEFACT:
        text = (
            f"{where} resolves a texture of {quantity(1 / h.frequency, 'm', 4)}, shorter than "
            "twice the sampling distance here; its image is seen at this place"
        )
        return NamedLine(line=line, kind=ARTEFACT, evidence=(text,), wavelength=1 / h.frequency)
    if claim.kind == SYNCHRONOUS:
        texts = [f"{round(h.frequency)} waves a turn in {where} as well, at another speed"]
        if scans[key[0]].formless.on_circle:
            texts.append("on one circle a figure of the part of that order looks the same")
        order = round(h.frequency)
        return NamedLine(line=line, kind=SYNCHRONOUS, evidence=tuple(texts), order=order)
    return _noise_effects(done, key, claim, where)


def _noise_effects(done: Attribution, key: Key, claim: SourceHypothesis, where: str) -> NamedLine:
    scans, line, h = done.scans, done.evidence[key].line, claim.hypothesis
    rate = scans[key[0]].signal.rate
    rates = {round(scans[own].signal.rate, 6) for own, _ in claim.partners} - {round(rate, 6)}
    if not rates:
        text = f"the same frequency in {where}, at another speed over the part"
        return NamedLine(
            line=line, kind=VIBRATION, evidence=(text, _self_or_alias_text(line, rate))
        )
    sampled = ", ".join(quantity(r, "Hz", 4) for r in sorted(rates))
    text = f"seen in {where}, sampled at {sampled}, where {hertz(h.frequency)} would be seen"
    kind = FOLDED if h.frequency > rate / 2 else VIBRATION
    return NamedLine(line=line, kind=kind, evidence=(text,), frequency=h.frequency)


def _self_or_alias_text(line: SpectralLine, rate: float) -> str:
    return f"itself or the image of {images(line.possible[TIME], rate)}: {RATE}"


def _matching_acceleration_lines(scan: StudiedScan, line: SpectralLine) -> AccelerationLine | None:
    """Return what the accelerometer feels that would be seen at this line, and is of its size."""
    if scan.acceleration_lines is None or TIME not in line.possible:
        return None
    seen, rate = line.possible[TIME], scan.signal.rate
    tolerance = 1 / scan.signal.duration
    if len(scan.acceleration_lines.lines) * 4 * tolerance / rate > _GREATEST_CHANCE:
        tolerance /= 4
    near = [
        one
        for one in scan.acceleration_lines.lines
        if abs(float(aliased_frequency(one.frequency, rate)) - seen)
        <= tolerance + 4 * one.frequency_uncertainty
        and _LEAST_AMPLITUDE_RATIO <= one.displacement / line.amplitude <= _GREATEST_AMPLITUDE_RATIO
    ]
    return min(near, key=lambda one: abs(np.log(one.displacement / line.amplitude)), default=None)


def _acceleration_text(scan: StudiedScan, line: SpectralLine, one: AccelerationLine) -> NamedLine:
    rate = scan.signal.rate
    texts = [
        f"the accelerometer feels {quantity(one.acceleration, 'm/s²')} along {one.axis} at "
        f"{hertz(one.frequency)} ({count(round(one.significance))} σ), "
        f"{quantity(one.displacement, 'm')} "
        "of motion"
    ]
    alias_count = one.frequency > rate / 2
    if alias_count:
        seen = float(aliased_frequency(one.frequency, rate))
        texts.append(f"sampled at {quantity(rate, 'Hz', 4)} it is seen at {hertz(seen)}")
    kind = FOLDED if alias_count else VIBRATION
    return NamedLine(line=line, kind=kind, evidence=tuple(texts), frequency=one.frequency)


def _name_from_single_scan(done: Attribution, key: Key, evidence: LineEvidence) -> NamedLine:
    """Name a line from one scan alone: its pace changed, and the line is sharp in one kind only."""
    scan, line = done.scans[key[0]], evidence.line
    kinds = {t.kind for t in evidence.tested if t.alive}
    if set(line.possible) == {PATH}:
        text = f"sharp {along(line.coordinate)}, spread over time, for the pace changed"
        return NamedLine(line=line, kind=PART, evidence=(text,), wavelength=1 / line.frequency)
    if TIME not in line.possible and set(line.possible) <= {TURN} and SYNCHRONOUS in kinds:
        order = whole_order(scan, line)
        text = f"{order} waves a turn, spread over time, for the spindle's speed changed"
        return NamedLine(line=line, kind=SYNCHRONOUS, evidence=(text,), order=order)
    if set(line.possible) == {TIME} and len(scan.coordinates) > 1:
        text = "sharp over time, spread over path and turns, for the pace changed"
        return NamedLine(
            line=line, kind=VIBRATION, evidence=(text, _self_or_alias_text(line, scan.signal.rate))
        )
    against = tuple(
        f"not {t.kind}: missing in {', '.join(done.scans[k].signal.name for k in t.absent)}"
        for t in evidence.tested
        if not t.alive
    )
    asked = missing_evidence(done.scans, key[0], line, kinds)
    if is_ring_or_spindle(evidence.tested):
        asked = "needs a scan with another feed per turn"
    return NamedLine(line=line, kind=UNDECIDED, evidence=against, needs=asked)


def _with_true_frequency(
    scans: Sequence[StudiedScan], named: dict[Key, NamedLine], key: Key
) -> NamedLine:
    """Return a vibration whose true frequency another scan has decided."""
    own = named[key]
    if own.kind != VIBRATION or own.frequency is not None:
        return own
    scan = scans[key[0]]
    seen, rate = own.line.possible[TIME], scan.signal.rate
    for (other, _), row in named.items():
        if other == key[0] or row.frequency is None:
            continue
        if abs(float(aliased_frequency(row.frequency, rate)) - seen) <= 1 / scan.signal.duration:
            text = f"{scans[other].signal.name} tells its frequency: {hertz(row.frequency)}"
            kind = FOLDED if row.frequency > rate / 2 else VIBRATION
            both = (own.evidence[0], text)
            return replace(own, kind=kind, frequency=row.frequency, evidence=both)
    return own
