import json
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
import torch
from safetensors import safe_open

from renderer.errors import InputError
from renderer.io.images import read_square
from train.command_settings import EvaluateSettings, PublishSettings
from train.commands.evaluate import evaluate
from train.commands.publish import publish_network
from train.report.summary import summarize
from train.runs import checkpoint
from train.runs.saved_networks import PUBLISHED, load_run, load_selected
from train.system.hashing import content_hash


def test_a_published_network_loads_and_its_file_holds_settings_and_scores_without_paths(finished, tmp_path):
    out = tmp_path / "pretrained" / "tiny"
    publish_network(PublishSettings(str(finished), str(out)))
    assert [path.name for path in out.iterdir()] == [PUBLISHED]
    network = load_run(out)
    assert network.classes == ("apple", "orange", "pear") and network.function.head.in_features == 64
    with safe_open(out / PUBLISHED, "pt") as file:
        metadata = {name: json.loads(text) for name, text in file.metadata().items()}
    assert metadata["settings"]["data.path"] == "tiny.npz" and metadata["settings"]["train.epochs"] == 3
    summary = json.loads((finished / "photographs" / "summary.json").read_text())
    assert metadata["scores"]["photographs"]["auc"] == summary["auc"]
    scored, run = summarize(out), summarize(finished)
    assert (scored.accuracy, scored.photographs) == (run.accuracy, run.photographs)
    assert str(finished.parent) not in str(metadata) and str(tmp_path) not in str(metadata)


def test_an_operating_point_is_published_kept_and_used(finished, photos, tmp_path):
    """The threshold of a rate of 1/2 on four others, tomatoes and apples, is the third of their log-odds."""
    first, second = tmp_path / "first", tmp_path / "second"
    with pytest.raises(InputError, match="together, or neither"):
        PublishSettings(str(finished), str(first), false_positive_rate=0.5)
    publish_network(PublishSettings(str(finished), str(first)))
    with pytest.raises(InputError, match="has no operating point"):
        load_run(first).detect(torch.zeros(1, 3, 16, 16))
    publish_network(PublishSettings(str(first), str(first), 0.5, str(photos)))
    publish_network(PublishSettings(str(first), str(second)))
    hashes = [content_hash(sorted(load_selected(folder)[1].items())) for folder in (first, second)]
    assert hashes[0] == hashes[1]
    network = load_run(second)
    files = [path for path in sorted(photos.rglob("*.png")) if path.parent.name != "orange"]
    images = torch.stack([torch.from_numpy(np.array(read_square(path, 16))).permute(2, 0, 1) / 255 for path in files])
    odds = torch.logit(network(images).double().softmax(1)[:, 1])
    (point,) = network.operating_points
    assert point.threshold == pytest.approx(float(odds.sort().values[1]), rel=1e-5)
    assert network.detect(images).sum() == 2
    evaluate(EvaluateSettings(str(photos), str(second), out=str(tmp_path / "scores")))
    summary = json.loads((tmp_path / "scores" / "summary.json").read_text())
    assert summary["operating_point"] == vars(point) | {"in_sample": True}


def test_each_of_several_labels_has_its_own_threshold(finished, photos, tmp_path):
    labels, both = ["orange", "apple"], tmp_path / "both"
    for name, label in {"both": labels, "orange": "orange", "apple": "apple"}.items():
        publish_network(PublishSettings(str(finished), str(tmp_path / name), 0.5, str(photos), label))
    network, images = load_run(both), torch.rand(9, 3, 16, 16)
    for label, point in zip(labels, network.operating_points, strict=True):
        (own,) = load_run(tmp_path / label).operating_points
        assert (point.label, point.threshold) == (label, own.threshold)
        assert torch.equal(network.detect(images, label), load_run(tmp_path / label).detect(images))
    with pytest.raises(InputError, match="but of orange, apple: give one of these as label"):
        network.detect(images)
    settings = EvaluateSettings(str(photos), str(both), label=labels[::-1], out=str(tmp_path / "scores"))
    evaluate(settings)
    summary = json.loads((tmp_path / "scores" / "summary.json").read_text())
    assert [point["label"] for point in summary["operating_point"]] == labels[::-1]


def test_a_network_that_cannot_be_built_is_not_published(finished, tmp_path):
    run = copytree(finished, tmp_path / "run")
    state = checkpoint.load(run / checkpoint.BEST)
    checkpoint.save(run / checkpoint.BEST, state | {"architecture": state["architecture"] | {"width": "wide"}})
    with pytest.raises(InputError, match=r"best\.pt is from another architecture"):
        publish_network(PublishSettings(str(run), str(tmp_path / "out")))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["none", "random", "adversarial", "best"])
def test_each_pretrained_network_says_what_it_left_out_and_has_scores_on_one_set_of_photographs(name):
    architecture = load_selected(Path("pretrained", name))[1]["architecture"]
    assert architecture["validation"]["fraction"] == 0.02
    images = {summarize(Path("pretrained", other)).photographs["photographs"].images for other in ("none", name)}
    assert len(images) == 1
