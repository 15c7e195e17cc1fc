"""The calibrator files a certificate of every identification, accepted or rejected."""

from __future__ import annotations

import pytest

pytest.importorskip("omsm_msgs", reason="the interfaces are not built")

from omsm_msgs.srv import Identify

from benchmarks.twin_motions import step_test_of
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.pipelines.history import history
from omsm_ros.twin.cell import blocks_of
from omsm_ros.twin.scenario import Scenario


def _bag(path, rise):
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as writer:
        for axes, distance in blocks_of(step_test_of(Scenario(step_rise=rise))):
            writer.write_block(axes)
            writer.write_block(distance)
    return str(path)


@pytest.mark.soak
def test_a_certificate_is_filed_of_every_identification(cell):
    folder, output = cell.folder / "certificates", cell.folder / "cal.json"
    base = str(cell.folder / "base.sqlite")
    cell.processes.start("calibrator", output=str(output), report=str(folder), catalogue=base)
    page = folder / "certificate.html"
    for rise, success, word in ((0.0, False, "✕ Rejected"), (20e-3, True, "✓ Accepted")):
        bag = _bag(cell.folder / f"rise_{rise}.mcap", rise)
        reply = cell.call(Identify, "calibrator/identify", bag=bag, order=2, duration=6.0)
        assert reply.success == success, reply.message
        assert str(page) in reply.message
        assert word in page.read_text(encoding="utf-8")
        assert output.exists() == success
        assert ("written into the catalogue" in reply.message) == success
    pytest.importorskip("sqlalchemy", reason="SQLAlchemy is an optional package")
    (machine,) = history(base)[0]
    (row,) = machine["calibrations"]
    assert (row["path"], row["source"]) == (str(output.resolve()), bag)


def test_neither_a_certificate_nor_a_database_that_fails_undoes_the_calibration(cell):
    (cell.folder / "taken").write_text("no database either, " * 100)
    output, taken = cell.folder / "cal.json", str(cell.folder / "taken")
    cell.processes.start("calibrator", output=str(output), report=taken, catalogue=taken)
    bag = _bag(cell.folder / "steps.mcap", 20e-3)
    reply = cell.call(Identify, "calibrator/identify", bag=bag, order=2, duration=6.0)
    assert reply.success
    assert "no certificate" in reply.message
    assert "not written into the catalogue" in reply.message
    assert output.exists()
