import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import augment
from augment.attacks.adversary import MAP_HEIGHT
from augment.attacks.attack import AttackResult
from augment.attacks.files import LINES
from augment.classifiers import Classifier
from renderer.io.mitsuba import mitsuba_map
from renderer.light.environment import read_map, to_map
from renderer.light.presets import load_light
from renderer.mesh import load_mesh
from train.attacks.experiment import attack_mesh
from train.attacks.settings import AttackExperimentSettings
from train.settings import compose, read_object, read_settings

CLASSES = ("orange", "lime", "sky")


def attacked(*overrides: str) -> AttackResult:
    small = [
        "renderer.rasterizer=numpy",
        "renderer.cache=null",
        "attack.max_steps=2",
        "attack.force=true",
        "attack.allow_negative=true",
    ]
    settings = read_settings(AttackExperimentSettings, compose("attack", [*small, *overrides]))
    by_color = Classifier(lambda images: 30 * images.mean((2, 3)), 8, CLASSES, "by_color")
    return attack_mesh(read_object("solid:orange:0", "orange", 0), settings, by_color, torch.device("cpu"))


def written(done: AttackResult, folder: Path) -> list[dict]:
    """The lines."""
    augment.save(done, folder)
    return [json.loads(line) for line in (folder / LINES).read_text().splitlines()]


def test_each_example_has_a_line_and_a_last_one_holds_the_checks(tmp_path):
    done = attacked("scene.backgrounds=[0.4,0.6]", "target=lime")
    checks = augment.check(done)
    augment.save(done, tmp_path, checks)
    *lines, last = [json.loads(line) for line in (tmp_path / LINES).read_text().splitlines()]
    by_steps = {str(steps): share for steps, share in checks.success_by_steps.items()}
    assert last == {"checks": asdict(checks) | {"success_by_steps": by_steps}, "warnings": checks.warnings}
    assert [line["example"] for line in lines] == [0, 1]
    shares = done.logits.softmax(2)
    for example, line in enumerate(lines):
        for name in ("success", "success_before", "steps", "cost", "cost_before"):
            assert line[name] == getattr(done.descent, name)[example].item()
        assert line["label"] == ["orange"]
        assert line["predicted"] == [CLASSES[done.logits[example, 0].argmax()]]
        assert line["confidence"] == [pytest.approx(shares[example].max().item())]
        before = done.logits_before[example].softmax(1)
        assert line["predicted_before"] == [CLASSES[before.argmax()]]
        assert line["confidence_before"] == [pytest.approx(before.max().item())]
        assert line["clean_correct"] is (before.argmax().item() == 0)
        change = (done.descent.values[example] - done.problem.start[example]).abs().max().item()
        assert line["largest_change"] == {"lighting": change} and change > 0


@pytest.mark.parametrize("kind, lights", [("projector", 2), ("geometry", 0)])
def test_the_image_shows_the_light_that_the_attack_has_changed(tmp_path, monkeypatch, kind, lights):
    """All of it, a pattern included."""
    panels = []
    monkeypatch.setattr("augment.attacks.files.save_figure", lambda *sides: panels.extend(sides[:2]))
    augment.save(attacked(f"attack={kind}"), tmp_path)
    spheres = [panel.spheres for panel in panels if panel.spheres is not None]
    assert len(spheres) == lights and (not lights or (spheres[0] != spheres[1]).any())


def test_the_light_is_read_back_to_the_bit_and_as_a_map_only_where_it_is_physical(tmp_path):
    """`st_peters` is positive all round and stays so within a small ball; `grace` is negative in places."""
    for light, physical in [("st_peters", True), ("grace", False)]:
        done = attacked(f"scene.light={light}", "attack.lighting.radius=0.001", "scene.exposure=2")
        (line,) = written(done, tmp_path / light)
        folder, values = tmp_path / light / "example_000", done.descent.values[0].unflatten(0, (49, 3))
        assert torch.equal(load_light(str(folder / "light.json")), values)
        expected = to_map(values, MAP_HEIGHT).float()
        assert (line["negative_light"] < 1e-6) == physical == (expected.min() >= 0).item()
        assert (folder / "light.hdr").is_file() == (folder / "light.exr").is_file() == physical
        in_mitsuba = mitsuba_map(values, MAP_HEIGHT).float().clamp(min=0)
        torch.testing.assert_close(read_map(folder / "mitsuba" / "light.exr"), in_mitsuba, rtol=0, atol=0)
    found = read_map(tmp_path / "st_peters" / "example_000" / "light.hdr")
    expected = read_map(tmp_path / "st_peters" / "example_000" / "light.exr")
    # A channel has 8 bits of the texel's largest.
    assert ((found - expected).abs() <= expected.amax(2, keepdim=True) / 128).all()


def test_the_shape_is_read_back_where_the_attack_left_it(tmp_path):
    done = attacked("attack=[geometry]")
    (line,) = written(done, tmp_path)
    mesh = done.problem.scene.mesh(0)
    moved = done.problem.scene.vertices[0] + done.descent.values[0].unflatten(0, (-1, 3))
    found = load_mesh(tmp_path / "example_000" / "mesh.glb")
    np.testing.assert_array_equal(found.vertices[found.faces], moved.double().numpy()[mesh.faces])
    shapes = [trimesh.Trimesh(vertices, mesh.faces, process=False) for vertices in (mesh.vertices, moved.numpy())]
    assert line["shape"]["flipped"] == ((shapes[0].face_normals * shapes[1].face_normals).sum(axis=1) < 0).sum()
    assert line["shape"]["displacement"] == pytest.approx(np.abs(moved.numpy() - mesh.vertices).max(0), abs=2**-23)
    assert 0 < max(line["shape"]["displacement"]) <= 0.002 + 2**-23


@pytest.mark.parametrize("normals", ["flat", "smooth"])
def test_the_meshs_file_has_the_normals_that_the_renderer_shades_with_and_the_view(tmp_path, normals):
    done = attacked("attack=[geometry]", f"renderer.normals={normals}")
    written(done, tmp_path)
    path = tmp_path / "example_000" / "mesh.glb"
    (part,) = trimesh.load(path, process=False).geometry.values()
    turns = np.linalg.norm(part.vertex_normals[part.faces] - part.face_normals[:, None], axis=2)
    assert (turns.max() < 1e-4) == (normals == "flat")  # float32 positions of faces a thousandth wide
    blob = path.read_bytes()
    tree = json.loads(blob[20 : 20 + int.from_bytes(blob[12:16], "little")])
    assert [node["name"] for node in tree["nodes"] if "camera" in node] == ["view 0"]


def test_every_line_has_each_versions_answer(tmp_path):
    done = attacked("scene.backgrounds=[0.4,0.6]")
    lines = written(done, tmp_path)
    for example, line in enumerate(lines):
        assert set(line["versions"]) == {"float", "8 bits", "JPEG 90", "reload"}
        rounded = (done.images[example] * 255).round() / 255
        answer = CLASSES[rounded.mean((0, 2, 3)).argmax()]
        off = (rounded - done.images[example]).abs()
        assert line["versions"]["8 bits"] == {
            "success": answer != "orange",
            "predicted": [answer],
            "confidence": [pytest.approx((30 * rounded.mean((2, 3))).softmax(1).max().item(), abs=1e-5)],
            "largest_difference": pytest.approx(off.max().item(), abs=1e-7),
            "mean_difference": pytest.approx(off.mean().item(), abs=1e-7),
        }
        assert line["versions"]["reload"]["largest_difference"] < 1e-5
