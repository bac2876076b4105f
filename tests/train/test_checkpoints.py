import os
import re
from pathlib import Path

import pytest
import torch

from renderer.errors import InputError
from train.checkpoints import load, load_newest, save
from train.data.sets import content_hash
from train.run_folder import BEST, LAST, PREVIOUS

WEIGHTS = {"weight": torch.arange(6.0).reshape(2, 3), "steps": torch.tensor(3)}
STATE = {"model": WEIGHTS, "architecture": {"classes": ["fig", "lime"]}, "epoch": 3}
STATE |= {"history": [{"epoch": 1, "train/loss": 0.25}], "random": [torch.arange(500)]}


class Harmful:
    def __reduce__(self):
        return os.mkdir, ("harm",)


NAN = {"model": {"weight": torch.tensor(torch.nan)}}
SPOILED = {
    "missing": Path.unlink,
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:2000]),
    "code": lambda path: torch.save(Harmful(), path),
    "no architecture": lambda path: save(path, {"model": {}}),
    "NaN": lambda path: save(path, STATE | NAN),
    "later version": lambda path: save(path, STATE | {"architecture": {"version": 99}}),
}


@pytest.mark.parametrize("spoil", SPOILED)
def test_a_file_without_a_network_is_refused_by_name_and_runs_no_code(tmp_path, monkeypatch, spoil):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / BEST
    save(path, STATE)
    SPOILED[spoil](path)
    with pytest.raises(InputError, match=rf"^(checkpoint )?{re.escape(str(path))} [^\n]+$"):
        load(path)
    assert not Path("harm").exists()


def test_different_contents_have_different_hashes_whatever_their_layout_in_memory():
    zeros = torch.zeros(3)
    values = [zeros, zeros.double(), torch.zeros(3, 1), -zeros]
    states = [{"a": [1, 2], "b": value} for value in values] + [{"a": [[1], 2], "b": zeros}]
    assert len({content_hash(state) for state in states}) == len(states)
    images = torch.rand(2, 3, 4, 4)
    same_images = images.contiguous(memory_format=torch.channels_last)
    assert content_hash(same_images) == content_hash(images)


def test_the_newest_undamaged_checkpoint_is_loaded_and_the_fault_of_a_newer_one_reported(tmp_path):
    for epoch in (1, 2):
        save(tmp_path / LAST, STATE | {"epoch": epoch}, tmp_path / PREVIOUS)
    state, fault = load_newest(tmp_path)
    assert (state["epoch"], fault) == (2, None)
    for spoil in (lambda path: path.write_bytes(path.read_bytes()[:-100]), Path.unlink):
        spoil(tmp_path / LAST)
        state, fault = load_newest(tmp_path)
        assert state["epoch"] == 1
        assert str(tmp_path / LAST) in fault
    (tmp_path / PREVIOUS).unlink()
    with pytest.raises(InputError, match=r"last.pt does not exist"):
        load_newest(tmp_path)
