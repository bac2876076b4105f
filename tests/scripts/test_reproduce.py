"""scripts/reproduce.sh starts valid commands alone.

A stub for Python writes its arguments to a file, and makes the folders of the runs of a sweep.
"""

import json
import os
import subprocess
import sys
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


def reproduce(folder: Path, *words: str, **environment: str) -> tuple[int, list[list[str]], str]:
    """Run the script in a folder with the stub in place of Python.

    Return its exit status, the arguments of each call of Python, and what it printed as errors.
    """
    stub = folder / "python"
    stub.write_text(STUB)
    stub.chmod(0o755)
    calls = folder / "calls"
    calls.touch()
    variables = {"PYTHON": str(stub), "RUNS": "runs", "PATH": os.environ["PATH"]}
    command = [ROOT / "scripts" / "reproduce.sh", *words]
    done = subprocess.run(
        command, cwd=folder, env=variables | environment, capture_output=True, text=True
    )
    return done.returncode, [*map(json.loads, calls.read_text().splitlines())], done.stderr


@pytest.mark.parametrize("arguments, environment", [(["gpu"], {}), ([], INPUTS), (["tpu"], INPUTS)])
def test_missing_inputs_are_refused_before_anything_runs(tmp_path, arguments, environment):
    status, calls, errors = reproduce(tmp_path, *arguments, **environment)
    assert (status, calls) == (2, [])
    assert errors.startswith("usage: ")


@pytest.mark.parametrize(
    ("command", "trainings", "tables"),
    [
        ("cpu", ["cpu"], ["cpu"]),
        ("gpu", ["paper", "fast"], ["paper", "fast"]),
        ("harden", ["harden"] * 2, ["harden"]),
        ("patterns", ["patterns"] * 5, ["patterns"]),
    ],
)
def test_every_training_has_valid_settings_and_tables_compare_all_runs_of_an_experiment(
    tmp_path, command, trainings, tables
):
    status, calls, errors = reproduce(tmp_path, command, "train.checkpoint_every=5", **INPUTS)
    assert (status, errors) == (0, "")
    started = [call for call in calls if call[:3] == ["-m", "train", "--multirun"]]
    assert [call[3] for call in started] == [f"experiment={name}" for name in trainings]
    for call in started:
        settings = train_command.read([first_of_sweep(word) for word in call[3:]])
        assert settings.data.path == "cifar100.npz"
        assert settings.train.checkpoint_every == 5
        assert settings.meshes == ["a.glb", {"mesh": "b.glb", "albedo_scale": 3.0}]
        is_from_network = command in ("harden", "patterns")
        folders = ["photographs", "laboratory"] if is_from_network else ["photographs"]
        assert [*settings.scored_folders] == folders
    compared = [call for call in calls if call[:2] == ["-m", "scripts.compare"]]
    for call, experiment in zip(compared, tables, strict=True):
        runs = [f"runs/{experiment}/augment-none+seed-{seed}" for seed in (0, 1)]
        assert call[2] == f"runs=[{','.join(runs)}]"


def first_of_sweep(word: str) -> str:
    swept = ("seed=", "augment=", "train.augmentation=")
    return word.split(",")[0] if word.startswith(swept) else word
