import csv
import json
import shlex
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from PIL import Image

from renderer.io.meshes import load_mesh
from renderer.light.presets import load_light

USER_ERROR = 2
ROOT = Path(__file__).parents[3]
SMALL = [
    f"classifier=run:{ROOT / 'pretrained' / 'none'}", "attack.force=true", "attack.max_steps=2", "device=cpu",
    "renderer.rasterizer=numpy", "renderer.shadows=false", "attack.allow_negative=true",
]  # fmt: skip


@pytest.fixture
def run(call) -> Callable[..., int]:
    """`pnb-attack` with small settings: the exit status."""
    return partial(call, "attack", "out=out", *SMALL)


ALWAYS = {
    "adversary.json", "mesh.glb", "light.json", "before_0.png", "after_0.png", "before.npy", "after.npy",
    "mitsuba/scene.xml", "mitsuba/part_0.ply", "mitsuba/light.exr", "light_before.json",
}  # fmt: skip


@pytest.mark.parametrize("parameters", ["skylight", "[geometry,albedo,pixels]"])
def test_one_parameter_and_several_at_once_run_and_write_what_they_promise(run, tmp_path, capsys, parameters):
    assert run(f"attack={parameters}") == 0
    printed = capsys.readouterr().out
    names = parameters.strip("[]").replace(",", "+")
    assert printed.startswith(f"solid:orange:0: {names} against run:")
    folder = tmp_path / "out" / "0_solid_orange_0"
    assert {path.name for path in folder.iterdir()} == {"attack.jsonl", "example_000.png", "example_000"}
    files = {str(path.relative_to(folder / "example_000")) for path in (folder / "example_000").rglob("*.*")}
    example, last = map(json.loads, (folder / "attack.jsonl").read_text().splitlines())
    maps = {"light.hdr", "light.exr"} if example["negative_light"] < 1e-6 else set()
    assert files == ALWAYS | maps | ({"pixels.npy"} if "pixels" in names else set())
    assert list(example["largest_change"]) == names.split("+")
    assert all(example["largest_change"].values())
    assert example["cost"] < example["cost_before"]
    assert example["versions"]["reload"]["largest_difference"] <= 1 / 255
    assert 0 <= last["checks"]["random_search"] <= 1 and last["checks"]["cost_fell"] == 1
    config = OmegaConf.load(tmp_path / "out" / "config.yaml")
    assert set(config.attack) >= set(names.split("+"))
    attacked = f"attack=[{parameters.strip('[]')}]"
    assert config.command == shlex.join(["python", "-m", "scripts.attack", "out=out", *SMALL, attacked])


def test_each_mesh_has_a_folder_and_what_was_written_is_attacked_again(run, tmp_path, capsys):
    assert run("attack=lighting+geometry", "attack.checks=false") == 0
    first = tmp_path / "out" / "0_solid_orange_0" / "example_000"
    light, shape = first / "light.json", first / "mesh.glb"
    assert load_light(str(light)).shape == (49, 3) and len(load_mesh(shape).faces) > 0
    meshes = f"scene.meshes=[{shape},{{mesh: 'solid:orange:0', label: apple}}]"
    assert run("attack=pixels", "out=again", meshes, f"scene.light={light}", "attack.checks=false") == 0
    folders = {path.name for path in (tmp_path / "again").iterdir() if path.is_dir()}
    assert folders == {"0_mesh", "1_solid_orange_0"}
    (line,) = (tmp_path / "again" / "1_solid_orange_0" / "attack.jsonl").read_text().splitlines()
    assert json.loads(line)["label"] == ["apple"]


def test_an_adversary_is_rendered_again_and_gone_on_from(run, tmp_path, capsys):
    assert run("attack=lighting+geometry+albedo", "attack.checks=false", "scene.views=2", "attack.shared=true") == 0
    first = tmp_path / "out" / "0_solid_orange_0"
    line = json.loads((first / "attack.jsonl").read_text())
    capsys.readouterr()
    assert run(f"reload={first / 'example_000'}", "out=none") == 0
    lines = capsys.readouterr().out.splitlines()
    assert not (tmp_path / "none").exists() and len(lines) == 2
    for view, text in enumerate(lines):
        predicted, confidence = line["predicted"][view], line["confidence"][view]
        assert text.startswith(f"view {view}: orange is classified as {predicted} ({confidence:.1%}), ")
        assert "a sensor's noise; values differ " in text
        assert float(text.rpartition("by ")[2].partition("/255")[0]) <= 1
    assert run(f"reload={first / 'example_000'}", "attack=lighting", "attack.checks=false", "out=again") == 0
    again = json.loads((tmp_path / "again" / "0_solid_orange_0" / "attack.jsonl").read_text())
    assert again["predicted_before"] == line["predicted"]
    assert again["cost_before"] == pytest.approx(line["cost"], abs=0.05)


def test_success_against_radius_is_a_table_and_a_figure(run, tmp_path, capsys):
    two = "scene.meshes=[solid:orange:0,solid:orange:0]", "scene.views=2"
    fast = "attack.checks=false", "attack.verify=null"
    assert run("attack=lighting", *two, *fast, "attack.radius_scales=[1,0.2]") == 0
    assert capsys.readouterr().out.count("| lighting 0.2 ") == 2
    with open(tmp_path / "out" / "sweep.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    meshes = ("0_solid_orange_0", "1_solid_orange_0", "all")
    found = {(row["mesh"], row["method"], row["lighting"]): row for row in rows}
    methods = ("adversarial", "random", "adversarial_without_noise", "random_without_noise")
    assert [*found] == [*product(meshes, methods, ("0.2", "1.0"))]
    for (mesh, method, radius), row in found.items():
        assert 0 <= float(row["low"]) <= float(row["value"]) <= float(row["high"]) <= 1
        if mesh == "all":
            assert int(row["hits"]) == sum(int(found[one, method, radius]["hits"]) for one in meshes[:2])
    with Image.open(tmp_path / "out" / "sweep.png") as figure:
        assert figure.size == (750, 570)


def test_adversaries_are_shown_to_other_networks_from_other_azimuths_and_on_other_meshes(run, tmp_path, capsys):
    networks = f"transfer.classifiers=[run:{ROOT / 'pretrained' / 'none'},run:{ROOT / 'pretrained' / 'best'}]"
    meshes = "transfer.meshes=['solid:orange:0',{mesh: 'solid:apple:0', label: apple}]"
    views = "scene.views=2", "transfer.azimuths=[-20,0]"
    # Without noise, which the few steps of this attack do not survive.
    options = "attack.checks=false", "attack.sensor_noise=0"
    assert run("attack=lighting", *options, *views, networks, meshes) == 0
    folder = tmp_path / "out" / "0_solid_orange_0"
    lines = [json.loads(line) for line in (folder / "transfer.jsonl").read_text().splitlines()]
    attacked = [json.loads(line) for line in (folder / "attack.jsonl").read_text().splitlines()]
    adversaries = [line for line in attacked if line["clean_correct"] and line["success"]]
    own, other, turned, still, same, apple = lines
    assert other["network"].endswith("best") and turned["azimuth"] == "-20°" and apple["mesh"] == "solid:apple:0"
    for line in (own, still, same):  # where nothing is another
        assert line["predicted"] == [each["predicted"] for each in adversaries]
        assert line["hits"] == line["n"] == len(adversaries) > 0
    assert "| network run:" in capsys.readouterr().out


REFUSED = [
    (["classifier=resnet18"], "classifier=resnet18 is not known: choose one of"),
    (["transfer.classifiers=[resnet18]"], "transfer.classifiers=resnet18 is not known: choose one of"),
    (["transfer.classifiers=[{network: x}]"], "transfer.classifiers: network is not known: give names"),
    (["transfer.meshes=[{mesh: 'solid:pear', label: paer}]"], "'paer' is not a class of the model: choose one, such"),
    (["attack=geometry", "transfer.meshes=[a.glb]"], "meshes: attacked geometry cannot be transferred"),
    (["attack=pixels", "transfer.azimuths=[3]"], "azimuths: attacked pixels cannot be transferred"),
    (["attack.radius_scales=[0.1,-1]"], "radius_scales=-1.0 must be at least 1e-05"),
    (["attack=[]"], "attack: name what to attack"),
    (["attack=lighting+skylight"], "lighting and skylight both set the light: choose one of them"),
    (["attack.verify=blender"], "verify=blender: choose one of reload, mitsuba"),
    (["reload=absent"], "absent/adversary.json does not exist: give a folder that an attack wrote"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=[" ".join(row[0]) for row in REFUSED])
def test_what_a_user_can_fix_is_one_line_and_status_2(run, tmp_path, capsys, arguments, message):
    assert run(*arguments) == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("error: ") and printed.err.count("\n") == 1
    assert message in printed.err
    assert not (tmp_path / "out").exists()
