import re
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from PIL import Image, ImageOps

from renderer.errors import InputError
from train.run_folder.checkpoint import BEST, save
from train.run_folder.classifier import (
    PUBLISHED,
    describe,
    load_classifier,
    load_run,
    load_selected,
    load_weights,
    publish,
    start_from,
)
from train.wideresnet import WideResNet

PRETRAINED = Path(__file__).parents[3] / "pretrained"
DATA = Path(__file__).parents[4] / "shared" / "data"


CLASSES = ["fig", "lime"]


def state_of(network: WideResNet, classes: list[str] = CLASSES, **architecture) -> dict:
    shape = {"depth": 10, "width": 1, "dropout": 0.0} | architecture
    return {"model": network.state_dict(), "architecture": {"classes": classes, **shape}}


def description_of(network: WideResNet, **changes) -> dict:
    shape = {"size": 32, "encoding": "linear", "depth": 10, "width": 1, "dropout": 0.0} | changes
    return describe(network, CLASSES, **shape)


@pytest.fixture
def run(tmp_path) -> Path:
    torch.manual_seed(0)
    network = WideResNet(2, 10, 1, 0.3, mean=(0.1, 0.2, 0.3), std=(0.3, 0.2, 0.1))
    architecture = {"classes": ["fig", "lime"], "size": 48, "depth": 10, "width": 1, "dropout": 0.3}
    save(tmp_path / BEST, {"model": network.state_dict(), "architecture": architecture})
    return tmp_path


@pytest.mark.parametrize("file", ["", BEST], ids=["folder", "file"])
def test_a_run_is_a_classifier_of_its_own_classes_at_its_own_size(run, file):
    classifier = load_classifier(f"run:{run / file}")
    assert (classifier.classes, classifier.size) == (("fig", "lime"), 48)
    assert classifier.name == f"run:{run / file}"
    network = WideResNet(2, 10, 1).eval()
    network.load_state_dict(torch.load(run / BEST, weights_only=True)["model"])
    images = torch.rand(3, 3, 48, 48)
    assert torch.equal(classifier(images), network(images))


def test_a_published_run_is_a_classifier_too(run):
    publish(run / PUBLISHED, torch.load(run / BEST, weights_only=True))
    (run / BEST).unlink()
    assert load_classifier(f"run:{run}").label("lime") == 1


def test_classifiers_of_other_sources_are_loaded_by_the_same_name():
    with pytest.raises(InputError, match="classifier=squeezenet_caffe comes without weights"):
        load_classifier("squeezenet_caffe")


@pytest.mark.parametrize(
    "name, weights, message",
    [
        ("run:absent", None, "run=absent holds neither best.pt nor model.safetensors"),
        ("run:absent", "a.pth", "weights=a.pth is not for classifier=run:absent, which has weights of its own: leave"),
        ("runs/2026-01-01", None, "squeezenet_caffe, torchvision:NAME, python:NAME, run:NAME"),
    ],
)
def test_what_cannot_be_loaded_is_one_sentence(name, weights, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_classifier(name, weights)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("arm", ["none", "random", "adversarial"])
def test_the_published_networks_are_classifiers_of_cifar_100(arm):
    classifier = load_classifier(f"run:{PRETRAINED / arm}")
    assert (len(classifier.classes), classifier.size, classifier.label("orange")) == (100, 32, 53)
    images = torch.full((1, 3, 32, 32), 0.5, requires_grad=True)
    (gradient,) = torch.autograd.grad(classifier(images)[0, 53], images)
    assert gradient.isfinite().all() and gradient.any()


@pytest.mark.realdata
@pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is absent")
def test_the_published_base_recognizes_most_oranges_in_rgb():
    """And hardly one with red and blue exchanged, unlike the networks that were hardened against light."""
    classifier = load_classifier(f"run:{PRETRAINED / 'none'}")
    paths = sorted((DATA / "photos" / "orange").iterdir())[::9]
    squares = [ImageOps.fit(Image.open(path).convert("RGB"), (32, 32), Image.Resampling.LANCZOS) for path in paths]
    images = torch.from_numpy(np.stack(squares)).permute(0, 3, 1, 2).float() / 255
    with torch.no_grad():
        recall, swapped = ((classifier(each).argmax(1) == 53).float().mean() for each in (images, images.flip(1)))
    assert recall > 0.6 and swapped < 0.05


# ---------------------------------------------------------------------------------------- a network on disk


def test_weights_of_another_architecture_are_named(network):
    other = WideResNet(3, 10, 1)
    with pytest.raises(InputError, match=r"a\.pt is from another architecture \(.* size mismatch for head.weight"):
        load_weights(other, network.state_dict(), Path("a.pt"))
    deeper = WideResNet(2, 16, 1)
    with pytest.raises(InputError, match=r'Missing key\(s\) in state_dict: "groups.0.1.'):
        load_weights(deeper, network.state_dict(), Path("a.pt"))
    with pytest.raises(InputError, match=r'Unexpected key\(s\) in state_dict: "groups.0.1.'):
        load_weights(network, deeper.state_dict(), Path("a.pt"))


def test_a_network_loads_from_its_file_or_its_run_folder(network, tmp_path):
    save(tmp_path / BEST, state_of(network))
    images = torch.rand(3, 3, 32, 32)
    for path in (tmp_path, tmp_path / BEST):
        loaded = load_run(path)
        assert loaded.classes == ("fig", "lime")
        assert torch.equal(loaded(images), network(images))


def test_a_network_is_stored_with_all_that_it_takes_to_use_it(network, tmp_path):
    described = describe(network, CLASSES, size=64, encoding="srgb", depth=10, width=1, dropout=0.0)
    state = {"model": network.state_dict(), "architecture": described}
    save(tmp_path / BEST, state)
    publish(tmp_path / PUBLISHED, state)
    for name in (BEST, PUBLISHED):
        loaded = load_run(tmp_path / name)
        assert (loaded.size, loaded.classes) == (64, ("fig", "lime"))
        kept = load_selected(tmp_path / name)[1]["architecture"]
        assert kept["encoding"] == "srgb"
        assert kept["mean"] == pytest.approx([0.1, 0.2, 0.3]) and kept["std"] == pytest.approx([0.3, 0.2, 0.1])
        with pytest.raises(InputError, match=r"size=32: .* was trained on images of 64 pixels per side"):
            load_run(tmp_path / name, size=32)


def test_an_old_network_that_does_not_say_its_size_has_32_or_the_one_asked_for(network, tmp_path):
    save(tmp_path / BEST, state_of(network))
    assert load_run(tmp_path).size == 32
    assert load_run(tmp_path, size=64).size == 64


@pytest.mark.parametrize(
    "key, value", [("version", "2"), ("version", None), ("size", "32"), ("size", 0), ("size", 1e3), ("size", 10**9),
                   ("encoding", 3), ("encoding", ["srgb"]), ("classes", 3), ("depth", "10"), ("mean", "a")]
)  # fmt: skip
def test_a_network_that_says_what_cannot_be_meant_is_refused_in_one_sentence(network, tmp_path, key, value):
    state = state_of(network)
    state["architecture"] = state["architecture"] | {key: value}
    save(tmp_path / BEST, state)
    publish(tmp_path / PUBLISHED, state)
    for name in (BEST, PUBLISHED):
        with pytest.raises(InputError, match=rf"^checkpoint {tmp_path / name} [^\n]+$"):
            load_run(tmp_path / name)


@pytest.mark.parametrize("architecture", [None, [], "orange", 3])
def test_a_network_without_a_description_is_refused_by_name(network, tmp_path, architecture):
    state = state_of(network) | {"architecture": architecture}
    save(tmp_path / BEST, state)
    publish(tmp_path / PUBLISHED, state)
    for name in (BEST, PUBLISHED):
        with pytest.raises(InputError, match=rf"^checkpoint {tmp_path / name} .*lacks its .*architecture"):
            load_run(tmp_path / name)


def test_a_network_of_a_later_version_is_refused(network, tmp_path):
    save(tmp_path / BEST, state_of(network, version=99))
    with pytest.raises(InputError, match=r"best.pt was written by a later version"):
        load_run(tmp_path)


# ---------------------------------------------------------------------------------------- starting from another run's


def test_a_network_starts_with_the_weights_and_the_normalization_of_another(network, tmp_path):
    save(tmp_path / BEST, {"model": network.state_dict(), "architecture": description_of(network)})
    own = WideResNet(2, 10, 1, 0.3, mean=(0.5, 0.5, 0.5))
    start_from(own, description_of(own, dropout=0.3), tmp_path)
    images = torch.rand(3, 3, 32, 32)
    assert torch.equal(own.eval()(images), network(images))


@pytest.mark.parametrize(
    "change, fault",
    [
        ({"classes": ["lime", "fig"]}, "other classes"),
        ({"size": 64}, "size 32, not 64"),
        ({"depth": 16}, "depth 10, not 16"),
        ({"width": 2}, "width 1, not 2"),
    ],
)
def test_a_start_that_contradicts_the_run_is_one_sentence(network, tmp_path, change, fault):
    save(tmp_path / BEST, {"model": network.state_dict(), "architecture": description_of(network)})
    with pytest.raises(
        InputError, match=f"train.init_from={tmp_path} was trained with {fault}: give this run the same"
    ):
        start_from(network, {**description_of(network), **change}, tmp_path)


@pytest.mark.parametrize(
    "architecture",
    [
        {"classes": ["fig", "lime"], "depth": 11},
        {"classes": ["fig", "lime"], "depth": 10, "heads": 3},
        {"depth": 10},
        {"classes": None},
        {"classes": [], "depth": 10, "width": 1},
        {"classes": ["fig", "lime", "pear"], "depth": 10, "width": 1},
        {"classes": ["fig", "lime"], "depth": 10, "width": 2},
        {"classes": ["fig", "lime"], "depth": 6 * 10**9 + 4, "width": 1},
        {"classes": ["fig", "lime"], "depth": 10, "width": 10**9},
        {"classes": ["fig", "lime"], "depth": 10.0, "width": 1},
        {"classes": ["fig", "lime"], "depth": 10, "width": 1, "mean": [0.5]},
        {"classes": 2, "depth": 10, "width": 1},
    ],
)
def test_a_checkpoint_of_another_network_is_one_error(network, tmp_path, architecture):
    save(tmp_path / BEST, state_of(network) | {"architecture": architecture})
    with pytest.raises(InputError, match=r"best.pt is from another architecture"):
        load_run(tmp_path)


@pytest.mark.parametrize("model", [None, 3, ["stem"], {"stem.weight": 1}, {}])
def test_a_checkpoint_of_other_things_than_weights_is_one_error(network, tmp_path, model):
    save(tmp_path / BEST, state_of(network) | {"model": model})
    with pytest.raises(InputError, match=r"checkpoint .*best\.pt (holds other things|is from another architecture)"):
        load_run(tmp_path)


def test_a_folder_without_a_network_is_one_error(tmp_path):
    with pytest.raises(InputError, match=f"run={re.escape(str(tmp_path))} holds neither best.pt nor model.safetensors"):
        load_run(tmp_path)


# ---------------------------------------------------------------------------------------- publishing


def test_a_published_network_is_the_same_to_half_precision(network, tmp_path):
    publish(tmp_path / PUBLISHED, state_of(network))
    for path in (tmp_path, tmp_path / PUBLISHED):
        loaded = load_run(path)
        assert loaded.classes == ("fig", "lime")
        found_state = loaded.function.state_dict()
        for (name, value), found in zip(network.state_dict().items(), found_state.values(), strict=True):
            assert found.dtype == value.dtype
            # rounding to 11 bits; below 2^-14 half precision is spaced evenly
            bound = value.double().abs() * 2**-11 + 2**-25
            assert ((found.double() - value.double()).abs() <= bound).all(), name


def test_a_published_file_that_cannot_be_written_is_an_error_that_names_it(network, tmp_path):
    (tmp_path / "model.safetensors").mkdir()
    with pytest.raises(IsADirectoryError, match=r"model\.safetensors"):
        publish(tmp_path / "model.safetensors", {"model": network.state_dict(), "architecture": {}})


def test_a_published_file_takes_half_the_room_and_any_memory_layout(network, tmp_path):
    publish(tmp_path / "a.safetensors", state_of(network.to(memory_format=torch.channels_last)))
    numbers = sum(value.numel() for value in network.state_dict().values())
    assert (tmp_path / "a.safetensors").stat().st_size < 2 * numbers + 10_000
    network.to(memory_format=torch.contiguous_format)
    publish(tmp_path / "b.safetensors", state_of(network))
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda path: path.write_bytes(path.read_bytes()[:-10]), id="truncated"),
        pytest.param(lambda path: path.write_bytes(b""), id="empty"),
        pytest.param(lambda path: safetensors.torch.save_file({"a": torch.zeros(1)}, path), id="no architecture"),
        pytest.param(
            lambda path: safetensors.torch.save_file({"a": torch.zeros(1)}, path, {"architecture": "{"}), id="no JSON"
        ),
    ],
)
def test_a_damaged_published_file_is_one_error(network, tmp_path, spoil):
    path = tmp_path / PUBLISHED
    publish(path, state_of(network))
    spoil(path)
    with pytest.raises(InputError, match=r"model.safetensors is damaged or lacks its architecture"):
        load_run(tmp_path)
