import pytest
import torch

from augment.service import SHOWN_EXAMPLES, AttackExamples
from renderer.errors import InputError
from renderer.image import to_bytes
from renderer.light.basis import HARMONICS, SumBasis
from renderer.light.local import Projector
from renderer.rendering import light_sphere
from train.attack_examples import LARGEST_SIDE, SPHERE, read_attack_examples, write_attack_examples

CLASSES = ["apple", "orange"]
BASIS = SumBasis((HARMONICS, Projector(pixels=2)))


def attack_examples(side: int, count: int = 2) -> AttackExamples:
    draws = torch.Generator().manual_seed(0)
    images, lights = (torch.rand(2, count, 3, *rest, generator=draws) for rest in ((side, side), (1,)))
    lights = lights.expand(2, count, 3, BASIS.size).transpose(2, 3)
    predictions = torch.tensor([[0.25, 0.75], [0.875, 0.125]])[:, None].expand(2, count, 2)
    return AttackExamples(*images, *lights, *predictions, torch.ones(count, dtype=torch.int64), BASIS)


def test_examples_are_read_as_they_were_written(tmp_path):
    written = attack_examples(8)
    write_attack_examples(tmp_path / "a", written, CLASSES)
    examples = read_attack_examples(tmp_path / "a")
    assert len(examples) == 2
    for row, (label, before, after) in enumerate(examples):
        assert label == "orange"
        assert (before.predicted, before.confidence) == ("orange", 0.75)
        assert (after.predicted, after.confidence) == ("apple", 0.875)
        for side, images, lights in [
            (before, written.images_before, written.lights_before),
            (after, written.images, written.lights),
        ]:
            sphere = light_sphere(lights[row], SPHERE, basis=BASIS)
            assert torch.equal(side.image, to_bytes(images[row])) and torch.equal(side.sphere, to_bytes(sphere))


def test_a_file_stays_small_whatever_the_size_of_the_images(tmp_path):
    write_attack_examples(tmp_path / "a", attack_examples(2 * LARGEST_SIDE, SHOWN_EXAMPLES), CLASSES)
    assert (tmp_path / "a").stat().st_size < 2**19
    _, before, _ = read_attack_examples(tmp_path / "a")[0]
    assert before.image.shape == (3, LARGEST_SIDE, LARGEST_SIDE)


def test_a_damaged_file_is_refused_by_name(tmp_path):
    write_attack_examples(tmp_path / "a", attack_examples(8), CLASSES)
    (tmp_path / "a").write_bytes((tmp_path / "a").read_bytes()[:-9])
    with pytest.raises(InputError, match=rf"^{tmp_path / 'a'} is damaged"):
        read_attack_examples(tmp_path / "a")
