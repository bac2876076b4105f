import json
from pathlib import Path

import numpy as np
import pytest

import renderer
from tests.helpers import save_noise
from tests.train.helpers import save_untrained_network
from train.cli import USER_ERROR
from train.results.overwrite import require_new_run, require_replaceable
from train.run_config import write_config
from train.run_folder import LAST

# Arguments of each command except for out=.
COMMANDS = {
    "attack": [
        *("network=run:network", "meshes=['solid:orange']", "attack.force=true", "device=cpu"),
        "renderer.shadows=false",
    ],
    "audit": [
        "network=run:network",
        "meshes=['solid:orange']",
        "hard_negatives=['solid:lemon']",
        "device=cpu",
    ],
    "evaluate": ["run=network", "photos=photos", "device=cpu", "precision=float32"],
    "fit": ["photograph=photos/orange/0.png", "mask=photos/orange/0.png", "mesh=solid:orange"],
    "lab": ["setups=6"],
    "report": ["runs=[network,photos]"],
    "train": ["experiment=paper", "data=shapes", "compare=[]", "train.device=cpu"],
}

# The file by which the results of a command are recognized, and its content.
RESULTS = {
    "train": (LAST, ""),
    "finished train": ("metrics.jsonl", '{"test/accuracy": 0.5}\n'),
    "attack": ("0_orange/attack.jsonl", "{}\n"),
    "adversary": ("adversary.json", "{}"),
    "audit": ("classifier/recognized.json", "{}"),
    "evaluate": ("summary.json", "{}"),
    "report": ("report.html", "<html>"),
    "lab": ("photos.csv", "path\n"),
    "publish": ("model.safetensors", ""),
    "fit": ("light.json", "{}"),
    "config": ("config.yaml", "out: out\n"),
}


def write_results(folder: Path, command: str) -> None:
    name, content = RESULTS[command]
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(content)


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture
def here(tmp_path) -> Path:
    save_untrained_network(tmp_path / "network", size=16)
    rng = np.random.default_rng(0)
    for label in ("orange", "fig"):
        for number in range(2):
            save_noise(tmp_path / "photos" / label / f"{number}.png", rng, (16, 16))
    return tmp_path


@pytest.mark.parametrize("command", RESULTS)
def test_a_folder_with_results_of_any_command_is_refused_by_its_argument(tmp_path, command):
    write_results(tmp_path, command)
    with pytest.raises(renderer.InputError, match=r"^out=.*overwrite=true"):
        require_replaceable(tmp_path, "out", overwrite=False)
    require_replaceable(tmp_path, "out", overwrite=True)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_and_leaves_the_folder_of_another(call, here, capsys, command):
    write_results(here / "out", "evaluate")
    before = contents(here)
    assert call(command, *COMMANDS[command], "out=out") == USER_ERROR
    lines = capsys.readouterr().err.splitlines()
    (error,) = [line for line in lines if line.startswith("error: ")]
    assert "out=" in error
    assert "overwrite=true" in error
    assert contents(here) == before


def test_older_scores_are_replaced_by_overwrite(call, here, monkeypatch):
    monkeypatch.setattr("train.results.scoring.write_roc", lambda *_: None)
    write_results(here / "out", "evaluate")
    assert call("evaluate", *COMMANDS["evaluate"], "label=fig", "out=out", "overwrite=true") == 0
    assert json.loads((here / "out" / "summary.json").read_text())["label"] == "fig"


@pytest.mark.slow
def test_an_attack_over_an_earlier_one_leaves_none_of_its_adversaries(call, here):
    fast = ["attack.max_steps=1", "attack.checks=false", "attack.verify=null"]
    command = ["attack", *COMMANDS["attack"], *fast, "out=out"]
    assert call(*command, "scene.views=2") == 0
    assert len(list((here / "out").glob("*/example_*.png"))) == 2
    assert call(*command) == USER_ERROR
    assert call(*command, "overwrite=true") == 0
    assert len(list((here / "out").glob("*/example_*.png"))) == 1


EPOCH_LINE = '{"epoch": 1, "train/loss": 1.0}\n'


def test_a_run_that_ended_before_its_first_checkpoint_is_started_again(tmp_path, tiny):
    write_config(tmp_path, tiny())
    (tmp_path / "metrics.jsonl").write_text(EPOCH_LINE)
    require_new_run(tmp_path, "out", overwrite=False, resume=False)


@pytest.mark.parametrize("resume", [False, True])
def test_a_finished_run_is_replaced_by_overwrite_alone(tmp_path, tiny, resume):
    write_config(tmp_path, tiny())
    (tmp_path / "metrics.jsonl").write_text(EPOCH_LINE + '{"test/accuracy": 0.5}\n')
    with pytest.raises(renderer.InputError, match=r"metrics\.jsonl.*overwrite=true"):
        require_new_run(tmp_path, "out", overwrite=False, resume=resume)
    require_new_run(tmp_path, "out", overwrite=True, resume=False)
