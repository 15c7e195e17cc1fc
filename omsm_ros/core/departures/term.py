"""One way in which a machine may depart from a linear, steady response, and a family of such."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from omsm_ros.core.samples.blocks import FloatArray


@dataclass(frozen=True, eq=False)
class Term:
    """One departure from a linear, steady response.

    parameter: time constant [s], frequency [Hz], travel or period [m]; 0 where it has none
    trials: how many independent ones its family tries, for the probability of the best
    damping: of a mode, else 0
    columns: (n, c), added to the reading per unit
    """

    family: str
    parameter: float
    trials: float
    columns: FloatArray
    damping: float = 0.0


@dataclass(frozen=True, eq=False)
class Family:
    """Terms of one kind.

    part: columns (n, terms · c) of the terms from one index to another, side by side, made when
        they are asked for: all of a long record's would be gigabytes
    width: columns of one term, c
    """

    name: str
    parameters: FloatArray
    trials: float
    part: Callable[[int, int], FloatArray]
    width: int
    dampings: FloatArray | None = None

    @classmethod
    def of(cls, name: str, parameters: FloatArray, trials: float, columns: FloatArray) -> Family:
        """Return the terms whose ``columns`` (n, terms · c) are known."""
        width = int(columns.shape[1] // len(parameters))

        def part(first: int, last: int) -> FloatArray:
            # A copy: a term outlives its family, and a view would keep all of that.
            return columns.T[first * width : last * width].copy().T

        return cls(name, parameters, trials, part, width)

    @property
    def columns(self) -> FloatArray:
        """Those of all terms, (n, terms · c)."""
        return self.part(0, len(self.parameters))

    def term(self, index: int) -> Term:
        """Return the term at ``index``."""
        damping = 0.0 if self.dampings is None else float(self.dampings[index])
        parameter = float(self.parameters[index])
        columns = self.part(index, index + 1)
        return Term(self.name, parameter, self.trials, columns, damping)
