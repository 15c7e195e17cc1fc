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

An error carries a code and values; its text, which names the offending value and the remedy, is
made by :mod:`omsm_ros.messages`. A text given instead of a code stays as it is.
"""

import errno
import math
import os
import re
import resource
from collections.abc import Callable, Iterator, Mapping
from typing import Any

_sentence: Callable[[str, Mapping[str, Any]], str] | None = None


def write_texts_with(sentence: Callable[[str, Mapping[str, Any]], str]) -> None:
    """Let ``sentence(code, values)`` write the texts of errors from now on."""
    global _sentence
    _sentence = sentence


class OmsmError(Exception):
    """Base of all deliberate errors of this package.

    code: which error, as ``room.subject``, or its text;  values: what the text of a code needs
    """

    def __init__(self, code: object = "", /, **values: Any) -> None:
        super().__init__(code)
        self.code, self.values = str(code), values

    def __str__(self) -> str:
        if _sentence is None:
            return " ".join([self.code, *(f"{k}={v!r}" for k, v in self.values.items())])
        return _sentence(self.code, self.values)


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


_LONGEST_LINE, _LONGEST_NAME = 1500, 160
# What stands in quotes, or is one word without any: a path, an argument.
_NAME = re.compile(r"""(?<!\w)(['"])(?:\\.|[^\\])*?\1(?!\w)|[^\s'"]+""")


def one_line(text: object) -> str:
    """Return what an error says in one line that has an end: its middle goes, not the remedy.

    Names and words in it come from outside: they may have any length, of which the beginning and
    the end are kept, and what would steer a terminal is written out.
    """
    # First to where searching it for names takes no time.
    line = shortened(printable(" ".join(str(text).split())), 4 * _LONGEST_LINE)
    line = _NAME.sub(lambda name: shortened(name[0], _LONGEST_NAME), line)
    return shortened(line, _LONGEST_LINE)


def shortened(text: str, most: int) -> str:
    """Return ``text`` in ``most`` characters, its middle left out where it has more."""
    if len(text) <= most:
        return text
    end = (most - 1) // 2
    return f"{text[: most - 1 - end]}…{text[-end:]}"


def printable(text: str) -> str:
    """Return ``text`` with all that would steer a terminal, ends of lines too, written out."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def too_many_open_files(err: BaseException) -> str:
    """Return one line about the limit of open files, if it is behind ``err``; empty if it is not.

    A library, or a part of one that cannot be loaded, tells of it in words alone.
    """
    words = os.strerror(errno.EMFILE)
    for cause in _causes(err):
        number = cause.errno if isinstance(cause, OSError) else None
        if number in (errno.EMFILE, errno.ENFILE) or (
            isinstance(cause, ImportError | RuntimeError) and words in str(cause)
        ):
            return f"too many open files: a process may hold {open_files()} here; {MORE_FILES}"
    return ""


MORE_FILES = "give it more with 'ulimit -n 1024' in this shell"
"""What to do where the limit of open files is too low."""

FEWEST_OPEN_FILES = 64
"""A node of ROS 2 holds some twenty, a bag of many parts and a report as many again."""


def open_files() -> float:
    """Return how many files a process may hold open here; infinity where that is not limited."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return math.inf if most == resource.RLIM_INFINITY else most


def _causes(err: BaseException) -> Iterator[BaseException]:
    """Yield ``err`` and what it was raised from, or in the course of."""
    known: set[int] = set()
    found: BaseException | None = err
    while found is not None and id(found) not in known:
        known.add(id(found))
        yield found
        found = found.__cause__ or found.__context__


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
