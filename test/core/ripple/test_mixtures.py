"""Random mixtures of marks, vibrations, aliases, spindle errors and drift, as in the benchmark."""

from collections import Counter

import pytest

from benchmarks.mixtures import mixture
from benchmarks.spectra import judged


@pytest.mark.parametrize("seed", [4003])
def test_lines_are_named_rightly_and_nothing_folded_is_on_the_part(seed):
    counted = Counter(judged(mixture(seed)))
    peaks = counted["right"] + counted["wrong"] + counted["undecided"]
    assert peaks >= 12
    assert counted["right"] >= 0.95 * peaks
    assert counted["folded on the part"] == 0
    assert counted["found"] >= 0.95 * (counted["found"] + counted["missed"])
