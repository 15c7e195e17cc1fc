"""Record calibrations and measurements in a catalogue, and evaluate the drift of each machine."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.repeatability import trend
from omsm_ros.errors import ConfigurationError, FileError, OmsmError
from omsm_ros.io import bags, json_and_yaml
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.files import MAX_RESULT_BYTES, SUMMARY, exception_text, read_text
from omsm_ros.quantities import COUNTER, SIGNAL, shown
from omsm_ros.report.tables import part
from omsm_ros.report.verdict import verdict_text
from omsm_ros.units import NANOSECONDS_PER_S

WAIT_S = 3
"""Longest time to wait for a database [s]."""

MOST_ROWS = 10_000
"""Rows of a table that are read at once: years of one machine, a second's work."""

_STEPS = 100_000  # of SQLite's machine, a millisecond or so
_SQLITE = "sqlite:///"
_KINDS = ("sqlite", "postgresql", "postgresql+psycopg")


class Catalogue:
    """A database of calibrations and measurements; a context manager.

    address: of a database for SQLAlchemy (``postgresql://user@host/base``), or the path of an
        SQLite file, which is created if needed
    Raises FileError if the database does not answer within three seconds, ConfigurationError
    without SQLAlchemy.
    """

    def __init__(self, address: str) -> None:
        self.address = address if "://" in address else f"{_SQLITE}{address}"
        kind = self.address.partition("://")[0]
        encoded = address.encode(errors="replace").decode() == address
        if kind not in _KINDS or not encoded or (kind == "sqlite" and "?" in address):
            raise ConfigurationError(
                f"catalogue {shown(address)}, expected a file, sqlite:///FILE or postgresql://…, "
                "in UTF-8"
            )
        if kind == "postgresql":
            self.address = self.address.replace("postgresql", "postgresql+psycopg", 1)

    def __enter__(self) -> Catalogue:
        try:
            import sqlalchemy
        except ImportError as err:
            raise ConfigurationError(
                "a catalogue needs SQLAlchemy: pip install sqlalchemy"
            ) from err
        self._sql = sqlalchemy
        sqlite = self.address.startswith("sqlite")
        waiting = {"timeout": WAIT_S} if sqlite else {"connect_timeout": WAIT_S}
        if not sqlite:
            waiting["options"] = (
                f"-c statement_timeout={1000 * WAIT_S} -c lock_timeout={1000 * WAIT_S} "  # type: ignore[assignment]
                "-c client_encoding=UTF8"  # without it a base returns bytes
            )
        self._tables = _tables(sqlalchemy)
        with self._translated():
            # No pool: a command adds one row and ends.
            self._engine = sqlalchemy.create_engine(
                self.address, connect_args=waiting, poolclass=sqlalchemy.pool.NullPool
            )
            if sqlite:
                sqlalchemy.event.listen(self._engine, "connect", _bounded)
            for table in self._tables.values():
                try:
                    self._make(table)
                except sqlalchemy.exc.DBAPIError as err:
                    # Another process may create it at the same time.
                    if not any(word in str(err) for word in ("already exists", "duplicate")):
                        raise
        return self

    def _make(self, table: Any) -> None:
        """Create a table, or add the columns that it lacks if an earlier version made it."""
        table.create(self._engine, checkfirst=True)
        there = {
            column["name"] for column in self._sql.inspect(self._engine).get_columns(table.name)
        }
        with self._engine.begin() as connection:
            for column in (c for c in table.c if c.name not in there):
                kind = column.type.compile(self._engine.dialect)
                change = f"ALTER TABLE {table.name} ADD COLUMN {column.name} {kind}"
                connection.execute(self._sql.text(change))

    def __exit__(self, *_: object) -> None:
        self._engine.dispose()

    def add(self, table: str, row: Mapping[str, object]) -> bool:
        """Add a row to "calibrations" or "measurements"; False if one of its id is there."""
        target = self._tables[table]
        now = datetime.now(tz=timezone.utc).replace(tzinfo=None, microsecond=0)
        with self._translated(), self._engine.begin() as connection:
            known = self._sql.select(target.c.id).where(target.c.id == row["id"])
            if connection.execute(known).first() is not None:
                return False
            try:
                with connection.begin_nested():
                    connection.execute(target.insert().values(added_at=now, **row))
            except self._sql.exc.IntegrityError:
                return False  # another writer was faster
        return True

    def rows(self, table: str, machine: str = "") -> list[dict[str, Any]]:
        """Return the newest ``MOST_ROWS`` of a table, the oldest first; of one machine, or all.

        Rows without a time of recording are ordered by the time of their addition.
        """
        source = self._tables[table]
        when = self._sql.func.coalesce(source.c.recorded_at, source.c.added_at)
        newest = (when.desc(), source.c.added_at.desc(), source.c.id.desc())
        asked = self._of(machine, table, self._sql.select(source)).order_by(*newest)
        with self._translated(), self._engine.connect() as connection:
            answer = connection.execute(asked.limit(MOST_ROWS)).mappings()
            found = [dict(row) for row in answer][::-1]
        for column in source.c:
            name = f"catalogue {self._shown_address()!r}: {column.name} of one of the {table}"
            _check(name, column.type.python_type, [row[column.name] for row in found])
        return found

    def count(self, table: str, machine: str = "") -> int:
        """Return how many rows a table has; of one machine, or of all."""
        every = self._sql.select(self._sql.func.count()).select_from(self._tables[table])
        with self._translated(), self._engine.connect() as connection:
            return int(connection.execute(self._of(machine, table, every)).scalar_one())

    def _of(self, machine: str, table: str, asked: Any) -> Any:
        return asked.where(self._tables[table].c.machine == machine) if machine else asked

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except (ImportError, self._sql.exc.NoSuchModuleError) as err:
            raise ConfigurationError(
                f"catalogue: {exception_text(err)}; pip install psycopg[binary]"
            ) from err
        except Exception as err:  # the library raises many kinds
            # The text of the database, without the statement and the link to a manual.
            text = str(err).partition("[SQL")[0].partition("(Background")[0]
            raise FileError(
                f"catalogue {self._shown_address()!r}: {' '.join(text.split())[:200]}; "
                "check that it is there and may be written"
            ) from err

    def _shown_address(self) -> str:
        try:
            url = self._sql.engine.make_url(self.address)
        except (ValueError, self._sql.exc.ArgumentError):
            return self.address.rpartition("@")[2]  # invalid, and may contain a password
        return str(url.render_as_string(hide_password=True))


def _check(name: str, kind: type, values: Sequence[object]) -> None:
    """Raise FileError unless the values are of their column's kind: SQLite keeps any in any."""
    for value in values:
        if value is None:
            continue
        if kind is float:
            SIGNAL.checked(value, FileError, name)
        elif not isinstance(value, kind):
            raise FileError(f"{name} is {shown(value)}, expected {kind.__name__}; delete that row")


def _bounded(connection: Any, _: object) -> None:
    """Let SQLite give up what does not end: a file may hold a view without an end."""
    begun = time.monotonic()
    connection.set_progress_handler(lambda: time.monotonic() - begun > WAIT_S, _STEPS)


def time_of(stamp_ns: int | None) -> datetime | None:
    """Return ROS time [ns] as UTC, or None for an unknown time."""
    if stamp_ns is None:
        return None
    return datetime.fromtimestamp(stamp_ns / NANOSECONDS_PER_S, tz=timezone.utc).replace(
        tzinfo=None
    )


_CALIBRATION_FIGURES: Mapping[str, Callable[[Calibration], float | None]] = {
    "static_gain": lambda c: c.static_gain,
    "static_gain_uncertainty": lambda c: c.certificate.static_gain.uncertainty,
    "delay": lambda c: c.dynamics.low_frequency_delay,
    "delay_uncertainty": lambda c: c.low_frequency_delay_uncertainty,
    "valid_up_to": lambda c: c.valid_up_to,
    "sample_period": lambda c: c.sample_period,
}
# Column, and place of its value in the summary.
_MEASUREMENT_FIGURES = {
    "deviation_rms": ("figures", "rms", "value"),
    "deviation_rms_uncertainty": ("figures", "rms", "standard_uncertainty"),
    "deviation_peak_to_valley": ("figures", "peak_to_valley", "value"),
    "dynamic_error_rms": ("dynamic_error_before", "rms"),
    "uncertainty_median": ("uncertainty", "median"),
}
_COUNTS = ("received", "corrected")


def _tables(sql: Any) -> dict[str, Any]:
    """Return the tables: times UTC, lengths [m], delays [s], frequencies [Hz]; NULL: unknown."""
    known = sql.MetaData()

    def table(name: str, texts: Sequence[str], figures: Sequence[str], *more: Any) -> Any:
        return sql.Table(
            name, known,
            sql.Column("id", sql.String(64), primary_key=True),
            sql.Column("recorded_at", sql.DateTime, index=True),
            sql.Column("added_at", sql.DateTime, nullable=False),
            sql.Column("machine", sql.Text, index=True),
            *(sql.Column(text, sql.Text) for text in texts),
            *(sql.Column(figure, sql.Float(53)) for figure in figures),
            *more,
        )  # fmt: skip

    calibrations = table(
        "calibrations", ("verdict", "path", "source", "settings"), [*_CALIBRATION_FIGURES]
    )
    measurements = table(
        "measurements", ("bag", "folder", "version", "settings"), [*_MEASUREMENT_FIGURES],
        sql.Column("calibration", sql.String(64), index=True),
        *(sql.Column(name, sql.BigInteger) for name in _COUNTS),
    )  # fmt: skip
    return {"calibrations": calibrations, "measurements": measurements}


_TABLES = ("calibrations", "measurements")


def keep_calibration(
    address: str,
    calibration: Calibration,
    path: Path,
    source: Path | None = None,
    recorded_ns: int | None = None,
) -> bool:
    """Add a calibration, its file and its bag; return False if the catalogue has it already.

    recorded_ns: when the bag was recorded [ns, ROS time]; None: read it from the bag ``source``
    """
    row = {
        "id": calibration.id,
        "recorded_at": time_of(recorded_ns or recorded_ns_of(source)),
        "machine": _machine(calibration.settings),
        "verdict": verdict_text(calibration),
        "path": str(path.absolute()),
        "source": "" if source is None else str(source.absolute()),
        "settings": json_and_yaml.text_of(dict(calibration.settings)),
        **{name: _number(of(calibration)) for name, of in _CALIBRATION_FIGURES.items()},
    }
    with Catalogue(address) as catalogue:
        return catalogue.add("calibrations", row)


def keep_measurement(address: str, folder: Path, bag: Path | None = None) -> bool:
    """Add the finished measurement in ``folder``.

    bag: its recording, if it was moved since;  return False if the catalogue has the same summary
    of the same folder already
    """
    path = folder / SUMMARY
    text = read_text(path, MAX_RESULT_BYTES, FileError, "summary")
    summary = json_and_yaml.object_of(text, FileError, f"summary {str(path)!r}")
    settings = part(summary, "settings")
    settings = settings if isinstance(settings, Mapping) else {}
    source = bag if bag is not None else Path(str(summary.get("bag", "")))
    place = str(folder.absolute())
    row = {
        "id": hashlib.sha256(f"{place}\0{text}".encode()).hexdigest(),
        "recorded_at": time_of(recorded_ns_of(source)),
        "machine": _machine(settings),
        "bag": str(source.absolute()),
        "folder": place,
        "version": str(part(summary, "versions", "omsm_ros") or ""),
        "settings": json_and_yaml.text_of(settings),
        "calibration": str(summary.get("calibration", "")),
        **{name: _count(part(summary, "samples", "distance", name)) for name in _COUNTS},
        **{name: _number(part(summary, *at)) for name, at in _MEASUREMENT_FIGURES.items()},
    }
    with Catalogue(address) as catalogue:
        return catalogue.add("measurements", row)


def keep(address: str, path: Path) -> bool:
    """Add a calibration file or the folder of a measurement."""
    if path.is_dir():
        return keep_measurement(address, path)
    return keep_calibration(address, load_calibration(path), path)


def history(address: str, machine: str = "") -> tuple[list[dict[str, Any]], int]:
    """Return the contents of the catalogue by machine; of one machine, or of all.

    Of each its name, its ``calibrations`` and ``measurements``, and linear trends of the lag,
    ``delay`` [s/s], of ``static_gain`` [1/s] and of the form's rms, ``deviation`` [m/s]; None for
    fewer than five rows. Also return the number of calibrations and measurements that are older
    than those listed; zero unless a table holds more than ``MOST_ROWS``.
    """
    older = 0
    rows: dict[str, dict[str, list[dict[str, Any]]]] = {}
    with Catalogue(address) as catalogue:
        for table in _TABLES:
            found = catalogue.rows(table, machine)
            if len(found) == MOST_ROWS:
                older += catalogue.count(table, machine) - len(found)
            for row in found:
                name = row["machine"] or ""
                rows.setdefault(name, {table: [] for table in _TABLES})[table].append(row)
    machines = []
    for name in sorted(rows):
        found = rows[name]
        accepted = [row for row in found["calibrations"] if row["verdict"] != "rejected"]
        trends = {column: _trend(accepted, column) for column in ("delay", "static_gain")}
        trends["deviation"] = _trend(found["measurements"], "deviation_rms")
        machines.append({"machine": name, **found, **trends})
    return machines, older


def _trend(rows: list[dict[str, Any]], name: str) -> dict[str, float] | None:
    when = [row["recorded_at"] for row in rows]
    times = [np.nan if t is None else (t - datetime(1970, 1, 1)).total_seconds() for t in when]
    values = [np.nan if row[name] is None else row[name] for row in rows]
    found = trend(np.array(times, np.float64), np.array(values, np.float64))
    return found and asdict(found)


def _machine(settings: Mapping[str, object]) -> str:
    return str(settings.get("machine", ""))[:200]


def _number(value: object) -> float | None:
    known = isinstance(value, int | float) and abs(value) <= SIGNAL.high
    return float(value) if known else None  # type: ignore[arg-type]


def _count(value: object) -> int | None:
    return value if isinstance(value, int) and 0 <= value <= COUNTER.high else None


def recorded_ns_of(bag: Path | None) -> int | None:
    """Return when a bag was recorded [ns, ROS time], None if it does not say or is not there."""
    try:
        if bag is None or not bag.exists():
            return None
        with bags.BagReader(bag) as reader:
            return reader.recorded_ns
    except (FileError, OSError):
        return None


def record_in_catalogue(address: str, keep: Callable[[], bool]) -> list[str]:
    """Call ``keep`` if there is a catalogue; return a warning if that failed.

    A failing database raises nothing, because the result is in its files already.
    """
    if not address:
        return []
    try:
        keep()
    except (OmsmError, OSError) as err:
        return [f"not written into the catalogue: {err}; add it later with 'omsm history --add'"]
    return []
