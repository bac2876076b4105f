"""What becomes of adversaries outside, counted anew from the records."""

import json

import pytest
import torch
import trimesh

from augment.classifiers import Classifier
from renderer.files.mesh_export import export_mesh
from renderer.mesh import Mesh
from train.studies.paper import survival

SIZE = 12


def by_brightness() -> Classifier:
    """Calls what is brighter than a grey in the middle an orange."""

    def logits(images):
        bright = 60 * (images[:, :, 4:8, 4:8].mean((1, 2, 3)) - 0.2)
        return torch.stack([bright, -bright], dim=1)

    return Classifier(logits, SIZE, ("orange", "coal"), "by_brightness")


def test_a_mesh_that_is_recognised_in_no_scene_is_counted_and_ends_nothing(tmp_path, reproduce, monkeypatch):
    monkeypatch.setattr(survival, "ATTACKS", {"light": "lighting"})
    monkeypatch.setattr(survival, "RENDERERS", ("reload",))
    ball = trimesh.creation.icosphere(subdivisions=1)
    for name, grey in (("black", 0.0), ("ball", 0.5)):
        export_mesh(Mesh.plain(ball.vertices, ball.faces, (grey,) * 3), tmp_path / f"{name}.glb")
    meshes = f"scene.meshes=[{tmp_path / 'black.glb'},{tmp_path / 'ball.glb'}]"
    small = 'section.overrides=["attack.max_steps=1","scene.search=2"]'
    reproduce(by_brightness(), "section=survival", f"out={tmp_path}", meshes, "section.examples=2", small)
    page = (tmp_path / "paper.md").read_text()
    cells = {
        row.split(" | ")[0].strip("| "): row.strip(" |").split(" | ")[1:] for row in page.splitlines() if "|" in row
    }
    assert cells["light"][0].endswith(" of 2")
    words = " ".join(page.split())
    assert "of 4 were); 2 have a scene" in words and "within 1/255: 2 of 2." in words


@pytest.mark.slow
def test_the_table_counts_what_still_fools_of_what_fooled(tmp_path, reproduce, monkeypatch):
    pytest.importorskip("mitsuba")
    ball = trimesh.creation.icosphere(subdivisions=2)
    export_mesh(Mesh.plain(ball.vertices, ball.faces, (0.6, 0.5, 0.5)), tmp_path / "ball.glb")
    monkeypatch.setattr(survival, "ATTACKS", {name: survival.ATTACKS[name] for name in ("light", "albedo")})
    overrides = [f"out={tmp_path / 'docs'}", f"scene.meshes=[{tmp_path / 'ball.glb'}]", "section.examples=2"]
    reproduce(by_brightness(), "section=survival", *overrides, 'section.overrides=["attack.max_steps=10"]')
    page = (tmp_path / "docs" / "paper.md").read_text()
    records = [json.loads(line) for line in (tmp_path / "docs" / "paper" / "survival.jsonl").read_text().splitlines()]
    assert {record["attack"] for record in records} == {"light", "albedo"}
    assert all(set(record["versions"]) == {"float", "8 bits", "JPEG 90", "reload", "mitsuba"} for record in records)
    for name in ("light", "albedo"):
        here = [record for record in records if record["attack"] == name]
        success = [record for record in here if record["success"]]
        (row,) = [line for line in page.splitlines() if line.startswith(f"| {name} |")]
        counts = [cell.rpartition("of ")[2] for cell in row.strip(" |").split(" | ")[1:]]
        assert counts == [str(len(here))] + [str(len(success))] * 5
    same = sum(record["versions"]["reload"]["largest_difference"] <= 1 / 255 for record in records)
    assert f"same image within 1/255: {same} of {len(records)}" in " ".join(page.split())
    assert same == len(records)
