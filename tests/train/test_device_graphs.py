import pytest
import torch
import torch.nn.functional as F
from torch._dynamo.exc import BackendCompilerFailed

from augment.labels import ranking_loss
from augment.utils import eval_mode
from train import device as compute
from train.device import RECOMPILE_LIMIT, SIZES, FixedSizes, compiler_works, compiles, training_pass
from train.wideresnet import WideResNet

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.fixture
def network() -> WideResNet:
    torch.manual_seed(0)
    return WideResNet(3, 10, 1, dropout=0.0).double().eval()


class Recorded:
    """A back end of torch.compile that notes the shape of each graph's images and runs it as it is."""

    def __init__(self):
        self.shapes = []

    def __call__(self, module, inputs):
        self.shapes.append(next(tuple(x.shape) for x in inputs if x.dim() == 4 and x.shape[1:] == (3, 8, 8)))
        return module.forward


@pytest.mark.parametrize(
    "choice, device, expected",
    [("auto", GPU, True), ("auto", CPU, False), ("always", GPU, True), ("never", GPU, False)],
)
def test_one_gpu_compiles_unless_told(monkeypatch, choice, device, expected):
    monkeypatch.setattr(compute, "compiler_works", lambda device: True)
    assert compiles(choice, device) == expected


def test_a_gpu_without_a_compiler_trains_all_the_same(monkeypatch, caplog):
    def no_compiler(images):
        raise BackendCompilerFailed("inductor", RuntimeError("Failed to find C compiler."), None)

    monkeypatch.setattr(compute.torch, "compile", lambda function: no_compiler)
    monkeypatch.setattr(compute.torch, "zeros", lambda size, device: None)
    compiler_works.cache_clear()
    assert not compiles("auto", GPU) and compiles("always", GPU)
    assert not compiles("auto", GPU)
    (line,) = caplog.messages
    assert "torch.compile fails here" in line and "Failed to find C compiler." in line
    compiler_works.cache_clear()


def test_several_processes_do_not_compile_unless_told(monkeypatch):
    monkeypatch.setattr(compute.processes, "world_size", lambda: 2)
    assert not compiles("auto", GPU) and compiles("always", GPU)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")  # the compiler looks at it
def test_batches_of_any_size_pass_through_a_few_graphs_with_the_models_result_and_gradient(network):
    backend = Recorded()
    fixed = FixedSizes(network, backend).eval()
    for parameter in network.parameters():
        parameter.requires_grad_(False)  # as in an attack
    for count in (1, 7, 16, 17, 30, 32, 33):
        images = torch.rand(count, 3, 8, 8, dtype=torch.float64, requires_grad=True)
        logits, expected = fixed(images), network(images)
        torch.testing.assert_close(logits, expected)
        weights = torch.rand_like(logits)
        found, exact = (torch.autograd.grad((x * weights).sum(), images)[0] for x in (logits, expected))
        torch.testing.assert_close(found, exact)
    assert [shape[0] for shape in backend.shapes] == [16, 32, 64]


def test_no_run_of_a_sweep_is_compiled_less_than_the_first():
    """Torch would stop at a number of graphs, of all the runs of a process together."""
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(192, 3)).double()
    found, image = [], torch.zeros(1, 3, 8, 8, dtype=torch.float64)
    for _ in range(RECOMPILE_LIMIT // len(SIZES) + 1):
        backend = Recorded()
        training_pass(network, 0.1, compiled=True)  # as each run begins
        fixed = FixedSizes(network, backend).eval()
        with torch.no_grad():
            for size in SIZES:
                fixed(image.expand(size, -1, -1, -1))
        found.append([shape[0] for shape in backend.shapes])
    assert found == [list(SIZES)] * len(found)


def test_training_mode_and_larger_batches_use_the_model_as_it_is(network):
    backend = Recorded()
    fixed = FixedSizes(network, backend)
    with torch.no_grad():
        fixed.train()(torch.rand(4, 3, 8, 8, dtype=torch.float64))
        fixed.eval()(torch.rand(SIZES[-1] + 1, 3, 8, 8, dtype=torch.float64))
    assert backend.shapes == []


def test_a_result_outlives_the_next_pass(network):
    fixed = FixedSizes(network, Recorded()).eval()
    first = fixed(torch.zeros(2, 3, 8, 8, dtype=torch.float64))
    before = first.clone()
    fixed(torch.ones(2, 3, 8, 8, dtype=torch.float64))
    assert torch.equal(first, before)


def test_the_mode_of_the_model_inside_is_found_and_restored(network):
    fixed = FixedSizes(network, Recorded()).train()
    with eval_mode(fixed):
        assert not network.training
    assert network.training


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_the_training_pass_is_the_mean_cross_entropy_and_the_number_of_hits(network, smoothing):
    images = torch.randint(0, 256, (9, 3, 8, 8), dtype=torch.uint8)
    labels = torch.arange(9) % 3
    network.float()
    loss, hits = training_pass(network, smoothing, compiled=False)(images, labels, labels == 0)
    logits = network(images / 255)
    uniform = -F.log_softmax(logits, 1).mean(1)
    expected = (1 - smoothing) * F.cross_entropy(logits, labels) + smoothing * uniform.mean()
    torch.testing.assert_close(loss, expected)
    assert hits == (logits.argmax(1) == labels).sum()


def test_the_training_pass_adds_the_weighted_ranking(network):
    images, labels = torch.randint(0, 256, (9, 3, 8, 8), dtype=torch.uint8), torch.arange(9) % 3 - 1  # one "no class 0"
    network.float().eval()
    alone, _ = training_pass(network, 0.0, compiled=False)(images, labels, labels == 0)
    both, _ = training_pass(network, 0.0, compiled=False, ranking=4.0, label=1)(images, labels, labels == 0)
    torch.testing.assert_close(both, alone + 4 * ranking_loss(network(images / 255), labels, 1))


def test_the_training_pass_adds_the_weighted_divergence_from_the_teacher_on_images_that_are_no_renders(network):
    """The teacher's probabilities are a constant."""
    images, labels = torch.randint(0, 256, (9, 3, 8, 8), dtype=torch.uint8), torch.arange(9) % 3
    rendered = torch.arange(9) < 4
    network.float()
    teacher = WideResNet(3, 10, 1, dropout=0.0).eval().requires_grad_(False)
    alone, _ = training_pass(network, 0.0, compiled=False)(images, labels, rendered)
    both, _ = training_pass(network, 0.0, compiled=False, distillation=4.0, teacher=teacher)(images, labels, rendered)
    learned, held = (each(images[4:] / 255).softmax(1) for each in (network, teacher))
    torch.testing.assert_close(both, alone + 4 * (held * (held / learned).log()).sum() / 9)


@pytest.mark.slow
def test_compiled_passes_give_the_same_gradients_and_logits(network):
    """Through the compiler of the CPU; there are no graphs to record there."""
    network.float()
    images, labels = torch.randint(0, 256, (9, 3, 8, 8), dtype=torch.uint8), torch.arange(9) % 3
    teacher = WideResNet(3, 10, 1, dropout=0.0).eval().requires_grad_(False)
    gradients = []
    for compiled in (False, True):
        network.zero_grad()
        network.train()
        step = training_pass(network, 0.1, compiled, ranking=1.0, label=1, distillation=1.0, teacher=teacher)
        step(images, labels, labels == 0)[0].backward()
        gradients.append({name: parameter.grad.clone() for name, parameter in network.named_parameters()})
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-5)
    network.eval()
    with torch.no_grad():
        torch.testing.assert_close(FixedSizes(network).eval()(images / 255), network(images / 255))
