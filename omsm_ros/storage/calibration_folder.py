"""Where calibrations are kept: none is ever overwritten, and a link names the one in force."""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.errors import CalibrationError, FileError
from omsm_ros.storage.calibration_file import load_calibration, save_calibration
from omsm_ros.storage.files import beside, said
from omsm_ros.units import NANOSECONDS_PER_S

_ID_CHARACTERS = 12


@dataclass(frozen=True, slots=True)
class CalibrationFolder:
    """``cal.json``, a link to the calibration in force, beside ``cal.TIME.ID.json``, one for each.

    TIME: UTC, when it came into force;  ID: the first characters of the calibration's id
    """

    link: Path

    def put(self, calibration: Calibration, since_ns: int) -> Path:
        """Keep a calibration that is in force since ``since_ns`` [ns]; return its file.

        A file that holds it already is linked again. Raises FileError.
        """
        self._keep_what_is_no_link()
        short = calibration.id[:_ID_CHARACTERS]
        kept = sorted(self.link.parent.glob(f"{self.link.stem}.*.{short}{self.link.suffix}"))
        target = kept[-1] if kept else self._named(since_ns, short)
        if not kept:
            save_calibration(target, calibration)
        self._point_at(target, since_ns)
        return target

    def in_force(self) -> tuple[Calibration, int] | None:
        """Return the calibration that the link names and since when [ns]; None without one.

        Raises CalibrationError if the file cannot be used.
        """
        if not os.path.lexists(self.link):
            return None
        return load_calibration(self.link), since(self.link)

    def _named(self, since_ns: int, short: str) -> Path:
        when = datetime.fromtimestamp(since_ns / NANOSECONDS_PER_S, timezone.utc)
        name = f"{self.link.stem}.{when:%Y%m%dT%H%M%SZ}.{short}{self.link.suffix}"
        return self.link.with_name(name)

    def _keep_what_is_no_link(self) -> None:
        """Rename a calibration that stands where the link belongs, as it was made before."""
        if self.link.is_symlink() or not self.link.is_file():
            return
        old, since_ns = load_calibration(self.link), self.link.stat().st_mtime_ns
        os.replace(self.link, self._named(since_ns, old.id[:_ID_CHARACTERS]))

    def _point_at(self, target: Path, since_ns: int) -> None:
        part = beside(self.link)
        try:
            part.symlink_to(target.name)
            os.utime(part, ns=(since_ns, since_ns), follow_symlinks=False)
            os.replace(part, self.link)
        except OSError as err:
            part.unlink(missing_ok=True)
            raise FileError(
                f"cannot link {str(self.link)!r} to {target.name!r}: {said(err)}; check the folder"
            ) from err


def since(path: Path) -> int:
    """Return since when a calibration is in force that ``path``, a file or a link, names [ns].

    Raises CalibrationError if there is none.
    """
    try:
        return os.lstat(path).st_mtime_ns
    except (OSError, ValueError) as err:
        raise CalibrationError(f"no calibration at {str(path)[:200]!r}: {said(err)}") from err


def confined(path: Path, folders: str) -> Path:
    """Return ``path`` resolved; CalibrationError unless it lies below one of ``folders``.

    folders: separated by ":", as in PATH; "~" is the home folder, "." the working directory;
        empty = anywhere
    """
    try:
        resolved = path.expanduser().resolve()
        allowed = [Path(each).expanduser().resolve() for each in folders.split(":") if each]
    except (OSError, ValueError, RuntimeError) as err:
        raise CalibrationError(f"no calibration at {str(path)[:200]!r}; check the path") from err
    if allowed and not any(resolved.is_relative_to(folder) for folder in allowed):
        raise CalibrationError(
            f"{str(path)[:200]!r} lies outside the folders that calibrations are loaded from, "
            f"{folders!r}; put it there, or start with another calibration_folders"
        )
    return resolved
