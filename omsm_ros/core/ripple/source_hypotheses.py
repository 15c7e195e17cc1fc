"""Test hypotheses on the sources of lines against all scans, and select the sources.

A texture on the part has the same wavelength in every scan, along the path or from ring to ring; a
vibration has the same frequency, a spindle error the same number of waves a turn. Each hypothesis
predicts the frequency of the line in every other scan. Lines found there are its partners. Sources
are selected one after the other, those with most partners first; a line that is explained by one
source is no evidence for another.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from omsm_ros.core.ripple.accelerometer import AccelerationLines
from omsm_ros.core.ripple.coordinates import LEAST_WAVES, Coordinate
from omsm_ros.core.ripple.density import Density, aliased_frequency, density, evenly
from omsm_ros.core.ripple.form_removal import HIGHEST_ORDER, FormRemoved
from omsm_ros.core.ripple.lines import LineSpectrum
from omsm_ros.core.ripple.scan_signal import PATH, RADIUS, TIME, TURN, ScanSignal
from omsm_ros.core.ripple.spectral_line import SpectralLine

PART, VIBRATION, SYNCHRONOUS = "on the part", "vibration", "synchronous spindle error"
ALIASED, ARTEFACT, UNDECIDED = "aliased vibration", "artefact of sampling", "undecided"
KINDS = (PART, VIBRATION, ALIASED, SYNCHRONOUS, ARTEFACT, UNDECIDED)

# Highest harmonic of bearings, motor and drawbar; more waves a turn are texture.
HIGHEST_SYNCHRONOUS = 500
# Fewer turns do not resolve whole numbers of waves a turn.
_LEAST_TURNS = 4.0
# A vibration is searched up to this multiple of the sampling rate.
_MOST_ALIASES = 5
# Relative stability of frequencies: mains 2e-4 (ENTSO-E: ±10 mHz of 50 Hz most of the time), feed
# and radius 1e-4.
_STEADY = {TIME: 2e-4, PATH: 1e-4, RADIUS: 1e-4, TURN: 1e-5}
# Tolerance of a frequency: standard uncertainties, and parts of a resolution for window and fit.
_TIMES_UNCERTAINTY, _OWN_BIN, _OTHER_BIN = 4.0, 0.3, 0.1
GREATEST_CHANCE = 0.1
"""Largest expected number of chance coincidences within a tolerance."""

# Expected amplitude over its σ from which a line that is not found is absent.
_DETECTION_RATIO = 9.0
# Largest ratio of the amplitudes of one line in two scans.
_AMPLITUDES = 3.5
# Ratio of the amplitudes of a partner and a line within which one source explains the partner.
_EXPLAINED = (0.7, 1.4)


@dataclass(frozen=True, eq=False, kw_only=True)
class StudiedScan:
    """Scan with its lines; ``acceleration_lines`` is None without an accelerometer.

    lines: those of the spectrum and the orders that were found with the form
    """

    signal: ScanSignal
    formless: FormRemoved
    spectrum: LineSpectrum
    lines: tuple[SpectralLine, ...]
    acceleration_lines: AccelerationLines | None = None

    @property
    def coordinates(self) -> dict[str, Coordinate]:
        """Coordinates in which the scan moves."""
        return self.spectrum.coordinates

    def density(self, coordinate: str) -> Density:
        """Return the density of the heights without form over TIME or along PATH."""
        path, place, step = self.signal.path, self.signal.time, self.signal.period
        if coordinate == PATH:
            place, step = path, float(np.median(np.diff(path) / np.diff(self.signal.sample)))
        return density(evenly(place, self.formless.residual, step), step)

    def resolution(self, coordinate: str) -> float:
        """Return the resolution of frequencies over ``coordinate`` [Hz], [1/m] or [1/turn]."""
        return self.coordinates[coordinate].resolution


Key = tuple[int, int]
"""Index of a scan, and of a line in it."""


@dataclass(frozen=True, slots=True)
class SourceHypothesis:
    """Hypothesis that a line is of a ``kind``, with a true ``frequency`` over ``coordinate``.

    uncertainty: of that frequency, including the resolution of the scan
    alias_count: zone of the alias of a vibration, 0 below half the sampling rate
    partners: lines of other scans that support it;  absent: scans in which it is missing
    """

    kind: str
    coordinate: str
    frequency: float
    uncertainty: float
    alias_count: int = 0
    partners: tuple[Key, ...] = ()
    absent: tuple[int, ...] = ()

    @property
    def alive(self) -> bool:
        """False if it is missing in a scan; a vibration may be missing."""
        return self.kind == VIBRATION or not self.absent


@dataclass(frozen=True, slots=True)
class ExpectedLine:
    """Where a hypothesis puts its line in a scan: ``tolerance`` about ``frequency``.

    aliased: True if it is the image of something beyond half the rate
    """

    coordinate: str
    frequency: float
    tolerance: float
    aliased: bool


def hypotheses_of(scan: StudiedScan, line: SpectralLine) -> Iterator[SourceHypothesis]:
    """Yield the hypotheses for a ``line`` of ``scan``, including vibrations with this alias."""
    if TIME in line.possible:
        seen, spread = line.possible[TIME], spread_of(scan, line, TIME)
        rate = scan.signal.rate
        yield SourceHypothesis(VIBRATION, TIME, seen, spread)
        for alias_count in range(1, _MOST_ALIASES + 1):
            for image in (alias_count * rate - seen, alias_count * rate + seen):
                yield SourceHypothesis(VIBRATION, TIME, image, spread, alias_count)
    for coordinate in (PATH, RADIUS):
        if coordinate in line.possible:
            spread = spread_of(scan, line, coordinate)
            yield SourceHypothesis(PART, coordinate, line.possible[coordinate], spread)
    if (order := whole_order(scan, line)) is not None:
        yield SourceHypothesis(SYNCHRONOUS, TURN, float(order), 0.0)


def whole_order(scan: StudiedScan, line: SpectralLine) -> int | None:
    """Return the waves a turn of the line if they are a whole number, else None."""
    if TURN not in line.possible or scan.signal.turns < _LEAST_TURNS:
        return None
    per_turn = line.possible[TURN]
    order = round(per_turn)
    own = scan.coordinates[TURN].resolution
    allowed = _TIMES_UNCERTAINTY * _own_uncertainty(scan, line, TURN) + _OWN_BIN * own
    if not 1 <= order <= HIGHEST_SYNCHRONOUS or abs(per_turn - order) > allowed:
        return None
    return order


def spread_of(scan: StudiedScan, line: SpectralLine, coordinate: str) -> float:
    """Return the tolerance of the frequency of the line over ``coordinate`` in other scans."""
    return (
        _TIMES_UNCERTAINTY * _own_uncertainty(scan, line, coordinate)
        + _OTHER_BIN * scan.resolution(coordinate)
        + _STEADY[coordinate] * line.possible[coordinate]
    )


def _own_uncertainty(scan: StudiedScan, line: SpectralLine, coordinate: str) -> float:
    share = scan.resolution(coordinate) / scan.resolution(line.coordinate)
    return line.frequency_uncertainty * share


def place_in(scan: StudiedScan, hypothesis: SourceHypothesis) -> ExpectedLine | None:
    """Return where the line is expected in ``scan``, None if the scan cannot show it."""
    coordinate = scan.coordinates.get(hypothesis.coordinate)
    if coordinate is None:
        return None
    if not coordinate.proportional_to_time:
        fine = hypothesis.frequency > coordinate.highest
        tolerance = hypothesis.uncertainty + _OWN_BIN * coordinate.resolution
        return ExpectedLine(coordinate.name, hypothesis.frequency, tolerance, fine)
    in_time = hypothesis.frequency * coordinate.pace
    rate = scan.signal.rate
    seen = float(aliased_frequency(in_time, rate))
    tolerance = hypothesis.uncertainty * coordinate.pace + _OWN_BIN * scan.resolution(TIME)
    return ExpectedLine(TIME, seen, tolerance, in_time > rate / 2)


def apart(one: ExpectedLine | None, other: ExpectedLine | None) -> bool:
    """Return True if a scan with these expected lines separates their hypotheses."""
    if one is None or other is None or one.coordinate != other.coordinate:
        return True
    return abs(one.frequency - other.frequency) > one.tolerance + other.tolerance


def lines_at(scan: StudiedScan, place: ExpectedLine) -> SpectralLine | None:
    """Return the strongest line of ``scan`` at ``place``, None if there is none."""
    near = [
        line
        for line in scan.lines
        if place.coordinate in line.possible
        and abs(line.possible[place.coordinate] - place.frequency)
        <= place.tolerance + _TIMES_UNCERTAINTY * _own_uncertainty(scan, line, place.coordinate)
    ]
    return max(near, key=lambda line: line.amplitude, default=None)


def chance_probability(scan: StudiedScan, place: ExpectedLine) -> float:
    """Return the expected number of lines of ``scan`` at ``place`` by chance."""
    band = scan.coordinates[place.coordinate].highest
    count = sum(place.coordinate in line.possible for line in scan.lines)
    return count * 2 * place.tolerance / band


def is_detected(scan: StudiedScan, hypothesis: SourceHypothesis, amplitude: float) -> bool | None:
    """Return whether ``scan`` shows a line of ``amplitude`` [m], None if it cannot decide."""
    place = place_in(scan, hypothesis)
    if place is None or chance_probability(scan, place) > GREATEST_CHANCE:
        return None
    line = lines_at(scan, place)
    if line is not None:
        ratio = line.amplitude / amplitude
        least = (
            1 / _AMPLITUDES * (1.0 if hypothesis.kind != PART else _least_share(scan, hypothesis))
        )
        alike = hypothesis.kind == VIBRATION or least <= ratio <= _AMPLITUDES
        return True if alike else None
    return None if _may_be_masked(scan, hypothesis, place, amplitude) else False


def _may_be_masked(
    scan: StudiedScan, hypothesis: SourceHypothesis, place: ExpectedLine, amplitude: float
) -> bool:
    if hypothesis.kind == VIBRATION:
        return False  # a vibration may stop, so that its absence is never used as evidence
    if place.coordinate == TIME:
        if place.frequency < (LEAST_WAVES + 1) * scan.resolution(TIME) or _near_form(scan, place):
            return True
        floor = scan.spectrum.sigma_at(place.frequency)
    elif place.aliased:
        return True  # an alias is searched only where another scan has found its line
    else:
        floor = scan.spectrum.noise * np.sqrt(2 / len(scan.signal))
    return amplitude * _least_share(scan, hypothesis) < _DETECTION_RATIO * floor


def _near_form(scan: StudiedScan, place: ExpectedLine) -> bool:
    turn = scan.coordinates.get(TURN)
    if turn is None:
        return False
    order = place.frequency / turn.pace
    width = place.tolerance + (scan.formless.degree + 2) / 2 * scan.resolution(TIME)
    nearest = round(order)
    return nearest <= max(HIGHEST_ORDER, scan.formless.degree) and (
        abs(order - nearest) * turn.pace < width
    )


def _least_share(scan: StudiedScan, hypothesis: SourceHypothesis) -> float:
    """Return the attenuation of a texture by averaging over a sample period."""
    coordinate = scan.coordinates[hypothesis.coordinate]
    return float(abs(np.sinc(hypothesis.frequency * coordinate.pace * scan.signal.period)))


@dataclass(frozen=True, eq=False)
class LineEvidence:
    """All hypotheses of one line, and those that a scan separates from the others."""

    line: SpectralLine
    tested: tuple[SourceHypothesis, ...]
    sources: tuple[SourceHypothesis, ...]


def attribution_evidence(scans: Sequence[StudiedScan]) -> dict[Key, LineEvidence]:
    """Return the evidence for every line of every scan."""
    keys = [(own, k) for own, scan in enumerate(scans) for k in range(len(scan.lines))]
    tested = {key: tuple(_tests(scans, key)) for key in keys}
    sources = {key: _sources(scans, tested[key]) for key in keys}
    images = _images(scans, sources)
    return {
        (own, k): LineEvidence(
            scans[own].lines[k], tested[own, k], (*sources[own, k], *images.get((own, k), ()))
        )
        for own, k in keys
    }


def _tests(scans: Sequence[StudiedScan], key: Key) -> Iterator[SourceHypothesis]:
    own, line = key[0], scans[key[0]].lines[key[1]]
    for hypothesis in hypotheses_of(scans[own], line):
        present, absent = [], []
        for other, scan in enumerate(scans):
            if other == own or (hypothesis.kind == PART and not _same_part(scans[own], scan)):
                continue
            shown = is_detected(scan, hypothesis, line.amplitude)
            if shown and (place := place_in(scan, hypothesis)) is not None:
                found = lines_at(scan, place)
                index = next(k for k, one in enumerate(scan.lines) if one is found)
                present.append((other, index))
            elif shown is False:
                absent.append(other)
        yield replace(hypothesis, partners=tuple(present), absent=tuple(absent))


def _same_part(one: StudiedScan, other: StudiedScan) -> bool:
    a, b = one.signal.radius, other.signal.radius
    low, high = max(a.min(), b.min()), min(a.max(), b.max())
    return bool(high - low >= -0.02 * max(a.max(), b.max()))


def _sources(
    scans: Sequence[StudiedScan], tested: Sequence[SourceHypothesis]
) -> tuple[SourceHypothesis, ...]:
    """Return the hypotheses that a scan separates from all other kinds and none contradicts."""
    alive = [t for t in tested if t.alive]
    found = []
    for one in alive:
        # On circles of one radius form of the part repeats as a spindle error does.
        rivals = [
            t for t in alive if t.kind != one.kind and not t.alias_count
            and not (one.kind == SYNCHRONOUS and t.coordinate == PATH)
        ]  # fmt: skip
        decisive = tuple(
            key
            for key in one.partners
            for place in [place_in(scans[key[0]], one)]
            if all(apart(place, place_in(scans[key[0]], r)) for r in rivals)
        )
        if decisive:
            found.append(replace(one, partners=decisive))
    # One vibration has one source: the one in most scans, then the one of lowest frequency.
    shaken = [c for c in found if c.kind == VIBRATION]
    best = sorted(shaken, key=lambda c: (-len(c.partners), c.frequency))[:1]
    return (*[c for c in found if c.kind != VIBRATION], *best)


def _images(
    scans: Sequence[StudiedScan], sources: dict[Key, tuple[SourceHypothesis, ...]]
) -> dict[Key, list[SourceHypothesis]]:
    """Return the sources of aliases of a texture that another scan resolves, by line."""
    found: dict[Key, list[SourceHypothesis]] = {}
    for key, own in sources.items():
        for texture in own:
            if texture.kind != PART or texture.coordinate != PATH:
                continue
            for partner in texture.partners:
                place = place_in(scans[partner[0]], texture)
                if place is not None and place.aliased and place.coordinate == TIME:
                    image = replace(texture, kind=ARTEFACT, partners=(key,))
                    found.setdefault(partner, []).append(image)
    return found


@dataclass
class Attribution:
    """Selected source of each line, and in ``also`` a second source that contributes to it."""

    scans: Sequence[StudiedScan]
    evidence: dict[Key, LineEvidence]
    selected: dict[Key, SourceHypothesis] = field(default_factory=dict)
    also: dict[Key, SourceHypothesis] = field(default_factory=dict)

    def open_sources(self, key: Key) -> list[SourceHypothesis]:
        """Return the sources of a line with a partner that no other source explains, else all."""
        every, chosen = self.evidence[key].sources, self.selected
        families = {p: _family(chosen[p].kind) for c in every for p in c.partners if p in chosen}
        left = [c for c in every for own in [_family(c.kind)]
                if any(families.get(p, own) == own for p in c.partners)]  # fmt: skip
        return left or list(every)

    def select(self, key: Key, source: SourceHypothesis) -> None:
        """Select a source for ``key``, and for its partners of similar amplitude."""
        self.selected[key] = source
        size = self.evidence[key].line.amplitude
        for partner in source.partners:
            ratio = self.evidence[partner].line.amplitude / size
            theirs = self._adopt_partner_source(partner, source, key)
            if partner in self.selected:
                if _family(self.selected[partner].kind) != _family(source.kind):
                    self.also.setdefault(partner, theirs or source)
            elif theirs is not None and _EXPLAINED[0] <= ratio <= _EXPLAINED[1]:
                self.selected[partner] = theirs
                self._note_secondary_sources(partner, theirs)

    def _note_secondary_sources(self, key: Key, source: SourceHypothesis) -> None:
        for other in self.evidence[key].sources:
            if _family(other.kind) != _family(source.kind) and any(
                partner in self.selected
                and _family(self.selected[partner].kind) == _family(other.kind)
                and key in self.selected[partner].partners
                for partner in other.partners
            ):
                self.also.setdefault(key, other)

    def _adopt_partner_source(
        self, partner: Key, source: SourceHypothesis, key: Key
    ) -> SourceHypothesis | None:
        """Return the source of ``partner`` that is the same as ``source`` and names ``key``."""
        own = [
            c
            for c in self.evidence[partner].sources
            if _family(c.kind) == _family(source.kind) and key in c.partners
        ]
        return max(own, key=lambda c: c.kind == ARTEFACT, default=None)


def attribute_lines(scans: Sequence[StudiedScan], evidence: dict[Key, LineEvidence]) -> Attribution:
    """Select a source for all lines: first lines of one kind, with most partners, then largest."""
    done = Attribution(scans, evidence)
    while True:
        waiting = [
            (_urgency(done, key, sources), key, sources)
            for key, own in evidence.items()
            if key not in done.selected and (sources := done.open_sources(key))
        ]
        if not waiting:
            return done
        _, key, sources = max(waiting, key=lambda entry: entry[0])
        done.select(key, _largest(done, key, sources))


def _urgency(
    done: Attribution, key: Key, sources: Sequence[SourceHypothesis]
) -> tuple[bool, int, bool, float]:
    kinds = {_family(c.kind) for c in sources}
    most = max(sources, key=lambda c: len(c.partners))
    size = done.evidence[key].line.amplitude
    return len(kinds) == 1, len(most.partners), most.kind != VIBRATION, size


def _largest(done: Attribution, key: Key, sources: Sequence[SourceHypothesis]) -> SourceHypothesis:
    """Return, of several sources at one frequency, the one with the strongest partners."""
    by_kind: dict[str, list[SourceHypothesis]] = {}
    for source in sources:
        by_kind.setdefault(_family(source.kind), []).append(source)
    sizes = {kind: unexplained_partner_amplitude(done, own) for kind, own in by_kind.items()}
    order = sorted(by_kind, key=lambda kind: -sizes[kind])
    if len(order) > 1:
        done.also[key] = by_kind[order[1]][0]
    return max(by_kind[order[0]], key=lambda c: (c.kind == ARTEFACT, len(c.partners)))


def unexplained_partner_amplitude(done: Attribution, sources: Sequence[SourceHypothesis]) -> float:
    """Return the largest amplitude of the partners that no other source explains [m]."""
    found = [
        done.evidence[p].line.amplitude
        for c in sources
        for p in c.partners
        if p not in done.selected or _family(done.selected[p].kind) == _family(c.kind)
    ]
    return max(found, default=0.0)


def _family(kind: str) -> str:
    """Return the kind, with aliased texture counted as texture on the part."""
    return PART if kind == ARTEFACT else kind


def is_ring_or_spindle(tested: Sequence[SourceHypothesis]) -> bool:
    """Return True if partners support both rings on the part and a spindle error."""
    kinds = {(t.kind, t.coordinate) for t in tested if t.alive and t.partners}
    return (PART, RADIUS) in kinds and any(kind == SYNCHRONOUS for kind, _ in kinds)
