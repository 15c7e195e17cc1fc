"""The page of ``omsm spectrum``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from omsm_ros.core.spectra.density import Density
from omsm_ros.core.spectra.hypotheses import KINDS, UNDECIDED, StudiedScan
from omsm_ros.core.spectra.ripple_guard import Named
from omsm_ros.readable import count, plain, quantity
from omsm_ros.report.common import style
from omsm_ros.report.common.page_parts import Section
from omsm_ros.report.common.study_page import StudyPage, fill_study
from omsm_ros.report.common.tables import Table
from omsm_ros.report.common.verdict import Verdict
from omsm_ros.report.spectrum import figures

CAPTIONS = {
    "time": "Spectral density over time; each dot is a line, as high as it stands out.",
    "path": "The same along the path: what is on the part has its wavelength here in every scan.",
    "evidence": "Lines that stay where they are at another speed are not on the part.",
    "motion": "The path's own motion. Grey: beyond what the calibration knows.",
}


@dataclass(frozen=True)
class SpectrumPage:
    """summary: of ``spectrum.json``;  figures: PNG files by the names in :data:`CAPTIONS`"""

    summary: Mapping[str, Any]
    figures: Mapping[str, bytes]


def drawn(
    scans: Sequence[tuple[StudiedScan, Sequence[Named], Density]], valid_up_to: float | None
) -> dict[str, bytes]:
    """Return PNG files of all figures."""
    pairs = [(studied, named) for studied, named, _ in scans]
    spectra = [(studied.signal.name, motion) for studied, _, motion in scans]
    made = {
        "time": figures.over_time(pairs),
        "path": figures.over_path(pairs),
        "evidence": figures.evidence(pairs),
        "motion": figures.motion(spectra, valid_up_to),
    }
    return {name: style.png(figure) for name, figure in made.items() if figure is not None}


def render(page: SpectrumPage) -> str:
    """Return the page as HTML."""
    summary = page.summary
    scans = summary["scans"]
    return fill_study(
        StudyPage(
            title="Lines in the spectrum",
            subtitle=", ".join(scan["name"] for scan in scans),
            verdict=_verdict(summary),
            sections=(
                Section("Lines", ("time",), tuple(_peak_table(scan) for scan in scans)),
                Section("Evidence", ("evidence", "path"), (_felt_table(scans),)),
                Section("Scans", ("motion",), (_scan_table(scans), _sampling_table(scans))),
                Section("Band stop", tables=(_stop_table(scans),)),
            ),
            captions=CAPTIONS,
            figures=page.figures,
            footer=str(summary["normalisation"]),
        )
    )


def _verdict(summary: Mapping[str, Any]) -> Verdict:
    counts = summary["counts"]
    found = tuple(f"{counts[kind]} {kind}" for kind in KINDS if counts[kind])
    if not found:
        return Verdict("good", "No line beyond 3 σ", ("nothing but noise",))
    if counts[UNDECIDED]:
        wanted = sorted({p["needs"] for s in summary["scans"] for p in s["peaks"] if p["needs"]})
        return Verdict("unknown", "Not all decided", (*found, *wanted))
    return Verdict("good", "All lines named", found)


def _peak_table(scan: Mapping[str, Any]) -> Table:
    rows = [
        (
            peak["kind"],
            quantity(peak["frequency"], "Hz", 5),
            quantity(peak["wavelength_along_path"] or peak["wavelength_along_radius"], "m", 4),
            quantity(peak["amplitude"], "m"),
            plain(peak["significance"]),
            _true(peak),
            "; ".join([*peak["evidence"], *([peak["needs"]] if peak["needs"] else [])]),
        )
        for peak in scan["peaks"]
    ]
    columns = ("seen at", "wavelength", "amplitude", "σ", "truly", "because")
    return Table(scan["name"], columns, rows, prose="because")


def _true(peak: Mapping[str, Any]) -> str:
    if peak["true_frequency"]:
        return quantity(peak["true_frequency"], "Hz", 5)
    if peak["true_wavelength"]:
        return quantity(peak["true_wavelength"], "m", 4)
    return f"{peak['order']} a turn" if peak["order"] else ""


def _felt_table(scans: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        (
            f"{scan['name']}, {line['axis']}",
            quantity(line["frequency"], "Hz", 5),
            f"{plain(line['acceleration'])} m/s²",
            quantity(line["displacement"], "m"),
            plain(line["significance"]),
        )
        for scan in scans
        if scan["accelerometer"]
        for line in scan["accelerometer"]["lines"]
    ]
    return Table("Felt by the accelerometer", ("frequency", "acceleration", "motion", "σ"), rows)


def _scan_table(scans: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        (
            scan["name"],
            count(scan["samples"]["analysed"]),
            quantity(scan["duration"], "s"),
            quantity(scan["spindle_speed_rpm"], "rpm"),
            quantity(scan["path_length"], "m"),
            quantity(scan["form"]["rms_removed"], "m"),
            quantity(scan["noise"]["rms"], "m"),
            quantity(scan["noise"]["amplitude"], "m"),
            quantity(scan["motion"]["outside_band_rms"], "m"),
        )
        for scan in scans
    ]
    columns = (
        *("points", "duration", "spindle", "path", "form removed, rms", "left, rms"),
        *("σ of an amplitude", "motion beyond the band"),
    )
    return Table("", columns, rows)


def _sampling_table(scans: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        (
            f"{scan['name']}, radius {quantity(place['radius'], 'm')}",
            quantity(place["distance"], "m", 4),
            quantity(place["shortest_wavelength"], "m", 4),
        )
        for scan in scans
        for place in scan["sampling"]
    ]
    return Table("Sampling of the part", ("distance", "shortest wavelength"), rows)


def _stop_table(scans: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        (
            scan["name"],
            ", ".join(f"{plain(low)} to {plain(high)} Hz" for low, high in stop["bands"]),
            quantity(stop["rms_before"], "m"),
            quantity(stop["rms_after"], "m"),
            quantity(stop["rms_removed"], "m"),
            "0, forward and backward",
            quantity(stop["settling_at_the_ends"], "s"),
        )
        for scan in scans
        if (stop := scan["band_stop"])
    ]
    columns = ("bands", "rms before", "rms after", "removed", "phase", "rings at the ends")
    return Table("", columns, rows)
