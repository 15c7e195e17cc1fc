"""Cases of the same kind as one that always runs."""

import pytest


def soaked(*cases):
    """Return the parameters of ``cases``, each a tuple or one value, for `make soak` alone."""
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.soak)
        for case in cases
    ]
