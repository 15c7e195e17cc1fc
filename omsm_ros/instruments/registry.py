"""The models by name: where the driver and the emulator of each are found.

Nothing is imported before it is asked for: most processes use one device.
"""

from importlib import import_module
from typing import Any, NamedTuple


class Model(NamedTuple):
    """Places ``module:object`` below this package.

    driver: a function of parameters, transport and clock that returns the device
    emulator: an ``Emulated``; empty without one
    """

    driver: str
    emulator: str = ""


PROBES = {
    "six_channel": Model("six_channel.device:make_binary", "six_channel.emulator:BINARY"),
    "six_channel_text": Model("six_channel.device:make_text", "six_channel.emulator:TEXT"),
    "linuxcnc": Model("linuxcnc.device:make"),
    "chrocodile": Model("chrocodile.dollar_device:make", "chrocodile.emulator:DOLLAR"),
    "chrocodile_packet": Model("chrocodile.packet_device:make", "chrocodile.emulator:PACKET"),
    "confocaldt": Model("micro_epsilon.device:make_serial", "micro_epsilon.emulator:SERIAL"),
    "confocaldt_ethernet": Model(
        "micro_epsilon.device:make_ethernet", "micro_epsilon.emulator:ETHERNET"
    ),
}
REFERENCES = {
    "capancdt": Model("micro_epsilon.capancdt_device:make", "micro_epsilon.emulator:CAPACITIVE"),
    "analog": Model("analog.device:make_reference"),
}
ACCELEROMETERS = {"analog": Model("analog.device:make_accelerometer")}


def loaded(place: str) -> Any:
    """Return the object at ``module:object`` below this package."""
    module, _, name = place.partition(":")
    return getattr(import_module(f"omsm_ros.instruments.{module}"), name)
