"""One line of the benchmark table."""

from __future__ import annotations

from typing import TypedDict


class Row(TypedDict):
    """A measured figure and the bar it has to clear.

    name: what was measured;  value, unit: the figure
    peer: the figure of what it is measured against, or its name, or None
    bar: the condition in words;  holds: whether it is met, None where nothing could be compared
    """

    name: str
    value: float
    unit: str
    peer: float | str | None
    bar: str
    holds: bool | None


def at_most(
    name: str, value: float, unit: str, limit: float, peer: float | str | None = None
) -> Row:
    """A figure that must not exceed ``limit``."""
    value = float(value)
    return Row(
        name=name, value=value, unit=unit, peer=peer, bar=f"<= {limit:g}", holds=value <= limit
    )


def at_least(
    name: str, value: float, unit: str, limit: float, peer: float | str | None = None
) -> Row:
    """A figure that must reach ``limit``."""
    value = float(value)
    return Row(
        name=name, value=value, unit=unit, peer=peer, bar=f">= {limit:g}", holds=value >= limit
    )


def between(
    name: str, value: float, unit: str, low: float, high: float, peer: float | str | None = None
) -> Row:
    """A figure that must lie within ``low`` and ``high``."""
    value = float(value)
    bar, holds = f"{low:g} to {high:g}", low <= value <= high
    return Row(name=name, value=value, unit=unit, peer=peer, bar=bar, holds=holds)


def not_compared(name: str, unit: str, bar: str, why: str) -> Row:
    """A figure that could not be had here."""
    return Row(name=name, value=float("nan"), unit=unit, peer=why, bar=bar, holds=None)
