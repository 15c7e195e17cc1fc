"""Keeps calibrations and measurements in a database, the catalogue.

It is an SQLite file, or PostgreSQL if several cells share it. A row is added only once. SQLAlchemy
is an optional package.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from typing import Any

from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.io.files import exception_text
from omsm_ros.quantities import SIGNAL, shown
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
        if kind not in _KINDS or not _is_text(address):
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
        with self._translated(), warnings.catch_warnings():
            # An unknown part of the address is an error.
            warnings.simplefilter("error", sqlalchemy.exc.SAWarning)
            # No pool: a command adds one row and ends.
            self._engine = sqlalchemy.create_engine(
                self.address, connect_args=waiting, poolclass=sqlalchemy.pool.NullPool
            )
            if sqlite:
                sqlalchemy.event.listen(self._engine, "connect", _bounded)
            self._make_tables()
        return self

    def _make_tables(self) -> None:
        known = self._tables["calibrations"].metadata
        try:
            known.create_all(self._engine, checkfirst=True)
        except self._sql.exc.DBAPIError as err:
            if "already exists" not in str(err):
                raise
            # Another process created them at the same time, so look again.
            known.create_all(self._engine, checkfirst=True)

    def __exit__(self, *_: object) -> None:
        self._engine.dispose()

    def add(self, table: str, row: Mapping[str, object]) -> bool:
        """Add a row to "calibrations" or "measurements"; False if one of its id is there."""
        target = self._tables[table]
        with self._translated(), self._engine.begin() as connection:
            known = self._sql.select(target.c.id).where(target.c.id == row["id"])
            if connection.execute(known).first() is not None:
                return False
            try:
                with connection.begin_nested():
                    connection.execute(target.insert().values(added_at=_now(), **row))
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
            raise FileError(
                f"catalogue {self._shown_address()!r}: {self._reason(err)}; "
                "check that it is there and may be written"
            ) from err

    @staticmethod
    def _reason(err: Exception) -> str:
        """Return the text of the database, without the statement and the link to a manual."""
        text = str(err).partition("[SQL")[0].partition("(Background")[0]
        return " ".join(text.split())[:200]

    def _shown_address(self) -> str:
        """Return the address without its password."""
        try:
            url = self._sql.engine.make_url(self.address)
        except (ValueError, self._sql.exc.ArgumentError):
            return self.address.rpartition("@")[2]  # invalid, and may contain a password
        return str(url.render_as_string(hide_password=True))


def _is_text(address: str) -> bool:
    """Whether it is Unicode; the name of a file may be any bytes, an address may not."""
    try:
        address.encode()
    except UnicodeEncodeError:
        return False
    return True


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


def _now() -> datetime:
    return datetime.now(tz=timezone.utc).replace(tzinfo=None, microsecond=0)


_CALIBRATION_FIGURES = (
    "static_gain", "static_gain_uncertainty", "delay", "delay_uncertainty", "valid_up_to",
    "sample_period",
)  # fmt: skip
_MEASUREMENT_FIGURES = (
    "deviation_rms", "deviation_peak_to_valley", "dynamic_error_rms", "uncertainty_median",
)  # fmt: skip


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
        "calibrations", ("verdict", "path", "source", "settings"), _CALIBRATION_FIGURES
    )
    measurements = table(
        "measurements", ("bag", "folder", "version", "settings"), _MEASUREMENT_FIGURES,
        sql.Column("calibration", sql.String(64), index=True),
        sql.Column("received", sql.BigInteger),
        sql.Column("corrected", sql.BigInteger),
    )  # fmt: skip
    return {"calibrations": calibrations, "measurements": measurements}
