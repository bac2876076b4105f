import pytest
import torch
from torchvision.ops import box_iou

import norm_balls as nb
from augment import dataset

LABELED = ("orange", "sweet_pepper", "mushroom", "cup", "bottle")
LOOKS = {"width": 3.2, "encoding": "srgb"}


@pytest.fixture(scope="module")
def detector():
    return nb.load("detector")


def test_the_published_detector_finds_more_than_half_of_other_solids(detector):
    objects = [(f"solid:{kind}:{seed}", kind) for kind in LABELED for seed in (2001, 2002)]
    scene = nb.build_scene(objects, detector.size, **LOOKS)
    rows = torch.arange(len(scene))
    assert detector.classes == ("background", *LABELED)
    truth = scene.truth(detector.label)
    outputs = detector(scene.render(scene.conditions(rows), rows)[:, 0])
    labels = truth.labels[:, 0, 0]
    found = []
    for output, box, label in zip(outputs, truth.boxes[:, 0], labels, strict=True):
        is_counted = (output["scores"] >= 0.4) & (output["labels"] == label)
        found.append(bool((box_iou(output["boxes"][is_counted], box) >= 0.5).any()))
    assert sum(found) >= 6


def test_renders_are_attacked_for_a_detector_that_reads_its_outputs_itself(detector):
    attack = nb.TrainingAttackSettings(max_steps=1)
    settings = nb.AugmentationSettings(mode="adversarial", attack=attack)
    meshes = [("solid:orange:2001", "orange")]
    options = {"network": detector, "settings": settings, "samples": 1, **LOOKS}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "BLOCK", 1)
        [render] = nb.render_dataset(meshes, detector.size, 1, **options)
    assert render.labels == ["orange"]
