from pathlib import Path

import pytest
import torch
from torch import nn

import norm_balls as nb
from tests.helpers import Brightness, save_plain

SIZE = 8
CLASSES = ["dark", "bright"]
# Gray values of the photographs of each class.
SHADES = {"dark": [10, 20, 200, 30], "bright": [250, 40, 220]}


@pytest.fixture
def photographs(tmp_path) -> Path:
    folder = tmp_path / "photographs"
    for name, shades in SHADES.items():
        for index, shade in enumerate(shades):
            save_plain(folder / name / f"{index}.png", shade)
    return folder


OPTIONS = {"classes": CLASSES, "size": SIZE, "value_range": (0, 255), "precision": "float32"}


def test_scores_count_the_photographs_of_each_class(photographs):
    scores = nb.evaluate(Brightness(127, scale=1).eval(), photographs, by="class", **OPTIONS)
    assert (scores.by_class["dark"].recall.hits, scores.by_class["dark"].recall.n) == (3, 4)
    assert (scores.by_class["bright"].recall.hits, scores.by_class["bright"].recall.n) == (2, 3)
    assert (scores.overall.recall.hits, scores.overall.recall.n) == (5, 7)
    # Top-1 accuracy is a mean over classes.
    assert scores.overall.class_top1.value == pytest.approx((3 / 4 + 2 / 3) / 2)
    assert scores.groups["dark"].class_top1.value == pytest.approx(3 / 4)
    assert scores.groups["bright"].class_top1.value == pytest.approx(2 / 3)
    assert scores.overall.class_top5.value == 1


def test_weights_of_the_caller_keep_their_layout_and_their_gradients(photographs):
    """Also in inference mode, as in a validation."""
    network = nn.Sequential(nn.Conv2d(3, 2, 3), nn.AdaptiveAvgPool2d(1), nn.Flatten()).eval()
    with torch.inference_mode():
        nb.evaluate(network, photographs, **OPTIONS)
    weight = network[0].weight
    assert weight.is_contiguous() and not weight.is_inference() and weight.requires_grad


def test_a_label_may_be_an_index(photographs):
    scores = nb.evaluate(Brightness(127, scale=1).eval(), photographs, 1, **OPTIONS)
    assert (scores.overall.recall.hits, scores.overall.recall.n) == (2, 3)
    assert (scores.overall.false_positive_rate.hits, scores.overall.false_positive_rate.n) == (1, 4)


def test_only_a_given_folder_is_written_and_the_network_stays(photographs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    network = Brightness(127, scale=1).eval()
    nb.evaluate(network, photographs, **OPTIONS)
    assert sorted(tmp_path.rglob("*")) == before
    assert network.limit.requires_grad and not network.training
    nb.evaluate(network, photographs, out="scores", **OPTIONS)
    assert (tmp_path / "scores" / "summary.json").is_file()


def test_a_classifier_refuses_the_fit_that_only_other_tasks_use(tmp_path):
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(192, 2)).eval()
    with pytest.raises(nb.InputError) as caught:
        nb.evaluate(network, tmp_path, "a", classes=["a", "b"], size=8, fit="stretch")
    assert caught.value.argument == "fit"
