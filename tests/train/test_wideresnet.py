import math

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from renderer.errors import InputError
from train.wideresnet import WideResNet


def count_parameters(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def expected_parameters(depth: int, width: int, classes: int) -> int:
    """Counted from the table of the paper (Zagoruyko and Komodakis 2016), 1 × 1 shortcuts where shapes change."""
    blocks, total, inputs = (depth - 4) // 6, 3 * 16 * 9, 16
    for outputs in (16 * width, 32 * width, 64 * width):
        for block in range(blocks):
            total += 2 * inputs + 9 * inputs * outputs + 2 * outputs + 9 * outputs**2
            total += inputs * outputs if block == 0 and (inputs != outputs or outputs > 16 * width) else 0
            inputs = outputs
    return total + 2 * inputs + (inputs + 1) * classes


@pytest.mark.parametrize("depth, width, published", [(40, 1, "0.6"), (40, 4, "8.9"), (16, 8, "11.0"), (28, 10, "36.5")])
def test_parameter_counts_are_those_published(depth, width, published):
    with torch.device("meta"):
        count = count_parameters(WideResNet(10, depth, width))
    assert count == expected_parameters(depth, width, classes=10)
    assert f"{count / 1e6:.1f}" == published


def test_wrn_16_4_for_100_classes_has_2_772_020_parameters():
    assert count_parameters(WideResNet(100)) == 2_772_020


def test_convolutions_start_with_he_initialization():
    torch.manual_seed(0)
    for name, module in WideResNet(100).named_modules():
        if isinstance(module, nn.Conv2d):
            weight = module.weight.detach()
            expected = math.sqrt(2 / (weight.shape[0] * weight[0, 0].numel()))
            spread = 5 / math.sqrt(2 * weight.numel())  # five standard errors of a standard deviation
            assert weight.std() / expected == pytest.approx(1, abs=spread), name
            assert abs(weight.mean()) < 5 * expected / math.sqrt(weight.numel()), name


def test_images_are_normalized_inside():
    torch.manual_seed(0)
    mean, std = (0.2, 0.5, 0.7), (0.1, 0.2, 0.4)
    network = WideResNet(5, 10, 1, 0.0, mean, std).double().eval()
    plain = WideResNet(5, 10, 1, 0.0, (0, 0, 0), (1, 1, 1)).double().eval()
    plain.load_state_dict(network.state_dict() | {"mean": plain.mean, "std": plain.std})
    images = torch.rand(2, 3, 16, 16, dtype=torch.float64)
    # the buffers began as float32
    shift, scale = (torch.tensor(values).double().view(1, 3, 1, 1) for values in (mean, std))
    torch.testing.assert_close(network(images), plain((images - shift) / scale))


def test_the_forward_pass_is_the_published_block_by_block():
    """A functional pass written down from the paper: pre-activation, the shortcut after the first ReLU."""
    torch.manual_seed(0)
    network = WideResNet(5, 16, 2, dropout=0.3).double().eval()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.uniform_(-1, 1), module.running_var.uniform_(0.5, 2)
            nn.init.uniform_(module.weight, 0.5, 2), nn.init.uniform_(module.bias, -1, 1)
    state = network.state_dict()

    def norm_relu(x, name):
        parts = (state[f"{name}.{part}"] for part in ("running_mean", "running_var", "weight", "bias"))
        return F.relu(F.batch_norm(x, *parts))

    images = torch.rand(2, 3, 12, 12, dtype=torch.float64)
    x = F.conv2d((images - network.mean) / network.std, state["stem.weight"], padding=1)
    for group in range(3):
        for block in range(2):
            name, stride = f"groups.{group}.{block}", 2 if group and not block else 1
            activated = norm_relu(x, f"{name}.norm1")
            hidden = F.conv2d(activated, state[f"{name}.conv1.weight"], stride=stride, padding=1)
            hidden = F.conv2d(norm_relu(hidden, f"{name}.norm2"), state[f"{name}.conv2.weight"], padding=1)
            x = hidden + (x if block else F.conv2d(activated, state[f"{name}.shortcut.weight"], stride=stride))
    logits = norm_relu(x, "norm").mean((2, 3)) @ state["head.weight"].T + state["head.bias"]
    torch.testing.assert_close(network(images), logits)


def test_dropout_acts_in_training_alone():
    torch.manual_seed(0)
    network = WideResNet(5, 10, 1, dropout=0.5)
    images = torch.rand(4, 3, 16, 16)
    assert not torch.equal(network(images), network(images))
    network.eval()
    assert torch.equal(network(images), network(images))


@pytest.mark.parametrize("size", [(8, 8), (33, 17), (64, 64)])
def test_images_of_other_sizes_give_logits_too(size):
    assert WideResNet(7, 10, 1).eval()(torch.rand(2, 3, *size)).shape == (2, 7)


@pytest.mark.parametrize(
    "settings, key",
    [
        ({"depth": 15}, "model.depth=15"),
        ({"depth": 4}, "model.depth=4"),
        ({"width": 0}, "model.width=0"),
        ({"dropout": 1.0}, "model.dropout=1.0"),
        ({"dropout": -0.1}, "model.dropout=-0.1"),
    ],
)
def test_an_impossible_architecture_names_its_key(settings, key):
    with pytest.raises(InputError, match=key):
        WideResNet(10, **settings)
