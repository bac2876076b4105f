import json
import math
from pathlib import Path, PureWindowsPath
from shutil import copytree

import pytest
import torch
from safetensors import safe_open

import norm_balls as nb
from renderer.errors import InputError
from renderer.io.images import read_image
from train import checkpoints, publication, run_folder
from train.checkpoints import load_run, load_selected
from train.data.sets import content_hash
from train.results.store import summarize
from train.run_folder import PUBLISHED


def test_a_published_network_is_one_file_with_settings_without_paths_and_scores(finished, tmp_path):
    published = tmp_path / "tiny"
    nb.publish(finished, published)
    assert [path.name for path in published.iterdir()] == [PUBLISHED]
    network = load_run(published)
    assert network.classes == ("apple", "orange", "pear")
    assert network.network.head.in_features == 64
    with safe_open(published / PUBLISHED, "pt") as file:
        metadata = {name: json.loads(text) for name, text in file.metadata().items()}
    assert metadata["settings"]["data.path"] == "tiny.npz"
    assert metadata["settings"]["train.epochs"] == 3
    assert str(finished.parent) not in str(metadata)
    assert str(published.parent) not in str(metadata)
    summary = json.loads((finished / "photographs" / "summary.json").read_text())
    assert metadata["scores"]["photographs"]["auc"] == summary["auc"]
    found, expected = summarize(published), summarize(finished)
    assert found.accuracy == expected.accuracy
    assert found.photographs == expected.photographs


def test_an_operating_point_is_above_the_second_lowest_log_odds_and_stays(
    finished, photos, tmp_path
):
    """With a rate of 1/2, 2 of the negatives may exceed it. It lies between two photographs."""
    calibrated = tmp_path / "first"
    nb.publish(finished, calibrated, calibrate=photos, false_positive_rate=0.5)
    network = load_run(calibrated)
    paths = sorted(photos.rglob("*.png"))
    negatives = [read_image(path, 16) for path in paths if path.parent.name != "orange"]
    every = torch.stack([read_image(path, 16) for path in paths])
    scores, others = (
        torch.logit(network(images).double().softmax(1)[:, 1]).sort().values
        for images in (torch.stack(negatives), every)
    )
    above = others[others > scores[1] + 1e-6][0]
    (point,) = network.operating_points
    assert point.threshold == pytest.approx(float(scores[1] + above) / 2, rel=1e-5)
    assert network.detect(torch.stack(negatives)).sum() == 2

    nb.publish(calibrated, tmp_path / "second")
    states = [load_selected(folder)[1] for folder in (calibrated, tmp_path / "second")]
    first, second = (content_hash(sorted(state.items())) for state in states)
    assert first == second
    nb.evaluate(network, photos, "orange", out=tmp_path / "scores")
    summary = json.loads((tmp_path / "scores" / "summary.json").read_text())
    assert summary["operating_point"] == vars(point) | {"in_sample": True}


def test_a_weight_that_half_precision_cannot_hold_is_published_in_full(finished, tmp_path):
    run = copytree(finished, tmp_path / "run")
    state = checkpoints.load(run / run_folder.BEST)
    weights = state["model"]
    # Weights of convolutions may have channels last.
    kernel = next(name for name, value in weights.items() if not value.is_contiguous())
    for name in (kernel, next(name for name in weights if name.endswith("running_var"))):
        weights[name][0] = 105_932.0
    checkpoints.save(run / run_folder.BEST, state)
    nb.publish(run, tmp_path / "out")
    published = load_run(tmp_path / "out").state_dict()
    assert [float(value.max()) for value in published.values()].count(105_932.0) == 2


LABELS = ("orange", "apple")
PRETRAINED = ["none", "random", "adversarial", "best"]


def test_several_labels_have_the_thresholds_that_each_has_alone(finished, photos, tmp_path):
    options = {"calibrate": photos, "false_positive_rate": 0.5}
    nb.publish(finished, tmp_path / "both", label=list(LABELS), **options)
    network = load_run(tmp_path / "both")
    images = torch.rand(9, 3, 16, 16)
    for label, point in zip(LABELS, network.operating_points, strict=True):
        nb.publish(finished, tmp_path / label, label=label, **options)
        alone = load_run(tmp_path / label)
        (expected,) = alone.operating_points
        assert point == expected
        assert torch.equal(network.detect(images, label), alone.detect(images))
    with pytest.raises(InputError, match="orange, apple"):
        network.detect(images)
    labels = list(reversed(LABELS))
    nb.evaluate(network, photos, labels, out=tmp_path / "scores")
    summary = json.loads((tmp_path / "scores" / "summary.json").read_text())
    points = [(point["label"], point["in_sample"]) for point in summary["operating_point"]]
    assert points == [(label, True) for label in labels]


def test_a_network_that_cannot_be_built_is_not_published(finished, tmp_path):
    run = copytree(finished, tmp_path / "run")
    state = checkpoints.load(run / run_folder.BEST)
    state["architecture"] = state["architecture"] | {"width": "wide"}
    checkpoints.save(run / run_folder.BEST, state)
    with pytest.raises(InputError, match=r"best\.pt is from another architecture"):
        nb.publish(run, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_all_pretrained_networks_are_scored_on_the_same_photographs():
    """Each was validated on images that it left out."""
    images = set()
    for name in PRETRAINED:
        _, state = load_selected(Path("pretrained", name))
        assert state["architecture"]["validation"]["fraction"] == 0.02
        images.add(summarize(Path("pretrained", name)).photographs["photographs"].images)
    assert len(images) == 1


@pytest.mark.parametrize("rate", [0, 5, -0.1, math.nan, "5%"], ids=str)
def test_a_false_positive_rate_is_a_fraction(tmp_path, rate):
    with pytest.raises(InputError, match="false_positive_rate"):
        nb.publish("best", tmp_path / "a", calibrate=tmp_path, false_positive_rate=rate)
    with pytest.raises(InputError, match="false_positive_rate"):
        nb.evaluate(nb.load("best"), tmp_path, calibrate=tmp_path, false_positive_rate=rate)


@pytest.mark.parametrize("name", PRETRAINED)
def test_the_results_are_those_of_the_page(name):
    lines = Path("pretrained", "README.md").read_text().splitlines()
    row = next(line for line in lines if line.startswith(f"|`{name}`|"))  # of the first table
    _, accuracy, *_, recall, false_positive_rate, auc, _ = row.strip("|").split("|")
    results = nb.load(name).results
    assert results["test/accuracy"].value == float(accuracy)
    errors = results["photographs/false_positive_rate"]
    # The page has the scores of another precision of the arithmetic.
    assert errors.value == pytest.approx(float(false_positive_rate), abs=3e-3)
    assert results["photographs/recall"].value == pytest.approx(float(recall), abs=5e-3)
    assert results["photographs/auc"].value == pytest.approx(float(auc.split()[0]), abs=1e-3)


def test_folders_of_windows_are_not_published(monkeypatch):
    monkeypatch.setattr(publication, "Path", PureWindowsPath)
    assert publication._without_folder(r"C:\Users\me\pear.glb") == "pear.glb"
    assert publication._without_folder(r"meshes\pear.glb") == r"meshes\pear.glb"


def test_networks_that_are_loaded_in_inference_mode_have_gradients():
    with torch.inference_mode():
        networks = nb.load("none"), nb.load_classifier("efficientnet_lite0")
    for network in networks:
        tensors = [*network.parameters(), *network.buffers()]
        assert not any(tensor.is_inference() for tensor in tensors)
