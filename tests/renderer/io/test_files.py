"""Files are replaced as a whole: a write that fails leaves the old file, and nothing beside it."""

import json
import os
import resource
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import renderer
from renderer.errors import InputError
from renderer.io.files import TEMPORARY, remove_unfinished, replacing, write_whole
from renderer.io.images import write_image, write_numbers
from renderer.light.environment import write_map
from renderer.light.projector import Projector
from train.runs import checkpoint

LIGHT = 0.1 * torch.rand(49, 3, generator=torch.Generator().manual_seed(0))
PATTERN = torch.rand(64 * 64, 3, generator=torch.Generator().manual_seed(0))
PIXELS = np.random.default_rng(0).integers(0, 256, (64, 64), dtype=np.uint8)
WRITERS: dict[str, Callable[[Path], object]] = {  # each writes more than a full disk takes
    "light.json": lambda path: renderer.save_light(path, LIGHT),
    "projector.json": lambda path: renderer.save_light(path, PATTERN, Projector(64)),
    **dict.fromkeys(("a.npy", "a.hdr", "a.exr"), lambda path: write_map(path, torch.rand(64, 128, 3))),
    "mesh.glb": lambda path: renderer.export_mesh(renderer.solid("orange"), path),
    "image.png": lambda path: write_image(path, Image.fromarray(PIXELS)),
    "numbers.npy": lambda path: write_numbers(path, np.ones(4096)),
    "last.pt": lambda path: checkpoint.save(path, {"model": {"weight": torch.rand(4096)}}),
}


@contextmanager
def full_disk(most: int = 1024) -> Iterator[None]:
    """No file grows beyond a number of bytes: the system refuses to write more, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("existing", [True, False])
@pytest.mark.parametrize("name", WRITERS)
def test_a_write_that_fails_leaves_the_old_file_whole_and_no_other(tmp_path, name, existing):
    path, old = tmp_path / name, b"the old file, which was whole"
    if existing:
        path.write_bytes(old)
    with full_disk(), pytest.raises((OSError, InputError), match=name.replace(".", r"\.")):
        WRITERS[name](path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == ({name: old} if existing else {})
    WRITERS[name](path)
    assert path.read_bytes() != old


def test_an_error_while_a_file_is_made_leaves_the_old_one(tmp_path):
    write_whole(tmp_path / "a.json", "old")
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.json") as temporary:
        temporary.write_text("half of the n")
        raise KeyboardInterrupt
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]


def test_a_file_keeps_its_permissions_and_a_link_its_target(tmp_path):
    write_whole(tmp_path / "a.json", "old")
    new = stat.S_IMODE((tmp_path / "a.json").stat().st_mode)
    (tmp_path / "plain").touch()
    assert new == stat.S_IMODE((tmp_path / "plain").stat().st_mode)
    (tmp_path / "a.json").chmod(0o640)
    (tmp_path / "link.json").symlink_to("a.json")
    write_whole(tmp_path / "link.json", "new")
    assert (tmp_path / "link.json").is_symlink() and (tmp_path / "a.json").read_text() == "new"
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o640


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to every file")
def test_a_file_that_may_not_be_written_is_not_replaced(tmp_path):
    write_whole(tmp_path / "a.json", "old")
    (tmp_path / "a.json").chmod(0o440)
    with pytest.raises(PermissionError, match=r"a\.json"):
        write_whole(tmp_path / "a.json", "new")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo], ids=["folder", "pipe"])
def test_only_a_file_is_replaced(tmp_path, make):
    make(tmp_path / "a.json")
    with pytest.raises(OSError, match=r"a\.json"):
        write_whole(tmp_path / "a.json", "new")
    assert not (tmp_path / "a.json").is_file() and len(list(tmp_path.iterdir())) == 1


def test_what_a_killed_process_left_is_removed(tmp_path):
    (tmp_path / TEMPORARY.replace("*", "0")).touch()
    (tmp_path / "own.tmp").touch()
    remove_unfinished(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["own.tmp"]


@pytest.mark.parametrize("kind", [str, Path])
def test_functions_take_paths_as_text_and_as_path(tmp_path, kind):
    renderer.save_light(kind(tmp_path / "light.json"), LIGHT)
    assert torch.equal(renderer.load_light(kind(tmp_path / "light.json")), LIGHT)
    assert json.loads((tmp_path / "light.json").read_text())["basis"] == "harmonics"
    renderer.export_mesh(renderer.solid("orange"), kind(tmp_path / "orange.glb"))
    assert len(renderer.load_mesh(kind(tmp_path / "orange.glb")).faces)
