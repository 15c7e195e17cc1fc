"""Identify from step tests of disturbed machines, and compare with the true response.

Every disturbance of the twin's catalogue that affects a step test, of medium size; with ``--full``
also small and large ones, ten tests each, and random pairs. A calibration may be accepted, accepted
with reservations (the disturbance is modelled, or covered by a wider band), or rejected with the
cause. It must not be accepted if the response is off by more than three stated standard
uncertainties and by more than five nanometres on the paper's scan. With ``--full`` the table goes
to docs/disturbances.md; ``python -m benchmarks.disturbed SEEDS PAIRS`` writes it from fewer tests.
"""

from __future__ import annotations

import sys
import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import named_causes
from benchmarks.disturbance_catalogue import CATALOGUE, SIZES, together
from benchmarks.row import Row, at_most, shown
from benchmarks.step_test import StepTest
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import ACCEPTED, REJECTED
from omsm_ros.core.calibration.intended_use import PAPER_USE
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.frequency_response import response_band
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import OmsmError
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.disturbances import NOTHING, Disturbances
from omsm_ros.units import NANOMETRE_M

_FIRST_SEED = 9000
_STAND_OFF = -49e-6
_GREATEST_ERROR_M, _GREATEST_SIGMAS = 5 * NANOMETRE_M, 3.0
# Disturbances of the part, which a step test on a mirror does not see.
_OF_THE_PART = ("part", "spindle", "vibration, 11 times a turn")
# A sample of thousands of pairs; it takes an hour on one processor.
_PAIRS, _SEED = 500, 5
_SEEDS = 10
# Pairs whose response is off by more stated uncertainties are listed.
_NOTABLE_SIGMAS = 2.0
_TABLE = Path(__file__).parent.parent / "docs" / "disturbances.md"


@dataclass(frozen=True)
class Outcome:
    """Result of one calibration compared with the true response.

    verdict: first words of it, or of the error;  why: its reasons and reservations
    error: on the paper's scan [m];  sigmas: largest error of the response over stated, in its band
    stated: standard uncertainty on the paper's scan [m]
    named: whether the cause that it names is right; empty where it names nothing
    """

    name: str
    verdict: str
    why: str
    error: float = 0.0
    sigmas: float = 0.0
    stated: float = 0.0
    named: str = ""

    @property
    def accepted(self) -> bool:
        """Whether it was accepted, with or without reservations."""
        return self.verdict.startswith("accepted")

    @property
    def wrong(self) -> bool:
        """Whether it was accepted although the error is significant and relevant."""
        far = self.sigmas > _GREATEST_SIGMAS and self.error > _GREATEST_ERROR_M
        return self.accepted and far


def rows(full: bool) -> Iterator[Row]:
    """Yield wrongly accepted and wrongly rejected tests; write the table if ``full``."""
    clean = [outcome("clean", NOTHING, seed) for seed in range(100 if full else 10)]
    alarms = [o for o in clean if o.verdict != ACCEPTED]
    yield at_most("false alarms on clean tests", _percent(alarms, clean), "%", 2, runs=len(clean))
    found = _alone(SIZES, _SEEDS) if full else _alone(SIZES[1:2], 1)
    yield _lies("alone", found)
    yield shown("rejected, alone", _percent([o for o in found if not o.accepted], found), "%")
    yield _wrong_causes("alone", found)
    if full:
        pairs = list(_pairs(_PAIRS))
        yield _lies("in pairs", pairs)
        yield _wrong_causes("in pairs", pairs)
        _TABLE.write_text(page([*clean[:1], *found], pairs))


def write_table(seeds: int, pairs: int) -> None:
    """Write docs/disturbances.md from ``seeds`` tests of each case, and ``pairs`` drawn pairs."""
    alone = [outcome("clean", NOTHING, 0), *_alone(SIZES, seeds)]
    _TABLE.write_text(page(alone, list(_pairs(pairs))))


def _of_a_step_test() -> dict[str, tuple[Disturbances, Disturbances, Disturbances]]:
    return {k: v for k, v in CATALOGUE.items() if not k.startswith(_OF_THE_PART)}


def _alone(wanted: Sequence[str], seeds: int) -> list[Outcome]:
    return [
        outcome(f"{name}, {size}", disturbances, seed)
        for name, sizes in _of_a_step_test().items()
        for size, disturbances in zip(SIZES, sizes, strict=True)
        if size in wanted
        for seed in range(seeds)
    ]


def _pairs(count: int) -> Iterator[Outcome]:
    random = np.random.default_rng(_SEED)
    met = _of_a_step_test()
    names = list(met)
    for seed in range(count):
        one, other = random.choice(names, 2, replace=False)
        k = int(random.integers(len(SIZES)))
        try:
            both = together(met[one][k], met[other][k])
        except OmsmError:
            continue
        yield outcome(f"{one} + {other}, {SIZES[k]}", both, seed)


def _lies(what: str, found: Sequence[Outcome]) -> Row:
    wrong = [o for o in found if o.wrong]
    return at_most(f"accepted though wrong, {what}", len(wrong), "", 0, runs=len(found))


def _wrong_causes(what: str, found: Sequence[Outcome]) -> Row:
    """Return the share of reserved or rejected results that name a wrong cause."""
    stated = [o for o in found if o.named]
    wrong = [o for o in stated if o.named == named_causes.WRONG]
    share = _percent(wrong, stated) if stated else 0.0
    return at_most(f"wrong cause named, {what}", share, "%", 5, runs=len(stated))


def _percent(part: Sequence[Outcome], whole: Sequence[Outcome]) -> float:
    return 100 * len(part) / len(whole)


def outcome(name: str, disturbances: Disturbances, seed: int) -> Outcome:
    """Record a step test of the disturbed cell, identify from it, and compare with its truth."""
    cell = Cell(disturbances=disturbances, seed=_FIRST_SEED + seed)
    made = record(cell, StepTest(), Flat(), stand_off=_STAND_OFF)
    assert made.truth is not None
    try:
        found = identify(made.motion_record()).calibration
    except OmsmError as err:
        return Outcome(name, "refused", str(err))
    certificate = found.certificate
    findings = [*certificate.reasons, *certificate.reservations]
    lowest = certificate.validity.from_hz or 0.0
    lines = np.geomspace(max(lowest, 0.1), max(found.valid_up_to, 0.2), 100)
    band = response_band(found.dynamics, found.covariance, lines)
    off = np.log(found.dynamics.response(lines) / made.truth.response.response(lines))
    sigmas = float(np.max(np.abs(off) / np.hypot(band.gain, band.phase)))
    error, stated = _on_scan(found, made.truth.response.response(_SCAN_HZ))
    return Outcome(
        name,
        certificate.verdict or "",
        "; ".join(map(str, findings)),
        error,
        sigmas,
        stated,
        named_causes.judged(name, findings) if findings else "",
    )


_SCAN_HZ, _SCAN_M = PAPER_USE.frequencies_hz, PAPER_USE.rms_m


def _on_scan(found: Calibration, truth: np.ndarray) -> tuple[float, float]:  # type: ignore[type-arg]
    off = np.abs(found.dynamics.response(_SCAN_HZ) - truth)
    band = response_band(found.dynamics, found.covariance, _SCAN_HZ)
    stated = np.hypot(band.gain, band.phase)
    motion_error = found.certificate.model_errors.motion_error_m or 0.0
    return (
        float(np.linalg.norm(off * _SCAN_M)),
        float(np.hypot(np.linalg.norm(stated * _SCAN_M), motion_error)),
    )


def page(alone: Sequence[Outcome], pairs: Sequence[Outcome]) -> str:
    """Return the text of docs/disturbances.md."""
    by_name: dict[str, list[Outcome]] = {}
    for each in alone:
        by_name.setdefault(each.name, []).append(each)
    return "\n".join(
        [
            "# Disturbed step tests",
            "",
            "Verdict of `omsm identify` on step tests of disturbed machines, compared with the "
            "truth of the twin. Error and stated uncertainty are those of the linear response on "
            "the paper's scan, in the test with the largest error. σ is the largest error of the "
            "response over its stated uncertainty, from 0.1 Hz to the end of the valid range. "
            "Named: whether the "
            "cause that is stated is the disturbance that was made.",
            "",
            "`python -m benchmarks disturbed --full` writes this page from "
            f"{_SEEDS} tests a case and {_PAIRS} pairs.{_fewer(by_name, pairs)} "
            "One machine, a servo of 40 Hz, is tried by",
            "",
            "```sh",
            "printf 'servo_bandwidth_hz: 40\\n' > slow.yaml",
            "omsm twin --out slow/ --disturbances slow.yaml",
            "omsm identify slow/steps.mcap --out slow.json",
            "```",
            "",
            f"Alone: {_summary(alone)} Each of {len(by_name)} cases was tested "
            f"{_times(by_name.values())}.",
            "",
            *_table(by_name),
            "",
            "## Pairs",
            "",
            *_pairs_of(pairs),
            "",
        ]
    )


def _fewer(by_name: Mapping[str, Sequence[Outcome]], pairs: Sequence[Outcome]) -> str:
    """Return a sentence that tells the numbers of a shorter run; empty for the full one."""
    seeds = max(map(len, by_name.values()))
    if seeds >= _SEEDS:
        return ""
    return f" The table below is of a shorter run: {seeds} a case and {len(pairs)} pairs."


def _pairs_of(pairs: Sequence[Outcome]) -> list[str]:
    if not pairs:
        return ["No pairs were tested."]
    notable = [p for p in pairs if not p.accepted or p.sigmas > _NOTABLE_SIGMAS]
    return [
        f"Drawn by chance, both of one size. {_summary(pairs)} Those rejected, and those off by "
        f"more than {_NOTABLE_SIGMAS:g} σ:",
        "",
        *_table({each.name: [each] for each in notable}),
    ]


def _times(groups: Iterable[Sequence[Outcome]]) -> str:
    counts = sorted({len(group) for group in groups})
    few, many = counts[0], counts[-1]
    return ("once" if many == 1 else f"{many} times") if few == many else f"{few} to {many} times"


def _table(by_name: Mapping[str, Sequence[Outcome]]) -> list[str]:
    return [
        "| disturbance | verdict | error [nm] | stated [nm] | σ | named | reservation or reason |",
        "|---|---|---|---|---|---|---|",
        *(_line(name, outcomes) for name, outcomes in by_name.items()),
    ]


def _summary(found: Sequence[Outcome]) -> str:
    counted = ", ".join(_counted(found))
    wrong = sum(o.wrong for o in found)
    return (
        f"{len(found)} tests: {counted}; accepted though more than {_GREATEST_SIGMAS:g} σ and "
        f"{_GREATEST_ERROR_M / NANOMETRE_M:g} nm off: {wrong}."
    )


def _counted(found: Sequence[Outcome]) -> list[str]:
    kinds = Counter(_verdict(o) for o in found)
    return [f"{count} {kind}" for kind, count in kinds.most_common()]


def _verdict(o: Outcome) -> str:
    return "rejected" if o.verdict == REJECTED else o.verdict.split(",")[0]


def _line(name: str, found: Sequence[Outcome]) -> str:
    worst = max(found, key=lambda o: o.sigmas)
    error, stated = worst.error / NANOMETRE_M, worst.stated / NANOMETRE_M
    words = textwrap.shorten(worst.why.replace("|", "/"), 160, placeholder=" …")
    said = _verdict(worst) if len(found) == 1 else ", ".join(_counted(found))
    return (
        f"| {name} | {said} | {error:.1f} | {stated:.1f} | {worst.sigmas:.1f} | {_named(found)} "
        f"| {words} |"
    )


def _named(found: Sequence[Outcome]) -> str:
    """Return how often the named cause was right, unknown or wrong."""
    kinds = Counter(o.named for o in found if o.named)
    return ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())


if __name__ == "__main__":
    write_table(*map(int, sys.argv[1:3]))
