"""Writing something into the catalogue must never cost a measurement."""

from __future__ import annotations

from collections.abc import Callable

from omsm_ros.errors import OmsmError


def remembered(address: str, keep: Callable[[], bool]) -> list[str]:
    """Write something down if there is a catalogue; return a warning where that failed.

    A measurement is never lost because of a database: it lies in its folder already.
    """
    if not address:
        return []
    try:
        keep()
    except (OmsmError, OSError) as err:
        return [f"not written into the catalogue: {err}; 'omsm history --add' does it later"]
    return []
