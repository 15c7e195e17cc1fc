"""Addresses of devices as URLs: ``daq://Dev1/ai0?range=10``."""

from __future__ import annotations

from urllib.parse import SplitResult, urlsplit

from omsm_ros.errors import ConfigurationError


def parts_of(address: str) -> SplitResult:
    """Return scheme, host, path and query; ConfigurationError for a text that is no address."""
    try:
        return urlsplit(address)
    except ValueError as err:
        raise ConfigurationError(f"address {address!r} cannot be read: {err}") from err
