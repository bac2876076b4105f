from collections.abc import Callable

import pytest
from scipy.stats import binomtest


@pytest.fixture
def wilson() -> Callable[[int, int], str]:
    """A share with its Wilson interval, as tables show it, by scipy."""

    def interval(hits: int, n: int) -> str:
        low, high = binomtest(hits, n).proportion_ci(method="wilson")
        return f"{hits / n:.3f} [{low:.3f}, {high:.3f}]"

    return interval
