"""Random mixtures of marks, vibrations, aliases, spindle errors and drift, as in the benchmark."""

from collections import Counter

import pytest

from benchmarks.mixtures import mixture
from benchmarks.spectra import judged


@pytest.mark.soak
@pytest.mark.parametrize("seed", [4003])
def test_lines_are_named_rightly_and_no_alias_is_classified_as_part(seed):
    counted = Counter(judged(mixture(seed)))
    peaks = counted["right"] + counted["wrong"] + counted["undecided"]
    assert peaks >= 12
    assert counted["right"] >= 0.95 * peaks
    assert counted["aliased as part"] == 0
    assert counted["found"] >= 0.95 * (counted["found"] + counted["missed"])
