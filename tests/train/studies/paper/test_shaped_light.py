import pytest
import torch

from augment.classifiers import Classifier
from augment.objects import SceneObject
from renderer.camera import ring
from renderer.image import ImageSettings
from renderer.shapes import solid
from train.studies.paper import shaped_light


def record(transport: str, kept: float, here: tuple[str, str], traced: tuple[str, str]) -> dict:
    said = {"here": here, "traced": traced}
    return {"mesh": "a cup", "label": "cup", "transport": transport, "kept": kept, **said}


def test_shares_are_of_what_both_recognised_before_and_what_was_fooled_here():
    found, missed, gone = ("cup", "coal"), ("cup", "cup"), ("coal", "coal")
    records = [
        record("direct", 0.3, found, found),
        record("direct", 0.3, found, missed),
        record("direct", 0.3, missed, found),  # not fooled here
        record("direct", 0.3, found, gone),  # not recognised there
        record("direct", 0.3, gone, found),  # not recognised here
        record("shadows", 0.01, found, found),
    ]
    rows = {tuple(row.split(" | ")[:2]): row for row in shaped_light.results(records).splitlines()}
    concave, convex = rows["| concave", "direct"], rows["| convex", "shadows"]
    assert "of 3 |" in concave and "50 % " in concave and "of 2 |" in concave
    assert convex.count("100 % ") == 2
    assert "none of 0" in rows["| convex", "direct"]


def test_a_cup_keeps_light_from_itself_and_a_ball_none():
    cameras, settings = ring(2, 2.2), ImageSettings(12, 2)
    kept = [
        shaped_light.kept_from_itself(SceneObject(name, solid(name, 0)), cameras, settings) for name in ("cup", "ball")
    ]
    assert kept[0] > shaped_light.SELF_SHADED > kept[1] == 0


@pytest.mark.slow
def test_a_section_attacks_under_every_transport_and_traces_the_paths(reproduce, tmp_path):
    pytest.importorskip("mitsuba")

    def logits(images):
        bright = 20 * (images[:, :, 4:8, 4:8].mean((1, 2, 3)) - 0.1)
        return torch.stack([bright, -bright], dim=1)

    network = Classifier(logits, 12, ("cup", "coal"), "by brightness")
    reproduce(
        network,
        "section=shaped_light",
        "section.examples=1",
        "section.steps=1",
        "label=cup",
        "scene.meshes=[solid:cup:0]",
        f"out={tmp_path}",
    )
    text = (tmp_path / "paper.md").read_text()
    assert "## Light that a mesh shapes itself" in text
    assert len((tmp_path / "paper" / "shaped_light.jsonl").read_text().splitlines()) == len(shaped_light.TRANSPORTS)
