"""--help, shell completion and the words that start an installed command."""

import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from augment.settings import NormalizedLightSettings
from renderer.settings import facts_of
from scripts.attack import main as attack
from scripts.render import main as render
from train.__main__ import main as train
from train.cli import USER_ERROR
from train.run_config import format_command
from train.settings import NetworkSettings, dotted

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("command", [train, attack], ids=["train", "attack"])
def test_help_shows_each_setting(command):
    shown = {line.strip().partition("=")[0] for line in command.format_help().splitlines()}
    assert {key for key, _ in dotted(OmegaConf.to_container(command.compose()))} <= shown


@pytest.mark.parametrize("command", [train, attack, render], ids=["train", "attack", "render"])
def test_help_without_choices_shows_the_values_that_hydra_composes(command):
    assert command.format_help() == command.format_help(["seed=0"])


def test_help_names_each_field_of_normalize_light():
    [named] = re.findall("{(.*)}", facts_of(NetworkSettings, "normalize_light").about)
    assert {*named.split(", ")} == {field.name for field in fields(NormalizedLightSettings)}


def start_without_torch(*words: str) -> subprocess.CompletedProcess:
    """Start pnb-train in a process in which torch and numpy cannot be imported."""
    code = (
        "import runpy, sys; sys.modules['torch'] = sys.modules['numpy'] = None; "
        "runpy.run_module('train', run_name='__main__')"
    )
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_help_shows_the_values_that_the_given_choices_have_where_torch_cannot_be_imported():
    assert "  train.epochs=8 " in start_without_torch("--help", "experiment=cpu").stdout


@pytest.mark.parametrize(
    "words", [["train.epohcs=3"], ["--multirun", "train.epohcs=1,2"], ["-m", "seed=1,2", "sedd=1"]]
)
def test_a_mistyped_key_is_named_where_torch_cannot_be_imported(words):
    done = start_without_torch(*words)
    assert done.returncode == USER_ERROR
    assert f"error: {words[-1].partition('=')[0]} is not a setting" in done.stderr


def test_a_shell_completes_a_command_beside_a_train_py_of_the_user(tmp_path):
    program = tmp_path / "bin" / "pnb-train"
    program.parent.mkdir()
    program.write_text("from train.__main__ import main\nmain()")
    (tmp_path / "train.py").write_text("raise SystemExit('not this')")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COMP_LINE": f"{program} experiment=b"}
    command = [sys.executable, program, "-sc", "query=bash"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("experiment=best\n", "")


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
