"""Indications of ISO 10110-5, read by hand, and their verdicts."""

import pytest

from omsm_ros.core.form.deviation_map import Doubt, UncertainValue
from omsm_ros.core.form.drawing import Drawing
from omsm_ros.errors import ConfigurationError

NM = 1e-9
E_LINE = 546.07 / 2


@pytest.mark.parametrize(
    ("text", "limits"),
    [
        ("3/0.5(0.2/0.1)", {"A": 0.5 * E_LINE, "B": 0.2 * E_LINE, "C": 0.1 * E_LINE}),
        ("ISO 10110-5 3/0,5(0,2)", {"A": 0.5 * E_LINE, "B": 0.2 * E_LINE}),
        ("ISO 10110-5:2015 3/100(50/20)", {"A": 100, "B": 50, "C": 20}),
        ("3/100 nm (50 nm/20 nm)", {"A": 100, "B": 50, "C": 20}),
        ("3/ 100 (50) nm", {"A": 100, "B": 50}),
        ("3/ – (1); RMS a < 0.1; λ = 546 nm", {"B": 273, "RMSa": 27.3}),
        ("3/ 2(1/0.5); λ = 632.8 nm", {"A": 632.8, "B": 316.4, "C": 158.2}),
        ("3/ –; RMSt < 100 nm; RMSi < 30 nm; λ = 546 nm", {"RMSt": 100, "RMSi": 30}),
        ("3/-(-/0.5)", {"C": 0.5 * E_LINE}),
        ("ISO 10110-5:2007 3/2", {"A": 2 * E_LINE}),
        ("3/0.1µm(50nm)", {"A": 100, "B": 50}),
    ],
)
def test_the_numbers_of_an_indication_have_their_unit(text, limits):
    found = Drawing.parsed(text).limits
    assert found == {name: pytest.approx(v * NM, rel=1e-9, abs=0) for name, v in limits.items()}


@pytest.mark.parametrize(
    "text", ["", "3/", "3/-", "4/0.5", "3/0.5(0.2", "3/a(b)", "3/1 2", "3/-(-)"]
)
def test_another_text_is_refused(text):
    with pytest.raises(ConfigurationError, match="is no tolerance of ISO 10110-5"):
        Drawing.parsed(text)


def test_each_term_has_a_verdict_and_the_worst_is_that_of_the_drawing():
    drawing = Drawing.parsed("3/100(50/20) nm")
    figures = {
        f"iso10110_{name}": UncertainValue(value * NM, 2 * NM)
        for name, value in (("A", 90), ("B", 48), ("C", 26))
    }
    found = drawing.verdicts(figures, [])
    assert {n: t["verdict"] for n, t in found["terms"].items()} == {
        "A": "holds", "B": "cannot tell", "C": "fails",
    }  # fmt: skip
    assert found["verdict"] == "fails"
    figures |= dict.fromkeys(("iso10110_B", "iso10110_C"), UncertainValue(5 * NM, 1 * NM))
    assert drawing.verdicts(figures, [])["verdict"] == "holds"
    gap = Doubt("a tenth has no points", None)
    assert drawing.verdicts(figures, [gap])["verdict"] == "cannot tell"
