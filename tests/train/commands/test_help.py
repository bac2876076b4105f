"""--help, shell completion and the words that start an installed command."""

import os
import subprocess
import sys
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from renderer.settings import facts_of, field_types
from train.cli import Command
from train.run_config import format_command
from train.settings import dotted

ROOT = Path(__file__).parents[3]
NAMES = ("train", "attack", "audit", "compare", "evaluate", "fit", "lab", "report")


def help_of(name: str, *arguments: str) -> str:
    """Run --help where torch cannot be imported, and return everything that is printed."""
    module = "train" if name == "train" else f"scripts.{name}"
    code = (
        "import runpy, sys; sys.modules['torch'] = sys.modules['numpy'] = None; "
        f"runpy.run_module({module!r}, run_name='__main__')"
    )
    command = [sys.executable, "-c", code, "--help", *arguments]
    return subprocess.run(command, cwd=ROOT, stdout=-1, stderr=-2, text=True, check=True).stdout


def command_of(name: str) -> Command:
    return import_module("train.__main__" if name == "train" else f"scripts.{name}").main


def facts_below(kind: type) -> list[tuple[type, str]]:
    """List the class and the name of each field of a settings class, and of nested classes."""
    found = []
    for name, hint in field_types(kind).items():
        found.append((kind, name))
        if is_dataclass(hint):
            found += facts_below(hint)
    return found


@pytest.mark.parametrize("name", NAMES)
def test_help_shows_each_setting_with_its_value_and_explanation(name):
    command = command_of(name)
    printed = help_of(name) if name in ("train", "attack", "report") else command.format_help()
    words = " ".join(printed.split())
    for kind, field in facts_below(command.kind):
        assert " ".join(facts_of(kind, field).about.split()) in words, field
    if name in ("train", "attack"):
        shown = {line.strip().partition("=")[0] for line in printed.splitlines() if "=" in line}
        assert {key for key, _ in dotted(OmegaConf.to_container(command.compose()))} <= shown
    assert f"pnb-{name}" in printed
    choices = {"train": "experiment=best", "attack": "attack=lighting"}
    assert choices.get(name, "") in printed


@pytest.mark.parametrize("name", NAMES)
def test_help_shows_the_settings_that_the_command_would_run_with(name):
    command = command_of(name)
    assert command.format_help() == command.format_help(["hydra.job.name=x"])


def test_help_shows_the_values_that_the_given_choices_have():
    assert "  train.epochs=8 " in help_of("train", "experiment=cpu")


@pytest.mark.parametrize(
    ("program", "path", "word", "completed"),
    [("bin/pnb-train", str(ROOT), "experiment=b", "experiment=best")],
    ids=["installed"],
)
def test_a_shell_completes_a_command_beside_a_train_py_of_the_user(
    tmp_path, program, path, word, completed
):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "pnb-train").write_text("from train.__main__ import main\nmain()")
    (tmp_path / "train.py").write_text("raise SystemExit('not this')")
    environment = os.environ | {"PYTHONPATH": path, "COMP_LINE": f"{program} {word}"}
    command = [sys.executable, tmp_path / program, "-sc", "query=bash"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == (f"{completed}\n", "")


@pytest.mark.parametrize(
    ("started", "processes", "words"),
    [
        ("/bin/pnb-train", 1, "pnb-train seed=1"),
        ("/bin/pnb-train", 2, "torchrun --nproc_per_node=2 --no-python pnb-train seed=1"),
        ("/clone/train/__main__.py", 1, "python -m train seed=1"),
        ("/clone/train/__main__.py", 2, "torchrun --nproc_per_node=2 -m train seed=1"),
    ],
)
def test_the_command_of_a_run_starts_as_the_run_did(monkeypatch, started, processes, words):
    monkeypatch.setattr(sys, "argv", [started])
    monkeypatch.setenv("WORLD_SIZE", str(processes))
    assert format_command(["seed=1", "out=a", "train.resume=true"]) == words
