import csv
import json
import shlex
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

import norm_balls as nb
from augment.classifier import as_network
from renderer.visibility import choose
from tests.helpers import find_red
from train.checkpoints import load_chosen
from train.command_settings import AttackExperimentSettings
from train.commands.attack import WITHOUT_NOISE, format_reloaded, load_targets, write_transfers

PRETRAINED = Path(__file__).parents[3] / "pretrained"
SMALL = [
    *(f"network=run:{PRETRAINED / 'none'}", "attack.force=true", "attack.max_steps=2"),
    *("attack.allow_negative=true", "device=cpu", "renderer.rasterizer=numpy"),
    "renderer.shadows=false",
]
WITHOUT_CHECKS = ["attack.checks=false", "attack.verify=null"]
FOLDER_OF_ORANGE = "0_solid_orange_0"


@pytest.fixture
def run(call) -> Callable[..., int]:
    return partial(call, "attack", "out=out", *SMALL)


def read_lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


ADVERSARY_FILES = {
    *("adversary.json", "mesh.glb", "light.json", "light_before.json", "before_0.png"),
    *("after_0.png", "before.npy", "after.npy", "pixels.npy"),
    *("mitsuba/scene.xml", "mitsuba/part_0.ply", "mitsuba/light.exr"),
}


def test_an_attack_prints_its_parameters_writes_files_and_records_settings(run, tmp_path, capsys):
    names = ["skylight", "geometry", "albedo", "pixels"]
    attacked = f"attack=[{','.join(names)}]"
    assert run(attacked) == 0
    start = f"solid:orange:0: {'+'.join(names)} against run:"
    assert capsys.readouterr().out.startswith(start)
    config = OmegaConf.load(tmp_path / "out" / "config.yaml")
    assert set(config.attack) >= set(names)
    arguments = ["out=out", *SMALL, attacked]
    assert config.command == shlex.join(["python", "-m", "scripts.attack", *arguments])

    folder = tmp_path / "out" / FOLDER_OF_ORANGE
    example, summary = read_lines(folder / "attack.jsonl")
    assert list(example["largest_change"]) == names
    assert all(example["largest_change"].values())
    assert example["cost"] < example["cost_before"]
    assert example["versions"]["reload"]["largest_difference"] <= 1 / 255
    assert 0 <= summary["checks"]["random_search"] <= 1
    assert summary["checks"]["cost_fell"] == 1

    written = {path.name for path in folder.iterdir()}
    assert written == {"attack.jsonl", "example_000.png", "example_000"}
    paths = (folder / "example_000").rglob("*.*")
    assert {str(path.relative_to(folder / "example_000")) for path in paths} == ADVERSARY_FILES


@pytest.mark.slow
def test_an_adversary_of_two_views_is_rendered_again_and_attacked_further(run, tmp_path, capsys):
    shared = "scene.views=2", "attack.shared=true"
    assert run("attack=lighting+geometry+albedo", *WITHOUT_CHECKS, *shared) == 0
    capsys.readouterr()
    folder = tmp_path / "out" / FOLDER_OF_ORANGE
    (line,) = read_lines(folder / "attack.jsonl")
    reload = f"reload={folder / 'example_000'}"
    assert run(reload, "out=none") == 0
    printed = capsys.readouterr().out.splitlines()
    assert not (tmp_path / "none").exists()
    assert len(printed) == 2
    for view, text in enumerate(printed):
        shown = f"{line['predicted'][view]} ({line['confidence'][view]:.1%})"
        assert text.startswith(f"view {view}: orange is recognized as {shown}; ")
        levels = float(text.rpartition("by ")[2].partition("/255")[0])
        assert levels <= 1

    assert run(reload, "attack=lighting", *WITHOUT_CHECKS, "out=again") == 0
    (again,) = read_lines(tmp_path / "again" / FOLDER_OF_ORANGE / "attack.jsonl")
    assert again["predicted_before"] == line["predicted"]
    assert again["cost_before"] == pytest.approx(line["cost"], abs=0.05)
    assert run(reload, "attack=pose", *WITHOUT_CHECKS, "out=turned") == 0
    (turned,) = read_lines(tmp_path / "turned" / FOLDER_OF_ORANGE / "attack.jsonl")
    assert turned["cost_before"] == pytest.approx(line["cost"], abs=0.05)


@pytest.mark.slow
def test_an_adversary_of_a_detector_is_rendered_and_detected_again(tmp_path):
    scene = nb.build_scene([("solid:orange:0", "orange")], size=32, views=2, light="uniform")
    settings = nb.AttackSettings(lighting=nb.StepSettings(step_size=0.2), max_steps=3)
    result = nb.attack(find_red, scene, settings=settings, classes=["orange", "apple"], force=True)
    nb.save(result, tmp_path)
    lines = read_lines(tmp_path / "attack.jsonl")
    for line in lines:
        adversary = nb.reload(tmp_path / f"example_{line['example']:03d}")
        reloaded = (adversary, choose("auto"), result.classifier, result.settings)
        (text,) = format_reloaded(*reloaded)
        expected = f"recognized as {line['predicted'][0]} ({line['confidence'][0]:.1%})"
        assert expected in text
        larger = as_network(find_red, 48, ["orange", "apple"])
        (text,) = format_reloaded(adversary, choose("auto"), larger, result.settings)
        assert text.endswith("at 48 × 48 pixels")
    assert {line["predicted"][0] for line in lines} == {"nothing"}


@pytest.mark.slow
def test_success_by_radius_is_a_table_and_a_figure_of_meshes_by_their_names(run, tmp_path, capsys):
    meshes = "meshes=[solid:orange:0,solid:apple:0]"
    radii = "attack.radius_scales=[1,0.2]"
    assert run("attack=lighting", meshes, *WITHOUT_CHECKS, radii) == 0

    assert "sweep.csv" in capsys.readouterr().out
    with open(tmp_path / "out" / "sweep.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    by_key = {(row["mesh"], row["method"], row["lighting"]): row for row in rows}
    first, second = FOLDER_OF_ORANGE, "1_solid_apple_0"
    for folder, label in ((first, "orange"), (second, "apple")):
        (line,) = read_lines(tmp_path / "out" / folder / "attack.jsonl")
        assert line["label"] == [label]
    methods = ("adversarial", "random", "adversarial_without_noise", "random_without_noise")
    assert list(by_key) == list(product((first, second, "all"), methods, ("0.2", "1.0")))
    for row in rows:
        assert 0 <= float(row["low"]) <= float(row["value"]) <= float(row["high"]) <= 1
    for method, radius in product(methods, ("0.2", "1.0")):
        hits = [int(by_key[mesh, method, radius]["hits"]) for mesh in (first, second)]
        assert int(by_key["all", method, radius]["hits"]) == sum(hits)
    assert (tmp_path / "out" / "sweep.png").is_file()


def test_no_adversary_is_shown_if_no_attack_succeeds(tmp_path):
    none = {"network": "other", "clean_correct": [], "success": [], f"success{WITHOUT_NOISE}": []}
    table = write_transfers([none], tmp_path / "transfer.jsonl")
    assert "0 of 0" in table
    assert read_lines(tmp_path / "transfer.jsonl")[0]["n"] == 0


@pytest.mark.slow
def test_adversaries_are_shown_to_other_networks_azimuths_and_meshes(run, tmp_path, capsys):
    targets = [
        f"transfer.networks=[run:{PRETRAINED / 'none'},run:{PRETRAINED / 'best'}]",
        "transfer.azimuths=[-20,0]",
        "transfer.meshes=['solid:orange:0',{mesh: 'solid:apple:0', label: apple}]",
    ]
    # The few steps do not find a margin for noise.
    words = "attack.checks=false", "attack.sensor_noise=0", "scene.views=2"
    assert run("attack=lighting", *words, *targets) == 0
    assert "| network run:" in capsys.readouterr().out
    folder = tmp_path / "out" / FOLDER_OF_ORANGE
    own, other, turned, still, same, apple = read_lines(folder / "transfer.jsonl")
    assert other["network"].endswith("best")
    assert turned["azimuth"] == "-20°"
    assert apple["mesh"] == "solid:apple:0"

    # The attacked network, azimuth and mesh give the predictions of the attack.
    attacked = read_lines(folder / "attack.jsonl")
    adversaries = [line for line in attacked if line["clean_correct"] and line["success"]]
    predicted = [line["predicted"] for line in adversaries]
    assert predicted
    for line in (own, still, same):
        assert line["predicted"] == predicted
        assert line["hits"] == line["n"] == len(predicted)


def test_the_threshold_and_the_goal_hold_for_networks_to_which_adversaries_are_shown():
    detector, classifier = "run:pretrained/detector", "run:pretrained/none"
    settings = AttackExperimentSettings(network=detector, threshold=0.9, goal="mislabel")
    settings.transfer.networks = [detector, classifier]
    shown = load_targets(settings, load_chosen(settings))["classifiers"]
    assert shown[0].task == nb.Detection(threshold=0.9, goal="mislabel")
    assert shown[1].task == nb.Classification()
