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
    │   ├── CalibrationError               a calibration, or its use with other data
    │   └── SurfaceError                   a nominal surface description
    ├── ProtocolError        (ValueError)  bytes that no device of this kind sends
    └── DeviceError          (OSError)     a device that is absent, silent or lost
        ├── DeviceTimeoutError (TimeoutError)
        └── NoSamplesError             connected, but nothing that could be read came

An error carries a code and values; its text, which names the offending value and the remedy, is
made by :mod:`omsm_ros.messages`. A text given instead of a code stays as it is. A
:class:`Notice` carries the same, but is returned instead of raised.
"""

import errno
import math
import os
import re
import resource
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

_sentence: Callable[[str, Mapping[str, Any]], str] | None = None


def write_texts_with(sentence: Callable[[str, Mapping[str, Any]], str]) -> None:
    """Let ``sentence(code, values)`` write the texts of errors from now on."""
    global _sentence
    _sentence = sentence


def text_of(code: str, values: Mapping[str, Any]) -> str:
    """Return the sentence for ``code``, or code and values where nothing writes sentences."""
    if _sentence is None:
        return " ".join([code, *(f"{name}={value!r}" for name, value in values.items())])
    return _sentence(code, values)


class Notice:
    """A statement for the user that stops nothing, such as a fault found in a recording.

    code: what is stated, as ``room.subject``, or its text;  values: what the text of a code needs
    """

    __slots__ = ("code", "values")

    def __init__(self, code: str, /, **values: Any) -> None:
        self.code, self.values = code, values

    def __str__(self) -> str:
        return text_of(self.code, self.values)

    def __repr__(self) -> str:
        return f"Notice({self.code!r}, **{self.values!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Notice) and (self.code, self.values) == (other.code, other.values)

    def __hash__(self) -> int:
        return hash(self.code)


class OmsmError(Exception):
    """Base of all deliberate errors of this package.

    code: which error, as ``room.subject``, or its text;  values: what the text of a code needs
    """

    def __init__(self, code: object = "", /, **values: Any) -> None:
        super().__init__(code)
        self.code, self.values = str(code), values

    def __str__(self) -> str:
        return text_of(self.code, self.values)


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
    """A calibration is malformed or altered, or was identified for other data."""


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


@contextmanager
def named_errors(
    error: type[OmsmError], what: str, caught: type[OmsmError] = OmsmError
) -> Iterator[None]:
    """Raise ``error``, whose text begins with ``what``, for an error ``caught`` within."""
    try:
        yield
    except caught as err:
        raise error(f"{what}: {err}") from err


DEBUG = "OMSM_DEBUG"
"""Environment variable that, when set, shows the traceback of a defect."""


_LONGEST_LINE, _LONGEST_NAME = 1500, 160
# A quoted text, or a word without quotes, such as a path or an argument.
_NAME = re.compile(r"""(?<!\w)(['"])(?:\\.|[^\\])*?\1(?!\w)|[^\s'"]+""")


def one_line(text: object) -> str:
    """Return the text of an error on one line of limited length, shortened in its middle.

    Names in it come from outside: long ones are shortened, control characters are escaped.
    """
    # Shortened first, because the search for names in a very long text takes time.
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
    """Return ``text`` with control characters and line ends escaped."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def too_many_open_files(err: BaseException) -> str:
    """Return one line about the limit of open files if it caused ``err``, else an empty text.

    Libraries report this limit by an error number or only by its text.
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
"""Remedy where the limit of open files is too low."""

FEWEST_OPEN_FILES = 64
"""A node of ROS 2 opens about 20 files, a bag in many parts and a report 20 more."""


def open_files() -> float:
    """Return how many files a process may hold open here; infinity where that is not limited."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return math.inf if most == resource.RLIM_INFINITY else most


def _causes(err: BaseException) -> Iterator[BaseException]:
    """Yield ``err``, its causes and its contexts."""
    known: set[int] = set()
    found: BaseException | None = err
    while found is not None and id(found) not in known:
        known.add(id(found))
        yield found
        found = found.__cause__ or found.__context__


def defect(err: BaseException) -> str:
    """Return one line about an unexpected exception: what to report, and how."""
    trace = err.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    place = "" if trace is None else f" in {trace.tb_frame.f_code.co_name}:{trace.tb_lineno}"
    said = " ".join(str(err).split())[:200]
    return (
        f"a defect of omsm_ros, not of your input: {type(err).__name__}: {said}{place}; "
        f"please report this line and the input, with the traceback that {DEBUG}=1 shows"
    )
