"""Files are replaced as a whole: a write that fails leaves the old file, and no other file."""

import math
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
from renderer.io.files import TEMPORARY, atomic_write, remove_unfinished, replacing, write_numbers
from renderer.io.images import write_image
from renderer.light.environment import read_panorama, write_map
from renderer.light.harmonics import equirectangular
from renderer.light.lamps import Projector
from train import checkpoints
from train.system import user_message

DRAWS = torch.Generator().manual_seed(0)
LIGHT = 0.1 * torch.rand(49, 3, generator=DRAWS)
PATTERN = torch.rand(64 * 64, 3, generator=DRAWS)
RADIANCE = torch.rand(64, 128, 3, generator=DRAWS)
PIXELS = np.random.default_rng(0).integers(0, 256, (64, 64), dtype=np.uint8)
# Functions that write more bytes than `full_disk` allows.
WRITERS: dict[str, Callable[[Path], object]] = {
    "light.json": lambda path: renderer.save_light(path, LIGHT),
    "projector.json": lambda path: renderer.save_light(path, PATTERN, Projector(64)),
    "map.npy": lambda path: write_map(path, RADIANCE),
    "map.hdr": lambda path: write_map(path, RADIANCE),
    "map.exr": lambda path: write_map(path, RADIANCE),
    "mesh.glb": lambda path: renderer.export_mesh(renderer.solid("orange"), path),
    "image.png": lambda path: write_image(path, Image.fromarray(PIXELS)),
    "numbers.npy": lambda path: write_numbers(path, np.ones(4096)),
    "last.pt": lambda path: checkpoints.save(path, {"model": torch.rand(4096)}, path.parent / "b"),
}


@contextmanager
def full_disk(max_bytes: int = 1024) -> Iterator[None]:
    """Let the system refuse to write files beyond a size, as on a full disk."""
    soft_limit, hard_limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, hard_limit))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft_limit, hard_limit))


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def permissions(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("has_old", [False, True])
def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path, name, has_old):
    before = {name: b"the old file"} if has_old else {}
    for content in before.values():
        (tmp_path / name).write_bytes(content)
    with full_disk(), pytest.raises((OSError, InputError), match=name) as raised:
        WRITERS[name](tmp_path / name)
    assert name in user_message(raised.value)  # A command prints this sentence.
    assert contents(tmp_path) == before
    WRITERS[name](tmp_path / name)
    assert contents(tmp_path)[name] != before.get(name)


def test_an_interrupted_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    atomic_write(path, "old")
    with pytest.raises(KeyboardInterrupt), replacing(path) as temporary:
        temporary.write_text("half of the n")
        raise KeyboardInterrupt
    assert contents(tmp_path) == {"a.json": b"old"}


def test_a_new_file_has_ordinary_permissions_and_a_replaced_file_keeps_its_own(tmp_path):
    path = tmp_path / "a.json"
    atomic_write(path, "old")
    (tmp_path / "plain").touch()
    assert permissions(path) == permissions(tmp_path / "plain")
    path.chmod(0o640)
    atomic_write(path, "new")
    assert path.read_text() == "new"
    assert permissions(path) == 0o640


def test_a_write_through_a_link_replaces_its_target(tmp_path):
    target = tmp_path / "a.json"
    link = tmp_path / "link.json"
    atomic_write(target, "old")
    link.symlink_to("a.json")
    atomic_write(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to every file")
def test_a_file_without_permission_to_write_is_not_replaced(tmp_path):
    path = tmp_path / "a.json"
    atomic_write(path, "old")
    path.chmod(0o440)
    with pytest.raises(PermissionError, match=r"a\.json"):
        atomic_write(path, "new")
    assert contents(tmp_path) == {"a.json": b"old"}


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo], ids=["folder", "pipe"])
def test_folders_and_pipes_are_not_replaced(tmp_path, make):
    path = tmp_path / "a.json"
    make(path)
    with pytest.raises(OSError, match=r"a\.json"):
        atomic_write(path, "new")
    assert not path.is_file()
    assert list(tmp_path.iterdir()) == [path]


def test_the_temporary_files_of_a_killed_process_are_removed(tmp_path):
    (tmp_path / TEMPORARY.replace("*", "0")).touch()
    (tmp_path / "own.tmp").touch()
    remove_unfinished(tmp_path)
    assert list(contents(tmp_path)) == ["own.tmp"]


@pytest.mark.parametrize(
    ("suffix", "rows"), [(".npy", 64), (".exr", 64), (".hdr", 64), (".npy", 8), (".npy", 16)]
)
def test_a_map_of_light_negative_in_places_has_its_flux_and_tells_the_error(suffix, rows, tmp_path):
    """Radiance 1 + 2 z has the irradiance π (1 + 4/3 z), with a mean square of π² (1 + 16/27)."""
    light = torch.zeros(49, 3)
    light[0] = math.sqrt(4 * math.pi)
    light[2] = 2 * math.sqrt(4 * math.pi / 3)
    path = tmp_path / f"map{suffix}"
    found = renderer.save_light(path, light, height=rows)
    radiance = read_panorama(path)[..., 0].double()
    directions, solid_angles = equirectangular(*radiance.shape)
    assert radiance.min() >= 0
    assert float((radiance * solid_angles).sum()) == pytest.approx(
        4 * math.pi, rel=0.01 + 2 / rows**2
    )
    height = torch.linspace(-1, 1, 201, dtype=torch.float64)
    normals = torch.stack([(1 - height**2).sqrt(), 0 * height, height], dim=1)
    cosines = (normals @ directions.flatten(0, 1).T).clamp(min=0)
    irradiance = cosines @ (radiance * solid_angles).flatten()
    error = (irradiance - math.pi * (1 + 4 / 3 * height)).square().mean().sqrt()
    root_mean_square = math.pi * math.sqrt(1 + 16 / 27)
    assert found == pytest.approx(float(error) / root_mean_square, abs=0.005)


@pytest.mark.parametrize("name", ["light.json", "light.JSON"])
def test_a_light_with_a_gradient_is_written_without_a_warning_to_a_new_folder(tmp_path, name):
    path = tmp_path / "new" / name
    renderer.save_light(path, LIGHT.clone().requires_grad_())
    assert torch.equal(renderer.load_light(path), LIGHT)


def test_coefficients_beyond_the_power_of_a_projector_are_white_in_the_image(tmp_path):
    projector = Projector(4, power=2.0)
    coefficients = torch.full((projector.size, 3), 2.1)
    coefficients[0] = -0.1
    renderer.save_light(tmp_path / "light.json", coefficients, projector)
    assert np.unique(np.asarray(Image.open(tmp_path / "light.png"))).tolist() == [0, 255]
