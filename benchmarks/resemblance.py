"""Errors of the machine that no scan shows: does the comparison of the form with them find them?

``python -m benchmarks.resemblance GOOD EACH`` prints the table of docs/adjustment.md: GOOD forms of
good parts, and EACH with an error in every size, with the uncertainty that two scans leave.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from benchmarks.adjustment import QUICK, REMOVED, adjusted
from benchmarks.worlds.catalogue import HALF_TRAVEL_M
from benchmarks.worlds.figure import Figure
from benchmarks.worlds.part import slopes
from benchmarks.worlds.world import World
from omsm_ros.core.adjustment import figures
from omsm_ros.core.adjustment.verdict import open_limit
from omsm_ros.core.surface.nominal import PAPER_MIRROR

_SCANNED, _FIRST_FORM = 430_100, 870_000
_WRONG_SIGMAS, _WRONG_M = 3.0, 5e-9


class Drawn:
    """Forms as two scans of one good machine would find them."""

    def __init__(self) -> None:
        world = World(seed=_SCANNED)
        found = adjusted(world, QUICK)
        self.solution, self.radius, self.nominal = found.solution, world.radius, world.nominal
        self.made = figures.FormOf.of(self.solution, PAPER_MIRROR, REMOVED)
        self.effects = figures.effects_on_form(self.made)
        form = figures.form_map(self.made)
        self.covariance, self.term_covariance = form.covariance, form.term_covariance
        self.every, self.by_height = figures._term_fit(self.solution, self.made.places)
        self.kept = [self.every.index(t) for t in form.terms]
        share, axes = np.linalg.eigh(form.covariance)
        self.root = axes * np.sqrt(np.maximum(share, 0.0))

    def errors(self) -> dict[str, list[tuple[str, np.ndarray]]]:
        """Return each error of the table: its sizes, and what they do to the heights [m]."""
        x, y = self.made.places.x, self.made.places.y
        z = self.nominal.height(x, y)
        along_x, along_y = slopes(self.nominal.height, x, y)
        lift, square = z / HALF_TRAVEL_M, along_x**2 + along_y**2
        nanometres = [(f"{v} nm", 1e-9 * v) for v in (20, 50, 150)]

        def sizes(shape, values):
            return [(name, value * shape) for name, value in values]

        def plain(*values):
            return [(f"{v:g}", v) for v in values]

        return {
            "scale of Z, or static gain of the machine": sizes(z, plain(2e-5, 1e-4, 5e-4, 2e-3)),
            "loop that bends with Z²": sizes(lift**2, nanometres),
            "loop that bends with Z³": sizes(lift**3, nanometres),
            "probe, by the square of the slope [m/rad²]": sizes(square, plain(5e-7, 2e-6, 1e-5)),
            "scale of X": sizes(along_x * x + along_y * y, plain(1e-4, 4e-4, 1.5e-3)),
            "straightness of X, bow": sizes((x**2 + y**2) / self.radius**2, nanometres),
        }

    def judged(self, seed: int, error: np.ndarray) -> tuple[bool, bool, float]:
        """Return whether it would be verified, whether it is wrong, and U of PV [m]."""
        places, area = self.made.places, self.made.places.area
        true = self.made.free(Figure.draw(seed, self.radius).height(places.x, places.y))
        chance = np.random.default_rng([seed, 7]).standard_normal(len(true))
        seen = replace(self.made, height=true + self.made.free(error) + self.root @ chance)
        alike = figures._resembled(seen, self.covariance, self.every, self.by_height, self.effects)
        more = np.stack([np.zeros(len(true)), *(change for _, change in alike)], axis=1)
        pv, rms = seen.pv_and_rms(more)
        to_terms = self.by_height[self.kept]
        spread = np.diag(self.term_covariance) + np.sum((to_terms @ more) ** 2, axis=1)
        off = [pv.value - np.ptp(true), rms.value - np.sqrt(area @ true**2)]
        off = np.append(off, to_terms @ (seen.height - true))
        stated = np.append([pv.uncertainty, rms.uncertainty], np.sqrt(spread))
        wrong = (np.abs(off) > _WRONG_SIGMAS * stated) & (np.abs(off) > _WRONG_M)
        verified = np.max(np.sqrt(area @ more**2)) <= open_limit(None)
        return bool(verified), bool(np.any(wrong)), 2 * pv.uncertainty


def main(good: int, each: int) -> None:
    """Print the table."""
    drawn = Drawn()

    def row(name: str, size: str, error: np.ndarray, number: int) -> None:
        found = [drawn.judged(_FIRST_FORM + k, error) for k in range(number)]
        verified, wrong, expanded = (np.array(column) for column in zip(*found, strict=True))
        print(f"| {name} | {size} | {100 * np.mean(verified):.0f} % | "
              f"{100 * np.mean(verified & wrong):.0f} % | "
              f"{1e9 * np.median(expanded):.0f} nm |", flush=True)  # fmt: skip

    row("none", "", np.zeros(len(drawn.made.height)), good)
    for name, sizes in drawn.errors().items():
        for size, error in sizes:
            row(name, size, error, each)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
