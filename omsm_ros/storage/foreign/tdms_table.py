"""Channels of a TDMS file, the format of LabVIEW and DIAdem; named ``group/channel``."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
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


class TdmsTable(ForeignTable):
    """The channels of one file; its units and its period are held against the map's."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            from nptdms import TdmsFile
            from nptdms.log import log_manager
        except ImportError as err:
            raise FileError(f"{self} needs npTDMS; pip install npTDMS, or give CSV") from err
        # What it would print of a damaged file is told here, in one line.
        log_manager.set_level(logging.CRITICAL)
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
        self._channels = {f"{g.name}/{c.name}": c for g in file.groups() for c in g.channels()}
        self.names = [n for n, c in self._channels.items() if c.dtype.kind in "fiuM"]
        properties = {name: self._channels[name].properties for name in self.names}
        self.units = {n: str(p[_UNIT]) for n, p in properties.items() if p.get(_UNIT)}
        periods = {float(p[_PERIOD]) for p in properties.values() if p.get(_PERIOD)}
        self.sample_period = periods.pop() if len(periods) == 1 else None

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
            raise FileError(f"{self} has {holds} in {name!r}; its unit in the map says otherwise")
        if dated:  # always UTC
            since = values.astype("datetime64[ns]").astype(np.int64)
            return np.asarray(since / NANOSECONDS_PER_S)
        return np.asarray(values, np.float64)
