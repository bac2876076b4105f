"""The validation split and the test split share nothing, and evaluations are logged."""

import csv
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from benchmarks import splits
from tests.helpers import save_noise

TRAINING = {
    *("stripes", "checkers", "spots", "half", "solid", "grace", "eucalyptus", "st_peters"),
    *splits.TRAINED,
}


def names_of(split: str) -> set[str]:
    """Return the meshes, patterns and maps of a split, except for those of objects of training."""
    maps = {name: f"{name}.npy" for name in (*splits.VALIDATION_MAPS, "night")}
    files = {name: name for name in (*splits.OUTSIDE, *splits.TRAINED)}
    parts = splits.validation_parts(maps) | splits.test_parts(maps, files, ["a.png"])
    names = set()
    for name, part in parts.items():
        if name.startswith(split) and not name.endswith("seen_objects"):
            names |= {item["mesh"] if isinstance(item, dict) else item for item in part["meshes"]}
            names |= {*part["patterns"], *part.get("environments", [])}
    return names


def test_the_splits_share_no_object_and_no_light_with_each_other_or_the_training():
    names = [TRAINING, names_of("validation"), names_of("test")]
    assert min(map(len, names)) >= 10
    assert len(set.union(*names)) == sum(map(len, names))


@pytest.fixture
def photographs(tmp_path) -> dict[str, Path]:
    """Divide 16 photographs of two sources, and of one that is left out, between the splits."""
    rng = np.random.default_rng(0)
    rows = [["path", "class", "source_tag"]]
    for number in range(16):
        label = ("orange", "apple")[number % 2]
        source = splits.EXCLUDED_SOURCES[0] if number == 15 else f"tag{number // 8}"
        rows.append([f"{label}/{number}.png", label, source])
        save_noise(tmp_path / "photos" / rows[-1][0], rng, (8, 8))
    with (tmp_path / "photos" / splits.TABLE).open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    splits.divide_photographs(tmp_path / "photos", tmp_path / "splits")
    return {name: tmp_path / "splits" / name / "photographs" for name in ("validation", "test")}


def test_the_splits_share_no_photograph(photographs):
    names = [{path.name for path in folder.glob("*/*.png")} for folder in photographs.values()]
    assert names[0].isdisjoint(names[1])
    assert len(names[0] | names[1]) == 15


def test_evaluations_on_the_test_split_are_logged_first(photographs, tmp_path, monkeypatch, capsys):
    log = tmp_path / "log.csv"
    log.write_text("date,commit,table,network,weights,parts,images\n")
    monkeypatch.setattr(splits, "LOG", log)
    method = SimpleNamespace(networks={"a run": torch.nn.Linear(2, 2)})
    monkeypatch.setattr(splits.Method, "load", lambda *_: method)
    monkeypatch.setattr(splits, "evaluate_method", Mock(side_effect=ZeroDivisionError))
    words = ["a run", "--splits", str(tmp_path / "splits"), "--table", "mine"]
    for command, logged_count in (("validate", 0), ("test", 1), ("test", 2)):
        with pytest.raises(ZeroDivisionError):
            splits.main([command, *words])
        rows = [*csv.DictReader(log.read_text().splitlines())]
        assert [row["network"] for row in rows] == logged_count * ["a run"]
        was_told = "was evaluated for 'mine' before" in capsys.readouterr().out
        assert was_told == (logged_count == 2)
