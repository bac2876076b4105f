"""--help, shell completion and the words that start an installed command."""

import inspect
import os
import re
import subprocess
import sys
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from train import settings
from train.audit.audit import AuditSettings
from train.lab.shots import LabSettings
from train.settings import compose, dotted, given_command

ROOT = Path(__file__).parents[3]


def help_of(name: str) -> str:
    """What --help prints, and whatever else the program says, where torch cannot be imported."""
    path = ROOT / ("train/__main__.py" if name == "train" else f"scripts/{name}.py")
    code = (
        "import runpy, sys; sys.modules['torch'] = None; del sys.argv[0]; runpy.run_path(sys.argv[0], None, '__main__')"
    )
    command = [sys.executable, "-c", code, path, "--help"]
    return subprocess.run(command, cwd=ROOT, stdout=-1, stderr=-2, text=True, check=True).stdout


@pytest.mark.parametrize("name", ["train", "attack"])
def test_help_shows_each_setting_with_its_comment_and_the_choices_that_apply(name):
    printed = help_of(name)
    assert f"pnb-{name} " in printed.splitlines()[0] and str(ROOT / "conf" / f"{name}.yaml") in printed
    shown = set(re.findall(r"^  ([\w.]+)=", printed, re.M))
    assert {key for key, _ in dotted(OmegaConf.to_container(compose(name)))} <= shown
    text = (ROOT / "conf" / f"{name}.yaml").read_text().partition("\nhydra:")[0]
    comments = re.findall(r"^ *\w+:.* # (.*)$", text, re.M)
    assert len(comments) > 15 and all(f"  # {comment}\n" in printed for comment in comments)
    assert "\n  renderer.shadows=" in printed and "of a mesh on itself" in printed  # of a group's file
    assert ("experiment=best" in printed, "\n  attack=lighting" in printed) == (name == "train", name == "attack")


@pytest.mark.parametrize("name", ["audit", "compare", "evaluate", "fit", "lab", "light", "publish", "report"])
def test_help_of_a_command_without_a_file_shows_its_settings_with_their_comments(name):
    schemas = {"audit": AuditSettings, "lab": LabSettings}
    schema = schemas.get(name) or import_module(f"scripts.{name}").Settings
    printed = help_of(name)
    assert re.findall(r"^  (\w+)=", printed, re.M) == [field.name for field in fields(schema)]
    comments = re.findall("  # (.*)", inspect.getsource(schema).partition("  def ")[0])
    assert all(comment in printed for comment in comments)
    shown = dict(re.findall(r"^  (\w+)=(.*?)(?:  +#.*)?$", printed, re.M))
    as_given = OmegaConf.to_container(OmegaConf.structured(schema), resolve=False)
    computed = {"out", "meshes", "patterns"}  # out: with the time; the others are named in code
    assert all(yaml.safe_load(text) == as_given[key] for key, text in shown.items() if key not in computed)


@pytest.mark.parametrize(
    ("program", "path", "word", "completed"),
    [
        ("bin/pnb-train", str(ROOT), "experiment=b", "experiment=best"),
        (ROOT / "scripts/attack.py", "", "rel", "reload="),
    ],
    ids=["installed", "clone"],
)
def test_a_shell_completes_a_command_beside_a_train_py_of_the_user(tmp_path, program, path, word, completed):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "pnb-train").write_text("from train.__main__ import start\nstart()")
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
    monkeypatch.setattr(settings, "world_size", lambda: processes)
    assert given_command(["seed=1", "run=a", "train.resume=true"]) == words
