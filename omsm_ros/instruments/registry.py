"""The models by name: where the driver and the emulator of each are found.

Nothing is imported before it is asked for: most processes use one device. Other packages add
probes by entry points, see docs/adding_a_probe.md.
"""

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, NamedTuple

from omsm_ros.errors import ConfigurationError

DRIVERS_GROUP, EMULATORS_GROUP = "omsm_ros.instruments", "omsm_ros.emulators"
_HERE = "omsm_ros.instruments"


class Model(NamedTuple):
    """Places ``module:object``; a module that begins with a dot is below this package.

    driver: a function of parameters, transport and clock that returns the device
    emulator: an ``Emulated``; empty without one
    """

    driver: str
    emulator: str = ""


_EMULATORS = {point.name: point.value for point in entry_points(group=EMULATORS_GROUP)}
_OWN_PROBES = {
    "six_channel": Model(".six_channel.device:make_binary", ".six_channel.emulator:BINARY"),
    "six_channel_text": Model(".six_channel.device:make_text", ".six_channel.emulator:TEXT"),
    "linuxcnc": Model(".linuxcnc.device:make"),
    "chrocodile": Model(".chrocodile.dollar_device:make", ".chrocodile.emulator:DOLLAR"),
    "chrocodile_packet": Model(".chrocodile.packet_device:make", ".chrocodile.emulator:PACKET"),
    "confocaldt": Model(".micro_epsilon.device:make_serial", ".micro_epsilon.emulator:SERIAL"),
    "confocaldt_ethernet": Model(
        ".micro_epsilon.device:make_ethernet", ".micro_epsilon.emulator:ETHERNET"
    ),
}
PROBES = {
    point.name: Model(point.value, _EMULATORS.get(point.name, ""))
    for point in entry_points(group=DRIVERS_GROUP)
} | _OWN_PROBES
"""Those of installed packages and ours, of which a package cannot replace any."""
REFERENCES = {
    "capancdt": Model(".micro_epsilon.capancdt_device:make", ".micro_epsilon.emulator:CAPACITIVE"),
    "analog": Model(".analog.device:make_reference"),
}
ACCELEROMETERS = {"analog": Model(".analog.device:make_accelerometer")}


def loaded(place: str) -> Any:
    """Return the object at ``place``; ConfigurationError if another package does not have it."""
    module, _, name = place.partition(":")
    try:
        return getattr(import_module(module, _HERE), name)
    except Exception as err:
        if place.startswith("."):
            raise
        raise ConfigurationError(
            f"{place!r}, an entry point of {DRIVERS_GROUP!r}, cannot be loaded: "
            f"{type(err).__name__}: {err}; correct or uninstall that package"
        ) from err
