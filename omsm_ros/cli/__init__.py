"""``omsm``: the offline commands.

Exit status 0: done; 2: bad input, with one line on stderr that names the remedy; 70: a defect of
omsm_ros, with one line on stderr to report; 130: interrupted. After SIGTERM and SIGHUP a command
removes unfinished files and ends by the signal. With ``--json`` standard output holds one JSON
object and nothing else.
"""

import atexit
import gc
import signal
from collections.abc import Sequence
from contextlib import AbstractContextManager

from omsm_ros.loading import exit_on_signal_while_loading, one_thread_of_blas

INTERRUPTED = 130
INTERRUPTION = "interrupted; no unfinished file was left"
# The loaded modules live to the end; collecting for each 700 new objects, Python's default, took
# 4 to 6 % of a command's time.
_OBJECTS_BETWEEN_COLLECTIONS = 50_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    # At its end Python would search all that was loaded for cycles, for another 6 % of the time.
    atexit.register(gc.freeze)
    one_thread_of_blas()
    with interruptible():
        from omsm_ros.cli import command_line
    return command_line.main(arguments)


def interruptible() -> AbstractContextManager[None]:
    """Let Ctrl-C while modules are loading end the command as it does later."""
    return exit_on_signal_while_loading((signal.SIGINT,), INTERRUPTED, f"omsm: {INTERRUPTION}\n")
