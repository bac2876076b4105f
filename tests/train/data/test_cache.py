"""The cache on disk is a hit if nothing has changed, and a miss if the file is damaged."""

import errno
import shutil
from pathlib import Path

import pytest
import torch

import renderer
from train.data.cache import TensorCache, cache_folder, source_key

KEY = "a key"
TENSORS = {
    "ratios": torch.tensor([[0.1, -0.0], [float("inf"), 1e-45]]),
    "indices": torch.tensor([3, -1]),
    "nothing": torch.zeros(3, 0),
}


def test_any_change_of_the_sources_is_another_key(tmp_path):
    package = tmp_path / "package"
    shutil.copytree(
        Path(renderer.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    assert source_key(package) == source_key(Path(renderer.__file__).parent)
    module = package / "camera.py"
    keys = {source_key(package)}
    for change in (
        lambda: module.write_text(module.read_text() + "\n"),
        lambda: module.rename(package / "other.py"),
        lambda: (package / "new.py").touch(),
    ):
        change()
        keys.add(source_key(package))
    assert len(keys) == 4


@pytest.fixture
def written(tmp_path) -> tuple[TensorCache, Path]:
    tensors = TensorCache(tmp_path)
    tensors.write(KEY, TENSORS)
    return tensors, tmp_path / KEY


def test_tensors_come_back_to_the_bit_and_not_under_another_key(written):
    tensors, path = written
    loaded = tensors.read(KEY)
    assert loaded.keys() == TENSORS.keys()
    for name, tensor in TENSORS.items():
        assert loaded[name].dtype == tensor.dtype
        assert loaded[name].shape == tensor.shape
        assert loaded[name].numpy().tobytes() == tensor.numpy().tobytes()
    shutil.copy(path, path.with_name("another key"))
    assert tensors.read("another key") is None


def test_no_flipped_bit_and_no_cut_is_taken_for_the_file(written):
    """Every bit of every byte, header and checksum as well, and every length."""
    tensors, path = written
    content = path.read_bytes()
    for position in range(len(content)):
        path.write_bytes(content[:position])
        assert tensors.read(KEY) is None, position
        for bit in range(8) if position % 16 == 0 else [position % 8]:
            flipped = content[position] ^ 1 << bit
            path.write_bytes(content[:position] + bytes([flipped]) + content[position + 1 :])
            assert tensors.read(KEY) is None, (position, bit)
    path.write_bytes(content)
    assert tensors.read(KEY) is not None


def test_a_full_disk_stops_no_run_and_is_tried_and_logged_once(tmp_path, monkeypatch, caplog):
    tries = []

    def full(*_):
        tries.append(1)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    cache = TensorCache(tmp_path)
    for _ in range(3):
        cache.write(KEY, TENSORS)
    assert caplog.text.count("No space left on device") == len(tries) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("choice", "environment", "folder"),
    [
        (
            "auto",
            {"XDG_CACHE_HOME": "/caches", "HOME": "/home/user"},
            "/caches/parametric-norm-balls",
        ),
        ("auto", {"HOME": "/home/user"}, "/home/user/.cache/parametric-norm-balls"),
        ("auto", {"XDG_CACHE_HOME": "relative", "HOME": "/home/user"}, None),
        ("~/here", {"HOME": "/home/user"}, "/home/user/here"),
        (None, {"XDG_CACHE_HOME": "/caches", "HOME": "/home/user"}, None),
    ],
)
def test_the_folder_is_the_users_cache_folder_unless_chosen(
    choice, environment, folder, monkeypatch
):
    monkeypatch.delenv("XDG_CACHE_HOME")
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert cache_folder(choice) == (folder and Path(folder))
