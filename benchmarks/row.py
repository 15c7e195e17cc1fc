"""One line of the benchmark table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """A measured figure and the bar it has to clear.

    name: what was measured;  value, unit: the figure
    peer: what it is measured against;  bar: the condition in words;  holds: whether it is met
    """

    name: str
    value: float
    unit: str
    peer: str
    bar: str
    holds: bool


def at_most(name: str, value: float, unit: str, limit: float, peer: str = "") -> Row:
    """A figure that must not exceed ``limit``."""
    return Row(name, float(value), unit, peer, f"<= {limit:g}", bool(value <= limit))


def at_least(name: str, value: float, unit: str, limit: float, peer: str = "") -> Row:
    """A figure that must reach ``limit``."""
    return Row(name, float(value), unit, peer, f">= {limit:g}", bool(value >= limit))


def between(name: str, value: float, unit: str, low: float, high: float, peer: str = "") -> Row:
    """A figure that must lie within ``low`` and ``high``."""
    return Row(name, float(value), unit, peer, f"{low:g} to {high:g}", bool(low <= value <= high))
