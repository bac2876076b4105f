"""The cache on disk: a hit where nothing has changed, a miss where anything has or the file is damaged."""

import errno
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from renderer import cache, transfer
from renderer.cache import OperatorCache, TensorCache, cache_folder, content_key, source_key
from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.image import ImageSettings
from renderer.light.basis import Harmonics
from renderer.mesh import Mesh, normalize
from renderer.rasterizer import Rasterizer, choose
from renderer.rasterizer import numpy as numpy_rasterizer
from renderer.shapes import solid
from renderer.transfer import TransferOperator, build_operators

RASTERIZER = choose("numpy")
SETTINGS = ImageSettings(size=8, samples=2)
CAMERA = OrthographicCamera(1.0, 0.5, 2.0)
PLATE = normalize(solid("plate"))
KEY = "a key"
TENSORS = {
    "ratios": torch.tensor([[0.1, -0.0], [float("inf"), 1e-45]]),
    "indices": torch.tensor([3, -1]),
    "nothing": torch.zeros(3, 0),
}


def textured(texels: np.ndarray) -> Mesh:
    """A triangle that looks up, under a texture."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    uvs = np.array([[[0, 0], [1, 0], [0.5, 1]]], dtype=np.float32)
    mesh = Mesh.plain(corners, [[0, 1, 2]])
    return replace(mesh, corner_uvs=uvs, texture_ids=np.zeros(1, np.int32), textures=(texels,))


TEXELS = np.random.default_rng(0).integers(0, 256, (4, 4, 3), dtype=np.uint8)
TEXTURED = textured(TEXELS)
MESHES = {
    "closed, many colors": PLATE,
    "textured": TEXTURED,
    "out of the image": replace(TEXTURED, vertices=TEXTURED.vertices + np.array([0, 0, 9])),
}


def same(first: list[TransferOperator], second: list[TransferOperator]) -> bool:
    return all(
        a.basis == b.basis
        and all(torch.equal(getattr(a, name), getattr(b, name)) for name in transfer.TENSORS)
        and all(getattr(a, name).dtype == getattr(b, name).dtype for name in transfer.TENSORS)
        for a, b in zip(first, second, strict=True)
    )


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_a_second_run_builds_nothing_and_has_the_same_operators_to_the_bit(mesh, tmp_path, rasterized):
    cameras = orbit_cameras(3, 2.0)
    expected = build_operators(mesh, cameras, SETTINGS, RASTERIZER, 1.5)
    for _ in range(3):
        assert same(OperatorCache(tmp_path).operators(mesh, cameras, SETTINGS, RASTERIZER, 1.5), expected)
    assert rasterized == [3, 3]


def test_without_a_folder_every_run_builds_and_a_view_asked_for_twice_is_built_once(tmp_path, monkeypatch, rasterized):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        first, second = OperatorCache().operators(PLATE, [CAMERA, CAMERA], SETTINGS, RASTERIZER)
        assert same([first], [second])
    assert rasterized == [1, 1] and not list(tmp_path.iterdir())


def changed(array: np.ndarray, index: tuple, by: float) -> np.ndarray:
    array = array.copy()
    array[index] += by
    return array


CHANGES = {
    "a texel": {"mesh": textured(changed(TEXELS, (3, 1, 2), 1))},
    "a vertex, by one rounding": {"mesh": replace(TEXTURED, vertices=changed(TEXTURED.vertices, (2, 1), 2.0**-52))},
    "a face": {"mesh": replace(TEXTURED, faces=TEXTURED.faces[:, [1, 2, 0]])},
    "a corner's color": {"mesh": replace(TEXTURED, corner_colors=changed(TEXTURED.corner_colors, (0, 0, 0), -0.1))},
    "a corner's texel": {"mesh": replace(TEXTURED, corner_uvs=changed(TEXTURED.corner_uvs, (0, 0, 0), 0.1))},
    "the polar angle": {"camera": replace(CAMERA, polar=np.nextafter(CAMERA.polar, 2))},
    "the field of view": {"camera": replace(CAMERA, width=2.1)},
    "the size": {"settings": replace(SETTINGS, size=9)},
    "the shadows": {"settings": replace(SETTINGS, shadows=True)},
    "the albedo scale": {"albedo_scale": 1.1},
    "the basis": {"basis": Harmonics(2)},
    "the dtype": {"dtype": torch.float64},
    "the rasterizer": {"rasterizer": Rasterizer("other", RASTERIZER.description)},
    "the renderer's code": {"code": "other"},
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_change_of_anything_that_goes_into_an_operator_builds_it_anew(change, tmp_path, monkeypatch, rasterized):
    monkeypatch.setitem(sys.modules, "renderer.rasterizer.other", numpy_rasterizer)

    def run(mesh=TEXTURED, camera=CAMERA, settings=SETTINGS, rasterizer=RASTERIZER, code=cache.RENDERER, **options):
        monkeypatch.setattr(cache, "RENDERER", code)
        OperatorCache(tmp_path).operators(mesh, [camera], settings, rasterizer, **options)
        return len(rasterized)

    assert [run(), run(**change), run(), run(**change)] == [1, 2, 2, 2]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (("ab", "c"), ("a", "bc")),
        ((("a",), "b"), ("a", ("b",))),
        ((1,), (1.0,)),
        (("a;'b",), ("a", "b")),
        ((np.zeros((2, 3)),), (np.zeros((3, 2)),)),
        ((np.zeros(1), np.zeros(2)), (np.zeros(2), np.zeros(1))),
    ],
)
def test_keys_differ_where_the_parts_only_look_alike_when_joined(first, second):
    assert content_key(*first) != content_key(*second)
    assert content_key(*first) == content_key(*first)
    with pytest.raises(TypeError, match="a Tensor has no content key"):
        content_key(first, torch.zeros(2))


def test_any_change_of_the_sources_is_another_key(tmp_path):
    package = tmp_path / "package"
    shutil.copytree(Path(cache.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    assert source_key(package) == cache.RENDERER
    module, keys = package / "mesh.py", {source_key(package)}
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
        assert loaded[name].dtype == tensor.dtype and loaded[name].shape == tensor.shape
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


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(written, monkeypatch):
    tensors, path = written
    before = path.read_bytes()

    def interrupted(self, content):
        with open(self, "wb") as file:
            file.write(content[:40])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tensors.write(KEY, {"ratios": torch.zeros(9)})
    assert list(path.parent.iterdir()) == [path] and path.read_bytes() == before


def test_a_full_disk_stops_no_run_and_is_tried_and_logged_once(tmp_path, monkeypatch, caplog):
    tries = []

    def full(*_):
        tries.append(1)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    operators = OperatorCache(tmp_path).operators(PLATE, orbit_cameras(3, 2.0), SETTINGS, RASTERIZER)
    assert same(operators, build_operators(PLATE, orbit_cameras(3, 2.0), SETTINGS, RASTERIZER))
    assert caplog.text.count("No space left on device") == len(tries) == 1 and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("choice", "environment", "folder"),
    [
        ("auto", {"XDG_CACHE_HOME": "/caches", "HOME": "/home/user"}, "/caches/parametric-norm-balls"),
        ("auto", {"HOME": "/home/user"}, "/home/user/.cache/parametric-norm-balls"),
        ("auto", {"XDG_CACHE_HOME": "relative", "HOME": "/home/user"}, None),
        ("~/here", {"HOME": "/home/user"}, "/home/user/here"),
        (None, {"XDG_CACHE_HOME": "/caches", "HOME": "/home/user"}, None),
    ],
)
def test_the_folder_is_the_users_cache_folder_unless_chosen(choice, environment, folder, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert cache_folder(choice) == (folder and Path(folder))
