import errno
import os
import pickle
import re
import sys
from pathlib import Path

import pytest
import safetensors.torch
import torch

from renderer.errors import InputError
from train.run_folder import files
from train.run_folder.checkpoint import BEST, LAST, PREVIOUS, content_hash, load, load_newest, save
from train.run_folder.classifier import (
    PUBLISHED,
    describe,
    load_run,
    load_selected,
    load_weights,
    publish,
    start_from,
)
from train.wideresnet import WideResNet

CLASSES = ["fig", "lime"]


def state_of(network: WideResNet, classes: list[str] = CLASSES, **architecture) -> dict:
    shape = {"depth": 10, "width": 1, "dropout": 0.0} | architecture
    return {"model": network.state_dict(), "architecture": {"classes": classes, **shape}}


def description_of(network: WideResNet, **changes) -> dict:
    shape = {"size": 32, "encoding": "linear", "depth": 10, "width": 1, "dropout": 0.0} | changes
    return describe(network, CLASSES, **shape)


@pytest.fixture
def network() -> WideResNet:
    """With statistics of its own, as after training."""
    torch.manual_seed(0)
    network = WideResNet(2, 10, 1, 0.0, mean=(0.1, 0.2, 0.3), std=(0.3, 0.2, 0.1))
    with torch.no_grad():
        for _ in range(3):
            network(torch.rand(8, 3, 16, 16))
    return network.eval()


class Harmful:
    def __reduce__(self):
        return os.mkdir, ("harm",)


# ---------------------------------------------------------------------------------------- writing


def test_a_checkpoint_comes_back_as_it_was_written(network, tmp_path):
    state = state_of(network) | {"epoch": 3, "arm": "none"}
    save(tmp_path / LAST, state)
    found = load(tmp_path / LAST)
    assert found.keys() == state.keys()
    assert {name: found[name] for name in ("epoch", "arm", "architecture")} == {
        name: state[name] for name in ("epoch", "arm", "architecture")
    }
    for name, value in state["model"].items():
        assert torch.equal(found["model"][name], value)
    assert os.listdir(tmp_path) == [LAST]


@pytest.mark.parametrize("fault", ["os.fsync", "os.replace"])
def test_a_disk_that_is_full_leaves_the_old_checkpoint_whole_and_the_error_names_the_new_one(
    network, tmp_path, monkeypatch, fault
):
    save(tmp_path / LAST, state_of(network) | {"epoch": 1})
    before = (tmp_path / LAST).read_bytes()

    def fail(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    module, function = fault.split(".")
    monkeypatch.setattr(getattr(files, module), function, fail)
    with pytest.raises(OSError, match="No space left on device") as full:
        save(tmp_path / LAST, state_of(network) | {"epoch": 2}, tmp_path / PREVIOUS)
    assert full.value.errno == errno.ENOSPC and full.value.filename == str(tmp_path / LAST)
    assert os.listdir(tmp_path) == [LAST]
    assert (tmp_path / LAST).read_bytes() == before
    monkeypatch.undo()
    save(tmp_path / LAST, state_of(network) | {"epoch": 2})
    assert load(tmp_path / LAST)["epoch"] == 2


# ---------------------------------------------------------------------------------------- reading


@pytest.mark.parametrize(
    "spoil, fault",
    [
        pytest.param(lambda path: path.unlink(), "does not exist", id="missing"),
        pytest.param(lambda path: path.write_bytes(b""), "is damaged", id="empty"),
        pytest.param(lambda path: path.write_bytes(path.read_bytes()[:2000]), "is damaged", id="truncated"),
        pytest.param(lambda path: path.write_text("a note"), "is damaged", id="text"),
        pytest.param(lambda path: path.write_bytes(pickle.dumps({"model": 1})), "is damaged", id="pickle"),
        pytest.param(lambda path: torch.save(Harmful(), path), "is damaged", id="code"),
        pytest.param(lambda path: torch.save(torch.zeros(3), path), "lacks its model", id="tensor"),
        pytest.param(lambda path: torch.save({"state_dict": {}}, path), "lacks its model", id="foreign"),
        pytest.param(lambda path: torch.save({"model": {}}, path), "lacks its model", id="no architecture"),
    ],
)
def test_a_file_that_is_no_checkpoint_is_named_and_runs_no_code(network, tmp_path, monkeypatch, spoil, fault):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / BEST
    save(path, state_of(network))
    spoil(path)
    with pytest.raises(InputError, match=f"checkpoint {re.escape(str(path))} {fault}"):
        load(path)
    assert not Path("harm").exists()


def test_a_flipped_byte_is_noticed_or_changes_nothing(network, tmp_path):
    """The zip archive inside has bytes that nobody reads; all others are under the hash."""
    path = tmp_path / LAST
    state = state_of(network) | {"history": [{"epoch": 1, "train/loss": 0.25}], "random": [torch.arange(5)]}
    save(path, state)
    whole, noticed = path.read_bytes(), 0
    for place in range(0, len(whole), len(whole) // 200):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x40]) + whole[place + 1 :])
        try:
            found = load(path)
        except InputError as error:
            assert f"checkpoint {path}" in str(error)
            noticed += 1
        else:
            assert content_hash(found) == content_hash(state)
    assert noticed > 100


@pytest.mark.parametrize(
    "other",
    [
        {"a": [1, 2], "b": torch.zeros(2)},
        {"a": [1, 3], "b": torch.zeros(3)},
        {"a": [1, 2, 3], "b": torch.zeros(3)},
        {"a": [[1], 2], "b": torch.zeros(3)},
        {"a": [1, 2], "b": torch.zeros(3, dtype=torch.float64)},
        {"a": [1, 2], "b": torch.zeros(3, 1)},
        {"a": [1, 2.0], "b": torch.zeros(3)},
        {"a": [1, 2], "c": torch.zeros(3)},
        {"a": [1, 2], "b": -torch.zeros(3)},
    ],
)
def test_the_hash_tells_contents_apart(other):
    assert content_hash(other) != content_hash({"a": [1, 2], "b": torch.zeros(3)})


def test_the_hash_does_not_depend_on_memory_layout():
    images = torch.rand(2, 3, 4, 4)
    assert content_hash(images) == content_hash(images.contiguous(memory_format=torch.channels_last))


def test_the_newest_whole_checkpoint_is_taken_and_what_is_wrong_with_a_newer_one_is_told(network, tmp_path):
    for epoch in (1, 2):
        save(tmp_path / LAST, state_of(network) | {"epoch": epoch}, tmp_path / PREVIOUS)
    assert load_newest(tmp_path)[0]["epoch"] == 2 and load_newest(tmp_path)[1] is None
    for spoil in (lambda path: path.write_bytes(path.read_bytes()[:-100]), Path.unlink):
        spoil(tmp_path / LAST)
        state, problem = load_newest(tmp_path)
        assert state["epoch"] == 1 and f"checkpoint {tmp_path / LAST}" in problem
    (tmp_path / PREVIOUS).unlink()
    with pytest.raises(InputError, match=r"last.pt does not exist"):
        load_newest(tmp_path)


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


def test_a_network_starts_with_the_weights_and_the_normalisation_of_another(network, tmp_path):
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


def test_a_checkpoint_nested_beyond_reason_is_one_error(network, tmp_path):
    nested = []
    for _ in range(3000):
        nested = [nested]
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(20_000)  # whoever forges one has as much
    try:
        torch.save(state_of(network) | {"more": nested}, tmp_path / BEST)
    finally:
        sys.setrecursionlimit(limit)
    with pytest.raises(InputError, match=r"best\.pt is damaged"):
        load(tmp_path / BEST)


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
