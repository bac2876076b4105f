"""scripts/reproduce.sh, with a stub in place of Python: every command that it starts is a valid one."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from train.__main__ import main as train_command

ROOT = Path(__file__).parents[2]
INPUTS = {"DATA": "cifar100.npz", "MESHES": "[a.glb,{mesh:b.glb,albedo_scale:3.0}]", "PHOTOS": "photos", "LAB": "lab"}
STUB = f"""#!{sys.executable}
import json, os, pathlib, sys
with open("calls", "a") as file:
    print(json.dumps(sys.argv[1:]), file=file)
for argument in sys.argv:
    if argument.startswith("sweep="):
        for run in ("augment-none+seed-0", "augment-none+seed-1"):
            pathlib.Path(argument[6:], run).mkdir(parents=True, exist_ok=True)
"""


def reproduce(folder: Path, *arguments: str, **environment: str) -> tuple[int, list[list[str]], str]:
    """(exit status, arguments of each call of Python, errors printed)."""
    (folder / "python").write_text(STUB)
    (folder / "python").chmod(0o755)
    (folder / "calls").touch()
    variables = {"PYTHON": str(folder / "python"), "RUNS": "runs", "PATH": os.environ["PATH"], **environment}
    command = [ROOT / "scripts" / "reproduce.sh", *arguments]
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True)
    return done.returncode, [*map(json.loads, (folder / "calls").read_text().splitlines())], done.stderr


@pytest.mark.parametrize(("arguments", "environment"), [(["gpu"], {}), ([], INPUTS), (["tpu"], INPUTS)])
def test_missing_inputs_are_refused_before_anything_runs(tmp_path, arguments, environment):
    status, calls, error = reproduce(tmp_path, *arguments, **environment)
    assert (status, calls) == (2, []) and error.startswith("usage: ")


@pytest.mark.parametrize(
    ("command", "trainings", "scores"),
    [
        ("cpu", ["cpu"], ["photographs"]),
        ("gpu", ["paper", "fast"], ["photographs", "photographs"]),
        ("harden", ["harden"] * 2, ["laboratory", "photographs"]),
        ("best", ["best"] * 5, ["laboratory", "photographs"]),
    ],
)
def test_every_training_is_valid_and_ends_in_tables_of_all_its_runs(tmp_path, command, trainings, scores):
    status, calls, error = reproduce(tmp_path, command, "train.checkpoint_every=5", **INPUTS)
    assert (status, error) == (0, "")
    if command in ("cpu", "gpu"):
        benchmark, *calls = calls
        assert benchmark[:3] == ["-m", "benchmarks.training", "speed"]
        given = dict(zip(benchmark[3::2], benchmark[4::2], strict=True))
        assert (given["--data"], given["--device"]) == ("cifar100.npz", {"cpu": "cpu", "gpu": "cuda"}[command])
    trained = [call for call in calls if call[:3] == ["-m", "train", "--multirun"]]
    assert [call[3] for call in trained] == [f"experiment={experiment}" for experiment in trainings]
    for call in trained:
        swept = ("seed=", "augment=", "train.augmentation=")
        overrides = [word.split(",")[0] if word.startswith(swept) else word for word in call[3:]]
        run = train_command.read(overrides)
        assert (run.data.path, run.train.checkpoint_every) == ("cifar100.npz", 5)
        assert run.scene.meshes == ["a.glb", {"mesh": "b.glb", "albedo_scale": 3.0}]
        assert [*run.evaluate.folders] == sorted({*scores, "photographs"}, reverse=True)
    compared = [call for call in calls if call[:2] == ["-m", "scripts.compare"]]
    assert [call[3] for call in compared] == [f"photographs={name}" for name in scores]
    for call in compared:
        assert re.fullmatch(r"runs=\[runs/(\w+)/augment-none\+seed-0,runs/\1/augment-none\+seed-1\]", call[2])
