"""Makes the devices that parameters describe, not yet connected."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.parameters import STREAMS, NowNs, Values, defaults
from omsm_ros.instruments.registry import ACCELEROMETERS, PROBES, REFERENCES, Model, loaded
from omsm_ros.instruments.stream import StreamDevice
from omsm_ros.instruments.trace import TracedTransport
from omsm_ros.instruments.transport import transport_for


def make_device(values: Values, now_ns: NowNs = time.time_ns) -> StreamDevice:
    """Return the probe that ``values``, each of PARAMETERS by name, describe.

    Raises ConfigurationError.
    """
    make = _maker(PROBES, values["device"])
    transport = transport_for(values["port"], values["baud_rate"])
    if values["trace"]:
        transport = TracedTransport(transport, Path(values["trace"]))
    device: StreamDevice = make(values, transport, now_ns)
    return device


def make_axes(values: Values, now_ns: NowNs = time.time_ns) -> StreamDevice:
    """Return the stream of axes that ``values``, each of AXIS_PARAMETERS, describe.

    Raises ConfigurationError.
    """
    if values["device"] not in STREAMS:
        raise ConfigurationError(f"device {values['device']!r}, expected one of {STREAMS}")
    return make_device(defaults() | dict(values), now_ns)


def make_reference(values: Values, now_ns: NowNs = time.time_ns) -> Any:
    """Return the reference sensor that ``values``, each of REFERENCE_PARAMETERS, describe.

    Raises ConfigurationError.
    """
    return _maker(REFERENCES, values["device"])(values, now_ns)


def make_accelerometer(values: Values, now_ns: NowNs = time.time_ns) -> Any:
    """Return the accelerometer that ``values``, each of ACCELEROMETER_PARAMETERS, describe.

    Raises ConfigurationError.
    """
    return _maker(ACCELEROMETERS, values["device"])(values, now_ns)


def _maker(models: Mapping[str, Model], name: str) -> Any:
    if name not in models:
        raise ConfigurationError(f"device {name!r}, expected one of {sorted(models)}")
    return loaded(models[name].driver)
