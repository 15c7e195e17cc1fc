"""Channels of a TDMS file, the format of LabVIEW and DIAdem; named ``group/channel``."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.storage.files import open_regular, said
from omsm_ros.storage.foreign.table import PIECE_ROWS, ForeignTable
from omsm_ros.units import NANOSECONDS_PER_S

# Properties that LabVIEW gives a channel (ni.com, "TDMS File Format Internal Structure").
_UNIT, _PERIOD = "unit_string", "wf_increment"
_BEGINS = ("wf_start_time", "wf_start_offset")
_SCALES, _MOST_SCALES = "NI_Number_Of_Scales", 100
# Where the library warns that numbers are others than the file means, and goes on.
_NOT_PASSED_OVER = ("nptdms.scaling", "nptdms.base_segment", "nptdms.tdms_segment")


class _Refusal(logging.Handler):
    """A warning is an error: of a scale that is not known, the raw numbers would be read."""

    def emit(self, record: logging.LogRecord) -> None:
        raise ValueError(record.getMessage())


class TdmsTable(ForeignTable):
    """The channels of one file; its units and its period are held against the map's."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            from nptdms import TdmsFile
            from nptdms.log import log_manager
        except ImportError as err:
            raise FileError(f"{self} needs npTDMS; pip install npTDMS, or give CSV") from err
        log_manager.set_level(logging.CRITICAL)
        for name in _NOT_PASSED_OVER:
            logger = logging.getLogger(name)
            logger.setLevel(logging.WARNING)
            logger.handlers[:] = [_Refusal()]
        with ExitStack() as opening:
            stream = opening.enter_context(open_regular(path, FileError, "table"))
            try:
                self._take(opening.enter_context(TdmsFile.open(stream)))
            except Exception as err:  # whatever the library says of a damaged file
                raise self._damaged(err) from err
            self._opened = opening.pop_all()

    def _take(self, file: Any) -> None:
        if file.file_status.incomplete_final_segment:
            raise ValueError("it was cut short")
        for group in file.groups():
            for told in (file, group, *group.channels()):
                _check_scales(told.properties)
        self._channels = {f"{g.name}/{c.name}": c for g in file.groups() for c in g.channels()}
        self.names = [n for n, c in self._channels.items() if _kind(c) in "fiuM"]
        properties = {name: self._channels[name].properties for name in self.names}
        self.units = {n: str(p[_UNIT]) for n, p in properties.items() if p.get(_UNIT)}
        self._properties = properties

    def used(self, names: Sequence[str]) -> None:
        """Take the period of the channels ``names``; FileError where they are not side by side."""
        told = {name: self._properties[name] for name in names}
        for key in (_PERIOD, *_BEGINS):
            values = {p[key]: name for name, p in told.items() if p.get(key)}
            if len(values) > 1:
                one, other = list(values.items())[:2]
                raise FileError(
                    f"{self} states {key} {one[0]} of {one[1]!r} and {other[0]} of {other[1]!r}; "
                    "their rows do not belong together: write them on one clock"
                )
            if key == _PERIOD and values:
                (self.sample_period,) = (self._period(value) for value in values)

    def _period(self, stated: object) -> float:
        try:
            return float(stated)  # type: ignore[arg-type]
        except (TypeError, ValueError) as err:
            raise self._damaged(err) from err

    def _damaged(self, err: Exception) -> FileError:
        return FileError(f"{self} cannot be read: {said(err)}; write it again, or as CSV")

    def _pieces(
        self, names: Sequence[str], dates: frozenset[str]
    ) -> Iterator[dict[str, FloatArray]]:
        lengths = {name: len(self._channels[name]) for name in names}
        if len(set(lengths.values())) > 1:
            raise FileError(f"{self} has channels of different lengths {lengths}; cut them alike")
        for low in range(0, lengths[names[0]], PIECE_ROWS):
            yield {name: self._slice(name, low, name in dates) for name in names}

    def _slice(self, name: str, low: int, dated: bool) -> FloatArray:
        try:
            values: Any = self._channels[name][low : low + PIECE_ROWS]
        except Exception as err:
            raise self._damaged(err) from err
        if dated != (values.dtype.kind == "M"):
            holds = "numbers" if dated else "dates"
            raise FileError(
                f"{self} has {holds} in {name!r}; its unit in the map says otherwise: correct it"
            )
        if dated:  # always UTC
            since = values.astype("datetime64[ns]").astype(np.int64)
            return np.asarray(since / NANOSECONDS_PER_S)
        with np.errstate(invalid="ignore"):  # damaged singles; what is no number is told
            return np.asarray(values, np.float64)


def _check_scales(properties: Mapping[str, object]) -> None:
    """Raise ValueError for more scales than anybody chains: the library would make them all."""
    scales = properties.get(_SCALES, 0)
    if isinstance(scales, int | float | np.number) and not scales <= _MOST_SCALES:
        raise ValueError(f"{_SCALES} is {scales}, expected at most {_MOST_SCALES}")


def _kind(channel: Any) -> str:
    """Return the kind of a channel's numbers; "f" where only reading it tells what is wrong."""
    try:
        return str(channel.dtype.kind)
    except Exception:  # whatever the library says of a channel that nobody may want
        return "f"
