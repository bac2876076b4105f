import pytest
import torch

from renderer.errors import InputError
from train.data import rendered_shapes
from train.data.cache import TensorCache
from train.data.rendered_shapes import load_shapes
from train.data.sets import relabeled

SIZE = 8
FEW = ("apple", "orange", "plate")


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Render few classes and images with one sample per pixel."""
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
    data = load_shapes(train=21, test=2, size=SIZE, seed=0)
    assert data.classes == FEW
    assert data.train.images.shape == (63, 3, SIZE, SIZE)
    assert data.train.images.dtype == torch.uint8
    assert data.train.labels.tolist() == [label for label in range(3) for _ in range(21)]
    assert data.test.labels.tolist() == [label for label in range(3) for _ in range(2)]
    assert [name for name, _ in instances] == [name for name in FEW for _ in range(2)] + list(FEW)
    assert len(data.train.images.unique(dim=0)) == 63
    assert len(set(instances)) == len(instances)


def test_images_are_rendered_again_for_other_settings_or_other_code_alone(
    tmp_path, instances, monkeypatch
):
    def load(**settings):
        before = len(instances)
        arguments = {
            "train": 1,
            "test": 2,
            "size": SIZE,
            "seed": 0,
            "cache": TensorCache(tmp_path),
        } | settings
        return load_shapes(**arguments), len(instances) - before

    first, rendered = load()
    again, cached = load()
    assert (rendered, cached) == (6, 0)
    assert torch.equal(again.train.images, first.train.images)
    assert [load(**change)[1] for change in ({"train": 2}, {"size": 9}, {"seed": 1})] == [3, 6, 6]
    monkeypatch.setattr(rendered_shapes, "CODE", "other")
    assert load()[1] == 6


def test_labels_count_the_classes_of_another_network():
    shapes = load_shapes(train=1, test=1, size=SIZE, seed=0)
    data = relabeled(shapes, ("plate", "lamp", "orange", "apple"), "data=shapes")
    assert data.train.labels.tolist() == data.test.labels.tolist() == [3, 2, 0]
    with pytest.raises(InputError, match="lamp"):
        relabeled(data, ("plate", "orange"), "data=shapes")
