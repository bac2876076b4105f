import os

import pytest
import torch

from renderer.errors import InputError
from train import device
from train.networks import WideResNet

CPU = torch.device("cpu")
GPU = torch.device("cuda")


def test_a_device_that_is_not_there_is_one_error():
    with pytest.raises(InputError, match=r"device=cuda:99 is not available here.*: use cpu"):
        device.choose_device("cuda:99")


@pytest.mark.parametrize(
    "quota, cores", [("300000 100000", 3), ("20000 100000", 1), ("max 100000", 8), (None, 8)]
)
def test_threads_are_at_most_the_containers_quota_of_cores(tmp_path, monkeypatch, quota, cores):
    if quota:
        (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(device, "QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)))
    for at_start, expected in [(8, cores), (1, 1)]:
        monkeypatch.setattr(device, "THREADS", at_start)
        assert device.most_threads() == expected


def test_a_large_training_gets_all_threads_and_a_small_one_gets_one(monkeypatch):
    monkeypatch.setattr(device, "most_threads", lambda: 6)
    assert device.choose_threads(WideResNet(3, 10, 1, dropout=0.0), 16, 16) == 1
    assert device.choose_threads(WideResNet(100, 16, 4, dropout=0.0), 128, 32) == 6


@pytest.mark.parametrize(
    "where, machine, rule, otherwise",
    [
        (GPU, "x86_64", "torch.cuda.is_bf16_supported", "float16"),
        (CPU, "x86_64", "torch.cpu._is_avx512_bf16_supported", "float32"),
        (CPU, "aarch64", "torch.ops.mkldnn._is_mkldnn_bf16_supported", "float32"),
    ],
)
def test_auto_is_bfloat16_where_hardware_computes_it(monkeypatch, where, machine, rule, otherwise):
    """A depthwise convolution is faster in float32 on every CPU."""
    grouped, depthwise = (torch.nn.Conv2d(4, 8, 3, groups=groups) for groups in (2, 4))
    monkeypatch.setattr(device.platform, "machine", lambda: machine)
    for supported, expected in ((True, "bfloat16"), (False, otherwise)):
        monkeypatch.setattr(rule, lambda supported=supported, **_: supported)
        assert device.choose_precision("auto", where, grouped) == expected
        of_depthwise = "float32" if where.type == "cpu" else expected
        assert device.choose_precision("auto", where, depthwise) == of_depthwise


def test_bfloat16_rounds_inside_and_gives_float32_logits_and_gradients():
    torch.manual_seed(0)
    network = WideResNet(3, 10, 1, dropout=0.0).eval()
    images = torch.rand(4, 3, 16, 16, requires_grad=True)
    exact = network(images)
    inside = []
    network.stem.register_forward_hook(lambda module, given, result: inside.append(result.dtype))
    logits = device.MixedPrecision(network, "bfloat16")(images)
    logits.sum().backward()
    assert inside == [torch.bfloat16]
    assert logits.dtype == images.grad.dtype == torch.float32
    assert {parameter.dtype for parameter in network.parameters()} == {torch.float32}
    assert (logits - exact).norm() / exact.norm() < 0.05  # bfloat16 has 8 bits, over a dozen layers
    # Autocast ends with the forward pass.
    product = torch.rand(8, 8) @ torch.rand(8, 8)
    assert product.dtype == torch.float32


@pytest.mark.parametrize("works", [True, False])
def test_one_gpu_compiles_where_it_can_unless_disabled(monkeypatch, caplog, works):
    def no_compiler(images):
        raise RuntimeError("Failed to find C compiler.")

    monkeypatch.setattr(
        device.torch, "compile", lambda function: (lambda images: images) if works else no_compiler
    )
    monkeypatch.setattr(device.torch, "zeros", lambda size, device: None)
    device.compiles.cache_clear()
    assert [device.compiles("auto", GPU), device.compiles("auto", GPU)] == [works, works]
    assert len(caplog.messages) == (not works)  # once
    assert device.compiles("always", GPU)
    assert not device.compiles("never", GPU)
    assert not device.compiles("auto", CPU)
    device.compiles.cache_clear()
    monkeypatch.setattr(device.distributed, "world_size", lambda: 2)
    assert not device.compiles("auto", GPU)
    device.compiles.cache_clear()
