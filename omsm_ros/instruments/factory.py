"""Makes the devices that parameters describe, not yet connected, and traces their traffic."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from typing import Any, TextIO

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.parameters import STREAMS, NowNs, Values, defaults
from omsm_ros.instruments.registry import ACCELEROMETERS, PROBES, REFERENCES, Model, loaded
from omsm_ros.instruments.stream import StreamDevice
from omsm_ros.instruments.transport import Transport, transport_for

READ, WRITTEN, OPENED, CLOSED = "<", ">", "open", "close"


class TracedTransport:
    """Writes down all traffic of another transport; each process begins a new file.

    Each line is an event: seconds since the trace began, a sign (``<`` from the device, ``>`` to
    it, ``!`` open or close), and the bytes in hexadecimal. A test can play the file back.
    """

    def __init__(
        self, transport: Transport, path: Path, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self._transport, self.name = transport, transport.name
        self._path = path
        self._monotonic = monotonic
        self._file: TextIO | None = None
        self._begun, self._began = False, 0.0

    def __getattr__(self, name: str) -> Any:
        """Return what only some transports have, such as a baud rate."""
        if name.startswith("_"):  # of an incomplete copy
            raise AttributeError(name)
        return getattr(self._transport, name)

    def spare(self) -> Any:
        """Return another connection of the transport that is traced, in the same trace."""
        other = copy(self)
        other._transport, other._file = self._transport.spare(), None  # type: ignore[attr-defined]
        return other

    def open(self) -> None:
        """Connect; raises DeviceError, or ConfigurationError if the trace cannot be written."""
        self.close()
        with self._telling():
            self._file = self._path.open("a" if self._begun else "w", encoding="ascii")
        self._began = self._began if self._begun else self._monotonic()
        self._begun = True
        self._transport.open()
        self._note("!", OPENED)

    def read(self, timeout: float) -> bytes:
        """Return what has arrived within ``timeout`` [s]; raises DeviceError."""
        data = self._transport.read(timeout)
        if data:
            self._note(READ, data.hex())
        return data

    def write(self, data: bytes) -> None:
        """Send all of ``data``; raises DeviceError."""
        self._transport.write(data)
        self._note(WRITTEN, data.hex())

    def close(self) -> None:
        """Disconnect."""
        self._transport.close()
        if self._file is not None:
            file, self._file = self._file, None
            with self._telling(), file:
                file.write(self._line("!", CLOSED))

    def _note(self, sign: str, text: str) -> None:
        if self._file is not None:
            with self._telling():
                self._file.write(self._line(sign, text))

    def _line(self, sign: str, text: str) -> str:
        return f"{self._monotonic() - self._began:.6f} {sign} {text}\n"

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """Raise ConfigurationError if the trace cannot be written."""
        try:
            yield
        except (OSError, ValueError) as err:  # a full disk, no such folder; NUL in the path
            raise ConfigurationError(
                f"cannot write the trace {str(self._path)!r}: {err}; choose another place, or none"
            ) from err


def make_device(values: Values, now_ns: NowNs = time.time_ns) -> StreamDevice:
    """Return the probe of ``values`` (PARAMETERS); raises ConfigurationError."""
    make = _maker(PROBES, values["device"])
    transport = transport_for(values["port"], values["baud_rate"])
    if values["trace"]:
        transport = TracedTransport(transport, Path(values["trace"]))
    device: StreamDevice = make(values, transport, now_ns)
    return device


def make_axes(values: Values, now_ns: NowNs = time.time_ns) -> StreamDevice:
    """Return the stream of axes of ``values`` (AXIS_PARAMETERS); raises ConfigurationError."""
    if values["device"] not in STREAMS:
        raise ConfigurationError(f"device {values['device']!r}, expected one of {STREAMS}")
    return make_device(defaults() | dict(values), now_ns)


def make_reference(values: Values, now_ns: NowNs = time.time_ns) -> Any:
    """Return the sensor of ``values`` (REFERENCE_PARAMETERS); raises ConfigurationError."""
    return _maker(REFERENCES, values["device"])(values, now_ns)


def make_accelerometer(values: Values, now_ns: NowNs = time.time_ns) -> Any:
    """Return the sensor of ``values`` (ACCELEROMETER_PARAMETERS); raises ConfigurationError."""
    return _maker(ACCELEROMETERS, values["device"])(values, now_ns)


def _maker(models: Mapping[str, Model], name: str) -> Any:
    if name not in models:
        raise ConfigurationError(f"device {name!r}, expected one of {sorted(models)}")
    return loaded(models[name].driver)
