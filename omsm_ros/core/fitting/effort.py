"""When is enough tried? What is not linear asks for ever more poles and departures."""

from __future__ import annotations

from dataclasses import dataclass

# Of 350 disturbed step tests those that were accepted had at most 1200 before their last round,
# and clean ones 150; in 1500 a record of 20 s at 1 kHz takes five seconds.
_ENOUGH = 1500


@dataclass(eq=False)
class Effort:
    """How often a record was compared with a model, in all the problems that were made of it."""

    comparisons: int = 0

    @property
    def spent(self) -> bool:
        """Whether no further order and no further departure is to be begun."""
        return self.comparisons > _ENOUGH
