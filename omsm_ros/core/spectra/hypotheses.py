"""Where would a line be seen in another scan, if it were on the part, a vibration, the spindle?

A line is the same wavelength over the part (along the path, or from ring to ring), the same
frequency in time, or the same number a turn. Each says where to look in every other scan.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.dynamics.aliasing import folded_frequency
from omsm_ros.core.spectra.coordinates import LEAST_WAVES, Coordinate
from omsm_ros.core.spectra.felt import Felt
from omsm_ros.core.spectra.form_removal import HIGHEST_ORDER, Formless
from omsm_ros.core.spectra.line import Line
from omsm_ros.core.spectra.lines import LineSpectrum
from omsm_ros.core.spectra.scan_signal import PATH, RADIUS, TIME, TURN, ScanSignal

PART, VIBRATION, SYNCHRONOUS = "on the part", "vibration", "synchronous spindle error"
FOLDED, ARTEFACT, UNDECIDED = "folded vibration", "artefact of sampling", "undecided"
KINDS = (PART, VIBRATION, FOLDED, SYNCHRONOUS, ARTEFACT, UNDECIDED)

# Harmonics of a turn that bearings, motor and drawbar make; more waves a turn are texture.
HIGHEST_SYNCHRONOUS = 500
# With fewer turns everything is near a whole number of waves a turn.
_LEAST_TURNS = 4.0
# A vibration from 0 to so many times the sampling rate is looked for behind its image.
_MOST_FOLDS = 5
# Mains keep their frequency to 2e-4 (ENTSO-E: ±10 mHz of 50 Hz most of the time); a feed and a
# radius are known to 1e-4.
_STEADY = {TIME: 2e-4, PATH: 1e-4, RADIUS: 1e-4, TURN: 1e-5}
# Standard uncertainties of a frequency; parts of a resolution that window and fit may leave.
_TIMES_UNCERTAINTY, _OWN_BIN, _OTHER_BIN = 4.0, 0.3, 0.1
# A place so wide that some line is likely to lie in it by chance tells nothing.
_GREATEST_CHANCE = 0.1
# Expected amplitude over its σ, from which an absent line is really absent.
_WOULD_BE_SEEN = 9.0
# The same line may be so many times as strong in another scan.
_AMPLITUDES = 3.5


@dataclass(frozen=True, eq=False, kw_only=True)
class StudiedScan:
    """A scan and all that was found in it; felt is None without an accelerometer.

    lines: those of the spectrum and the orders that were found with the form
    """

    signal: ScanSignal
    formless: Formless
    spectrum: LineSpectrum
    lines: tuple[Line, ...]
    felt: Felt | None = None

    @property
    def coordinates(self) -> dict[str, Coordinate]:
        """Those in which it moves."""
        return self.spectrum.coordinates

    def resolution(self, coordinate: str) -> float:
        """Return the unit of frequencies: Hz, 1/m or 1/turn."""
        return self.coordinates[coordinate].resolution


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A line as one of a ``kind``, of a true ``frequency`` in ``coordinate``.

    uncertainty: of that frequency, with what the scan's length leaves open
    folds: how often a vibration was folded before it was seen where it was
    """

    kind: str
    coordinate: str
    frequency: float
    uncertainty: float
    folds: int = 0


@dataclass(frozen=True, slots=True)
class Place:
    """Where a hypothesis puts its line in a scan: ``tolerance`` about ``frequency``.

    folded: True if it is the image of something beyond half the rate
    """

    coordinate: str
    frequency: float
    tolerance: float
    folded: bool


def hypotheses_of(scan: StudiedScan, line: Line) -> Iterator[Hypothesis]:
    """Yield what ``line`` of ``scan`` may be; of a vibration also what folds to it."""
    if TIME in line.possible:
        seen, spread = line.possible[TIME], spread_of(scan, line, TIME)
        rate = scan.signal.rate
        yield Hypothesis(VIBRATION, TIME, seen, spread)
        for folds in range(1, _MOST_FOLDS + 1):
            for image in (folds * rate - seen, folds * rate + seen):
                yield Hypothesis(VIBRATION, TIME, image, spread, folds)
    for coordinate in (PATH, RADIUS):
        if coordinate in line.possible:
            spread = spread_of(scan, line, coordinate)
            yield Hypothesis(PART, coordinate, line.possible[coordinate], spread)
    if (order := whole_order(scan, line)) is not None:
        yield Hypothesis(SYNCHRONOUS, TURN, float(order), 0.0)


def whole_order(scan: StudiedScan, line: Line) -> int | None:
    """Return how many waves a turn the line has, if it is a whole number."""
    if TURN not in line.possible or scan.signal.turns < _LEAST_TURNS:
        return None
    per_turn = line.possible[TURN]
    order = round(per_turn)
    own = scan.coordinates[TURN].resolution
    allowed = _TIMES_UNCERTAINTY * _own_spread(scan, line, TURN) + _OWN_BIN * own
    if not 1 <= order <= HIGHEST_SYNCHRONOUS or abs(per_turn - order) > allowed:
        return None
    return order


def spread_of(scan: StudiedScan, line: Line, coordinate: str) -> float:
    """Return how far the true frequency in ``coordinate`` may be from where the line was seen."""
    return (
        _TIMES_UNCERTAINTY * _own_spread(scan, line, coordinate)
        + _OTHER_BIN * scan.resolution(coordinate)
        + _STEADY[coordinate] * line.possible[coordinate]
    )


def _own_spread(scan: StudiedScan, line: Line, coordinate: str) -> float:
    """Return the standard uncertainty of its frequency in ``coordinate``."""
    share = scan.resolution(coordinate) / scan.resolution(line.coordinate)
    return line.frequency_uncertainty * share


def place_in(scan: StudiedScan, hypothesis: Hypothesis) -> Place | None:
    """Return where the line would be in ``scan``; None if the scan cannot show it."""
    coordinate = scan.coordinates.get(hypothesis.coordinate)
    if coordinate is None:
        return None
    if not coordinate.proportional_to_time:
        fine = hypothesis.frequency > coordinate.highest
        tolerance = hypothesis.uncertainty + _OWN_BIN * coordinate.resolution
        return Place(coordinate.name, hypothesis.frequency, tolerance, fine)
    in_time = hypothesis.frequency * coordinate.pace
    rate = scan.signal.rate
    seen = float(folded_frequency(in_time, rate))
    tolerance = hypothesis.uncertainty * coordinate.pace + _OWN_BIN * scan.resolution(TIME)
    return Place(TIME, seen, tolerance, in_time > rate / 2)


def apart(one: Place | None, other: Place | None) -> bool:
    """Return True if a scan in which two hypotheses have these places separates them."""
    if one is None or other is None or one.coordinate != other.coordinate:
        return True
    return abs(one.frequency - other.frequency) > one.tolerance + other.tolerance


def found_at(scan: StudiedScan, place: Place) -> Line | None:
    """Return the line of ``scan`` at ``place``, the strongest if there are several."""
    near = [
        line
        for line in scan.lines
        if place.coordinate in line.possible
        and abs(line.possible[place.coordinate] - place.frequency)
        <= place.tolerance + _TIMES_UNCERTAINTY * _own_spread(scan, line, place.coordinate)
    ]
    return max(near, key=lambda line: line.amplitude, default=None)


def by_chance(scan: StudiedScan, place: Place) -> float:
    """Return how many lines of ``scan`` would lie at ``place`` if they lay anywhere."""
    band = scan.coordinates[place.coordinate].highest
    count = sum(place.coordinate in line.possible for line in scan.lines)
    return count * 2 * place.tolerance / band


def shows(scan: StudiedScan, hypothesis: Hypothesis, amplitude: float) -> bool | None:
    """Return whether a line of ``amplitude`` [m] elsewhere is in ``scan``; None: undecidable."""
    place = place_in(scan, hypothesis)
    if place is None or by_chance(scan, place) > _GREATEST_CHANCE:
        return None
    line = found_at(scan, place)
    if line is not None:
        ratio = line.amplitude / amplitude
        least = (
            1 / _AMPLITUDES * (1.0 if hypothesis.kind != PART else _least_share(scan, hypothesis))
        )
        alike = hypothesis.kind == VIBRATION or least <= ratio <= _AMPLITUDES
        return True if alike else None
    return None if _may_hide(scan, hypothesis, place, amplitude) else False


def _may_hide(scan: StudiedScan, hypothesis: Hypothesis, place: Place, amplitude: float) -> bool:
    """Return True if the line could be there and not be found."""
    if hypothesis.kind == VIBRATION:
        return False  # the machine may stand still: absence is no proof, and is never used as one
    if place.coordinate == TIME:
        if place.frequency < (LEAST_WAVES + 1) * scan.resolution(TIME) or _near_form(scan, place):
            return True
        floor = scan.spectrum.sigma_at(place.frequency)
    elif place.folded:
        return True  # it is looked for only where another scan has found it
    else:
        floor = scan.spectrum.noise * np.sqrt(2 / len(scan.signal))
    return amplitude * _least_share(scan, hypothesis) < _WOULD_BE_SEEN * floor


def _near_form(scan: StudiedScan, place: Place) -> bool:
    """Return True where taking out the form takes a line out as well."""
    turn = scan.coordinates.get(TURN)
    if turn is None:
        return False
    order = place.frequency / turn.pace
    width = place.tolerance + (scan.formless.degree + 2) / 2 * scan.resolution(TIME)
    nearest = round(order)
    return nearest <= max(HIGHEST_ORDER, scan.formless.degree) and (
        abs(order - nearest) * turn.pace < width
    )


def _least_share(scan: StudiedScan, hypothesis: Hypothesis) -> float:
    """Return the share of a texture's amplitude that an average over a sample period leaves."""
    coordinate = scan.coordinates[hypothesis.coordinate]
    return float(abs(np.sinc(hypothesis.frequency * coordinate.pace * scan.signal.period)))
