"""``systematic.npz``: what the systematic errors of a scan do to its points."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from omsm_ros.core.correction.scan_fields import ScanFields
from omsm_ros.errors import FileError
from omsm_ros.storage.files import open_regular, said, save_bytes

# A hundred fields of ten thousand points are four megabytes.
MAX_BYTES = 100_000_000
_NAMES = ("names", "fields", "every")


def save_fields(path: Path | str, fields: ScanFields) -> None:
    """Write ``systematic.npz``."""
    content = io.BytesIO()
    np.savez(
        content,
        names=np.array(fields.names, dtype=np.str_),
        fields=fields.fields.astype(np.float32),
        every=np.int64(fields.every),
        bounds=np.array(fields.bounds, dtype=np.str_),
        aligned=np.array(fields.aligned, dtype=np.str_),
    )
    save_bytes(path, content.getvalue())


def load_fields(path: Path | str) -> ScanFields:
    """Read ``systematic.npz``; FileError if it is something else."""
    what = f"fields {str(path)!r}"
    with open_regular(Path(path), FileError, "fields") as stream:
        raw = stream.read(MAX_BYTES + 1)
    if len(raw) > MAX_BYTES:
        raise FileError(f"{what} have more than {MAX_BYTES} bytes; correct the scan again")
    try:
        # No pickles, by default; a NaN that signals is refused below.
        with np.load(io.BytesIO(raw)) as content, np.errstate(invalid="ignore"):
            names, fields, every = (np.asarray(content[name]) for name in _NAMES)
            # Where nobody says which are upper bounds, each may be one.
            bounds = content["bounds"] if "bounds" in content else np.unique(names)
            aligned = content.get("aligned", ())
            if np.iscomplexobj(fields) or every.ndim:
                raise ValueError("a field is complex, or its spacing is no single number")
            values = fields.astype(np.float64)
        found = ScanFields(
            tuple(map(str, names)),
            values,
            int(every),
            tuple(map(str, bounds)),
            tuple(map(str, aligned)),
        )
    except Exception as err:  # whatever numpy says of a damaged archive
        raise FileError(f"{what} are damaged: {said(err)}; correct the scan again") from err
    shape = found.fields.shape
    if len(shape) != 2 or shape[0] != len(names) or found.every < 1:
        raise FileError(f"{what} have shape {shape!r} for {len(names)} names; correct it again")
    if not np.all(np.isfinite(found.fields)):
        raise FileError(f"{what} hold what is no number; correct the scan again")
    return found
