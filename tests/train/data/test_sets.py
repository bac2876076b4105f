import re
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from renderer.errors import InputError
from tests.helpers import save_plain
from train.data import sets


def arrays(**changes) -> dict[str, np.ndarray]:
    """Make the arrays of an .npz file of two classes, with changes. None removes an array."""
    rng = np.random.default_rng(0)
    good = {"classes": np.array(["lime", "fig"])}
    for part, labels in (("train", [0, 1, 1, 0, 1]), ("test", [1, 0])):
        images = rng.integers(0, 256, (len(labels), 3, 8, 8), dtype=np.uint8)
        good |= {f"{part}_images": images, f"{part}_labels": np.array(labels)}
    return {name: array for name, array in (good | changes).items() if array is not None}


def numbered(count: int, classes: int = 1) -> sets.Split:
    """Make images (N, 3, 1, 1) whose values are their rows, with labels in turn."""
    rows = torch.arange(count)
    return sets.Split(rows.view(-1, 1, 1, 1).expand(-1, 3, 1, 1).to(torch.uint8), rows % classes)


def test_a_sample_is_spread_evenly_over_the_images():
    for count, rows in (3, [0, 4, 8]), (20, [*range(9)]):
        assert numbered(9).sample(count)[:, 0, 0, 0].tolist() == rows


def test_an_npz_file_comes_back_as_it_was_written(tmp_path):
    np.savez(tmp_path / "data.npz", **arrays())
    data = sets.load_npz(str(tmp_path / "data.npz"))
    assert data.classes == ("lime", "fig")
    assert data.size == 8
    for name in ("train", "test"):
        split = getattr(data, name)
        assert split.images.dtype == torch.uint8
        assert split.labels.dtype == torch.int64
        np.testing.assert_array_equal(split.images, arrays()[f"{name}_images"])
        np.testing.assert_array_equal(split.labels, arrays()[f"{name}_labels"])


@pytest.mark.parametrize(
    "changes, fault",
    [
        ({"test_labels": None}, "test_labels is not a file in the archive"),
        ({"train_images": np.zeros((5, 8, 8, 3), np.uint8)}, r"of uint8 and shape \(5, 8"),
        ({"test_images": np.zeros((2, 3, 9, 9), np.uint8)}, "differ in size"),
        ({"train_labels": np.zeros(4, int)}, r"\(4,\); they must be integers \(5,\)"),
        ({"test_labels": np.array([0, 2])}, "labels must be 0 to 1"),
        ({"test_labels": np.array([0, 2**64 - 1], np.uint64)}, "labels must be 0 to 1"),
        ({"classes": np.array(["fig", "fig"])}, "classes must be distinct strings"),
        ({"classes": np.array(["lime", "fig"], dtype=object)}, "allow_pickle=False"),
    ],
)
def test_a_fault_in_an_npz_file_is_named(tmp_path, changes, fault):
    path = tmp_path / "data.npz"
    np.savez(path, **arrays(**changes))
    with pytest.raises(InputError, match=f"^path={re.escape(str(path))}.*{fault}"):
        sets.load_npz(str(path))


def test_class_folders_become_classes_and_images_of_any_size_are_reduced(tmp_path):
    for name, number in product(["lime", "fig"], range(10)):
        value = number + 100 * (name == "fig")
        save_plain(tmp_path / name / f"{number}.png", value, size=(20 + number, 30))
    (tmp_path / ".thumbnails").mkdir()
    data = sets.load_folder(str(tmp_path), size=8, test_fraction=0.2)
    assert data.classes == ("fig", "lime")
    assert data.train.images.shape == (16, 3, 8, 8)
    assert data.test.images.shape == (4, 3, 8, 8)
    values = torch.cat([data.train.images, data.test.images]).flatten(1)
    assert (values == values[:, :1]).all()
    labels = torch.cat([data.train.labels, data.test.labels])
    names = [data.classes[label] for label in labels]
    expected = {n: "lime" for n in range(10)} | {100 + n: "fig" for n in range(10)}
    assert dict(zip(values[:, 0].tolist(), names, strict=True)) == expected


def test_train_and_test_folders_are_the_splits(tmp_path):
    for part, name, value in [("train", "fig", 1), ("train", "lime", 2), ("test", "lime", 3)]:
        save_plain(tmp_path / part / name / "a.png", value)
    data = sets.load_folder(str(tmp_path), size=8, test_fraction=0.1)
    assert data.train.images[:, 0, 0, 0].tolist() == [1, 2]
    assert data.train.labels.tolist() == [0, 1]
    assert data.test.images[:, 0, 0, 0].tolist() == [3]
    assert data.test.labels.tolist() == [1]


@pytest.mark.parametrize(
    "images, fault",
    [
        ([], "is not a folder"),
        (["fig/a.png"], "has 1 class folders: give two or more"),
        (["fig/a.png", "lime/.a.png"], "data/lime holds no image"),
        (["train/fig/a.png", "test/fig/a.png", "val/fig/a.png"], "the folders test, train, val: "),
        (["train/fig/a.png", "train/lime/a.png", "test/a.png"], "data/test holds no class f"),
        (["train/fig/a.png", "train/lime/a.png", "test/1/a.png"], "^path: .*data/test holds 1: "),
        (["fig/a.png", "lime/a.png"], "^test_fraction=0.1 cannot split the one image of class 0"),
    ],
)
def test_a_fault_in_a_folder_is_named(tmp_path, images, fault):
    for name in images:
        save_plain(tmp_path / "data" / name, 0)
    with pytest.raises(InputError, match=fault):
        sets.load_folder(str(tmp_path / "data"), 8, 0.1)


def test_torchvisions_data_become_splits_with_the_channels_first(monkeypatch):
    pixels = np.random.default_rng(0).integers(0, 256, (2, 10, 32, 32, 3), dtype=np.uint8)

    def cifar100(path, train, download):
        return SimpleNamespace(data=pixels[int(train)], targets=[3] * 10, classes=["fig", "lime"])

    monkeypatch.setattr("torchvision.datasets.CIFAR100", cifar100)
    data = sets.load_cifar100("here")
    assert data.classes == ("fig", "lime")
    assert data.train.labels.tolist() == [3] * 10
    np.testing.assert_array_equal(data.train.images, pixels[1].transpose(0, 3, 1, 2))
    np.testing.assert_array_equal(data.test.images, pixels[0].transpose(0, 3, 1, 2))


def test_the_fraction_of_every_class_is_held_out_within_that_of_a_larger_fraction():
    split = numbered(200, classes=4)
    rows = sets.held_out_rows(split, 0.1)
    assert split[rows].labels.bincount().tolist() == [5] * 4
    torch.manual_seed(1)
    assert torch.equal(rows, sets.held_out_rows(split, 0.1))
    assert (sets.held_out_rows(split, 0.2) >= rows).all()


@pytest.mark.parametrize("fraction", [0.001, 0.999])
def test_a_fraction_leaves_an_image_of_each_class_in_both_parts(fraction):
    split = numbered(200, classes=4)
    is_held_out = sets.held_out_rows(split, fraction)
    counts = split.labels[is_held_out].bincount()
    assert counts.tolist() == [1 if fraction < 0.5 else 49] * 4


def test_channel_statistics_are_those_of_float64():
    images = np.random.default_rng(0).beta(0.5, 2, (40, 3, 9, 9)) * [[[[250]], [[255]], [[20]]]]
    images = images.astype(np.uint8)
    means, deviations = sets.channel_statistics(torch.from_numpy(images))
    # the sums differ in order alone
    np.testing.assert_allclose(means, (images / 255).mean((0, 2, 3)), rtol=1e-12)
    np.testing.assert_allclose(deviations, (images / 255).std((0, 2, 3)), rtol=1e-12)
