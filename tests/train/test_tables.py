import pytest
from scipy.stats import norm

from train.tables import format_fraction, format_interval, fraction


@pytest.mark.parametrize(("hits", "n"), [(0, 1), (1, 1), (0, 40), (40, 40), (1, 527), (263, 527), (1, 10**6)])
def test_a_fraction_has_the_wilson_interval(hits, n):
    """The p whose distance from hits / n is 1.96 of its own standard errors (Wilson 1927)."""
    result = fraction(hits, n)
    assert 0 <= result["low"] <= result["value"] <= result["high"] <= 1
    assert (result["value"], result["hits"], result["n"]) == (hits / n, hits, n)
    for end in {result["low"], result["high"]} - {0.0, 1.0}:
        distance = abs(hits / n - end) / (end * (1 - end) / n) ** 0.5
        assert distance == pytest.approx(norm.ppf(0.975), rel=1e-6)


def test_a_fraction_of_nothing_is_unknown():
    assert fraction(0, 0) == {"value": None, "low": None, "high": None, "hits": 0, "n": 0}
    assert (format_fraction(fraction(0, 0)), format_interval(fraction(0, 0))) == ("-", "-")
