"""The examples in docstrings of public functions run and print what they say."""

import doctest
import importlib
from types import FunctionType

import pytest
import torch
from torch import Tensor

import augment

PUBLIC = {name: getattr(augment, name) for name in augment.__all__}
FUNCTIONS = [name for name, value in PUBLIC.items() if isinstance(value, FunctionType)]


def logits(images: Tensor) -> Tensor:
    mean = images.mean((1, 2, 3))
    return torch.stack([mean, 0.3 + 0 * mean], dim=1)


@pytest.fixture(scope="module")
def result() -> augment.AttackResult:
    """As in the example of `augment.attack`."""
    classifier = augment.Classifier(logits, size=8, classes=["orange", "other"])
    scene = augment.build_scene([("solid:orange", "orange")], classifier.size)
    settings = augment.AttackSettings(lighting=augment.StepSettings(step_size=0.5), max_steps=20)
    return augment.attack(classifier, scene, settings=settings)


@pytest.mark.parametrize("module", sorted({value.__module__ for value in PUBLIC.values()}))
def test_examples_run(module, result):
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    names = {"augment": augment, "torch": torch, "nn": torch.nn, "result": result}
    failures, _ = doctest.testmod(importlib.import_module(module), extraglobs=names, optionflags=flags)
    assert not failures


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name != "attack"])
def test_every_public_function_has_an_example(name):
    assert ">>>" in PUBLIC[name].__doc__
