import pytest
from scipy.stats import binomtest

from train.photographs.shares import share


@pytest.mark.parametrize(
    ("hits", "n"), [(0, 1), (1, 1), (0, 40), (40, 40), (1, 527), (263, 527), (527, 527), (1, 10**6)]
)
def test_intervals_are_wilson_score_intervals(hits, n):
    """Also at the ends, where the normal approximation leaves [0, 1]."""
    result = share(hits, n)
    expected = binomtest(hits, n).proportion_ci(method="wilson")
    assert 0 <= result["low"] <= result["value"] <= result["high"] <= 1
    assert (result["value"], result["hits"], result["n"]) == (hits / n, hits, n)
    # The order of the operations shows below 12 digits.
    assert (result["low"], result["high"]) == pytest.approx((expected.low, expected.high), rel=0, abs=1e-12)


def test_a_share_of_nothing_is_unknown_rather_than_0():
    assert share(0, 0) == {"value": None, "low": None, "high": None, "hits": 0, "n": 0}
