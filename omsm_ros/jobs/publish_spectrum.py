"""The folder of ``omsm spectrum``: JSON, page, and the clouds without a stopped band."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omsm_ros.jobs.progress import Progress, no_progress
from omsm_ros.jobs.spectrum import (
    SpectrumOfScan,
    SpectrumOptions,
    spectra_of,
    summary_of,
    without_bands,
)
from omsm_ros.storage.cloud_file import PlyWriter
from omsm_ros.storage.files import REPORT, SPECTRUM, save_json, save_text
from omsm_ros.storage.recording.topics import AnyBag
from omsm_ros.storage.result_folder import result_folder


def publish_spectra(
    paths: Sequence[AnyBag],
    options: SpectrumOptions,
    out: Path,
    *,
    report: bool = True,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Study the scans, write the results into ``out``, and return ``spectrum.json``'s content."""
    clouds = [f"band_stopped_{k + 1}.ply" for k in range(len(paths))]
    with result_folder(out, (*clouds, *_clouds_before(out), REPORT, SPECTRUM)) as folder:
        scans = spectra_of(paths, options, progress)
        summary = summary_of(scans, options)
        files = {"spectrum": SPECTRUM}
        for name, scan in zip(clouds, scans, strict=True) if options.stop else ():
            _write_cloud(folder / name, scan)
            files[f"{scan.studied.signal.name} without the band"] = name
        if report:
            # Here, because drawing takes longer to load than all else.
            from omsm_ros.report.spectrum.page import SpectrumPage, drawn, render

            valid = options.calibration.valid_up_to if options.calibration else None
            figures = drawn([(s.studied, s.named, s.motion) for s in scans], valid)
            save_text(folder / REPORT, render(SpectrumPage(summary, figures)))
            files["report"] = REPORT
        summary["files"] = files
        save_json(folder / SPECTRUM, summary)
    return summary


def _clouds_before(out: Path) -> list[str]:
    """Return the clouds of an earlier run, which may have had more scans."""
    earlier = out.glob("band_stopped_*.ply") if (out / SPECTRUM).is_file() else ()
    return [path.name for path in earlier]


def _write_cloud(path: Path, scan: SpectrumOfScan) -> None:
    with PlyWriter(path, "omsm_ros, metres, a band of frequencies taken out") as ply:
        ply.write(without_bands(scan))
