import pytest
import torch

from augment.service import SHOWN_EXAMPLES, AttackExamples
from renderer.errors import InputError
from renderer.light.basis import HARMONICS, SumBasis
from renderer.light.local import Projector
from train.attack_examples import LARGEST_SIDE, read_attack_examples, write_attack_examples

CLASSES = ["apple", "orange"]
BASIS = SumBasis((HARMONICS, Projector(pixels=2)))


def attack_examples(side: int, count: int = 2) -> AttackExamples:
    draws = torch.Generator().manual_seed(0)
    images, lights = (torch.rand(2, count, 3, *rest, generator=draws) for rest in ((side, side), (1,)))
    lights = lights.expand(2, count, 3, BASIS.size).transpose(2, 3)
    predictions = torch.tensor([[0.25, 0.75], [0.875, 0.125]])[:, None].expand(2, count, 2)
    return AttackExamples(images, lights, predictions, torch.ones(count, dtype=torch.int64), BASIS)


def test_a_file_stays_small_and_a_damaged_one_is_refused_by_name(tmp_path):
    path = tmp_path / "a"
    write_attack_examples(path, attack_examples(2 * LARGEST_SIDE, SHOWN_EXAMPLES), CLASSES)
    assert path.stat().st_size < 2**19
    label, before, after = read_attack_examples(path)[0]
    assert (label, before.predicted, before.confidence) == ("orange", "orange", 0.75)
    assert (after.predicted, after.confidence) == ("apple", 0.875)
    assert before.image.shape == (3, LARGEST_SIDE, LARGEST_SIDE)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match=rf"^{path} is damaged"):
        read_attack_examples(path)
