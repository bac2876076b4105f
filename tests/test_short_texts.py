"""Results of the Python API are short when they are printed."""

import numpy as np
import pytest
import torch
from PIL import Image

import norm_balls as nb

CLASSES = ["orange", "apple", "pear"]
LONGEST = 1500


def contrasts(images: torch.Tensor) -> torch.Tensor:
    return 30 * (images.mean((2, 3)) - 0.3)


@pytest.fixture
def classifier() -> nb.Classifier:
    return nb.Classifier(contrasts, size=16, classes=CLASSES)


def test_an_attack_and_what_it_holds(classifier, tmp_path):
    scene = nb.build_scene([("solid:orange", "orange")], 16, views=2)
    result = nb.attack(classifier, scene, force=True)
    nb.save(result, tmp_path)
    adversary = nb.reload(tmp_path / "example_000")
    for value in (result, result.minimum, adversary, scene.conditions(torch.arange(2))):
        assert len(repr(value)) < LONGEST
    assert f"images_in_views={tuple(result.images_in_views.shape)}" in repr(result).replace(
        "float32 ", ""
    )


def test_an_attack_on_photographs(classifier):
    pixels = torch.randint(0, 256, (3, 3, 16, 16), dtype=torch.uint8)
    assert len(repr(nb.attack_photographs(classifier, pixels))) < LONGEST


def test_scores(tmp_path):
    for name in CLASSES:
        (tmp_path / name).mkdir()
        for number in range(40):
            pixels = np.random.default_rng(number).integers(0, 256, (8, 8, 3)).astype(np.uint8)
            Image.fromarray(pixels).save(tmp_path / name / f"{number}.png")
    scores = nb.evaluate(contrasts, tmp_path, classes=CLASSES, size=8)
    assert len(repr(scores)) < LONGEST
    assert len(repr(scores.pooled)) < LONGEST
    assert len(repr(scores.predicted)) < LONGEST
    printed = str(scores)
    assert len(printed) < 3 * LONGEST
    assert f"{scores.overall.recall.value:.3f}" in printed


def test_a_report_of_an_audit():
    page = "<html>" * 10**6
    report = nb.AuditReport("orange", None, None, "", page)
    assert len(repr(report)) < 300


def test_an_error_counts_the_images_of_all_meshes_as_those_of_all(classifier):
    """Both views of the orange and one of the two of the pear are misclassified, in one light."""
    meshes = [("solid:orange", "pear"), ("solid:pear", "pear"), ("solid:lemon", "pear")]
    scene = nb.build_scene(meshes, 16, views=2)
    images = scene.render(scene.conditions(torch.arange(len(scene))), torch.arange(len(scene)))
    wrong = (contrasts(images.flatten(0, 1)).argmax(1) != 2).sum()
    with pytest.raises(nb.InputError, match=rf"\b{wrong} of 6 images are not classified"):
        nb.attack(classifier, scene)
