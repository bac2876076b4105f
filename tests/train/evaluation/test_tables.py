import os
import shutil
import sys
from types import SimpleNamespace

import pytest

from train.evaluation.tables import Proportion, Table, format_fraction, format_interval, fraction


def test_a_fraction_has_the_wilson_interval():
    """p = 0.2 of 40 ± 1.96 standard errors about (8 + z² / 2) / (40 + z²), z = 1.96 (Wilson 1927)."""
    expected = {"value": 0.2, "low": 0.10500, "high": 0.34757, "hits": 8, "n": 40}
    assert vars(fraction(8, 40)) == pytest.approx(expected, rel=1e-4)


def test_a_fraction_of_nothing_is_unknown():
    assert fraction(0, 0) == Proportion(value=None, low=None, high=None, hits=0, n=0)
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
