"""Put part, machine and one error together, and run step test and scans one after the other."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from benchmarks.worlds import scans
from benchmarks.worlds.catalogue import KINDS, Kind
from benchmarks.worlds.figure import Figure, Truth
from benchmarks.worlds.machine import Machine, Path, Recording
from benchmarks.worlds.part import Nominal, OffAxisParaboloid, Part
from benchmarks.worlds.sources import Shop, Site, declared, drawn

RADIUS_M = 12.7e-3
PAUSE_S = 20.0
"""Between two scans, for the way back."""
QUICK_FEED_M = 3e-4
FULL_FEED_M = 1e-4


@dataclass(frozen=True)
class World:
    """A part on a machine of a shop, with one kind of error in one size."""

    kind: str = "none"
    size: int = 1
    """0 small, 1 medium, 2 large."""
    seed: int = 0
    nominal: Nominal = field(default_factory=OffAxisParaboloid)
    radius: float = RADIUS_M
    share: float = 1.0
    """Of the declared sources that the machine has: 0 leaves noise and resolution alone."""

    @property
    def row(self) -> Kind:
        """Return the kind's row of the catalogue."""
        return KINDS[self.kind]

    @property
    def clean(self) -> World:
        """Return the same world, by the same chances, without the error."""
        return replace(self, kind="none")

    @property
    def value(self) -> float:
        """Return the size of the error in the kind's unit."""
        return self.row.sizes[self.size]

    @cached_property
    def part(self) -> Part:
        """Return the part, with the figure of this seed."""
        return Part(self.nominal, Figure.draw(self.seed, self.radius), self.radius)

    @cached_property
    def shop(self) -> Shop:
        """Return machine and clamping without the error."""
        return drawn(self.seed, self.radius, self.share)

    def _disturbed(self, machine: Machine, where: str) -> Machine:
        """Return the machine with the error, if it acts ``where``."""
        if self.row.scope not in (where, "both"):
            return machine
        site = Site(np.random.default_rng([self.seed, 907]), self.radius, machine.exposure)
        return self.row.build(machine, self.value, site)

    @cached_property
    def scanning(self) -> Machine:
        """Return the machine of the scans."""
        return self._disturbed(self.shop.scanning, "scan")

    @cached_property
    def testing(self) -> Machine:
        """Return the machine of the step test."""
        return self._disturbed(self.shop.testing, "test")

    def step_test(self, path: Path | None = None, repeat: int = 0) -> Recording:
        """Run the step test."""
        return scans.step_test(self.testing, path, seed=1000 * self.seed + 500 + repeat)

    def scan(
        self,
        rpm: float = 30.0,
        direction: str = "in",
        clocking: float = 0.0,
        feed: float = QUICK_FEED_M,
        beyond: float = 0.0,
        start: float = 0.0,
        repeat: int = 0,
    ) -> Recording:
        """Scan the part once, ``start`` seconds after it was clamped.

        ``repeat`` changes what chance does from one recording to the next. The part is clocked
        by ``clocking`` [rad], right-handed about the axis towards the probe; tilt turns with it.
        """
        path = scans.spiral(self.part, rpm, direction, clocking, feed, beyond, start)
        pose = self.shop.pose
        cos, sin = np.cos(clocking), np.sin(clocking)
        turned = replace(
            pose,
            x=pose.x * cos - pose.y * sin,
            y=pose.x * sin + pose.y * cos,
            clocking=pose.clocking + clocking,
            tip=pose.tip * cos - pose.tilt * sin,
            tilt=pose.tip * sin + pose.tilt * cos,
        )
        return scans.scan(self.scanning, self.part, path, 1000 * self.seed + repeat, turned)

    def scans(
        self, plan: Iterable[tuple[float, str, float]], feed: float = QUICK_FEED_M, **more: float
    ) -> list[Recording]:
        """Run scans (rpm, direction, clocking) one after the other, with pauses between them."""
        done, clock = [], 0.0
        for repeat, (rpm, direction, clocking) in enumerate(plan):
            one = self.scan(rpm, direction, clocking, feed, start=clock, repeat=repeat, **more)
            clock += one.path.duration + PAUSE_S
            done.append(one)
        return done

    def truth(self, along: str = "normal") -> Truth:
        """Return PV, rms and Zernike terms of the part's deviation."""
        return self.part.truth(along)

    def declared(self, left_out: bool = True) -> dict[str, object]:
        """Return the sources that the shop states.

        For an undeclared kind the row of its source is dropped, unless it is a spindle harmonic
        (other harmonics are stated). With ``left_out`` false the row stays and is exceeded.
        """
        row = self.row
        harmonic = row.source.startswith("spindle_")
        gone = left_out and row.group == "undeclared" and not harmonic
        return declared(row.source if gone else "")
