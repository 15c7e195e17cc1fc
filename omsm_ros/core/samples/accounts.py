"""Where did every sample go?

For each stream ``received == corrected + pending + sum(counted.values())`` at any time. What
never came is none of these: trigger counts that a session left out are ``missing``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Reason(IntEnum):
    """Why a sample gave no surface point; 0 means that it did.

    INVALID: not finite, or the probe gave no usable reading, on either side of a pair
    UNMATCHED: the other stream has no sample of this trigger count
    DUPLICATE: the trigger count was seen before
    LATE: came after later samples, into a gap that had been passed
    SETTLING: the filter had just started
    OVERDUE: waited for its partner, or for whom its partner waited, longer than is allowed
    BEYOND: taken where no member of the calibration set knows the dynamics
    SLIPPED: the counters of the two streams no longer count the same triggers
    """

    NONE = 0
    INVALID = 1
    UNMATCHED = 2
    DUPLICATE = 3
    LATE = 4
    SETTLING = 5
    OVERDUE = 6
    BEYOND = 7
    SLIPPED = 8


@dataclass(frozen=True)
class StreamAccount:
    """One stream: samples received, turned into points, still waiting, and counted by reason.

    missing: trigger counts that never came, between the first and the last of each session
    """

    received: int = 0
    corrected: int = 0
    pending: int = 0
    counted: Mapping[str, int] = field(default_factory=dict)
    missing: int = 0


@dataclass(frozen=True)
class Account:
    """Both streams of a corrector."""

    axes: StreamAccount = StreamAccount()
    distance: StreamAccount = StreamAccount()

    def as_dict(self) -> dict[str, dict[str, object]]:
        """Return JSON values: stream -> received, corrected, pending, counted {reason: samples}."""
        return asdict(self)


class Tally:
    """The running account of one stream."""

    def __init__(self) -> None:
        self.received = 0
        self.missing = 0
        self.corrected = 0
        self._counted: Counter[Reason] = Counter()

    def count(self, reason: Reason, samples: int) -> None:
        """Enter ``samples`` under ``reason``; NONE means corrected."""
        if reason is Reason.NONE:
            self.corrected += samples
        else:
            self._counted[reason] += samples

    def count_each(self, reasons: NDArray[np.uint8]) -> None:
        """Enter one sample under each of ``reasons`` (n,)."""
        for value, samples in enumerate(np.bincount(reasons)):
            self.count(Reason(value), int(samples))

    def snapshot(self, pending: int) -> StreamAccount:
        """Return the account as it stands with ``pending`` samples waiting."""
        counted = {reason.name.lower(): n for reason, n in sorted(self._counted.items()) if n}
        return StreamAccount(self.received, self.corrected, pending, counted, self.missing)
