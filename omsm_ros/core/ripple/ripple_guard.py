"""Attribute the lines of scans to their sources: part, vibration, spindle or sampling.

A source is named only if a scan separates it from all others: its line is present where no other
source would put it, and is missing in no scan that would have to show it; or if the accelerometer
measures it; or if the pace of the scan changed and the line is sharp in one coordinate only.
Otherwise it is undecided.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.ripple.accelerometer import LARGEST_GAIN, AccelerationLine, AccelerationLines
from omsm_ros.core.ripple.density import aliased_frequency, significance
from omsm_ros.core.ripple.form_removal import FormFit, FormRemoved
from omsm_ros.core.ripple.lines import LEAST_SIGMA, LineSpectrum, find_lines, further_lines
from omsm_ros.core.ripple.scan_signal import PATH, TIME, TURN, ScanSignal
from omsm_ros.core.ripple.source_hypotheses import (
    ALIASED,
    ARTEFACT,
    GREATEST_CHANCE,
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
from omsm_ros.errors import Notice

# Relative change of pace that moves a line of fifty waves by one; a smaller one decides nothing.
_SAME_PACE = 0.02
# Least amplitude of a line over a/ω² of the acceleration that causes it.
_LEAST_AMPLITUDE_RATIO = 0.1
# Uncertainty of the frequency of an order, in resolutions.
_OF_AN_ORDER = 0.25
# Distance in resolutions below which a line and an order are not fitted separately.
_LEAKS_BINS = 1.5
# The first pass corrects the frequencies of the lines, the second their amplitudes.
_TURNS_OF_FITTING = 2


def missing_evidence(
    scans: Sequence[StudiedScan], own: int, line: SpectralLine, kinds: set[str]
) -> Notice:
    """Return the measurement that would decide between the remaining ``kinds``."""
    scan, paces = scans[own], scans[own].coordinates
    others = [s.coordinates for k, s in enumerate(scans) if k != own]
    shared = [(paces[n].pace, s[n].pace) for s in others for n in line.possible
              if n != TIME and n in s]  # fmt: skip
    if not any(abs(here - there) > _SAME_PACE * here for here, there in shared):
        scan_needed = Notice("ripple.second_scan")
    elif PART in kinds or SYNCHRONOUS in kinds:
        scan_needed = Notice("ripple.further_scan")
    else:
        scan_needed = Notice("ripple.slower_scan")
    if scan.acceleration_lines is None:
        return Notice("ripple.needs_scan_or_accelerometer", scan=scan_needed)
    return Notice("ripple.needs_scan", scan=scan_needed)


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedLine:
    """Spectral line and its source.

    kind: one of :data:`omsm_ros.core.ripple.source_hypotheses.KINDS`;  evidence: for it
    needs: measurement that would decide, if undecided
    frequency: true frequency of a vibration [Hz], None if unknown
    wavelength: of a texture on the part [m];  order: waves a turn of the spindle
    also: another source that contributes to the line
    """

    line: SpectralLine
    kind: str
    evidence: tuple[Notice, ...] = ()
    needs: Notice | None = None
    frequency: float | None = None
    wavelength: float | None = None
    order: int | None = None
    also: str = ""


def analyse_scan(
    signal: ScanSignal,
    acceleration_lines: AccelerationLines | None = None,
    textures: Sequence[tuple[float, float]] = (),
) -> StudiedScan:
    """Separate form and lines of one scan.

    textures: frequencies along the path [1/m] that are known from other scans and too high to be
        searched, with their uncertainties
    """
    formless, spectrum = _separated(signal, textures)
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
    """Analyse scans of one part: first each by itself, then with the textures of the others.

    Where the pace changes, the alias of a texture finer than twice the sampling distance is no
    line; a fit at its known frequency still shows it.
    """
    studied = [analyse_scan(signal, acceleration_lines) for signal, acceleration_lines in scans]
    return [
        analyse_scan(one.signal, one.acceleration_lines, finer)
        if (finer := _finer_textures(one, studied))
        else one
        for one in studied
    ]


def _finer_textures(one: StudiedScan, studied: Sequence[StudiedScan]) -> list[tuple[float, float]]:
    """Return textures beyond the resolution of ``one`` with their uncertainty, that rising."""
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


def _separated(
    signal: ScanSignal, textures: Sequence[tuple[float, float]]
) -> tuple[FormRemoved, LineSpectrum]:
    form = FormFit(signal)
    formless = form.without()
    known = [texture(signal, formless.residual, wave, spread) for wave, spread in textures]
    spectrum = find_lines(signal, formless.residual, known, form.reserved_orders())
    if not spectrum.lines:
        return formless, spectrum
    form.refine(sum_of(spectrum.lines, spectrum.coordinates, len(signal)))
    for _ in range(_TURNS_OF_FITTING):
        formless = form.without(waves_of(spectrum.lines, spectrum.coordinates))
        spectrum = find_lines(signal, formless.residual, spectrum.lines, form.reserved_orders())
        if not spectrum.lines:
            break
    return formless, further_lines(signal, spectrum, form.reserved_orders())


def _order_lines(formless: FormRemoved, spectrum: LineSpectrum) -> Iterable[SpectralLine]:
    coordinates = spectrum.coordinates
    for found in formless.orders:
        ratio = np.array(found.amplitude**2 / (2 * found.amplitude_uncertainty**2))
        sigma = float(significance(ratio, len(formless.orders)))
        turn = coordinates[TURN]
        if sigma < LEAST_SIGMA or any(
            abs(line.possible.get(TURN, np.inf) - found.frequency) < _LEAKS_BINS * turn.resolution
            and line.amplitude > found.amplitude
            for line in spectrum.lines
        ):
            continue
        possible = {TURN: found.frequency} | {
            name: found.frequency * turn.pace / c.pace
            for name, c in coordinates.items()
            if c.like == turn.like and name != TURN
        }
        yield replace(
            found,
            frequency_uncertainty=_OF_AN_ORDER * turn.resolution,
            significance=sigma,
            possible=possible,
        )


def name_lines(scans: Sequence[StudiedScan]) -> list[list[NamedLine]]:
    """Return the source of each line of each scan, in the order of the scans and their lines."""
    evidence = attribution_evidence(scans)
    done = attribute_lines(scans, evidence)
    named = {key: _named(done, key, found) for key, found in evidence.items()}
    named = {key: _with_true_frequency(scans, named, key) for key in named}
    return [[named[own, k] for k in range(len(scan.lines))] for own, scan in enumerate(scans)]


def _named(done: Attribution, key: Key, evidence: LineEvidence) -> NamedLine:
    scan, line = done.scans[key[0]], evidence.line
    source = done.selected.get(key)
    own = None if source is None else _by_other_scans(done, key, source)
    also = done.also.get(key)
    if own is not None and source is not None and also is not None:
        second = _by_other_scans(done, key, also)
        text = Notice(
            "ripple.coincident_lines",
            kind=second.kind,
            amplitude=unexplained_partner_amplitude(done, [source]),
            other=unexplained_partner_amplitude(done, [also]),
        )
        own = replace(own, evidence=(*own.evidence, text), also=second.kind)
    measured = _matching_acceleration_line(scan, line)
    if measured is None:
        return own or _by_single_scan(done, key, evidence)
    vibration = _by_acceleration(scan, line, measured)
    if own is None or source is None or own.kind in (VIBRATION, ALIASED):
        return vibration
    size = unexplained_partner_amplitude(done, [source])
    if size > measured.displacement and size > 0.5 * line.amplitude:
        return replace(own, evidence=(*own.evidence, *vibration.evidence), also=vibration.kind)
    text = Notice("ripple.coincident_source", amplitude=size, kind=own.kind)
    return replace(vibration, evidence=(*vibration.evidence, text), also=own.kind)


def _by_other_scans(done: Attribution, key: Key, source: SourceHypothesis) -> NamedLine:
    scans, line = done.scans, done.evidence[key].line
    names = [scans[own].signal.name for own, _ in source.partners]
    if source.kind in (PART, ARTEFACT):
        code, wavelength = "ripple.aliased_texture", 1 / source.frequency
        if source.kind == PART:
            code = f"ripple.same_wavelength_on_{source.coordinate}"
        text = Notice(code, scans=names, wavelength=wavelength)
        return NamedLine(line=line, kind=source.kind, evidence=(text,), wavelength=wavelength)
    if source.kind == SYNCHRONOUS:
        order = round(source.frequency)
        texts = [Notice("ripple.same_order", order=order, scans=names)]
        if scans[key[0]].formless.on_circle:
            texts.append(Notice("ripple.order_or_form_on_circle"))
        return NamedLine(line=line, kind=SYNCHRONOUS, evidence=tuple(texts), order=order)
    return _vibration_in_other_scans(done, key, source, names)


def _vibration_in_other_scans(
    done: Attribution, key: Key, source: SourceHypothesis, names: list[str]
) -> NamedLine:
    scans, line, frequency = done.scans, done.evidence[key].line, source.frequency
    rate = scans[key[0]].signal.rate
    rates = {round(scans[own].signal.rate, 6) for own, _ in source.partners} - {round(rate, 6)}
    if not rates:
        text = Notice("ripple.same_frequency", scans=names)
        return NamedLine(line=line, kind=VIBRATION, evidence=(text, _or_alias(line, rate)))
    sampled = [Notice("ripple.rate", rate=r) for r in sorted(rates)]
    text = Notice("ripple.other_rates", scans=names, rates=sampled, frequency=frequency)
    return NamedLine(
        line=line, kind=_vibration(frequency, rate), evidence=(text,), frequency=frequency
    )


def _vibration(frequency: float, rate: float) -> str:
    return ALIASED if frequency > rate / 2 else VIBRATION


def _or_alias(line: SpectralLine, rate: float) -> Notice:
    """Return that the line may be an alias, with the lowest frequencies beyond half the rate."""
    seen = line.possible[TIME]
    return Notice("ripple.or_alias", first=rate - seen, second=rate + seen)


def _matching_acceleration_line(scan: StudiedScan, line: SpectralLine) -> AccelerationLine | None:
    if scan.acceleration_lines is None or TIME not in line.possible:
        return None
    seen, rate = line.possible[TIME], scan.signal.rate
    tolerance = 1 / scan.signal.duration
    if len(scan.acceleration_lines.lines) * 4 * tolerance / rate > GREATEST_CHANCE:
        tolerance /= 4
    near = [
        one
        for one in scan.acceleration_lines.lines
        if abs(float(aliased_frequency(one.frequency, rate)) - seen)
        <= tolerance + 4 * one.frequency_uncertainty
        and _LEAST_AMPLITUDE_RATIO <= one.displacement / line.amplitude <= LARGEST_GAIN
    ]
    return min(near, key=lambda one: abs(np.log(one.displacement / line.amplitude)), default=None)


def _by_acceleration(scan: StudiedScan, line: SpectralLine, one: AccelerationLine) -> NamedLine:
    rate = scan.signal.rate
    texts = [
        Notice(
            "ripple.acceleration",
            acceleration=one.acceleration,
            axis=one.axis,
            frequency=one.frequency,
            significance=round(one.significance),
            displacement=one.displacement,
        )
    ]
    kind = _vibration(one.frequency, rate)
    if kind == ALIASED:
        seen = float(aliased_frequency(one.frequency, rate))
        texts.append(Notice("ripple.aliased_at", rate=rate, frequency=seen))
    return NamedLine(line=line, kind=kind, evidence=tuple(texts), frequency=one.frequency)


def _by_single_scan(done: Attribution, key: Key, evidence: LineEvidence) -> NamedLine:
    scan, line = done.scans[key[0]], evidence.line
    kinds = {t.kind for t in evidence.tested if t.alive}
    if set(line.possible) == {PATH}:
        text = Notice("ripple.sharp_on_path")
        return NamedLine(line=line, kind=PART, evidence=(text,), wavelength=1 / line.frequency)
    if TIME not in line.possible and set(line.possible) <= {TURN} and SYNCHRONOUS in kinds:
        order = whole_order(scan, line)
        text = Notice("ripple.sharp_on_turns", order=order)
        return NamedLine(line=line, kind=SYNCHRONOUS, evidence=(text,), order=order)
    if set(line.possible) == {TIME} and len(scan.coordinates) > 1:
        text = Notice("ripple.sharp_on_time")
        return NamedLine(
            line=line, kind=VIBRATION, evidence=(text, _or_alias(line, scan.signal.rate))
        )
    against = tuple(
        Notice(
            "ripple.missing_in", kind=t.kind, scans=[done.scans[k].signal.name for k in t.absent]
        )
        for t in evidence.tested
        if not t.alive
    )
    needs = missing_evidence(done.scans, key[0], line, kinds)
    if is_ring_or_spindle(evidence.tested):
        needs = Notice("ripple.needs_other_feed")
    return NamedLine(line=line, kind=UNDECIDED, evidence=against, needs=needs)


def _with_true_frequency(
    scans: Sequence[StudiedScan], named: dict[Key, NamedLine], key: Key
) -> NamedLine:
    own = named[key]
    if own.kind != VIBRATION or own.frequency is not None:
        return own
    scan = scans[key[0]]
    seen, rate = own.line.possible[TIME], scan.signal.rate
    for (other, _), row in named.items():
        if other == key[0] or row.frequency is None:
            continue
        if abs(float(aliased_frequency(row.frequency, rate)) - seen) <= 1 / scan.signal.duration:
            name = scans[other].signal.name
            text = Notice("ripple.true_frequency", scan=name, frequency=row.frequency)
            kind = _vibration(row.frequency, rate)
            both = (own.evidence[0], text)
            return replace(own, kind=kind, frequency=row.frequency, evidence=both)
    return own
