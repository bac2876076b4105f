from copy import deepcopy

import pytest
import torch
from torch import nn

from renderer.errors import InputError
from train import device
from train.device import MixedPrecision, choose_precision
from train.wideresnet import WideResNet

CPU = torch.device("cpu")


@pytest.fixture
def network() -> WideResNet:
    torch.manual_seed(0)
    return WideResNet(10, 10, 1, dropout=0.0).eval()


def test_bfloat16_rounds_inside_and_gives_float32_logits_and_gradients(network):
    images = torch.rand(4, 3, 16, 16, requires_grad=True)
    exact = network(images)
    inside = []
    network.stem.register_forward_hook(lambda module, arguments, result: inside.append(result.dtype))
    logits = MixedPrecision(network, "bfloat16")(images)
    logits.sum().backward()
    assert inside == [torch.bfloat16]
    assert logits.dtype == images.grad.dtype == torch.float32
    assert {parameter.dtype for parameter in network.parameters()} == {torch.float32}
    assert not torch.equal(logits, exact)
    assert (logits - exact).norm() / exact.norm() < 0.05  # bfloat16 keeps 8 bits, over a dozen layers


def test_float32_is_the_bare_network(network):
    images = torch.rand(4, 3, 16, 16)
    expected = deepcopy(network).to(memory_format=torch.channels_last)(images)
    assert torch.equal(MixedPrecision(network, "float32")(images), expected)


def test_channels_last_changes_the_result_by_rounding_alone(network):
    images = torch.rand(4, 3, 16, 16, dtype=torch.float64)
    network.double()
    expected = deepcopy(network)(images)
    layer = MixedPrecision(network, "float32").network
    torch.testing.assert_close(layer(images.contiguous(memory_format=torch.channels_last)), expected)


def test_autocast_ends_with_the_forward_pass(network):
    MixedPrecision(network, "bfloat16")(torch.rand(1, 3, 16, 16))
    assert (torch.rand(8, 8) @ torch.rand(8, 8)).dtype == torch.float32


def test_auto_chooses_one_and_leaves_random_state_and_threads():
    device._faster_precision.cache_clear()
    torch.manual_seed(3)
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert choose_precision("auto", CPU) in ("bfloat16", "float32")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("faster", ["bfloat16", "float32"])
def test_auto_takes_the_faster_by_its_best_time(monkeypatch, faster):
    steps = []

    def step_time(layer: nn.Module, images: torch.Tensor, name: str) -> float:
        steps.append(name)
        if name != faster:
            return 2.0
        return 1.0 if steps.count(name) > 1 else 100.0  # once, something else had the core

    monkeypatch.setattr(device, "_step_time", step_time)
    device._faster_precision.cache_clear()
    try:
        assert choose_precision("auto", CPU) == faster
        assert choose_precision("auto", CPU) == faster
    finally:
        device._faster_precision.cache_clear()
    assert len(steps) == 2 * device.MEASUREMENTS  # once per process


def test_a_named_precision_is_taken_as_it_is_and_another_refused():
    assert [choose_precision(name, CPU) for name in ("bfloat16", "float32")] == ["bfloat16", "float32"]
    with pytest.raises(InputError, match=r"train.precision=float16: choose one of auto, bfloat16, float32"):
        choose_precision("float16", CPU)
