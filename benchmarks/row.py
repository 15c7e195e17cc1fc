"""One line of the benchmark table."""

from __future__ import annotations

from typing import TypedDict


class Row(TypedDict):
    """A measured figure and the bar it has to clear.

    name: what was measured;  value, unit: the figure;  runs: over which it was taken, if several
    peer: the figure of what it is measured against, or its name, or None
    bar: the condition in words;  holds: whether it is met, None where nothing could be compared
    """

    name: str
    value: float
    unit: str
    runs: int | None
    peer: float | str | None
    bar: str
    holds: bool | None


def at_most(
    name: str,
    value: float,
    unit: str,
    limit: float,
    peer: float | str | None = None,
    runs: int | None = None,
) -> Row:
    """A figure that must not exceed ``limit``."""
    return _row(name, value, unit, runs, peer, f"<= {limit:g}", float(value) <= limit)


def at_least(
    name: str,
    value: float,
    unit: str,
    limit: float,
    peer: float | str | None = None,
    runs: int | None = None,
) -> Row:
    """A figure that must reach ``limit``."""
    return _row(name, value, unit, runs, peer, f">= {limit:g}", float(value) >= limit)


def between(
    name: str,
    value: float,
    unit: str,
    low: float,
    high: float,
    peer: float | str | None = None,
    runs: int | None = None,
) -> Row:
    """A figure that must lie within ``low`` and ``high``."""
    holds = low <= float(value) <= high
    return _row(name, value, unit, runs, peer, f"{low:g} to {high:g}", holds)


def shown(
    name: str, value: float, unit: str, peer: float | str | None = None, runs: int | None = None
) -> Row:
    """Return a figure without a limit, for information."""
    return _row(name, value, unit, runs, peer, "", None)


def not_compared(name: str, unit: str, bar: str, why: str) -> Row:
    """Return a figure that could not be measured here."""
    return _row(name, float("nan"), unit, None, why, bar, None)


def failed(name: str, why: str) -> Row:
    """Return a failed row for a part that raised an error."""
    return _row(name, float("nan"), "", None, why, "runs", False)


def _row(
    name: str,
    value: float,
    unit: str,
    runs: int | None,
    peer: float | str | None,
    bar: str,
    holds: bool | None,
) -> Row:
    # Plain Python types, because the table becomes JSON.
    plain = None if holds is None else bool(holds)
    return Row(name=name, value=float(value), unit=unit, runs=runs, peer=peer, bar=bar, holds=plain)
