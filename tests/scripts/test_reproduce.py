"""scripts/reproduce.sh, with a stub in place of Python."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import training
from train.settings import ExperimentSettings, compose, read_settings

ROOT = Path(__file__).parents[2]


STUB = """#!{python}
import json, os, pathlib, sys
with open(os.environ["CALLS"], "a") as file:
    print(json.dumps(sys.argv[1:]), file=file)
for argument in sys.argv:
    if argument.startswith("sweep="):
        for cell in ("augment-none+seed-0", "augment-none+seed-1"):
            (pathlib.Path(argument[6:]) / cell).mkdir(parents=True, exist_ok=True)
"""


def reproduce(tmp_path: Path, *arguments: str, **environment: str) -> tuple[int, list[list[str]], str]:
    """(exit status, arguments of each call of Python, errors printed) of a run that calls a stub."""
    stub, calls = tmp_path / "python", tmp_path / "calls"
    stub.write_text(STUB.format(python=sys.executable))
    stub.chmod(0o755)
    variables = {"PYTHON": str(stub), "CALLS": str(calls), "DOCS": str(tmp_path), "RUNS": "runs"}
    variables |= {"PATH": os.environ["PATH"], **environment}
    done = subprocess.run(
        [ROOT / "scripts" / "reproduce.sh", *arguments], cwd=tmp_path, env=variables, capture_output=True
    )
    lines = calls.read_text().splitlines() if calls.exists() else []
    return done.returncode, [json.loads(line) for line in lines], done.stderr.decode()


INPUTS = {"DATA": "cifar100.npz", "MESHES": "[a.glb,{mesh:b.glb,albedo_scale:3.0}]", "PHOTOS": "photos"}


@pytest.mark.parametrize(("arguments", "environment"), [(["gpu"], {}), ([], INPUTS), (["tpu"], INPUTS)])
def test_missing_inputs_are_refused_before_anything_runs(tmp_path, arguments, environment):
    status, calls, error = reproduce(tmp_path, *arguments, **environment)
    assert (status, calls) == (2, []) and error.startswith("usage: ")


@pytest.mark.parametrize(("machine", "experiments"), [("cpu", ["cpu"]), ("gpu", ["paper", "fast"])])
def test_reproducing_measures_then_trains_and_compares_each_experiment(tmp_path, machine, experiments):
    status, (benchmark, *calls), error = reproduce(tmp_path, machine, "train.checkpoint_every=5", **INPUTS)
    assert (status, error) == (0, "")
    assert benchmark[:3] == ["-m", "benchmarks.training", "speed"]
    options = training.parser().parse_args(benchmark[2:])
    assert (options.csv, options.data) == (tmp_path / "training_speed.csv", Path("cifar100.npz"))
    assert (options.meshes, options.device) == (INPUTS["MESHES"], {"cpu": "cpu", "gpu": "cuda"}[machine])

    for experiment, train, compare in zip(experiments, calls[::2], calls[1::2], strict=True):
        assert train[:4] == ["-m", "train", "--multirun", f"experiment={experiment}"]
        assert train[4:6] == ["augment=none,random,adversarial", "seed=0,1,2,3,4"]
        assert train[-2:] == [f"sweep=runs/{experiment}", "train.checkpoint_every=5"]
        for arm in ("none", "random", "adversarial"):
            overrides = [train[3], f"augment={arm}", "seed=4", *train[6:]]
            run = read_settings(ExperimentSettings, compose("train", overrides))
            assert (run.augment.arm, run.seed, run.data.path, run.evaluate.photos) == (arm, 4, "cifar100.npz", "photos")
            assert run.scene.meshes == ["a.glb", {"mesh": "b.glb", "albedo_scale": 3.0}]
        assert compare[0] == "scripts/compare_runs.py"
        folders = [f"runs/{experiment}/augment-none+seed-{seed}" for seed in (0, 1)]
        assert compare[1:] == [f"runs=[{','.join(folders)}]", "photographs=photographs", "exclude=[]"]
        assert (tmp_path / f"runs_{experiment}.md").read_text().startswith(f"# experiment={experiment}\n")


@pytest.mark.parametrize(("experiment", "trainings"), [("harden", 4), ("best", 1)])
def test_fine_tuned_networks_are_valid_runs_that_end_in_a_page_of_both_folders(tmp_path, experiment, trainings):
    status, calls, error = reproduce(tmp_path, experiment, "train.checkpoint_every=5", LAB="lab", **INPUTS)
    assert (status, error, len(calls)) == (0, "", trainings + 2)
    for train in calls[:trainings]:
        assert train[:4] == ["-m", "train", "--multirun", f"experiment={experiment}"] and "seed=0,1,2" in train
        swept = ("seed=", "augment=", "train.augmentation=")
        overrides = [word.split(",")[0] if word.startswith(swept) else word for word in train[3:]]
        run = read_settings(ExperimentSettings, compose("train", overrides))
        assert run.train.init_from == "pretrained/none" and run.train.checkpoint_every == 5
        assert run.evaluate.photos == {"photographs": "photos", "laboratory": "lab"}
    assert [call[2] for call in calls[trainings:]] == ["photographs=laboratory", "photographs=photographs"]
    assert (tmp_path / f"runs_{experiment}.md").read_text().startswith(f"# experiment={experiment}\n")
