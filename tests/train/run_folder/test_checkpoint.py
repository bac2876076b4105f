import errno
import os
import pickle
import re
import sys
from pathlib import Path

import pytest
import torch

from renderer.errors import InputError
from train.networks import WideResNet
from train.run_folder import files
from train.run_folder.checkpoint import BEST, LAST, PREVIOUS, content_hash, load, load_newest, save


def state_of(network: WideResNet) -> dict:
    return {"model": network.state_dict(), "architecture": {"classes": ["fig", "lime"]}}


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
