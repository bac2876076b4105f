import csv
import math

import numpy as np
import pytest
import torch

from renderer.cache import TensorCache
from renderer.light.harmonics import irradiance_basis, nonzero_coefficients
from train import rendered_shapes
from train.photographs.folder import find_photographs, load_photographs
from train.rendered_shapes import SOURCE, even_light, hard_light, load_shapes, write_held_out

SIZE = 8
FEW = ("apple", "orange", "plate")


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Few classes and images, one sample per pixel: the tests look at what is rendered, not at how well."""
    monkeypatch.setattr(rendered_shapes, "CLASSES", FEW)
    monkeypatch.setattr(rendered_shapes, "SETTINGS", rendered_shapes.ImageSettings(samples=1))
    monkeypatch.setattr(rendered_shapes, "HELD_OUT_PER_CLASS", 3)


@pytest.fixture
def instances(monkeypatch) -> list[tuple[str, int]]:
    """The solids made, in order, as (name, seed)."""
    made = []
    solid = rendered_shapes.solid

    def recorded(name, seed):
        made.append((name, seed))
        return solid(name, seed)

    monkeypatch.setattr(rendered_shapes, "solid", recorded)
    return made


def test_every_class_has_the_images_asked_for_of_as_many_instances_as_that_takes(instances):
    data = load_shapes(train=21, test=2, size=SIZE, seed=0)
    assert data.classes == FEW
    assert data.train.images.shape == (63, 3, SIZE, SIZE) and data.train.images.dtype == torch.uint8
    assert data.train.labels.tolist() == [label for label in range(3) for _ in range(21)]
    assert data.test.labels.tolist() == [label for label in range(3) for _ in range(2)]
    assert [name for name, _ in instances] == [name for name in FEW for _ in range(2)] + list(FEW)
    assert len(data.train.images.unique(dim=0)) == 63


def test_no_instance_is_in_two_of_training_test_and_held_out_images(instances, tmp_path):
    load_shapes(train=1, test=1, size=SIZE, seed=0)
    write_held_out(tmp_path, SIZE, seed=0)
    assert len(instances) == len(set(instances)) == 9


def test_images_that_are_on_disk_are_not_rendered_again(tmp_path, instances):
    cache = TensorCache(tmp_path / "cache")
    for folder in ("first", "second"):
        data = load_shapes(1, 2, SIZE, 0, cache)
        write_held_out(tmp_path / folder, SIZE, 0, cache)
        assert len(instances) == 9
    fresh = load_shapes(1, 2, SIZE, 0)
    for part in ("train", "test"):
        assert torch.equal(getattr(data, part).images, getattr(fresh, part).images)
        assert torch.equal(getattr(data, part).labels, getattr(fresh, part).labels)
    for path in (tmp_path / "first").rglob("*.png"):
        assert path.read_bytes() == (tmp_path / "second" / path.relative_to(tmp_path / "first")).read_bytes()


@pytest.mark.parametrize(
    ("change", "splits"),
    [({"train": 2}, 1), ({"size": 9}, 2), ({"seed": 1}, 2), ({"code": "other"}, 2)],
)
def test_images_of_other_settings_or_other_code_are_rendered(change, splits, tmp_path, instances, monkeypatch):
    def load(code=rendered_shapes.CODE, **settings):
        monkeypatch.setattr(rendered_shapes, "CODE", code)
        load_shapes(**{"train": 1, "test": 2, "size": SIZE, "seed": 0} | settings, cache=TensorCache(tmp_path))

    load()
    instances.clear()
    load(**change)
    assert len(instances) == 3 * splits


def test_held_out_images_are_a_folder_of_photographs_marked_as_rendered(tmp_path):
    write_held_out(tmp_path, SIZE, seed=0)
    photographs = find_photographs(tmp_path, FEW, "orange")
    assert [item.label for item in photographs] == [name for name in FEW for _ in range(3)]
    assert {item.source for item in photographs} == {SOURCE} == {"rendered, hard light"}
    _, images, _ = load_photographs(tmp_path, photographs, SIZE)
    assert len(images.unique(dim=0)) == 9


def test_every_class_is_held_out_under_the_same_lights_before_the_same_cameras(tmp_path, monkeypatch):
    """With one and the same solid in every class's place, the classes' images are the same, byte for byte."""
    solid = rendered_shapes.solid
    monkeypatch.setattr(rendered_shapes, "HELD_OUT_PER_CLASS", 21)
    monkeypatch.setattr(rendered_shapes, "solid", lambda name, seed: solid("pear", 0))
    write_held_out(tmp_path, SIZE, seed=0)
    with open(tmp_path / "photos.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    lights = {}
    for row in rows:
        lights.setdefault(row["light"], []).append((tmp_path / row["path"]).read_bytes())
    assert {len(images) for images in lights.values()} == {len(FEW)}
    assert {len(set(images)) for images in lights.values()} == {1}
    assert len({images[0] for images in lights.values()}) == 21


def test_training_light_leaves_no_side_dark_and_held_out_light_does():
    draws = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(2000, 3, generator=draws, dtype=torch.float64), dim=1)
    back = torch.tensor([math.cos(1.0), 0.0, math.sin(1.0)])
    shading = irradiance_basis(normals, 6).numpy()
    ratios = {}
    for light in (even_light, hard_light):
        lights = torch.stack([light(back, draws) for _ in range(200)])[:, nonzero_coefficients(6)].double().numpy()
        luminance = np.einsum("nk,lkc->ln", shading, lights)
        ratios[light] = luminance.min(1) / luminance.max(1)
    assert ratios[even_light].min() > 0.45 > 0.3 > ratios[hard_light].max()
