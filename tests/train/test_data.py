import hashlib
import pickle
import re
from pathlib import Path
from urllib.error import URLError

import numpy as np
import pytest
import torch
import torchvision
from PIL import Image

from renderer.errors import InputError
from train.data import (
    Split,
    channel_statistics,
    load_cifar100,
    load_folder,
    load_npz,
    stratified_split,
)

DATA = Path(__file__).parents[2].parent / "shared" / "data"


def arrays(**changes) -> dict[str, np.ndarray]:
    """What an .npz file of two classes holds, some of it changed; None leaves an array out."""
    rng = np.random.default_rng(0)
    good = {
        "train_images": rng.integers(0, 256, (5, 3, 8, 8), dtype=np.uint8),
        "train_labels": np.array([0, 1, 1, 0, 1]),
        "test_images": rng.integers(0, 256, (2, 3, 8, 8), dtype=np.uint8),
        "test_labels": np.array([1, 0]),
        "classes": np.array(["lime", "fig"]),
    }
    return {name: array for name, array in (good | changes).items() if array is not None}


def numbered(count: int, classes: int = 1) -> Split:
    """Images (N, 3, 1, 1) that show their row's number, with labels in turn."""
    rows = torch.arange(count)
    return Split(rows.view(-1, 1, 1, 1).expand(-1, 3, 1, 1).to(torch.uint8), rows % classes)


def save_image(path: Path, value: int, size: tuple[int, int] = (8, 8)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (value, value, value)).save(path)


# ---------------------------------------------------------------------------------------- .npz


def test_an_npz_file_comes_back_as_it_was_written(tmp_path):
    np.savez(tmp_path / "data.npz", **arrays())
    data = load_npz(str(tmp_path / "data.npz"))
    assert data.classes == ("lime", "fig") and data.size == 8
    for name in ("train", "test"):
        split = getattr(data, name)
        assert split.images.dtype == torch.uint8 and split.labels.dtype == torch.int64
        np.testing.assert_array_equal(split.images, arrays()[f"{name}_images"])
        np.testing.assert_array_equal(split.labels, arrays()[f"{name}_labels"])


@pytest.mark.parametrize(
    "changes, fault",
    [
        ({"test_labels": None}, "the array test_labels is missing"),
        ({"train_images": np.zeros((5, 8, 8, 3), np.uint8)}, r"train_images is uint8 of shape \(5, 8, 8, 3\)"),
        ({"train_images": np.zeros((5, 3, 8, 9), np.uint8)}, r"train_images is uint8 of shape \(5, 3, 8, 9\)"),
        ({"train_images": np.zeros((5, 3, 8), np.uint8)}, r"train_images is uint8 of shape \(5, 3, 8\)"),
        ({"test_images": np.zeros((2, 3, 8, 8), np.float32)}, "test_images is float32"),
        ({"test_images": np.zeros((2, 3, 9, 9), np.uint8)}, "differ in size"),
        ({"train_labels": np.zeros(4, int)}, r"train_labels is int64 of shape \(4,\); it must be integers \(5,\)"),
        ({"train_labels": np.zeros(5)}, "train_labels is float64"),
        ({"train_labels": np.array([0, 1, 2, 0, 1])}, "train_labels must hold labels 0 to 1"),
        ({"test_labels": np.array([0, -1])}, "test_labels must hold labels 0 to 1"),
        ({"test_images": np.zeros((0, 3, 8, 8), np.uint8), "test_labels": np.zeros(0, int)}, "one at least"),
        ({"classes": np.array(["fig", "fig"])}, "classes must be distinct strings"),
        ({"classes": np.array([0, 1])}, "classes must be distinct strings"),
        ({"classes": np.array(["lime", "fig"], dtype=object)}, "loads without pickle"),
    ],
)
def test_a_fault_in_an_npz_file_is_named(tmp_path, changes, fault):
    path = tmp_path / "data.npz"
    np.savez(path, **arrays(**changes))
    with pytest.raises(InputError, match=f"data.path={re.escape(str(path))}.*{fault}"):
        load_npz(str(path))


@pytest.mark.realdata
def test_cifar100_has_its_published_classes_and_statistics():
    path = DATA / "cifar100.npz"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    data = load_npz(str(path))
    assert (len(data.train), len(data.test), len(data.classes), data.size) == (50_000, 10_000, 100, 32)
    assert data.classes.index("orange") == 53
    assert data.train.labels.bincount().tolist() == [500] * 100
    means, deviations = channel_statistics(data.train.images)
    assert np.round(means, 4).tolist() == [0.5071, 0.4865, 0.4409]
    assert np.round(deviations, 4).tolist() == [0.2673, 0.2564, 0.2762]


# ---------------------------------------------------------------------------------------- folders


def test_class_folders_become_classes_and_images_of_any_size_are_reduced(tmp_path):
    for label, name in enumerate(["lime", "fig"]):
        for number in range(10):
            save_image(tmp_path / name / f"{number}.png", 100 * label + number, size=(20 + number, 30))
    (tmp_path / ".thumbnails").mkdir()
    data = load_folder(str(tmp_path), size=8, test_fraction=0.2)
    assert data.classes == ("fig", "lime")
    assert data.train.images.shape == (16, 3, 8, 8) and data.test.images.shape == (4, 3, 8, 8)
    shown = {}
    for split in (data.train, data.test):
        for image, label in zip(split.images, split.labels, strict=True):
            assert len(image.unique()) == 1
            shown[int(image[0, 0, 0])] = data.classes[label]
    assert shown == {100 * label + n: name for label, name in enumerate(["lime", "fig"]) for n in range(10)}


def test_train_and_test_folders_are_the_splits(tmp_path):
    for part, name, value in [("train", "fig", 1), ("train", "lime", 2), ("test", "lime", 3)]:
        save_image(tmp_path / part / name / "a.png", value)
    data = load_folder(str(tmp_path), size=8, test_fraction=0.1)
    assert data.train.images[:, 0, 0, 0].tolist() == [1, 2] and data.train.labels.tolist() == [0, 1]
    assert data.test.images[:, 0, 0, 0].tolist() == [3] and data.test.labels.tolist() == [1]


@pytest.mark.parametrize(
    "images, test, fault",
    [
        (None, 0.1, "is not a folder"),
        (["fig/a.png"], 0.1, "holds 1 class folders: it needs two or more"),
        (["fig/a.png", "lime/.a.png"], 0.1, "data/lime holds no image: put some there or remove the folder"),
        (
            ["train/fig/a.png", "val/fig/a.png"],
            0.1,
            "holds the folders train, val: divide it into train and test alone",
        ),
        (["Test/fig/a.png", "Train/fig/a.png"], 0.1, "holds the folders Test, Train: divide it"),
        (["train/fig/a.png", "test/fig/a.png", "val/fig/a.png"], 0.1, "holds the folders test, train, val: divide it"),
        (["fig/a.png", "lime/a.png"], 0.1, "data.test_fraction=0.1 of the 1 images of class 0"),
        (["fig/a.png", "lime/a.png"], 60, "data.test_fraction=60 must lie between 0 and 1"),
    ],
)
def test_a_fault_in_a_folder_is_named(tmp_path, images, test, fault):
    for name in images or []:
        save_image(tmp_path / "data" / name, 0)
    with pytest.raises(InputError, match=fault):
        load_folder(str(tmp_path / "data"), 8, test)


def test_a_broken_image_of_a_class_folder_is_named_without_advice_that_would_not_help(tmp_path):
    for name in ("fig", "lime"):
        save_image(tmp_path / name / "a.png", 0)
    (tmp_path / "fig" / "b.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"1 of 3 photographs cannot be read, .*fig/b\.png .*: replace them$"):
        load_folder(str(tmp_path), 8, 0.1)


def test_files_of_other_kinds_are_counted_and_named_before_training(tmp_path, caplog):
    for name in ("fig", "lime"):
        for number in range(4):
            save_image(tmp_path / name / f"{number}.png", 0)
        for number in range(3):
            (tmp_path / name / f"{number}.heic").touch()
    with caplog.at_level("WARNING", "train"):
        load_folder(str(tmp_path), 8, 0.25)
    assert (
        f"6 files in {tmp_path} are not images that can be read: fig/0.heic, fig/1.heic, fig/2.heic, ..." in caplog.text
    )


# ---------------------------------------------------------------------------------------- CIFAR-100


def write_cifar100(root: Path, monkeypatch) -> dict[str, np.ndarray]:
    """torchvision's own layout, with few images, and the checksums that torchvision then expects."""
    rng = np.random.default_rng(0)
    cifar100, folder = torchvision.datasets.CIFAR100, root / torchvision.datasets.CIFAR100.base_folder
    folder.mkdir(parents=True)
    names = [f"class {number:02d}" for number in range(100)]
    pixels = {part: rng.integers(0, 256, (100, 3072), dtype=np.uint8) for part in ("train", "test")}
    contents = {part: {"data": pixels[part], "fine_labels": list(range(100))} for part in pixels}
    checksums = {}
    for part, content in {**contents, "meta": {"fine_label_names": names}}.items():
        pickled = pickle.dumps(content)
        (folder / part).write_bytes(pickled)
        checksums[part] = hashlib.md5(pickled).hexdigest()
    monkeypatch.setattr(cifar100, "train_list", [["train", checksums["train"]]])
    monkeypatch.setattr(cifar100, "test_list", [["test", checksums["test"]]])
    monkeypatch.setattr(cifar100, "meta", {**cifar100.meta, "md5": checksums["meta"]})
    return pixels


def test_torchvisions_files_are_read_where_they_are_there_already(tmp_path, monkeypatch):
    pixels = write_cifar100(tmp_path, monkeypatch)
    data = load_cifar100(str(tmp_path))
    assert data.classes == tuple(f"class {number:02d}" for number in range(100))
    for part, split in [("train", data.train), ("test", data.test)]:
        np.testing.assert_array_equal(split.images, pixels[part].reshape(-1, 3, 32, 32))
        assert split.labels.tolist() == list(range(100))


def test_without_files_and_network_there_is_one_error(tmp_path, monkeypatch):
    def download(self):
        raise URLError("no route to host")

    monkeypatch.setattr(torchvision.datasets.CIFAR100, "download", download)
    with pytest.raises(InputError, match=f"data.path={re.escape(str(tmp_path))}: CIFAR-100 .* no route to host"):
        load_cifar100(str(tmp_path))


# ---------------------------------------------------------------------------------------- splits and statistics


def test_a_stratified_split_is_complete_disjoint_and_holds_out_a_share_of_every_class():
    kept, held_out = stratified_split(numbered(200, classes=4), fraction=0.1, seed=0)
    rows = [split.images[:, 0, 0, 0].tolist() for split in (kept, held_out)]
    assert sorted(rows[0] + rows[1]) == list(range(200))
    assert held_out.labels.bincount().tolist() == [5] * 4
    for split, shown in zip((kept, held_out), rows, strict=True):
        assert split.labels.tolist() == [row % 4 for row in shown]


def test_a_stratified_split_depends_on_its_seed_alone():
    torch.manual_seed(1)
    first, again, other = (stratified_split(numbered(200, 4), 0.1, seed)[1].images for seed in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)


@pytest.mark.parametrize("share", [0, 1, -0.1, float("nan"), 0.001, 0.999])
def test_a_share_that_leaves_a_split_empty_is_an_error(share):
    with pytest.raises(InputError, match=f"data.validation={share} "):
        stratified_split(numbered(200, classes=4), share, seed=0)


def test_channel_statistics_are_those_of_float64():
    images = np.random.default_rng(0).beta(0.5, 2, (40, 3, 9, 9)) * [[[[250]], [[255]], [[20]]]]
    images = images.astype(np.uint8)
    means, deviations = channel_statistics(torch.from_numpy(images))
    # the sums differ in order alone
    np.testing.assert_allclose(means, (images / 255).mean((0, 2, 3)), rtol=1e-12)
    np.testing.assert_allclose(deviations, (images / 255).std((0, 2, 3)), rtol=1e-12)
