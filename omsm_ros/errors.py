"""Every error this package raises on purpose, in one tree.

Catch the branch you can do something about; the offline commands turn any of
them into one line on stderr and exit status 2::

    OmsmError
    ├── DataError            (ValueError)  numbers that cannot be used as they are
    │   ├── StepTestError                  no usable steps in the motion
    │   └── IdentificationError            no trustworthy model in the data
    ├── ConfigurationError   (ValueError)  a parameter or setting makes no sense
    ├── FileError            (ValueError)  a file is missing, truncated or foreign
    │   ├── BagError                       a recording
    │   ├── CalibrationError               a calibration, or its use where it does not belong
    │   └── SurfaceError                   a nominal surface description
    ├── ProtocolError        (ValueError)  bytes that no device of this kind sends
    └── DeviceError          (OSError)     a device that is absent, silent or lost
        ├── DeviceTimeoutError (TimeoutError)
        └── NoSamplesError             connected, but nothing that could be read came

Each text names the offending value and the remedy.
"""


class OmsmError(Exception):
    """Base of all deliberate errors of this package."""


class DataError(OmsmError, ValueError):
    """Numbers that cannot be used as they are: wrong shape, unit, NaN, too few."""


class StepTestError(DataError):
    """The motion holds no steps that could identify anything."""


class IdentificationError(DataError):
    """The data do not support a trustworthy transfer function."""


class ConfigurationError(OmsmError, ValueError):
    """A parameter or setting makes no sense."""


class FileError(OmsmError, ValueError):
    """A file is missing, truncated or not what it claims to be."""


class BagError(FileError):
    """A recording cannot be read or lacks what is needed."""


class CalibrationError(FileError):
    """A calibration is malformed, altered, or does not belong to these data."""


class SurfaceError(FileError):
    """A nominal surface description is malformed."""


class ProtocolError(OmsmError, ValueError):
    """Bytes that do not follow the device's protocol."""


class DeviceError(OmsmError, OSError):
    """A device is absent, silent, or its connection was lost."""


class DeviceTimeoutError(DeviceError, TimeoutError):
    """A device did not answer in time."""


class NoSamplesError(DeviceError):
    """A device is connected, but sends nothing, or nothing that can be read.

    Connecting anew may help, but shows nothing by itself: only samples do.
    """


DEBUG = "OMSM_DEBUG"
"""Environment variable that, when set, shows the traceback of a defect."""


_LONGEST_LINE = 1500


def one_line(text: object) -> str:
    """Return what an error says in one line that has an end: its middle goes, not the remedy.

    Names and words in it come from outside: they may have any length, and what would steer a
    terminal is written out.
    """
    line = printable(" ".join(str(text).split()))
    half = _LONGEST_LINE // 2
    return line if len(line) <= _LONGEST_LINE else f"{line[:half]} … {line[-half:]}"


def printable(text: str) -> str:
    """Return ``text`` with all that would steer a terminal, ends of lines too, written out."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def defect(err: BaseException) -> str:
    """Return one line about an exception that nobody foresaw: what to report, and how."""
    trace = err.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    place = "" if trace is None else f" in {trace.tb_frame.f_code.co_name}:{trace.tb_lineno}"
    said = " ".join(str(err).split())[:200]
    return (
        f"a defect of omsm_ros, not of your input: {type(err).__name__}: {said}{place}; "
        f"please report this line and the input, with the traceback that {DEBUG}=1 shows"
    )
