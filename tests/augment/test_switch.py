from typing import Any

import numpy as np
import pytest
import torch
from oracles import srgb_of
from torch import Tensor

import norm_balls as nb
from augment.classifier import TaskNetwork
from augment.exposure import IsDim
from augment.switch import Switch
from renderer import InputError

SIZE = 8
NAMES = ["red", "green", "blue"]
BELOW = 0.25


def brightness(linear: float) -> Tensor:
    """Return a gray image (1, 3, SIZE, SIZE) of a linear value."""
    return torch.from_numpy(srgb_of(np.full((1, 3, SIZE, SIZE), linear)))


class Constant(torch.nn.Module):
    """Network that returns the mean of each channel and a number of its own."""

    def __init__(self, number: float, kind: str):
        super().__init__()
        self.number, self.kind = number, kind

    def forward(self, images: Tensor) -> Any:
        means = images.mean((2, 3)) + self.number
        if self.kind == "tensor":
            return means
        return [{"scores": row} for row in means]


def rows(outputs: Any) -> np.ndarray:
    """Return the numbers (N, 3) in outputs of any kind."""
    if isinstance(outputs, list):
        return torch.stack([item["scores"] for item in outputs]).numpy()
    return outputs.numpy()


@pytest.mark.parametrize("kind", ["tensor", "list"])
@pytest.mark.parametrize("levels", [(0.1, 0.9, 0.2, 0.4, 0.24), (0.1, 0.2), (0.3, 0.9)])
def test_each_image_gets_the_outputs_of_the_network_for_its_brightness(kind, levels):
    images = torch.cat([brightness(level) for level in levels])
    network = Switch(Constant(0.0, kind), Constant(10.0, kind), IsDim(BELOW))
    added = np.where(np.array(levels) < BELOW, 10, 0)[:, None]
    expected = images.mean((2, 3)).numpy() + added
    np.testing.assert_array_equal(rows(network(images)), expected)


@pytest.mark.parametrize(("fraction", "is_dim"), [(0.01, True), (0.03, False)])
def test_an_image_with_more_than_two_percent_of_bright_values_is_not_dim(fraction, is_dim):
    image = brightness(0.05).float()[..., :1, :].repeat(1, 1, 100, 1)
    values = image.flatten()
    values[: round(fraction * len(values))] = 1.0
    network = Switch(Constant(0.0, "tensor"), Constant(10.0, "tensor"), IsDim(BELOW))
    assert (network(values.view_as(image)) > 5).all() == is_dim


def test_a_name_of_two_networks_is_the_first_with_the_second_for_dim_images():
    from train.checkpoints import load_network

    plain, dim = nb.load("none"), nb.load("best")
    switched = load_network("dim:run:pretrained/none+run:pretrained/best")
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    shown = torch.cat([images, images * 0.1]).requires_grad_()
    outputs = switched(shown), torch.cat([plain(shown[:2]), dim(shown[2:])])
    torch.testing.assert_close(*outputs)
    gradients = [torch.autograd.grad(each.square().sum(), shown)[0] for each in outputs]
    torch.testing.assert_close(*gradients)


def test_only_the_second_network_of_a_switch_gets_images_in_normalized_light():
    from train.checkpoints import load_chosen, load_network
    from train.settings import TaskSettings

    name = "dim:run:pretrained/none+run:pretrained/best"
    plain, dim = nb.load("none"), nb.load("best").normalizing_light()
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    expected = torch.cat([plain(images), dim(images * 0.1)])
    settings = nb.NormalizedLightSettings()
    chosen = load_chosen(TaskSettings(network=name, normalize_light={}))
    for network in (load_network(name).normalizing_light(), chosen):
        assert network.normalized_light == settings
        torch.testing.assert_close(network(torch.cat([images, images * 0.1])), expected)
        with pytest.raises(nb.InputError, match="already"):
            network.normalizing_light()


def test_the_candidates_of_a_detector_are_those_of_the_network_that_an_image_gets():
    plain = nb.load("detector")
    dim = plain.normalizing_light()
    shown = torch.rand(3, 3, plain.size, plain.size, generator=torch.Generator().manual_seed(0))
    shown[1] *= 0.1
    found = plain.with_dim(dim)(shown)
    # In a batch of another size, candidates with nearly equal scores may change places.
    first, last = plain(shown[[0, 2]])
    expected = [first, dim(shown[1:2])[0], last]
    for item, own in zip(found, expected, strict=True):
        for key in own:
            torch.testing.assert_close(item[key], own[key], rtol=1e-4, atol=1e-4)


def test_a_detector_with_a_function_of_the_user_can_be_shown_dim_images_alone():
    def decode(outputs):
        boxes = torch.tensor([[1.0, 1.0, 4.0, 4.0]]).expand(len(outputs), 1, 4)
        return [
            {"boxes": box, "scores": row[None, :].sigmoid()}
            for box, row in zip(boxes, outputs, strict=True)
        ]

    task = nb.Detection(decode=decode)
    names = [f"object {number}" for number in range(3)]
    plain, dim = (
        TaskNetwork(Constant(number, "tensor").eval(), SIZE, names, task=task)
        for number in (0.0, 1.0)
    )
    images = torch.cat([brightness(0.9), brightness(0.1)]).float()
    found = plain.with_dim(dim)(images)
    expected = [plain(images[:1])[0], dim(images[1:])[0]]
    for item, own in zip(found, expected, strict=True):
        assert torch.equal(item["scores"], own["scores"])


@pytest.mark.parametrize(
    ("size", "names", "said"), [(9, NAMES, "size"), (SIZE, [*NAMES[:2], "black"], "classes")]
)
def test_networks_of_other_images_or_classes_are_an_error(size, names, said):
    plain = nb.Classifier(Constant(0.0, "tensor").eval(), SIZE, NAMES)
    other = nb.Classifier(Constant(0.0, "tensor").eval(), size, names)
    with pytest.raises(InputError, match=f"another {said} than"):
        plain.with_dim(other)


@pytest.mark.parametrize("name", ["none", "detector"])
def test_two_networks_are_not_hardened_at_once(name):
    network = nb.load(name)
    with pytest.raises(InputError, match="train one of them"):
        nb.harden(network.with_dim(network), ["solid:orange"], "pretrained/laboratory")
