"""Opens the tables of a recording of another program, of any known format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omsm_ros.errors import FileError
from omsm_ros.io.tables.table import ForeignTable, TableForm

_ARRAYS = (".npy", ".npz", ".mat", ".h5", ".hdf5")
_BAGS = (".mcap", ".bag", ".db3")


def open_tables(path: Path, form: TableForm, wanted: Sequence[str]) -> list[ForeignTable]:
    """Return the tables of a recording that have some of the columns ``wanted``.

    A file has one table; a bag has one for each topic. Raises FileError if it cannot be read, or
    has none of the columns.
    """
    suffix = path.suffix.lower()
    if suffix in _BAGS or (path / "metadata.yaml").is_file():
        return _topics(path.parent if suffix == ".db3" else path, wanted)
    table = _table(path, suffix, form)
    if not any(table.names.count(name) == 1 for name in wanted):
        table.close()
        hint = table.hint(wanted) or "name the columns as it does, each once"
        held = table.names[:20] or "no column of numbers at all"
        raise FileError(f"{table} has none of the columns {list(wanted)}, but {held}; {hint}")
    return [table]


def _table(path: Path, suffix: str, form: TableForm) -> ForeignTable:
    # Imported when needed: some are optional packages, and all take time to load.
    if suffix in _ARRAYS:
        from omsm_ros.io.tables.array_table import ArrayTable

        return ArrayTable(path)
    if suffix == ".tdms":
        from omsm_ros.io.tables.array_table import TdmsTable

        return TdmsTable(path)
    from omsm_ros.io.tables.text_table import TextTable

    return TextTable(path, form)


def _topics(path: Path, wanted: Sequence[str]) -> list[ForeignTable]:
    from omsm_ros.io.tables.topic_table import ForeignBag

    bag = ForeignBag(path)
    topics = bag.topics()
    found: list[ForeignTable] = [t for t in topics if set(t.names) & set(wanted)]
    if not found:
        bag.close()
        held = [name for t in topics for name in t.names if name.startswith("/")]
        raise FileError(
            f"bag {str(path)!r} has none of the columns {list(wanted)}, but {held[:20]}; "
            "name them by topic and field"
        )
    return found
