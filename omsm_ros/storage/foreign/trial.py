"""Does a library live through a file? Some trust it so far that a damaged one ends the process."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import resource
import warnings
from collections.abc import Callable


def survives(read: Callable[[], object]) -> bool:
    """Return whether a process that calls ``read`` lives on; what it raises is no matter.

    It is a copy of this one, so that nothing is loaded anew, as a process of its own would for a
    second, and is gone with all that it read.
    """
    with warnings.catch_warnings():
        # Python 3.12 warns where there are threads; the copy waits for none of them.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        faulthandler.disable()  # one line is told by who asked
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with contextlib.suppress(BaseException):
            read()
        os._exit(0)
    return not os.WIFSIGNALED(os.waitpid(child, 0)[1])
