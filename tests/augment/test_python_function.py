import textwrap
from pathlib import Path

import pytest
import torch

from augment.classifiers import load_classifier
from renderer.errors import InputError

SOURCE = """
from torch import nn

def red_or_not():
    return nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(3, 2)), 16, ["red", "other"]

def one(): return 3
def no_module(): return "a", 16, ["red"]
def no_size(): return nn.Identity(), "16", ["red"]
def classes_without_order(): return nn.Identity(), 16, {"red", "blue"}
def huge(): return nn.Identity(), 10**9, ["red"]
def leaves(): raise SystemExit(0)
def broken(): return 1 / 0
"""


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    (tmp_path / "own_networks").mkdir()
    (tmp_path / "own_networks" / "__init__.py").touch()
    (tmp_path / "own_networks" / "color.py").write_text(textwrap.dedent(SOURCE))
    (tmp_path / "own_networks" / "broken.py").write_text("import a_library_that_is_not_there")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # and taken off again, with what was imported from there
    return tmp_path


def test_a_function_in_the_current_folder_makes_a_classifier():
    classifier = load_classifier("python:own_networks.color:red_or_not")
    assert (classifier.size, classifier.classes) == (16, ("red", "other"))
    assert classifier(torch.rand(2, 3, 16, 16)).shape == (2, 2)
    assert classifier.name == "python:own_networks.color:red_or_not" and not classifier.training


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("own_networks.color", "names no function: give python:package.module:function"),
        ("own_networks.shape:f", "there is no module own_networks.shape in the current folder or installed"),
        ("own_networks.color:blue", "own_networks.color has no function blue"),
        ("own_networks.color:one", r"returns int: return \(module, size, classes\)"),
        ("own_networks.color:no_module", "returns str first: return a torch.nn.Module"),
        ("own_networks.color:no_size", "returns the size '16'"),
        ("own_networks.color:classes_without_order", "returns no list of class names"),
        ("own_networks.color:huge", ": size=1000000000 must be at least 1 and at most 4096"),
        ("own_networks.color:leaves", r"raises SystemExit \(0\) in line \d+ of .*color.py: fix it"),
        (
            "own_networks.color:broken",
            r"raises ZeroDivisionError \(division by zero\) in line \d+ of .*color.py",
        ),
        ("own_networks.broken:f", r"raises ModuleNotFoundError \(No module named 'a_library_that_is_not_there'\)"),
    ],
)
def test_what_makes_no_classifier_is_refused_in_one_sentence(name, message):
    with pytest.raises(InputError, match=f"^classifier=python:{name}.*{message}"):
        load_classifier(f"python:{name}")


def test_weights_of_a_file_are_refused():
    with pytest.raises(InputError, match=r"weights=w\.pt is not for classifier=python:"):
        load_classifier("python:own_networks.color:red_or_not", "w.pt")
