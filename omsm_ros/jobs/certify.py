"""The certificate of a calibration as files to keep: a page, its Markdown, and the plots."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

from omsm_ros import __version__
from omsm_ros.core.identification.fitted_record import fitted_record
from omsm_ros.core.identification.identify import Identification
from omsm_ros.report.certificate.markdown import picture_name, render_markdown
from omsm_ros.report.certificate.page import CertificatePage, certificate_figures_of, render
from omsm_ros.storage.files import save_bytes
from omsm_ros.storage.result_folder import result_folder

PAGE, MARKDOWN = "certificate.html", "certificate.md"


def write_certificate(out: Path, identified: Identification, *, source: str = "") -> Path:
    """Write certificate.html, certificate.md and its plots into ``out``; return the page's path.

    source: name of the recording, for a reader
    """
    calibration = identified.calibration
    certificate = CertificatePage(
        calibration,
        datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        source,
        __version__,
        certificate_figures_of(calibration, fitted_record(identified)),
    )
    files = {picture_name(name): picture for name, picture in certificate.figures.items()}
    files[MARKDOWN] = render_markdown(certificate).encode("utf-8", "replace")
    files[PAGE] = render(certificate).encode("utf-8", "replace")
    with result_folder(out, (MARKDOWN, PAGE)) as folder:
        for name, content in files.items():
            save_bytes(folder / name, content)
    return out / PAGE
