"""A teacher shares the frozen layers of its pupil, and its logits stay the same."""

from copy import deepcopy

import pytest
import torch
from torch import nn

from train.device import MixedPrecision
from train.train_settings import TrainSettings
from train.training.recipe import SharedTeacher, share_layers

SIZE = 4
LAST_LAYER_ONLY = TrainSettings(freeze="all_but_last", eval_mode=True)


class Counted(nn.Module):
    """Layer that counts its calls."""

    calls = 0

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return images.flatten(1).tanh()


def pair(*layers_after: nn.Module) -> tuple[MixedPrecision, MixedPrecision]:
    """Build a pupil and its teacher."""
    torch.manual_seed(0)
    layers = [Counted(), nn.Linear(3 * SIZE**2, 8), nn.Dropout(), nn.Linear(8, 5)]
    pupil = MixedPrecision(nn.Sequential(*layers, *layers_after), "float32")
    return pupil, deepcopy(pupil).eval()


def test_the_logits_are_those_of_the_teacher_after_the_last_layer_has_learned():
    pupil, teacher = pair()
    shared = share_layers(LAST_LAYER_ONLY, pupil, teacher, SIZE)
    assert isinstance(shared, SharedTeacher)
    pupil.eval()
    images = torch.rand(6, 3, SIZE, SIZE)
    expected = teacher(images)
    calls = teacher.network[0].calls
    with torch.no_grad():
        pupil.network[3].weight += 1
    assert not torch.equal(pupil(images), expected)
    assert torch.equal(shared(images), expected)
    assert teacher.network[0].calls == calls


@pytest.mark.parametrize(
    ("changes", "layers_after"),
    [
        ({"freeze": None}, ()),
        ({"freeze": "1"}, ()),
        ({"eval_mode": False}, ()),
        ({}, (nn.Softmax(1),)),
    ],
)
def test_a_teacher_with_other_features_or_more_layers_computes_its_own(changes, layers_after):
    pupil, teacher = pair(*layers_after)
    values = {"freeze": "all_but_last", "eval_mode": True} | changes
    assert share_layers(TrainSettings(**values), pupil, teacher, SIZE) is teacher
