"""The examples in docstrings run and print what they say. Those of public names use `nb`."""

import doctest
import importlib
from pathlib import Path
from types import FunctionType, ModuleType

import pytest
import torch
from torch import Tensor

import norm_balls as nb

ROOT = Path(__file__).parents[1]
PACKAGES = ("renderer", "augment", "train")
FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
PUBLIC = {name: getattr(nb, name) for name in nb.__all__}


def modules_with_examples() -> list[str]:
    names = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if ">>>" in path.read_text(encoding="utf-8"):
                parts = path.relative_to(ROOT).with_suffix("").parts
                names.append(".".join(parts).removesuffix(".__init__"))
    return names


def is_public(module: ModuleType, name: str) -> bool:
    """Tell whether `norm_balls` exports a module, or a name of it such as "Mesh.plain"."""
    exported = list(PUBLIC.values())
    if any(value is module for value in exported):
        return True
    defined = getattr(module, name.split(".")[0], None)
    return any(value is defined for value in exported)


def logits(images: Tensor) -> Tensor:
    mean = images.mean((1, 2, 3))
    return torch.stack([mean, 0.3 + 0 * mean], dim=1)


@pytest.fixture(scope="module")
def result() -> nb.AttackResult:
    """Define what the example of `nb.attack` defines."""
    classifier = nb.Classifier(logits, size=8, classes=["orange", "other"])
    scene = nb.build_scene([("solid:orange", "orange")], classifier.size)
    light = nb.StepSettings(step_size=0.5)
    settings = nb.AttackSettings(lighting=light, max_steps=20, allow_negative=True)
    return nb.attack(classifier, scene, settings=settings)


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_run(name, result, tmp_path, monkeypatch):
    """Examples of public names run without the names of their module, as those of a user do."""
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(name)
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    for test in doctest.DocTestFinder(exclude_empty=True).find(module):
        if test.examples and is_public(module, test.name.removeprefix(f"{name}.")):
            assert "import norm_balls as nb\n" in [example.source for example in test.examples]
            test.globs = {"result": result}
        runner.run(test)
    assert runner.summarize().failed == 0


def test_every_public_function_has_an_example():
    functions = {name: value for name, value in PUBLIC.items() if isinstance(value, FunctionType)}
    assert [name for name, value in functions.items() if ">>>" not in value.__doc__] == []
