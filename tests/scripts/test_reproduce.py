"""scripts/reproduce.sh starts valid commands alone.

A stub takes the place of Python. It writes its arguments to a file, and makes
the folders of the runs of a sweep.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from train.__main__ import main as train_command

ROOT = Path(__file__).parents[2]
INPUTS = {
    "DATA": "cifar100.npz",
    "MESHES": "[a.glb,{mesh:b.glb,albedo_scale:3.0}]",
    "PHOTOS": "photos",
    "LAB": "lab",
}
STUB = f"""#!{sys.executable}
import json, pathlib, sys
with open("calls", "a") as file:
    print(json.dumps(sys.argv[1:]), file=file)
for argument in sys.argv:
    if argument.startswith("sweep="):
        for run in ("augment-none+seed-0", "augment-none+seed-1"):
            pathlib.Path(argument[6:], run).mkdir(parents=True, exist_ok=True)
"""


@dataclass(frozen=True)
class Outcome:
    """What a run of the script did.

    Attributes:
        status: Exit status.
        calls: Arguments of each call of Python.
        errors: What the script printed to standard error.
    """

    status: int
    calls: list[list[str]]
    errors: str


def reproduce(folder: Path, *arguments: str, **environment: str) -> Outcome:
    """Run the script in a folder with the stub in place of Python."""
    stub = folder / "python"
    stub.write_text(STUB)
    stub.chmod(0o755)
    calls = folder / "calls"
    calls.touch()
    variables = {"PYTHON": str(stub), "RUNS": "runs", "PATH": os.environ["PATH"]}
    done = subprocess.run(
        [ROOT / "scripts" / "reproduce.sh", *arguments],
        cwd=folder,
        env=variables | environment,
        capture_output=True,
        text=True,
    )
    lines = calls.read_text().splitlines()
    return Outcome(done.returncode, [json.loads(line) for line in lines], done.stderr)


@pytest.mark.parametrize(
    ("arguments", "environment"), [(["gpu"], {}), ([], INPUTS), (["tpu"], INPUTS)]
)
def test_missing_inputs_are_refused_before_anything_runs(tmp_path, arguments, environment):
    outcome = reproduce(tmp_path, *arguments, **environment)
    assert outcome.status == 2
    assert outcome.calls == []
    assert outcome.errors.startswith("usage: ")


@pytest.mark.parametrize(
    ("command", "trainings"),
    [
        ("cpu", ["cpu"]),
        ("gpu", ["paper", "fast"]),
        ("harden", ["harden"] * 2),
        ("best", ["best"] * 5),
    ],
)
def test_every_training_has_valid_settings(tmp_path, command, trainings):
    outcome = reproduce(tmp_path, command, "train.checkpoint_every=5", **INPUTS)
    assert outcome.errors == ""
    assert outcome.status == 0
    calls = [call for call in outcome.calls if call[:3] == ["-m", "train", "--multirun"]]
    assert [call[3] for call in calls] == [f"experiment={name}" for name in trainings]
    for call in calls:
        settings = train_command.read([first_of_sweep(word) for word in call[3:]])
        assert settings.data.path == "cifar100.npz"
        assert settings.train.checkpoint_every == 5
        assert settings.meshes == ["a.glb", {"mesh": "b.glb", "albedo_scale": 3.0}]
        is_from_network = command in ("harden", "best")
        folders = ["photographs", "laboratory"] if is_from_network else ["photographs"]
        assert [*settings.scored_folders] == folders


def first_of_sweep(word: str) -> str:
    """Return a setting with the first of the values that a sweep gives it."""
    swept = ("seed=", "augment=", "train.augmentation=")
    return word.split(",")[0] if word.startswith(swept) else word


@pytest.mark.parametrize(("command", "device"), [("cpu", "cpu"), ("gpu", "cuda")])
def test_the_training_speed_is_measured_first(tmp_path, command, device):
    first_call = reproduce(tmp_path, command, **INPUTS).calls[0]
    assert first_call[:3] == ["-m", "benchmarks.training", "speed"]
    options = dict(zip(first_call[3::2], first_call[4::2], strict=True))
    assert options["--data"] == "cifar100.npz"
    assert options["--device"] == device


@pytest.mark.parametrize(
    ("command", "tables"),
    [
        ("cpu", [("cpu", "photographs")]),
        ("gpu", [("paper", "photographs"), ("fast", "photographs")]),
        ("harden", [("harden", "laboratory"), ("harden", "photographs")]),
        ("best", [("best", "laboratory"), ("best", "photographs")]),
    ],
)
def test_the_tables_compare_all_runs_of_an_experiment(tmp_path, command, tables):
    outcome = reproduce(tmp_path, command, **INPUTS)
    calls = [call for call in outcome.calls if call[:3] == ["-m", "scripts", "compare"]]
    for call, (experiment, images) in zip(calls, tables, strict=True):
        runs = [f"runs/{experiment}/augment-none+seed-{seed}" for seed in (0, 1)]
        assert call[3] == f"runs=[{','.join(runs)}]"
        assert call[4] == f"photos={images}"
