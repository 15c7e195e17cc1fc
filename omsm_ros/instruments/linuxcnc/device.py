"""Reads LinuxCNC: lines of HAL's sampler over TCP, one a servo cycle.

The first column is the number of the servo cycle, counted in HAL itself, so that a lost cycle is a
gap and a restart of LinuxCNC is a fall. HAL samples while all joints are homed: before that the
positions are not known. The time is that number times the period which
LinuxCNC states itself. ``overrun`` on a line of its own is counted; the samples that it reports are
missing numbers, too.
"""

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.parameters import USUAL_COLUMNS, NowNs, Values
from omsm_ros.instruments.scaling import AXES
from omsm_ros.instruments.six_channel.device import CsvStreamDevice, make_text
from omsm_ros.instruments.transport import Transport
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M

COLUMNS = "sequence device_time x y z b c status distance"
"""Columns of ``config/linuxcnc/cell.hal``."""
# HAL's numbers have 53 bits: a picometre of a millimetre, and 17 prad of a degree, are resolved.
_PARTS = 10**9
# A tenth of the smallest unit that LinuxCNC has [1/m, 1/rad]; counts of an encoder are smaller.
_MOST_PER_UNIT = 1e4
# Units of LinuxCNC where the machine is metric.
_COUNTS_PER_UNIT = {axis: 1 / (DEGREE_RAD if axis in "bc" else MILLIMETRE_M) for axis in AXES}


def make(values: Values, transport: Transport, now_ns: NowNs) -> CsvStreamDevice:
    """Return the device that ``values`` describe; millimetres and degrees where they state none.

    Raises ConfigurationError for a scale that is that of an encoder.
    """
    given = dict(values)
    if given["columns"] == USUAL_COLUMNS:
        given["columns"] = COLUMNS
    for axis, usual in _COUNTS_PER_UNIT.items():
        stated = given[f"{axis}.counts_per_unit"]
        if stated > _MOST_PER_UNIT:
            raise ConfigurationError(
                f"'{axis}.counts_per_unit' {stated:g} is that of an encoder, but LinuxCNC sends "
                "positions in mm, inch or degrees: leave it out for mm and degrees; for counts "
                "take device six_channel_text"
            )
        given[f"{axis}.counts_per_unit"] = stated or usual
    return make_text(given, transport, now_ns, parts=_PARTS, homed=True)
