"""The certificate of a calibration, or the page of a model, as files to keep."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

from omsm_ros import __version__
from omsm_ros.core.identification.fitted_record import fitted_record
from omsm_ros.core.identification.identify import Identification
from omsm_ros.core.sampled.free_run import FreeRun
from omsm_ros.core.sampled.model import SampledModel
from omsm_ros.jobs.identify_table import SampledRecord
from omsm_ros.readable import moment
from omsm_ros.report.certificate.markdown import picture_name, render_markdown
from omsm_ros.report.certificate.model_page import ModelPage, model_figures_of, render_model
from omsm_ros.report.certificate.page import CertificatePage, certificate_figures_of, render
from omsm_ros.storage.files import save_bytes
from omsm_ros.storage.result_folder import result_folder

PAGE, MARKDOWN, MODEL_PAGE = "certificate.html", "certificate.md", "model.html"


def write_certificate(out: Path, identified: Identification, *, source: str = "") -> Path:
    """Write certificate.html, certificate.md and its plots into ``out``; return the page's path.

    source: name of the recording, for a reader
    """
    calibration = identified.calibration
    certificate = CertificatePage(
        calibration=calibration,
        date=_today(),
        source=source,
        version=__version__,
        figures=certificate_figures_of(calibration, fitted_record(identified)),
    )
    files = {picture_name(name): picture for name, picture in certificate.figures.items()}
    files[MARKDOWN] = render_markdown(certificate).encode("utf-8", "replace")
    files[PAGE] = render(certificate).encode("utf-8", "replace")
    with result_folder(out, (MARKDOWN, PAGE)) as folder:
        for name, content in files.items():
            save_bytes(folder / name, content)
    return out / PAGE


def write_model_page(
    out: Path, model: SampledModel, record: SampledRecord, run: FreeRun, *, source: str = ""
) -> Path:
    """Write model.html into ``out``: the model, and its ``run`` over ``record``; return its path.

    source: name of the record, for a reader
    """
    page = ModelPage(
        model=model,
        run=run,
        date=_today(),
        source=source,
        version=__version__,
        figures=model_figures_of(model, record.input, record.output, run),
    )
    with result_folder(out, (MODEL_PAGE,)) as folder:
        save_bytes(folder / MODEL_PAGE, render_model(page).encode("utf-8", "replace"))
    return out / MODEL_PAGE


def _today() -> str:
    return moment(datetime.now(timezone.utc))
