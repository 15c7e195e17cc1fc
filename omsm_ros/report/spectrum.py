"""The report of ``omsm spectrum``: figures and page."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from omsm_ros.core.ripple.density import Density, smoothed
from omsm_ros.core.ripple.ripple_guard import NamedLine
from omsm_ros.core.ripple.scan_signal import PATH, TIME
from omsm_ros.core.ripple.source_hypotheses import (
    ALIASED,
    ARTEFACT,
    KINDS,
    PART,
    SYNCHRONOUS,
    UNDECIDED,
    VIBRATION,
    StudiedScan,
)
from omsm_ros.readable import plain, quantity
from omsm_ros.report import style
from omsm_ros.report.page_parts import Section, fill_study
from omsm_ros.report.tables import Table, filled
from omsm_ros.report.verdict import PageVerdict
from omsm_ros.units import MICROMETRE_M, MILLIMETRE_M, NANOMETRE_M

# Colours of Okabe and Ito, distinct for all colour vision.
COLOURS = {
    PART: "#009E73",
    VIBRATION: "#D55E00",
    ALIASED: "#CC79A7",
    SYNCHRONOUS: "#0072B2",
    ARTEFACT: "#E69F00",
    UNDECIDED: "#1F2933",
}
_WIDTH_IN, _ROW_IN = 9.2, 2.5


def densities(
    scans: Sequence[tuple[StudiedScan, Sequence[NamedLine]]], coordinate: str
) -> Figure | None:
    """Draw the amplitude spectral density of each scan over TIME or PATH, with its lines.

    Along the path over the wavelength; None if no scan moves over the part.
    """
    over = coordinate == PATH
    shown = [(s, n) for s, n in scans if not over or PATH in s.coordinates]
    if not shown:
        return None
    made, axes = style.figure(_WIDTH_IN, _ROW_IN * len(shown) + 0.3, len(shown), sharex=True)
    unit, what = ("nm·√mm", "along the path") if over else ("nm/√Hz", "over time")
    for row, (studied, named) in zip(axes, shown, strict=True):
        signal, found = studied.signal, studied.density(coordinate)
        frequency, level = smoothed(found)
        style.logarithmic(row.xaxis)
        style.logarithmic(row.yaxis)
        height = np.sqrt(level / MILLIMETRE_M if over else level) / NANOMETRE_M
        row.plot(_place(frequency, over), height, color=style.MUTED, linewidth=0.8)
        extent = float(np.ptp(signal.path)) / MILLIMETRE_M if over else signal.duration
        for one in named:
            if coordinate in one.line.possible:
                # The height of a line of amplitude a is a²/2 over one frequency resolution.
                at = _place(one.line.possible[coordinate], over)
                top = one.line.amplitude * np.sqrt(extent / 2) / NANOMETRE_M
                row.plot([at], [top], "o", color=COLOURS[one.kind], markersize=5, zorder=5)
        if over:
            twice = _place(found.frequency[-1], over)
            row.axvline(twice, color=style.MUTED, linewidth=0.8, linestyle=":")
        style.label(row, y=unit, title=f"{style.named(signal.name)}, {what}")
    if not over:
        kinds = {row.kind for _, named in shown for row in named}
        for kind in (kind for kind in KINDS if kind in kinds):
            axes[0].plot([], [], "o", color=COLOURS[kind], markersize=5, label=kind)
        if kinds:
            style.legend_above(axes[0])
    along = "wavelength [µm]; dotted: twice the sampling distance"
    style.label(axes[-1], x=along if over else "frequency [Hz]")
    return made


def _place(frequency: Any, over: bool) -> Any:
    """Return a frequency in time [Hz], or the wavelength of one along the path [µm]."""
    return 1 / frequency / MICROMETRE_M if over else frequency


def motion(spectra: Sequence[tuple[str, Density]], valid_up_to: float | None) -> Figure:
    """Draw the density of the motion of Z and the calibrated band (Fig. 7c)."""
    made, (one,) = style.figure(_WIDTH_IN, 3.0)
    style.logarithmic(one.xaxis)
    if any(np.any(spectrum.density > 0) for _, spectrum in spectra):
        style.logarithmic(one.yaxis)
    for k, (name, spectrum) in enumerate(spectra):
        frequency, level = smoothed(spectrum)
        colour = list(COLOURS.values())[k % len(COLOURS)]
        # A stationary Z has zero density, which has no logarithm.
        if np.any(level > 0):
            heights, shown = np.sqrt(level) / NANOMETRE_M, style.named(name)
            one.plot(frequency, heights, linewidth=0.9, color=colour, label=shown)
    if valid_up_to is not None:
        top = max(float(s.frequency[-1]) for _, s in spectra)
        one.axvspan(valid_up_to, top, color=style.MISSING, zorder=0, label="not calibrated")
    style.label(one, x="frequency [Hz]", y="nm/√Hz", title="Motion of Z")
    if one.get_legend_handles_labels()[1]:
        style.legend(one, loc="upper right")
    return made


def evidence(scans: Sequence[tuple[StudiedScan, Sequence[NamedLine]]]) -> Figure | None:
    """Draw every line of every scan at its frequency in time; None without such a line.

    A line at the same frequency in scans of different speed is not texture.
    """
    if not any(TIME in row.line.possible for _, named in scans for row in named):
        return None
    made, (one,) = style.figure(_WIDTH_IN, 0.5 * len(scans) + 1.2)
    for level, (_, named) in enumerate(scans):
        for row in named:
            if TIME in row.line.possible:
                at = row.line.possible[TIME]
                one.plot(
                    [at, at], [level - 0.35, level + 0.35], color=COLOURS[row.kind], linewidth=1.6
                )
    style.logarithmic(one.xaxis, every=(1.0, 2.0, 5.0))
    low, high = one.get_xlim()
    # A decade at least, so that the axis has numbers.
    one.set_xlim(min(low, high / 10), high)
    one.set_yticks(range(len(scans)), [style.named(s.signal.name) for s, _ in scans])
    one.invert_yaxis()
    style.label(one, x="frequency in time [Hz]", title="Lines of all scans")
    return made


CAPTIONS = {
    "time": "Spectral density over time; dots: lines at their amplitude.",
    "path": "Spectral density along the path: texture has the same wavelength in every scan.",
    "evidence": "Lines at the same frequency at different speeds are not on the part.",
    "motion": "Spectral density of the motion of Z. Grey: above the calibrated band.",
}


def drawn(
    scans: Sequence[tuple[StudiedScan, Sequence[NamedLine], Density]], valid_up_to: float | None
) -> dict[str, bytes]:
    """Return PNG files of all figures."""
    pairs = [(studied, named) for studied, named, _ in scans]
    spectra = [(studied.signal.name, motion) for studied, _, motion in scans]
    made = {
        "time": densities(pairs, TIME),
        "path": densities(pairs, PATH),
        "evidence": evidence(pairs),
        "motion": motion(spectra, valid_up_to),
    }
    return {name: style.png(figure) for name, figure in made.items() if figure is not None}


def render(summary: Mapping[str, Any], figures: Mapping[str, bytes]) -> str:
    """Return the page of ``spectrum.json`` as HTML; figures: PNG files, as in :data:`CAPTIONS`."""
    scans = summary["scans"]
    return fill_study(
        title="Lines in the spectrum",
        subtitle=", ".join(scan["name"] for scan in scans),
        verdict=_verdict(summary),
        sections=(
            Section("Lines", ("time",), tuple(peak_table(scan) for scan in scans)),
            Section("Evidence", ("evidence", "path"), (_acceleration_table(scans),)),
            Section(
                "Scans", ("motion",), (filled("", scans, "{name}", _SCANS), _sampling_table(scans))
            ),
            Section("Removed", tables=(_stop_table(scans), _vibration_table(scans))),
        ),
        captions=CAPTIONS,
        figures=figures,
        footer=str(summary["normalisation"]),
    )


def _verdict(summary: Mapping[str, Any]) -> PageVerdict:
    counts = summary["counts"]
    found = tuple(f"{counts[kind]} {kind}" for kind in KINDS if counts[kind])
    found += (summary["exposure"]["finding"],) if summary["exposure"] else ()
    if not found:
        return PageVerdict("good", "No line above 3 σ", ("noise only",))
    if counts[UNDECIDED]:
        wanted = sorted({p["needs"] for s in summary["scans"] for p in s["peaks"] if p["needs"]})
        return PageVerdict("unknown", "Some lines of unknown source", (*found, *wanted))
    return PageVerdict("good", "Source of every line identified", found)


def peak_table(scan: Mapping[str, Any]) -> Table:
    """Return the lines of one scan of ``spectrum.json``, with their sources."""
    rows = [
        (
            peak["kind"],
            quantity(peak["frequency"], "Hz", 5),
            quantity(peak["wavelength_along_path"] or peak["wavelength_along_radius"], "m", 4),
            quantity(peak["amplitude"], "m"),
            quantity(peak["amplitude_on_part"], "m"),
            plain(peak["significance"]),
            _true(peak),
            "; ".join([*peak["evidence"], *([peak["needs"]] if peak["needs"] else [])]),
        )
        for peak in scan["peaks"]
    ]
    columns = (
        *("apparent frequency", "wavelength", "amplitude", "on the part", "σ"),
        *("true value", "evidence"),
    )
    return Table(scan["name"], columns, rows, prose="evidence")


def _true(peak: Mapping[str, Any]) -> str:
    if peak["true_frequency"]:
        return quantity(peak["true_frequency"], "Hz", 5)
    if peak["true_wavelength"]:
        return quantity(peak["true_wavelength"], "m", 4)
    return f"{peak['order']} per turn" if peak["order"] else ""


def _acceleration_table(scans: Sequence[Mapping[str, Any]]) -> Table:
    shaken = [scan for scan in scans if scan["accelerometer"]]
    lines = [{**line, "scan": s["name"]} for s in shaken for line in s["accelerometer"]["lines"]]
    columns = {
        "frequency": "{frequency:Hz/5}",
        "acceleration": "{acceleration:plain} m/s²",
        "motion": "{displacement:m}",
        "σ": "{significance:plain}",
    }
    return filled("Accelerometer lines", lines, "{scan}, {axis}", columns)


_SCANS = {
    "points": "{samples[analysed]:count}",
    "duration": "{duration:s}",
    "spindle": "{spindle_speed_rpm:rpm}",
    "path": "{path_length:m}",
    "form removed, rms": "{form[rms_removed]:m}",
    "residual, rms": "{noise[rms]:m}",
    "σ of an amplitude": "{noise[amplitude]:m}",
    "motion outside the band": "{motion[outside_band_rms]:m}",
}
_STOPS = {
    "bands": "{bands}",
    "rms before": "{rms_before:m}",
    "rms after": "{rms_after:m}",
    "removed": "{rms_removed:m}",
    "phase": "0, forward and backward",
    "settling at the ends": "{settling_at_the_ends:s}",
}


def _sampling_table(scans: Sequence[Mapping[str, Any]]) -> Table:
    places = [{**place, "scan": scan["name"]} for scan in scans for place in scan["sampling"]]
    columns = {"distance": "{distance:m/4}", "shortest wavelength": "{shortest_wavelength:m/4}"}
    return filled("Sampling of the part", places, "{scan}, radius {radius:m}", columns)


def _stop_table(scans: Sequence[Mapping[str, Any]]) -> Table:
    stops = [{**scan["band_stop"], "scan": scan["name"]} for scan in scans if scan["band_stop"]]
    for stop in stops:
        stop["bands"] = ", ".join(
            f"{plain(low)} to {plain(high)} Hz" for low, high in stop["bands"]
        )
    return filled("", stops, "{scan}", _STOPS)


def _vibration_table(scans: Sequence[Mapping[str, Any]]) -> Table:
    rows = [(scan["name"], one["finding"]) for scan in scans for one in scan["vibration_removed"]]
    return Table("Vibration, in phase with the accelerometer", ("result",), rows, prose="result")
