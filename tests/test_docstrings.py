"""The examples in docstrings of public functions run and print what they say."""

import doctest
import importlib
from types import FunctionType, ModuleType

import pytest
import torch
from torch import Tensor

import augment
import norm_balls
import renderer

PUBLIC = {}
for package in (renderer, augment):
    for name in package.__all__:
        PUBLIC[f"{package.__name__}.{name}"] = getattr(package, name)


def module_of(value: object) -> str:
    """Return the name of a module, or of the module that defines a function or a class."""
    return value.__name__ if isinstance(value, ModuleType) else value.__module__


MODULES = {module_of(value) for value in PUBLIC.values()}
FUNCTIONS = [name for name, value in PUBLIC.items() if isinstance(value, FunctionType)]


def logits(images: Tensor) -> Tensor:
    mean = images.mean((1, 2, 3))
    return torch.stack([mean, 0.3 + 0 * mean], dim=1)


@pytest.fixture(scope="module")
def result() -> augment.AttackResult:
    """Define what the example of `augment.attack` defines."""
    classifier = augment.Classifier(logits, size=8, classes=["orange", "other"])
    scene = augment.build_scene([("solid:orange", "orange")], classifier.size)
    light = augment.StepSettings(step_size=0.5)
    settings = augment.AttackSettings(lighting=light, max_steps=20, allow_negative=True)
    return augment.attack(classifier, scene, settings=settings)


@pytest.mark.parametrize("module", sorted(MODULES))
def test_examples_run(module, result, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    names = {
        "nb": norm_balls,
        "augment": augment,
        "renderer": renderer,
        "torch": torch,
        "nn": torch.nn,
        "result": result,
    }
    failures, _ = doctest.testmod(
        importlib.import_module(module),
        extraglobs=names,
        optionflags=flags,
    )
    assert not failures


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name != "augment.attack"])
def test_every_public_function_has_an_example(name):
    assert ">>>" in PUBLIC[name].__doc__
