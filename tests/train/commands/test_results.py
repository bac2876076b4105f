"""No command replaces results, its own or another's, unless `overwrite=true` says so."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import renderer
from train.commands.results import require_new_run, require_replaceable
from train.networks import WideResNet, describe
from train.runs.checkpoint import BEST, LAST, save
from train.runs.run_config import write_config

USER_ERROR = 2
CLASSES = ["fig", "lime", "orange"]
NETWORK = ["device=cpu", "precision=float32"]
ORANGE = ["scene.meshes=['solid:orange']", "attack.force=true", "device=cpu", "renderer.shadows=false"]
TRAINING = ["experiment=paper", "data=shapes", "compare=[]", "train.device=cpu"]
COMMANDS = {  # that write to out= or, of a training, to run=
    "attack": ["classifier=run:network", *ORANGE],
    "audit": ["classifier=run:network", "meshes=['solid:orange']", "look_alikes=['solid:lemon']", "device=cpu"],
    "evaluate": ["run=network", "photos=photos", *NETWORK],
    "fit": ["photograph=photos/orange/0.png", "mask=photos/orange/0.png", "mesh=solid:orange"],
    "lab": ["setups=6"],
    "publish": ["run=network"],
    "report": ["network", "photos"],
    "train": TRAINING,
}
HELD: dict[str, Callable[[Path], object]] = {  # by command: what shows its results in a folder
    "train": lambda folder: (folder / LAST).touch(),
    "finished train": lambda folder: (folder / "metrics.jsonl").write_text('{"test/accuracy": 0.5}\n'),
    "attack": lambda folder: write(folder / "0_orange" / "attack.jsonl", "{}\n"),
    "adversary": lambda folder: write(folder / "adversary.json", "{}"),
    "audit": lambda folder: write(folder / "classifier" / "recognized.json", "{}"),
    "evaluate": lambda folder: write(folder / "summary.json", "{}"),
    "report": lambda folder: write(folder / "report.html", "<html>"),
    "lab": lambda folder: write(folder / "photos.csv", "path\n"),
    "publish": lambda folder: (folder / "model.safetensors").touch(),
    "fit": lambda folder: write(folder / "light.json", "{}"),
    "config": lambda folder: write(folder / "config.yaml", "out: out\n"),
}


def write(path: Path, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def here(tmp_path) -> Path:
    """A folder with a network and photographs of its classes."""
    torch.manual_seed(0)
    network = WideResNet(len(CLASSES), 10, 1, 0.0)
    described = describe(network, CLASSES, size=16, encoding="linear", depth=10, width=1, dropout=0.0)
    (tmp_path / "network").mkdir()
    save(tmp_path / "network" / BEST, {"model": network.state_dict(), "architecture": described})
    rng = np.random.default_rng(0)
    for label in ("orange", "fig"):
        (tmp_path / "photos" / label).mkdir(parents=True)
        for number in range(2):
            pixels = rng.integers(0, 256, (16, 16, 3)).astype(np.uint8)
            Image.fromarray(pixels).save(tmp_path / "photos" / label / f"{number}.png")
    return tmp_path


@pytest.mark.parametrize("holder", HELD)
def test_a_folder_with_results_of_any_command_is_refused_and_named(tmp_path, holder):
    HELD[holder](tmp_path)
    with pytest.raises(renderer.InputError, match=r"^out=.*overwrite=true"):
        require_replaceable(tmp_path, "out", overwrite=False)
    with pytest.raises(renderer.InputError, match=r"^run=.*"):
        require_replaceable(tmp_path, "run", overwrite=False)
    require_replaceable(tmp_path, "out", overwrite=True)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("holder", ["evaluate", pytest.param("attack", marks=pytest.mark.slow)])
def test_every_command_refuses_another_commands_folder_and_leaves_it_as_it_is(call, here, capsys, command, holder):
    (here / "out").mkdir()
    HELD[holder](here / "out")
    before = contents(here)
    place = "run=out" if command == "train" else "out=out"
    assert call(command, *COMMANDS[command], place) == USER_ERROR
    printed = capsys.readouterr().err
    [error] = [line for line in printed.splitlines() if line.startswith("error: ")]
    assert place.partition("=")[0] + "=" in error and "out holds" in error and "overwrite=true" in error
    assert contents(here) == before


@pytest.mark.parametrize("command", ["attack", "audit", "evaluate", "publish"])
def test_no_command_writes_into_the_folder_of_a_run(call, here, capsys, command):
    write_config_of_a_run = "train: {}\nrun: network\n"
    (here / "network" / "config.yaml").write_text(write_config_of_a_run)
    before = contents(here / "network")
    assert call(command, *COMMANDS[command], "out=network") == USER_ERROR
    assert "overwrite=true" in capsys.readouterr().err
    assert contents(here / "network") == before


def test_older_scores_are_replaced_by_overwrite_alone(call, here):
    command = "evaluate", *COMMANDS["evaluate"], "out=scores"
    assert call(*command, "label=orange") == 0
    first = contents(here / "scores")
    assert call(*command, "label=fig") == USER_ERROR
    assert contents(here / "scores") == first
    assert call(*command, "label=fig", "overwrite=true") == 0
    assert json.loads((here / "scores" / "summary.json").read_text())["label"] == "fig"


def test_a_map_that_exists_is_replaced_by_overwrite_alone(call, here, capsys):
    (here / "sky.exr").write_bytes(b"mine")
    assert call("light", "light=grace", "height=8", "out=sky.exr") == USER_ERROR
    assert "out=sky.exr" in (error := capsys.readouterr().err) and "overwrite=true" in error
    assert (here / "sky.exr").read_bytes() == b"mine"
    assert call("light", "light=grace", "height=8", "out=sky.exr", "overwrite=true") == 0
    assert renderer.load_light(here / "sky.exr").isfinite().all()


def test_an_attack_over_an_earlier_one_leaves_none_of_its_adversaries(call, here):
    command = (
        "attack",
        *COMMANDS["attack"],
        "attack.max_steps=1",
        "attack.checks=false",
        "attack.verify=null",
        "out=out",
    )
    assert call(*command, "scene.meshes=['solid:orange','solid:orange:1']", "scene.views=2") == 0
    assert len(list((here / "out").glob("*/example_*.png"))) == 4
    assert call(*command) == USER_ERROR
    assert call(*command, "overwrite=true") == 0
    assert len(list((here / "out").glob("*/example_*.png"))) == 1


def test_the_page_of_an_audit_is_not_replaced_by_a_report(call, here, capsys):
    HELD["audit"](here / "network")
    (here / "network" / "report.html").write_text("the audit's")
    assert call("report", "network") == USER_ERROR
    assert "overwrite=true" in capsys.readouterr().err
    assert (here / "network" / "report.html").read_text() == "the audit's"


def test_a_run_that_ended_before_its_first_checkpoint_is_started_again_and_a_finished_one_is_not(tmp_path, tiny):
    write_config(tmp_path, tiny())
    (tmp_path / "metrics.jsonl").write_text('{"epoch": 1, "train/loss": 1.0}\n')
    require_new_run(tmp_path, "run", overwrite=False, resume=False)
    (tmp_path / "metrics.jsonl").write_text('{"epoch": 1, "train/loss": 1.0}\n{"test/accuracy": 0.5}\n')
    for resume in (False, True):
        with pytest.raises(renderer.InputError, match=r"metrics\.jsonl.*overwrite=true"):
            require_new_run(tmp_path, "run", overwrite=False, resume=resume)
    require_new_run(tmp_path, "run", overwrite=True, resume=False)
