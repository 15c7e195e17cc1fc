"""May results be written there, or would they take the place of what was measured?

A name completed by the shell is easily that of the recording itself. Every command puts its result
in the place of an older one, so what is read, and any recording, is looked for before it begins.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

from omsm_ros.errors import ConfigurationError, shortened

_OUTPUTS = ("out", "plot", "report")
_RECORDINGS = (".mcap", ".db3", ".bag")
# What a command makes of a file is one of the same kind, which may stand for it.
_IN_PLACE = {
    ("latency", "calibration"),
    ("reversal", "calibration"),
    ("selfcal", "calibration"),
    ("align", "geometry"),
}


def check_outputs(args: argparse.Namespace) -> None:
    """Raise ConfigurationError where an output of a command is what it reads, or a recording."""
    given = vars(args)
    read = {
        name: [*_paths(value)]
        for name, value in given.items()
        if name not in (*_OUTPUTS, "command") and (args.command, name) not in _IN_PLACE
    }
    for output in _OUTPUTS:
        written = given.get(output)
        if not isinstance(written, Path) or not os.path.lexists(written):
            continue
        what = f"--{output} {shortened(repr(str(written)), 200)}"
        if any(_same(written, path) for paths in read.values() for path in paths):
            raise ConfigurationError(
                f"{what} is what is read, and would be lost; give another name"
            )
        # Who writes recordings takes the place of none, and says so.
        taken = args.command != "import" and written.is_file()
        if taken and written.suffix.lower() in _RECORDINGS:
            raise ConfigurationError(f"{what} is a recording, and would be lost; give another name")


def _paths(value: object) -> Iterator[Path]:
    """Yield the paths in what an argument was taken for."""
    if isinstance(value, list | tuple):
        for one in value:
            yield from _paths(one)
    elif isinstance(value, str | Path) and value != "":
        yield Path(value)


def _same(written: Path, path: Path) -> bool:
    """Return whether both are one file, or one folder that is a bag."""
    try:
        alike = os.path.samefile(written, path)
    except (OSError, ValueError):
        return False
    return alike and (written.is_file() or (written / "metadata.yaml").is_file())
