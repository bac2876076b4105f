import os
import shutil
import sys
from types import SimpleNamespace

import pytest
from scipy.stats import norm

from train.tables import Table, format_fraction, format_interval, fraction


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


@pytest.mark.parametrize("width", [45, 60, 80, 300])
def test_a_table_fits_the_terminal_with_every_cell_beside_its_row_and_column(monkeypatch, width):
    header = ["network", "auc", "recall", "false positives"]
    rows = [[name, *(f"{metric} of {name}" for metric in header[1:])] for name in ("before", "after")]
    monkeypatch.setattr(sys, "stdout", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(shutil, "get_terminal_size", lambda: os.terminal_size((width, 24)))
    _, *parts = str(Table("scores", header, rows)).split("\n\n")
    shown = []
    for part in parts:
        first, _, *lines = ([cell.strip() for cell in line.strip("| ").split(" | ")] for line in part.splitlines())
        assert max(map(len, part.splitlines())) <= width
        cells = ((line[0], head, cell) for line in lines for head, cell in zip(first[1:], line[1:], strict=True))
        shown += [{*cell.split(" of ")} == {row, head} for row, head, cell in cells]
    assert shown == [True] * 6
