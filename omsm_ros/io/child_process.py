"""Reads what comes from outside in a process of its own, with limits of time and memory.

A file may be made, or damaged, so that a library crashes, does not end or takes all memory. Loads
optional libraries.
"""

import faulthandler
import importlib
import logging
import math
import multiprocessing
import os
import resource
import signal
import time
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias, TypeVar, cast

from omsm_ros.errors import FileError, OmsmError
from omsm_ros.io.files import library_errors
from omsm_ros.loading import end_with_parent
from omsm_ros.quantities import MAP_POINTS, shown

T = TypeVar("T")
Attend: TypeAlias = Callable[..., None]

UNLIMITED = resource.RLIM_INFINITY
# Reading a bag from outside takes at most this time [s] and memory [bytes].
_BAG_S, _BAG_BYTES = 300.0, 8 << 30
# Elapsed time to load a library and to read a small file [s], and slow unpacking [bytes/s].
_FILE_S, _SLOWEST_BYTES_S = 20.0, 5e6
# Between two looks at a process, and two messages of progress that say nothing new [s].
_LOOK_S, _PROGRESS_S = 0.05, 0.5
_PROGRESS, _DONE, _FAILED = "progress", "done", "failed"


def read_in_child(path: Path, what: str, remedy: str, read: Callable[[], T]) -> T:
    """Return what ``read`` makes of the file at ``path``, pickled by a copy of this process.

    Raises FileError, which calls the file ``what``, for all that goes wrong; ``remedy`` ends it.
    """

    def work() -> T:
        logging.disable()  # some libraries log the bytes of a damaged file
        with library_errors(what, remedy):
            return read()

    seconds = math.ceil(_FILE_S + path.stat().st_size / _SLOWEST_BYTES_S)
    return in_child(work, seconds, what=what, remedy=remedy, method="fork")


def in_child(
    work: Callable[..., T],
    seconds: float = _BAG_S,
    most_bytes: int = _BAG_BYTES,
    attend: Attend | None = None,
    *,
    what: str = "the bag",
    remedy: str = "check it with omsm inspect",
    method: str = "spawn",
) -> T:
    """Return what ``work`` returns in a process of its own, or raise what it raises.

    Raises FileError if it takes longer, or more memory, or crashes; its text has ``what`` was read,
    and the ``remedy``.

    attend: called with the fields of the progress that ``work(progress)`` states, and without
        fields meanwhile; what it raises ends the process
    method: "spawn" for a new process, to which ``work`` is pickled, else "fork" for a copy of this
        one, where no module is loaded again
    """
    context: Any = multiprocessing.get_context(method)
    receiver, sender = context.Pipe(duplex=False)
    arguments = (os.getpid(), sender, work, most_bytes, attend is not None)
    child = context.Process(target=_child, args=arguments, daemon=True)
    with warnings.catch_warnings():
        # Python 3.12 warns of threads; a fork does not wait for any of them.
        warnings.simplefilter("ignore", DeprecationWarning)
        child.start()
    sender.close()
    until = time.monotonic() + seconds
    # The process begins with this stage, which includes loading modules.
    kind, content = _PROGRESS, cast("Any", {"stage": "reading"})
    try:
        while kind == _PROGRESS:
            if attend is not None:
                attend(**content)
            if time.monotonic() > until:
                raise FileError(f"{what} was not read in {seconds:g} s; {remedy}")
            kind, content = receiver.recv() if receiver.poll(_LOOK_S) else (_PROGRESS, {})
    except EOFError as err:
        raise FileError(
            f"{what} cannot be read: the program that reads it ended, perhaps as it needed more "
            f"than {most_bytes / 2**30:.3g} GB; {remedy}"
        ) from err
    finally:
        child.kill()
        child.join()
        receiver.close()
    if kind == _FAILED:
        raise content
    return content  # type: ignore[no-any-return]


def _child(
    caller: int, sender: Connection, work: Callable[..., Any], most_bytes: int, tells: bool
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller ends this process
    end_with_parent(signal.SIGKILL)  # a killed caller cannot
    if os.getppid() != caller:
        return
    faulthandler.disable()  # and reports a crash in one line
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
    stated: tuple[object, float] = (None, 0.0)

    def progress(stage: str, **numbers: object) -> None:
        nonlocal stated
        about, now = (stage, numbers.get("order")), time.monotonic()
        if about != stated[0] or now - stated[1] > _PROGRESS_S:
            stated = about, now
            sender.send((_PROGRESS, {"stage": stage, **numbers}))

    try:
        answer = (_DONE, work(progress) if tells else work())
    except MemoryError:
        return  # the parent sees that this process ended
    except OmsmError as err:
        kind = FileError if isinstance(err, FileError) else OmsmError
        answer = (_FAILED, kind(str(err)))
    sender.send(answer)


def walk_in_child(path: Path, what: str) -> None:
    """Raise FileError if reading ``path`` does not end, crashes, or needs other files."""
    read_in_child(path, what, "write it again", lambda: _walk(path, what))


def _walk(path: Path, what: str) -> None:
    """Read all attributes, and all arrays that could be a map."""
    import h5py

    def look(name: str, item: Any) -> None:
        list(item.attrs.items())
        _keep_within(h5py, name, item, what)
        if isinstance(item, h5py.Dataset) and item.size and item.size <= MAP_POINTS.high:
            item[()]

    with h5py.File(path, "r") as content:
        look("/", content)
        content.visititems(look)


def _keep_within(h5py: Any, name: str, item: Any, what: str) -> None:
    """Raise FileError if an array or a link of a group is in another file.

    The author of the file would choose which file of the user is opened.
    """
    if isinstance(item, h5py.Group):
        links = {child: item.get(child, getlink=True) for child in item}
        elsewhere = [c for c, link in links.items() if isinstance(link, h5py.ExternalLink)]
    elif isinstance(item, h5py.Dataset):
        mapped = item.virtual_sources() if item.is_virtual else []
        other = item.external or [source for source in mapped if source.file_name != "."]
        elsewhere = [name] if other else []
    else:
        elsewhere = []
    if elsewhere:
        raise FileError(
            f"{what} takes {shown(elsewhere[0])} from another file; save it with all its data"
        )


def import_optional(name: str, what: str) -> ModuleType:
    """Return the module ``name``; raise FileError about the file ``what`` if a module lacks."""
    try:
        return importlib.import_module(name)
    except ImportError as err:
        missing = (err.name or name).partition(".")[0]
        raise FileError(
            f"{what} needs a further Python package: pip install {missing}, or convert it to text"
        ) from err
