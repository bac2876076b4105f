import os
import signal
from copy import deepcopy

import pytest
import torch
from torch._dynamo.exc import BackendCompilerFailed

from renderer.errors import InputError
from train import runtime
from train.networks import WideResNet
from train.recipe import TrainSettings, training_loss
from train.runtime import (
    RECOMPILE_LIMIT,
    SIZES,
    GraphedModel,
    Interrupted,
    Interruption,
    MixedPrecision,
    choose_device,
    choose_precision,
    compiled_pass,
    compiler_works,
    compiles,
    set_threads,
)

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.fixture(autouse=True)
def threads_and_determinism():
    threads, deterministic = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    yield
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(deterministic)


@pytest.fixture
def network() -> WideResNet:
    torch.manual_seed(0)
    return WideResNet(3, 10, 1, dropout=0.0).eval()


@pytest.mark.parametrize("name", ["abacus", "cuda:99"])
def test_a_device_that_is_not_there_is_one_error(name):
    with pytest.raises(InputError, match=f"device={name} is not available here: use cpu"):
        choose_device(name)


@pytest.mark.parametrize("quota, cores", [("300000 100000", 3), ("20000 100000", 1), ("max 100000", 8), (None, 8)])
def test_threads_are_no_more_than_the_containers_quota_of_cores(tmp_path, monkeypatch, quota, cores):
    if quota:
        (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(runtime, "QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    torch.set_num_threads(8)
    set_threads(None)
    assert torch.get_num_threads() == cores
    set_threads(5)
    assert torch.get_num_threads() == 5
    torch.set_num_threads(1)  # by the user
    set_threads(None)
    assert torch.get_num_threads() == 1


@pytest.mark.parametrize("supported, expected", [(True, "bfloat16"), (False, "float32")])
@pytest.mark.parametrize(
    "device, machine, rule",
    [
        (GPU, "x86_64", "torch.cuda.is_bf16_supported"),
        (CPU, "x86_64", "torch.cpu._is_avx512_bf16_supported"),
        (CPU, "aarch64", "torch.ops.mkldnn._is_mkldnn_bf16_supported"),
    ],
)
def test_auto_is_bfloat16_where_the_hardware_computes_in_it(monkeypatch, device, machine, rule, supported, expected):
    monkeypatch.setattr(runtime.platform, "machine", lambda: machine)
    monkeypatch.setattr(rule, lambda **options: supported)
    assert choose_precision("auto", device) == expected


def test_a_named_precision_is_taken_as_it_is_and_another_refused():
    assert [choose_precision(name, CPU) for name in ("bfloat16", "float32")] == ["bfloat16", "float32"]
    with pytest.raises(InputError, match=r"precision=float16: choose one of auto, bfloat16, float32"):
        choose_precision("float16", CPU)


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
    assert (logits - exact).norm() / exact.norm() < 0.05  # bfloat16 has 8 bits, over a dozen layers
    assert (torch.rand(8, 8) @ torch.rand(8, 8)).dtype == torch.float32  # autocast ends with the forward pass


def test_float32_is_the_bare_network_and_channels_last_changes_it_by_rounding_alone(network):
    images, contiguous = torch.rand(4, 3, 16, 16), deepcopy(network).double()
    expected = deepcopy(network).to(memory_format=torch.channels_last)(images)
    assert torch.equal(MixedPrecision(network, "float32")(images), expected)
    layer = MixedPrecision(deepcopy(contiguous), "float32").network
    images = images.double()
    torch.testing.assert_close(layer(images.contiguous(memory_format=torch.channels_last)), contiguous(images))


class Recorded:
    """A compiler for torch.compile that notes the shape of each graph's images and runs it as it is."""

    def __init__(self):
        self.shapes = []

    def __call__(self, module, inputs):
        self.shapes.append(next(tuple(x.shape) for x in inputs if x.dim() == 4 and x.shape[1:] == (3, 8, 8)))
        return module.forward


@pytest.mark.parametrize(
    "choice, device, several, expected",
    [
        ("auto", GPU, False, True), ("auto", CPU, False, False), ("always", GPU, False, True),
        ("never", GPU, False, False), ("auto", GPU, True, False), ("always", GPU, True, True),
    ],
)  # fmt: skip
def test_one_gpu_compiles_unless_told(monkeypatch, choice, device, several, expected):
    monkeypatch.setattr(runtime, "compiler_works", lambda device: True)
    monkeypatch.setattr(runtime.utils, "world_size", lambda: 1 + several)
    assert compiles(choice, device) == expected


def test_a_gpu_without_a_compiler_trains_all_the_same(monkeypatch, caplog):
    def no_compiler(images):
        raise BackendCompilerFailed("inductor", RuntimeError("Failed to find C compiler."), None)

    monkeypatch.setattr(runtime.torch, "compile", lambda function: no_compiler)
    monkeypatch.setattr(runtime.torch, "zeros", lambda size, device: None)
    compiler_works.cache_clear()
    assert not compiles("auto", GPU) and compiles("always", GPU)
    assert not compiles("auto", GPU)
    (line,) = caplog.messages
    assert "torch.compile fails here" in line and "Failed to find C compiler." in line
    compiler_works.cache_clear()


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")  # the compiler looks at it
def test_batches_of_any_size_pass_through_a_few_graphs_with_the_models_result_and_gradient(network):
    recorded = Recorded()
    graphed = GraphedModel(network.double(), recorded).eval()
    for parameter in network.parameters():
        parameter.requires_grad_(False)  # as in an attack
    for count in (1, 7, 16, 17, 30, 32, 33):
        images = torch.rand(count, 3, 8, 8, dtype=torch.float64, requires_grad=True)
        logits, expected = graphed(images), network(images)
        torch.testing.assert_close(logits, expected)
        weights = torch.rand_like(logits)
        gradient, exact = (torch.autograd.grad((x * weights).sum(), images)[0] for x in (logits, expected))
        torch.testing.assert_close(gradient, exact)
    assert [shape[0] for shape in recorded.shapes] == [16, 32, 64]


def test_no_run_of_a_sweep_is_compiled_less_than_the_first():
    """Torch would stop at a number of graphs, of all the runs of a process together."""
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(192, 3)).double()
    sizes, image = [], torch.zeros(1, 3, 8, 8, dtype=torch.float64)
    for _ in range(RECOMPILE_LIMIT // len(SIZES) + 1):
        recorded = Recorded()
        compiled_pass(network)  # as each run begins
        graphed = GraphedModel(network, recorded).eval()
        with torch.no_grad():
            for size in SIZES:
                graphed(image.expand(size, -1, -1, -1))
        sizes.append([shape[0] for shape in recorded.shapes])
    assert sizes == [list(SIZES)] * len(sizes)


def test_training_mode_and_larger_batches_use_the_model_as_it_is(network):
    recorded = Recorded()
    graphed = GraphedModel(network, recorded)
    with torch.no_grad():
        graphed.train()(torch.rand(4, 3, 8, 8))
        graphed.eval()(torch.rand(SIZES[-1] + 1, 3, 8, 8))
    assert recorded.shapes == [] and not network.training


@pytest.mark.slow
def test_compiled_passes_give_the_same_gradients_and_logits(network):
    """Through the compiler of the CPU; there are no graphs to record there."""
    images, labels = torch.randint(0, 256, (9, 3, 8, 8), dtype=torch.uint8), torch.arange(9) % 3
    teacher = WideResNet(3, 10, 1, dropout=0.0).eval().requires_grad_(False)
    settings = TrainSettings(init_from="base", label_smoothing=0.1, ranking=1.0, distillation=1.0)
    loss, gradients = training_loss(network, settings, 1, teacher), []
    for step in (loss, compiled_pass(loss)):
        network.zero_grad()
        network.train()
        step(images, labels, labels == 0)[0].backward()
        gradients.append({name: parameter.grad.clone() for name, parameter in network.named_parameters()})
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-5)
    network.eval()
    with torch.no_grad():
        torch.testing.assert_close(GraphedModel(network).eval()(images / 255), network(images / 255))


@pytest.mark.parametrize("ended", ["asked", "unasked", "by an error"])
def test_a_signal_is_noted_never_swallowed_and_hides_no_error(ended):
    """It ends the run where it is asked for, or else where the block ends; the handlers are those of before."""
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    expected = {"asked": Interrupted, "unasked": KeyboardInterrupt, "by an error": ZeroDivisionError}[ended]
    with pytest.raises(expected) as stopped, Interruption() as interruption:
        assert not interruption.requested()
        signal.raise_signal(signal.SIGINT)
        if ended == "by an error":
            raise ZeroDivisionError
        if ended == "asked":
            assert interruption.requested()
            interruption.stop()
    assert ended != "asked" or stopped.value.code == 128 + signal.SIGINT
    assert [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)] == before


def test_a_signal_that_is_ignored_stays_so():
    """As nohup ignores SIGHUP, a shell ignores SIGINT for what it starts in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interruption() as interruption:
            signal.raise_signal(signal.SIGINT)
            assert not interruption.requested()
    finally:
        signal.signal(signal.SIGINT, before)
