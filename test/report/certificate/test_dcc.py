"""The Digital Calibration Certificate, read by an independent reader and against PTB's schema."""

import os
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from omsm_ros.report.certificate.tables import dcc_quantities, render_dcc

SI = "{https://ptb.de/si}"


@pytest.fixture
def text(certified):
    return render_dcc(certified, "0.1.0")


def test_pydcc_reads_the_same_values_and_uncertainties(certified, text, monkeypatch):
    """Signatures, and the list of versions on PTB's server, are not part of this test."""
    for name in ("certvalidator", "certvalidator.errors"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    reader = pytest.importorskip("dcc.dcc", reason="pip install pydcc")
    monkeypatch.setattr(reader, "DCCXMLValidator", MagicMock())
    read = reader.DCC(byte_array=text.encode())
    assert read.uid() == certified.id
    assert read.version() == "3.2.1"
    reals = [entry["real"] for _, entry in read.get_calibration_results("name")]
    stated = dcc_quantities(certified)
    assert [float(r["value"]) for r in reals] == [q.value for q in stated]
    assert [r["unit"] for r in reals] == [q.unit for q in stated]
    for real, one in zip(reals, stated, strict=True):
        if one.expanded is not None:
            assert float(real["expandedUnc"]["uncertainty"]) == one.expanded


def test_values_and_uncertainties_are_those_of_the_calibration(certified, text):
    reals = ET.fromstring(text).findall(f".//{SI}real")
    lag = reals[0]
    assert float(lag.find(f"{SI}value").text) == certified.dynamics.low_frequency_delay
    assert lag.find(f"{SI}unit").text == r"\second"
    # Gain and phase in the band, against the response itself; U from the covariance by sampling.
    top = certified.valid_up_to
    at = [q for q in dcc_quantities(certified) if q.name == f"gain at {top:.6g} Hz"]
    assert at[0].value == pytest.approx(abs(certified.dynamics.response([top])[0]))
    assert len(reals) == len(dcc_quantities(certified)) == 15
    factor = {float(e.text) for e in ET.fromstring(text).iter(f"{SI}coverageFactor")}
    assert factor == {2.0}
    assert all(np.isfinite(float(r.find(f"{SI}value").text)) for r in reals)


def test_texts_from_outside_are_escaped(certified):
    settings = {**certified.settings, "machine": "<a> & b"}
    origin = replace(certified.certificate.origin, customer="Optics & Co")
    certificate = replace(certified.certificate, origin=origin)
    made = replace(certified, settings=settings, certificate=certificate)
    parsed = ET.fromstring(render_dcc(made, "0.1.0"))
    assert any("<a> & b" in (e.text or "") for e in parsed.iter("{https://ptb.de/dcc}content"))
    assert parsed.findtext(".//{*}customer/{*}name/{*}content") == "Optics & Co"


def test_the_schema_of_ptb_accepts_it(text):
    """Validate against dcc.xsd 3.2.1 and SI_Format.xsd in the folder that DCC_SCHEMAS names."""
    folder = os.environ.get("DCC_SCHEMAS")
    if not folder:
        pytest.skip("DCC_SCHEMAS names no folder with PTB's dcc.xsd and SI_Format.xsd (LGPL)")
    xmlschema = pytest.importorskip("xmlschema")
    places = {"https://ptb.de/si": str(Path(folder) / "SI_Format.xsd")}
    schema = xmlschema.XMLSchema(
        str(Path(folder) / "dcc.xsd"), locations=places, validation="lax", allow="local"
    )
    faults = [e for e in schema.iter_errors(text) if "Signature" not in str(e)]
    assert not faults, faults[0]
