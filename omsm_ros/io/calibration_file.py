"""``CAL.json``: a calibration as a file, its schema and its id checked."""

import os
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from omsm_ros.core.calibration.calibration import FURTHER, SCHEMA, SCHEMA_1, Calibration, content_id
from omsm_ros.core.calibration.calibration_set import (
    AXES,
    MOST_MEMBERS,
    SET_SCHEMA,
    SET_SCHEMA_1,
    set_from_content,
)
from omsm_ros.errors import CalibrationError, FileError, named_errors
from omsm_ros.io import json_and_yaml
from omsm_ros.io.files import (
    exception_text,
    explained_errors,
    read_text,
    save_json,
    temporary_sibling,
)
from omsm_ros.io.json_and_yaml import NUMBER, check_form, form
from omsm_ros.units import NANOSECONDS_PER_S

MAX_CALIBRATION_BYTES = 4_000_000

_COEFFICIENTS = {"type": "array", "items": NUMBER, "minItems": 1, "maxItems": 64}
_PROPERTIES = {
    "schema": {"enum": [SCHEMA, SCHEMA_1]},
    "id": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
    "numerator": _COEFFICIENTS,
    "denominator": _COEFFICIENTS,
    "delay": NUMBER,
    "static_gain": NUMBER,
    "sample_period": NUMBER,
    "valid_up_to": NUMBER,
    "covariance": {"type": "array", "items": NUMBER, "maxItems": 16384},
    "settings": {"type": "object"},
    "certificate": {"type": "object"},
}
_NUMERATORS = {"type": "object", "additionalProperties": _COEFFICIENTS, "maxProperties": 4}
_FURTHER = {"numerators": _NUMERATORS, "covariance": _PROPERTIES["covariance"]}
_FORM = form({**_PROPERTIES, FURTHER: form(_FURTHER, tuple(_FURTHER))}, tuple(_PROPERTIES))


_MEMBER = form({"position": NUMBER, "calibration": _FORM}, ("position", "calibration"))
_SET_PROPERTIES = {
    "schema": {"enum": [SET_SCHEMA, SET_SCHEMA_1]},
    "id": _PROPERTIES["id"],
    "along": {"enum": list(AXES)},
    "members": {"type": "array", "items": _MEMBER, "maxItems": MOST_MEMBERS},
    "certificate": {"type": "object"},
}
_SET_FORM = form(_SET_PROPERTIES, tuple(_SET_PROPERTIES))


def save_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write ``CAL.json`` (schema "omsm-calibration/2"), or a set of them."""
    save_json(path, {"id": calibration.id, **calibration.content()})


def load_calibration(path: Path | str) -> Calibration:
    """Read ``CAL.json`` of either version, or a set of them.

    Raises CalibrationError if it is malformed, altered or implausible.
    """
    return _calibration_in(_text_of(path), path)


def load_for_others(path: Path | str) -> Calibration:
    """Read ``CAL.json`` for a caller that may not see it; a CalibrationError shows no content."""
    text = _text_of(path)
    try:
        return _calibration_in(text, path)
    except CalibrationError:
        # The cause is left out because everybody can subscribe to the log.
        raise CalibrationError(
            f"{str(path)!r} is there, but no calibration that can be used; on that computer, "
            f"'omsm compare {str(path)!r} {str(path)!r}' says why"
        ) from None


def _text_of(path: Path | str) -> str:
    return read_text(path, MAX_CALIBRATION_BYTES, CalibrationError, "calibration")


def _calibration_in(text: str, path: Path | str) -> Calibration:
    what = f"calibration {str(path)!r}"
    return calibration_of(json_and_yaml.object_of(text, CalibrationError, what), what)


def calibration_of(content: dict[str, Any], what: str) -> Calibration:
    """Return the calibration or the set of a file's ``content``; errors name it ``what``.

    Raises CalibrationError if it is malformed, altered or implausible.
    """
    is_set = content.get("schema") in (SET_SCHEMA, SET_SCHEMA_1)
    check_form(content, _SET_FORM if is_set else _FORM, CalibrationError, what)
    with named_errors(CalibrationError, what, CalibrationError):
        stored = _check_id(content)
        if not is_set:
            return calibration_from(content, stored)
        own = [dict(member["calibration"]) for member in content["members"]]
        return set_from_content(content, [calibration_from(c, _check_id(c)) for c in own])


def calibration_from(content: dict[str, Any], stored: str) -> Calibration:
    """Return the calibration of ``content`` whose id ``stored`` is right.

    One of version 1 keeps its id as ``certificate.origin.made_from``. Raises CalibrationError if
    it is implausible.
    """
    calibration = Calibration.from_content(content)
    if content["schema"] == SCHEMA:
        return calibration
    certificate = calibration.certificate
    origin = replace(certificate.origin, made_from=stored)
    return replace(calibration, certificate=replace(certificate, origin=origin))


def _check_id(content: dict[str, Any]) -> str:
    """Remove the id from ``content`` and return it; CalibrationError if it is of other content."""
    stored = content.pop("id")
    if stored != content_id(content):
        raise CalibrationError(
            f"it was altered after it was made: id {stored!r} does not match its content "
            f"{content_id(content)!r}; identify it again"
        )
    return str(stored)


# The folder of calibrations: none is overwritten, and a link names the one in force.

_ID_CHARACTERS = 12


@dataclass(frozen=True, slots=True)
class CalibrationFolder:
    """``cal.json``, a link to the calibration in force, and ``cal.TIME.ID.json``, one for each.

    TIME: UTC, when it came into force;  ID: the first characters of the calibration's id
    """

    link: Path

    def put(self, calibration: Calibration, since_ns: int) -> Path:
        """Keep a calibration that is in force since ``since_ns`` [ns]; return its file.

        A file that holds it already is linked again. Raises FileError.
        """
        self._rename_file()
        short = calibration.id[:_ID_CHARACTERS]
        kept = sorted(self.link.parent.glob(f"{self.link.stem}.*.{short}{self.link.suffix}"))
        target = kept[-1] if kept else self._named(since_ns, short)
        if not kept:
            save_calibration(target, calibration)
        self._link_to(target, since_ns)
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

    def _rename_file(self) -> None:
        if self.link.is_symlink() or not self.link.is_file():
            return
        old, since_ns = load_calibration(self.link), self.link.stat().st_mtime_ns
        os.replace(self.link, self._named(since_ns, old.id[:_ID_CHARACTERS]))

    def _link_to(self, target: Path, since_ns: int) -> None:
        part = temporary_sibling(self.link)
        try:
            part.symlink_to(target.name)
            os.utime(part, ns=(since_ns, since_ns), follow_symlinks=False)
            os.replace(part, self.link)
        except OSError as err:
            part.unlink(missing_ok=True)
            raise FileError(
                f"cannot link {str(self.link)!r} to {target.name!r}: {exception_text(err)}; check "
                "the folder"
            ) from err


def since(path: Path) -> int:
    """Return since when the calibration at ``path`` is in force [ns]; CalibrationError without."""
    said = f"no calibration at {str(path)[:200]!r}"
    with explained_errors(said, "check the path", CalibrationError):
        return os.lstat(path).st_mtime_ns
