"""Which kinds does each line have evidence for, and which explanation needs the fewest things?

A claim says what a line is, and names its partners: the lines of other scans that are the same
thing there, where no other kind would put it. Claims are settled one after the other, those
with most partners first; what one of them explains is evidence for nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from omsm_ros.core.spectra.hypotheses import (
    ARTEFACT,
    PART,
    SYNCHRONOUS,
    VIBRATION,
    Hypothesis,
    Place,
    StudiedScan,
    apart,
    found_at,
    hypotheses_of,
    place_in,
    shows,
)
from omsm_ros.core.spectra.line import Line
from omsm_ros.core.spectra.scan_signal import PATH, RADIUS, TIME

# A partner of that size, over the line's own, is explained by it and by nothing besides.
_EXPLAINED = (0.7, 1.4)

Key = tuple[int, int]
"""Place of a scan, and of a line in it."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A line is of this ``kind``; by its partners, and with none that is missing.

    texture: of an artefact, the line that another scan resolves
    """

    kind: str
    hypothesis: Hypothesis
    partners: tuple[Key, ...]
    texture: Key | None = None


@dataclass(frozen=True, eq=False)
class Tested:
    """A hypothesis of a line: partners where it is there, scans in which it is missing."""

    hypothesis: Hypothesis
    present: tuple[Key, ...]
    absent: tuple[int, ...]

    @property
    def kind(self) -> str:
        """Of the hypothesis."""
        return self.hypothesis.kind

    @property
    def alive(self) -> bool:
        """False if a scan that would have to show it does not; a vibration may come and go."""
        return self.kind == VIBRATION or not self.absent


@dataclass(frozen=True, eq=False)
class Evidence:
    """Of one line: all hypotheses as tested, and the claims that follow."""

    line: Line
    tested: tuple[Tested, ...]
    claims: tuple[Claim, ...]


def evidence_of(scans: Sequence[StudiedScan]) -> dict[Key, Evidence]:
    """Return the evidence for every line of every scan."""
    keys = [(own, k) for own, scan in enumerate(scans) for k in range(len(scan.lines))]
    tested = {key: tuple(_tests(scans, key)) for key in keys}
    claims = {key: _claims(scans, tested[key]) for key in keys}
    images = _images(scans, claims)
    return {
        key: Evidence(_line(scans, key), tested[key], (*claims[key], *images.get(key, ())))
        for key in keys
    }


def _line(scans: Sequence[StudiedScan], key: Key) -> Line:
    return scans[key[0]].lines[key[1]]


def _tests(scans: Sequence[StudiedScan], key: Key) -> Iterator[Tested]:
    own, line = key[0], _line(scans, key)
    for hypothesis in hypotheses_of(scans[own], line):
        present, absent = [], []
        for other, scan in enumerate(scans):
            if other == own or (hypothesis.kind == PART and not _same_part(scans[own], scan)):
                continue
            shown = shows(scan, hypothesis, line.amplitude)
            if shown:
                place = place_in(scan, hypothesis)
                present += [_key_at(other, scan, place)] if place is not None else []
            elif shown is not None:
                absent.append(other)
        yield Tested(hypothesis, tuple(present), tuple(absent))


def _key_at(own: int, scan: StudiedScan, place: Place) -> Key:
    found = found_at(scan, place)
    return own, next(k for k, line in enumerate(scan.lines) if line is found)


def _same_part(one: StudiedScan, other: StudiedScan) -> bool:
    """Return True if the scans have rings of the part in common."""
    a, b = one.signal.radius, other.signal.radius
    low, high = max(a.min(), b.min()), min(a.max(), b.max())
    return bool(high - low >= -0.02 * max(a.max(), b.max()))


def _claims(scans: Sequence[StudiedScan], tested: Sequence[Tested]) -> tuple[Claim, ...]:
    """Return hypotheses that a scan separates from all other kinds, and that none contradicts."""
    alive = [t for t in tested if t.alive]
    found = []
    for one in alive:
        rivals = [t for t in alive if _is_rival(one, t)]
        decisive = tuple(key for key in one.present if _decides(scans[key[0]], one, rivals))
        if decisive:
            found.append(Claim(one.kind, one.hypothesis, decisive))
    return tuple(_least_folded(found))


def _is_rival(one: Tested, other: Tested) -> bool:
    """Return True for another kind, unless it folds: what folds is no rival of what does not."""
    if one.kind == SYNCHRONOUS and other.hypothesis.coordinate == PATH:
        return False  # on circles of one radius a figure of the part repeats just so
    return one.kind != other.kind and not other.hypothesis.folds


def _decides(scan: StudiedScan, one: Tested, rivals: Sequence[Tested]) -> bool:
    place = place_in(scan, one.hypothesis)
    return all(apart(place, place_in(scan, rival.hypothesis)) for rival in rivals)


def _least_folded(found: list[Claim]) -> list[Claim]:
    """Return the claims with one vibration: that in most scans, then the lowest frequency."""
    shaken = [c for c in found if c.kind == VIBRATION]
    if not shaken:
        return found
    best = min(shaken, key=lambda c: (-len(c.partners), c.hypothesis.frequency))
    return [c for c in found if c.kind != VIBRATION] + [best]


def _images(
    scans: Sequence[StudiedScan], claims: dict[Key, tuple[Claim, ...]]
) -> dict[Key, list[Claim]]:
    """Return lines to which a texture that another scan resolves folds in a scan too coarse."""
    found: dict[Key, list[Claim]] = {}
    for key, own in claims.items():
        for texture in own:
            if texture.kind != PART or texture.hypothesis.coordinate != PATH:
                continue
            for partner in texture.partners:
                place = place_in(scans[partner[0]], texture.hypothesis)
                if place is not None and place.folded and place.coordinate == TIME:
                    image = Claim(ARTEFACT, texture.hypothesis, (key,), key)
                    found.setdefault(partner, []).append(image)
    return found


@dataclass
class Settled:
    """What each line is, as far as it is decided; ``also`` what else it holds."""

    scans: Sequence[StudiedScan]
    evidence: dict[Key, Evidence]
    claim: dict[Key, Claim] = field(default_factory=dict)
    also: dict[Key, Claim] = field(default_factory=dict)

    def open_claims(self, key: Key) -> list[Claim]:
        """Return the claims of a line whose partners are not all explained as something else.

        All of them if none is left: a line is something.
        """
        every = self.evidence[key].claims
        left = [c for c in every if any(self._may_be(p, c) for p in c.partners)]
        return left or list(every)

    def _may_be(self, partner: Key, claim: Claim) -> bool:
        settled = self.claim.get(partner)
        return settled is None or _family(settled.kind) == _family(claim.kind)

    def settle(self, key: Key, claim: Claim) -> None:
        """Decide, and with it what partners of its size are."""
        self.claim[key] = claim
        size = self.evidence[key].line.amplitude
        for partner in claim.partners:
            ratio = self.evidence[partner].line.amplitude / size
            theirs = self._as_theirs(partner, claim, key)
            if partner in self.claim:
                if _family(self.claim[partner].kind) != _family(claim.kind):
                    self.also.setdefault(partner, theirs or claim)
            elif theirs is not None and _EXPLAINED[0] <= ratio <= _EXPLAINED[1]:
                self.claim[partner] = theirs
                self._note_besides(partner, theirs)

    def _note_besides(self, key: Key, claim: Claim) -> None:
        """Note what else a line holds by what was decided of its partners before it."""
        for other in self.evidence[key].claims:
            if _family(other.kind) != _family(claim.kind) and any(
                partner in self.claim
                and _family(self.claim[partner].kind) == _family(other.kind)
                and key in self.claim[partner].partners
                for partner in other.partners
            ):
                self.also.setdefault(key, other)

    def _as_theirs(self, partner: Key, claim: Claim, key: Key) -> Claim | None:
        """Return ``partner``'s own claim to be what ``key`` is by ``claim``; it names ``key``."""
        own = [
            c
            for c in self.evidence[partner].claims
            if _family(c.kind) == _family(claim.kind) and key in c.partners
        ]
        return max(own, key=lambda c: c.kind == ARTEFACT, default=None)


def settled(scans: Sequence[StudiedScan], evidence: dict[Key, Evidence]) -> Settled:
    """Settle all claims: lines of one kind first, with most partners, then the largest."""
    done = Settled(scans, evidence)
    while True:
        waiting = [
            (_urgency(done, key, claims), key, claims)
            for key, own in evidence.items()
            if key not in done.claim and (claims := done.open_claims(key))
        ]
        if not waiting:
            return done
        _, key, claims = max(waiting, key=lambda entry: entry[0])
        done.settle(key, _largest(done, key, claims))


def _urgency(done: Settled, key: Key, claims: Sequence[Claim]) -> tuple[bool, int, bool, float]:
    kinds = {_family(c.kind) for c in claims}
    most = max(claims, key=lambda c: len(c.partners))
    size = done.evidence[key].line.amplitude
    return len(kinds) == 1, len(most.partners), most.kind != VIBRATION, size


def _largest(done: Settled, key: Key, claims: Sequence[Claim]) -> Claim:
    """Return, of several things at one frequency, the one that is strongest where it is alone."""
    by_kind: dict[str, list[Claim]] = {}
    for claim in claims:
        by_kind.setdefault(_family(claim.kind), []).append(claim)
    sizes = {kind: size_elsewhere(done, own) for kind, own in by_kind.items()}
    order = sorted(by_kind, key=lambda kind: -sizes[kind])
    if len(order) > 1:
        done.also[key] = by_kind[order[1]][0]
    return max(by_kind[order[0]], key=lambda c: (c.kind == ARTEFACT, len(c.partners)))


def size_elsewhere(done: Settled, claims: Sequence[Claim]) -> float:
    """Return the greatest amplitude of the partners that nothing else explains [m]."""
    found = [
        done.evidence[p].line.amplitude
        for c in claims
        for p in c.partners
        if p not in done.claim or _family(done.claim[p].kind) == _family(c.kind)
    ]
    return max(found, default=0.0)


def _family(kind: str) -> str:
    """Return the kind; a texture that is folded is of the same family as one that is resolved."""
    return PART if kind == ARTEFACT else kind


def radius_or_turn(tested: Sequence[Tested]) -> bool:
    """Return True if a line may be rings on the part as well as the spindle, both with partners."""
    kinds = {(t.kind, t.hypothesis.coordinate) for t in tested if t.alive and t.present}
    return (PART, RADIUS) in kinds and any(kind == SYNCHRONOUS for kind, _ in kinds)
