"""Cases of the same kind as one that always runs."""

import pytest


def soaked(*cases):
    """Return the parameters of ``cases``, each a tuple or one value, for `make soak` alone."""
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.soak)
        for case in cases
    ]


def always(*chosen, of):
    """Return ``chosen``, and the other cases of ``of`` for `make soak` alone."""
    return [*chosen, *soaked(*(case for case in of if case not in chosen))]
