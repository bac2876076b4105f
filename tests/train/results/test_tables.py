import csv
import os
import shutil
import sys
from types import SimpleNamespace

import pytest

from train.results import tables
from train.results.tables import Proportion, Table, format_fraction, format_interval, fraction


def test_the_range_of_seeds_is_not_called_an_interval():
    of_seeds = tables.Estimate(0.5, 0.4, 0.6, f"{tables.RANGE} of 2 seeds")
    of_images = tables.Estimate(0.5, 0.4, 0.6, "images")
    assert tables.describe_intervals([of_seeds]) == "lowest and highest of 2 seeds"
    described = tables.describe_intervals([of_images, of_seeds])
    assert described == "95% intervals over images, or lowest and highest of 2 seeds"


def test_a_fraction_of_nothing_is_unknown():
    nothing = fraction(0, 0)
    assert nothing == Proportion(value=None, low=None, high=None, hits=0, n=0)
    assert format_fraction(nothing) == "-"
    assert format_interval(nothing) == "-"


@pytest.mark.parametrize("value", [-5000.0, 999.4, 999.7, -999.7, 0.04321, 1234.5])
def test_a_number_in_a_table_has_three_digits_and_no_exponent(value):
    found = float(tables.as_text(value).replace(",", ""))
    assert found == pytest.approx(value, rel=0.005)
    assert "e" not in tables.as_text(value)


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_any_characters_of_a_name_are_read_again_from_a_csv_file(tmp_path, line_end):
    rows = [["path", "label"], ["Icon\r.png", "a\nb"], ["c\r\nd", 'e,"f"'], ["", "é"]]
    tables.write_csv(tmp_path / "a.csv", rows, line_end)
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as file:
        assert list(csv.reader(file, strict=True)) == rows


def split_cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("| ").split(" | ")]


@pytest.mark.parametrize("width", [45, 60, 80, 300])
def test_a_table_fits_the_terminal_and_every_cell_is_in_its_row_and_column(monkeypatch, width):
    monkeypatch.setattr(sys, "stdout", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(shutil, "get_terminal_size", lambda *_, **__: os.terminal_size((width, 24)))
    metrics = ["auc", "recall", "false positives"]
    networks = ("before", "after")
    table_rows = [[name, *(f"{metric} of {name}" for metric in metrics)] for name in networks]

    text = str(Table("scores", ["network", *metrics], table_rows))

    found = []
    _, *parts = text.split("\n\n")
    for part in parts:
        lines = part.splitlines()
        assert max(map(len, lines)) <= width
        (_, *columns), _, *rows = map(split_cells, lines)
        for network, *cells in rows:
            for column, cell in zip(columns, cells, strict=True):
                assert cell == f"{column} of {network}"
                found.append(cell)
    assert len(found) == 6
