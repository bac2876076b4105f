import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from renderer.lights import load_light
from renderer.mesh import load_mesh
from train.cli import USER_ERROR

ROOT = Path(__file__).parents[2]
SMALL = [
    f"classifier=run:{ROOT / 'pretrained' / 'none'}", "attack.force=true", "attack.max_steps=2", "device=cpu",
    "renderer.visibility=software", "renderer.cache=null",
]  # fmt: skip


@pytest.fixture(autouse=True)
def one_thread():
    """The network is so small that threads would wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def run(monkeypatch, tmp_path) -> Callable[..., int]:
    """`python scripts/attack.py` within this process, from another folder: the exit status."""

    def command(*arguments: str) -> int:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["attack.py", "out=out", *SMALL, *arguments])
        try:
            runpy.run_path(str(ROOT / "scripts" / "attack.py"), run_name="__main__")
        except SystemExit as stop:
            return stop.code
        return 0

    return command


LIGHT, SHAPE = ["_light.hdr", "_light.json"], ["_shape.glb", "_shape.ply"]
KINDS = {
    "lighting": LIGHT,
    "skylight": LIGHT,
    "geometry": SHAPE,
    "albedo": [],
    "pixels": [],
    "lighting+geometry": LIGHT + SHAPE,
    "[albedo,pixels]": [],
}


@pytest.mark.parametrize(("kinds", "endings"), KINDS.items(), ids=KINDS)
def test_every_kind_and_several_at_once_run_and_write_what_they_promise(run, tmp_path, capsys, kinds, endings):
    assert run(f"attack={kinds}") == 0
    printed = capsys.readouterr()
    names = kinds.strip("[]").replace(",", "+")
    assert printed.err == "" and printed.out.startswith(f"solid:orange:0: {names} against run:")
    folder = tmp_path / "out" / "0_solid_orange_0"
    expected = ["attack.jsonl", *(f"example_000{ending}" for ending in [".png", *endings])]
    assert sorted(path.name for path in folder.iterdir()) == sorted(expected)
    example, last = map(json.loads, (folder / "attack.jsonl").read_text().splitlines())
    assert list(example["largest_change"]) == names.split("+")
    assert all(example["largest_change"].values()) and ("shape" in example) == ("geometry" in names)
    assert example["cost"] < example["cost_before"]
    assert 0 <= last["checks"]["random_search"] <= 1 and last["checks"]["cost_fell"] == 1
    assert set(OmegaConf.load(tmp_path / "out" / "config.yaml").attack) >= set(names.split("+"))


def test_each_mesh_has_a_folder_and_what_was_written_is_attacked_again(run, tmp_path, capsys):
    assert run("attack=lighting+geometry", "attack.checks=false") == 0
    first = tmp_path / "out" / "0_solid_orange_0"
    light, shape = (first / f"example_000{ending}" for ending in ("_light.json", "_shape.glb"))
    assert load_light(str(light)).shape == (49, 3) and len(load_mesh(shape).faces) > 0
    meshes = f"scene.meshes=[{shape},{{mesh: 'solid:orange:0', label: apple}}]"
    assert run("attack=pixels", "out=again", meshes, f"scene.light={light}", "attack.checks=false") == 0
    folders = {path.name for path in (tmp_path / "again").iterdir() if path.is_dir()}
    assert folders == {"0_example_000_shape", "1_solid_orange_0"}
    (line,) = (tmp_path / "again" / "1_solid_orange_0" / "attack.jsonl").read_text().splitlines()
    assert json.loads(line)["label"] == ["apple"]


REFUSED = [
    (["attack=lihgting"], "attack=lihgting is not known: choose from lighting, skylight, geometry, albedo, pixels"),
    (["attack=null"], "attack=null is not known: choose from lighting"),
    (["attack=[]"], "attack: name what to change"),
    (["attack=lighting+skylight"], "attack: lighting and skylight both set the light: choose one of them"),
    (["attack.lighting.radius=-1"], "attack: radius=-1.0 must be at least 0"),
    (["attack.restarts=1"], "attack.restarts draws from the norm-balls"),
    (["scene.views=0"], "scene.views=0 must be at least 1"),
    (["scene.backgrounds=[absent.png]"], "scene.backgrounds: absent.png cannot be read"),
    (["label=ornage"], "has no class 'ornage': choose one, such as orange"),
    (["target=[apple,pear]", "attack.shared=true"], "target=['apple', 'pear'] names 2 classes for 1 views"),
    (["classifier=alexnet"], "classifier=alexnet is not known: choose one of "),
    (["label=apple", "attack.force=false"], "of solid:orange:0 are not recognised as 'apple' before any attack"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=[" ".join(row[0]) for row in REFUSED])
def test_what_a_user_can_mend_is_one_line_and_status_2(run, tmp_path, capsys, arguments, message):
    assert run(*arguments) == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("error: ") and printed.err.count("\n") == 1
    assert message in printed.err
    assert not (tmp_path / "out").exists()


def test_a_mistyped_key_prints_the_nearest_one(run, capsys):
    assert run("attack.max_step=3") == 1
    assert capsys.readouterr().err.splitlines()[-1] == "Nearest valid key to 'attack.max_step': attack.max_steps"
