import errno
import shutil
from pathlib import Path

import pytest
import torch

import renderer
from renderer.errors import InputError
from train.data import rendered_shapes
from train.data.sets import relabeled

SIZE = 8
FEW = ("apple", "plate")


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    monkeypatch.setattr(rendered_shapes, "CLASSES", FEW)
    monkeypatch.setattr(rendered_shapes, "SETTINGS", rendered_shapes.ImageSettings(samples=1))


@pytest.fixture
def instances(monkeypatch) -> list[tuple[str, int]]:
    """Return a list that grows by the name and the seed of each solid that is made."""
    made = []
    solid = rendered_shapes.solid

    def recorded(name, seed):
        made.append((name, seed))
        return solid(name, seed)

    monkeypatch.setattr(rendered_shapes, "solid", recorded)
    return made


def test_every_class_has_the_images_asked_for_of_instances_that_no_other_part_shows(instances):
    data = rendered_shapes.load_shapes(train=21, test=2, size=SIZE, seed=0)
    assert data.classes == FEW
    assert data.train.images.shape == (42, 3, SIZE, SIZE)
    assert data.train.images.dtype == torch.uint8
    assert data.train.labels.tolist() == [label for label in range(2) for _ in range(21)]
    assert data.test.labels.tolist() == [label for label in range(2) for _ in range(2)]
    assert [name for name, _ in instances] == [name for name in FEW for _ in range(2)] + list(FEW)
    assert len(data.train.images.unique(dim=0)) == 42
    assert len(set(instances)) == len(instances)


def test_images_are_rendered_again_for_other_settings_or_code(tmp_path, instances, monkeypatch):
    def load(**settings):
        before = len(instances)
        arguments = {"train": 1, "test": 2, "size": SIZE, "seed": 0} | settings
        return rendered_shapes.load_shapes(**arguments, cache=tmp_path), len(instances) - before

    first, rendered = load()
    again, cached = load()
    assert (rendered, cached) == (4, 0)
    assert torch.equal(again.train.images, first.train.images)
    assert [load(**change)[1] for change in ({"train": 2}, {"seed": 1})] == [2, 4]
    monkeypatch.setattr(rendered_shapes, "CODE", "other")
    assert load()[1] == 4


def test_labels_count_the_classes_of_another_network():
    shapes = rendered_shapes.load_shapes(train=1, test=1, size=SIZE, seed=0)
    data = relabeled(shapes, ("plate", "lamp", "apple"), "data=shapes")
    assert data.train.labels.tolist() == data.test.labels.tolist() == [2, 0]
    with pytest.raises(InputError, match="lamp"):
        relabeled(data, ("plate", "orange"), "data=shapes")


def test_any_change_of_the_sources_is_another_key(tmp_path):
    sources, package = Path(renderer.__file__).parent, tmp_path / "package"
    shutil.copytree(sources, package, ignore=shutil.ignore_patterns("__pycache__"))
    assert rendered_shapes.source_key(package) == rendered_shapes.source_key(sources)
    module = package / "camera.py"
    keys = {rendered_shapes.source_key(package)}
    for change in (
        lambda: module.write_text(module.read_text() + "\n"),
        lambda: module.rename(package / "other.py"),
        lambda: (package / "new.py").touch(),
    ):
        change()
        keys.add(rendered_shapes.source_key(package))
    assert len(keys) == 4


def test_no_flipped_bit_and_no_cut_of_a_cached_file_gives_other_images(tmp_path):
    """Every bit of some bytes, one bit of a third of the others, and as many lengths."""
    images = torch.arange(48, dtype=torch.uint8).view(1, 3, 4, 4)
    rendered_shapes.write_cached(tmp_path, "key", images)
    (path,) = tmp_path.iterdir()
    content = path.read_bytes()
    for position in range(0, len(content), 3):
        path.write_bytes(content[:position])
        assert rendered_shapes.read_cached(tmp_path, "key") is None, position
        for bit in range(8) if position % 96 == 0 else [position % 8]:
            flipped = content[position] ^ 1 << bit
            path.write_bytes(content[:position] + bytes([flipped]) + content[position + 1 :])
            read = rendered_shapes.read_cached(tmp_path, "key")
            # Some bits, such as those of the date, do not matter.
            assert read is None or torch.equal(read, images), (position, bit)
    path.write_bytes(content)
    assert torch.equal(rendered_shapes.read_cached(tmp_path, "key"), images)


def test_a_full_disk_stops_no_run(tmp_path, monkeypatch, caplog):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    rendered_shapes.load_shapes(train=1, test=1, size=SIZE, seed=0, cache=tmp_path)
    assert "No space left on device" in caplog.text
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("choice", "caches", "folder"),
    [
        ("auto", "/caches", "/caches/parametric-norm-balls"),
        ("auto", "", "/home/user/.cache/parametric-norm-balls"),
        ("auto", "relative", None),
        ("~/here", "", "/home/user/here"),
        (None, "/caches", None),
    ],
)
def test_the_folder_is_the_users_cache_folder_unless_chosen(choice, caches, folder, monkeypatch):
    monkeypatch.setenv("HOME", "/home/user")
    monkeypatch.setenv("XDG_CACHE_HOME", caches)
    assert rendered_shapes.cache_folder(choice) == (folder and Path(folder))
