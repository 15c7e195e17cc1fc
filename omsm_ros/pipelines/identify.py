"""The motion in a bag, ready to identify from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from omsm_ros import __version__
from omsm_ros.core.calibration.calibration import settings_with
from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse, use_of_motion
from omsm_ros.core.estimation.sampled_model import FreeRun, SampledModel, free_run
from omsm_ros.core.identification.fitted_record import fitted_record
from omsm_ros.core.identification.identify import Identification
from omsm_ros.core.identification.sampled_identification import identify_samples
from omsm_ros.core.streams.blocks import Block, BoolArray, FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord, assemble
from omsm_ros.core.streams.stamps import check_period
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.errors import BagError, ConfigurationError, DataError, FileError
from omsm_ros.io import bags
from omsm_ros.io.descriptions import load_motion
from omsm_ros.io.files import save_bytes
from omsm_ros.io.folders import result_folder
from omsm_ros.io.table_file import first_line, load_columns
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.progress import Progress, no_progress
from omsm_ros.pipelines.recording import path_in, read_blocks
from omsm_ros.quantities import TIME_LAPSE
from omsm_ros.readable import date_text, quantity
from omsm_ros.report.certificate.markdown import picture_name, render_markdown
from omsm_ros.report.certificate.model_page import ModelPage, model_figures_of, render_model
from omsm_ros.report.certificate.page import CertificatePage, certificate_figures_of, render
from omsm_ros.units import seconds_of


def motion_of_bag(
    path: AnyBag,
    *,
    duration: float = 0.0,
    time_lapse: object = 1.0,
    trigger: CommonTrigger = EQUAL_COUNTS,
    by_stamps: bool = False,
    progress: Progress = no_progress,
) -> MotionRecord:
    """Return the motion in a bag, its first ``duration`` seconds (0 = all), ready to identify from.

    time_lapse: how much faster than real time the recording was played [1]
    trigger: what is stated of the counters of axes and distance
    by_stamps: join both by their stamps, not by their counters
    The reference sensor is used where it was recorded.

    Raises DataError where the stamps contradict the sample period, or the counters each other.
    """
    faster = TIME_LAPSE.checked(time_lapse, ConfigurationError, "time_lapse")
    topics = [bags.AXES_TOPIC, bags.DISTANCE_TOPIC]
    with bags.BagReader(path) as bag:
        if any(t.role == bags.REFERENCE_TOPIC and t.messages for t in bag.topics()):
            topics.append(bags.REFERENCE_TOPIC)
    blocks = read_blocks(path, topics, progress)
    if not blocks[bags.AXES_TOPIC] or not blocks[bags.DISTANCE_TOPIC]:
        raise BagError(f"{str(path)!r} has its topics but no samples on them; record a step test")
    axes, distance, *reference = (_beginning(blocks[topic], duration) for topic in topics)
    for name, stream in (("axis", axes), ("distance", distance)):
        check_period(name, stream, faster)
    return assemble(  # type: ignore[misc]
        axes,
        distance,
        *reference,
        trigger=trigger,
        by_stamps=by_stamps,  # type: ignore[arg-type]
    )


def settings_of_bag(path: AnyBag, stated: Mapping[str, object]) -> dict[str, object]:
    """Return what a calibration from this bag belongs to: ``stated``, and the probe's report."""
    with bags.BagReader(path) as bag:
        return settings_with(stated, bag.probe_settings())


def recorded_ns_of_bag(path: AnyBag) -> int | None:
    """Return when the recording began [ns, ROS time], None where its clock was never set."""
    with bags.BagReader(path) as bag:
        return bag.recorded_ns


def _beginning(blocks: list[Block], duration: float) -> list[Block]:
    if duration == 0 or not blocks:
        return blocks
    end = blocks[0].first_sample + duration / blocks[0].sample_period
    return [block for block in blocks if block.first_sample < end]


def intended_use_of(scan: Path | None, accuracy: float | None) -> IntendedUse:
    """Return the intended use: a scan, as a bag or as a plan CSV, and the accuracy asked for [m].

    scan: None for the paper's.  Raises FileError, BagError or ConfigurationError.
    """
    if scan is None:
        return replace(PAPER_USE, accuracy_m=accuracy)
    if scan.suffix.lower() == ".csv":
        z, period = load_motion(scan)
        return use_of_motion(z, period, accuracy)
    path = path_in(scan)
    return use_of_motion(path.z, path.sample_period, accuracy)


# A model between two columns of a table, or two channels of a bag; and its run over another.

# Clocks of two computers differ by a tenth of this.
_SAME_PERIOD = 5e-3
# Periods; a time that is written with few digits scatters by one.
_GAP = 2.5


@dataclass(frozen=True, eq=False)
class SampledRecord:
    """Samples (n,) of two quantities, ``period`` [s] apart; ``used`` where the output counts."""

    input: FloatArray
    output: FloatArray
    used: BoolArray
    period: float


def record_of_table(
    path: Path, input: str, output: str, period: float, duration: float = 0.0
) -> SampledRecord:
    """Read two columns of a CSV file, one line a ``period`` [s]; ``duration`` [s], 0 = all.

    Raises DataError where a column of time says otherwise.
    """
    _check_time(path, period)
    columns = load_columns(path, (input, output))
    lines = round(duration / period) or len(columns[0])
    u, y = (column[:lines] for column in columns)
    return SampledRecord(u, y, np.ones(len(y), np.bool_), period)


def _check_time(path: Path, period: float) -> None:
    """Raise DataError where a column of time, which says its unit, contradicts the ``period`` [s].

    Frequencies would all be wrong by the same factor, and no residual would show it; where lines
    are missing, what comes after them is of another instant.
    """
    named = {name: one for name in first_line(path) if (one := seconds_of(name)) is not None}
    for name, second in named.items():
        try:
            (time,) = load_columns(path, (name,))
        except FileError:  # dates, or the like
            continue
        steps = np.diff(time) * second
        mean, most = float(np.mean(steps)), float(np.max(steps))
        even = abs(float(np.median(steps)) / period - 1) < _SAME_PERIOD
        if even and most > _GAP * period:
            raise DataError(
                f"table {str(path)!r}: {name!r} goes on by {quantity(most, 's')} after row "
                f"{int(np.argmax(steps)) + 1}, where rows are {quantity(period, 's')} apart: cut "
                "the record there"
            )
        if abs(mean / period - 1) > _SAME_PERIOD:
            raise DataError(
                f"table {str(path)!r}: by {name!r} a row takes {mean:.6g} s, not {period:.6g} s; "
                "give the period of the record, or correct the name of that column"
            )


def record_of_motion(motion: MotionRecord) -> SampledRecord:
    """Return the axis's position [m] and the probe's distance [m]."""
    return SampledRecord(motion.z, motion.distance, motion.ok, motion.sample_period)


def model_of(
    record: SampledRecord, *, hold: str, order: int = 0, max_delay: int = 3
) -> SampledModel:
    """Identify the output from the input; options as of ``identify_samples``."""
    return identify_samples(
        record.input,
        record.output,
        record.period,
        hold=hold,
        order=order,
        max_delay=max_delay,
        used=record.used,
    )


def run_of(model: SampledModel, record: SampledRecord) -> FreeRun:
    """Run ``model`` over the input of ``record``, beside its output."""
    return free_run(model, record.input, record.output, record.used)


def text_of_run(record: SampledRecord, run: FreeRun) -> str:
    """Return time, input, output and the model's output as CSV."""
    time = record.period * np.arange(len(record.input))
    rows = np.column_stack([time, record.input, record.output, run.output])
    lines = [",".join(f"{value:.12g}" for value in row) for row in rows.tolist()]
    return "\n".join(["time_s,input,output,model", *lines]) + "\n"


# The certificate of a calibration, or the page of a model, as files to keep.

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
    return date_text(datetime.now(timezone.utc))
