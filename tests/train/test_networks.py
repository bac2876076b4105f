import math
import re
from itertools import product
from pathlib import Path

import pytest
import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchvision.models import mnasnet0_5, resnet18
from torchvision.transforms.functional import normalize

from renderer.errors import InputError
from train.checkpoints import load_network, load_run, load_selected, save, write_published
from train.networks import Dropout, WideResNet, build_network, describe
from train.run_folder import BEST, PUBLISHED
from train.settings import ExperimentSettings, ModelSettings
from train.training.inputs import Initial, load_initial

CLASSES = ("apple", "orange", "pear")
MEAN = (0.4, 0.5, 0.6)
STD = (0.2, 0.3, 0.25)
SOURCE = """
import torch
from torch import Tensor, nn

class Network(nn.Linear):
    def forward(self, images):
        return super().forward(images.mean((2, 3)))

def build(): return Network(3, 3), 16, ["apple", "orange", "pear"]
def of_other_size(): return Network(3, 3), 32, ["apple", "orange", "pear"]
def of_other_classes(): return Network(3, 3), 16, ["orange", "apple", "pear"]
def of_other_logits(): return Network(3, 4), 16, ["apple", "orange", "pear"]
"""


@pytest.fixture(autouse=True)
def own_models(tmp_path, monkeypatch) -> None:
    (tmp_path / "own_models.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.fixture
def network() -> WideResNet:
    torch.manual_seed(0)
    network = WideResNet(3, 10, 1, 0.0, MEAN, STD)
    with torch.no_grad():
        for _ in range(3):
            network(torch.rand(8, 3, 16, 16))
    return network.eval()


def description_of(network: nn.Module, **changes) -> dict:
    shape = {"size": 48, "encoding": "linear", "depth": 10, "width": 1, "dropout": 0.0} | changes
    return describe(network, CLASSES, **shape)


def write(folder: Path, network: nn.Module, description: dict | None = None, **changes) -> Path:
    architecture = description_of(network) if description is None else description
    state = {"model": network.state_dict(), "architecture": architecture | changes}
    save(folder / BEST, state)
    write_published(folder / PUBLISHED, state)
    return folder


def test_parameter_counts_are_those_published():
    published = {(10, 40, 4): "8.9", (10, 28, 10): "36.5", (100, 16, 4): "2.77202"}
    for shape, millions in published.items():
        with torch.device("meta"):
            count = sum(parameter.numel() for parameter in WideResNet(*shape).parameters())
        assert round(count / 1e6, len(millions.partition(".")[2])) == float(millions)


def test_convolutions_start_with_he_initialization():
    torch.manual_seed(0)
    modules = WideResNet(100).named_modules()
    convolutions = {name: part for name, part in modules if isinstance(part, nn.Conv2d)}
    for name, convolution in convolutions.items():
        weight = convolution.weight.detach()
        fan_out = weight.shape[0] * weight[0, 0].numel()
        expected = math.sqrt(2 / fan_out)
        # Both limits are five standard errors.
        largest_deviation = 5 / math.sqrt(2 * weight.numel())
        largest_mean = 5 * expected / math.sqrt(weight.numel())
        assert weight.std() / expected == pytest.approx(1, abs=largest_deviation), name
        assert abs(weight.mean()) < largest_mean, name


def published_logits(state: dict[str, Tensor], normalized: Tensor) -> Tensor:
    """Compute the forward pass of the paper: the shortcut begins after the first ReLU."""

    def norm_relu(x: Tensor, name: str) -> Tensor:
        parts = ("running_mean", "running_var", "weight", "bias")
        return F.relu(F.batch_norm(x, *(state[f"{name}.{part}"] for part in parts)))

    x = F.conv2d(normalized, state["stem.weight"], padding=1)
    for group, block in product(range(3), range(2)):
        name, stride = f"groups.{group}.{block}", 2 if group > 0 and block == 0 else 1
        activated = norm_relu(x, f"{name}.norm1")
        hidden = F.conv2d(activated, state[f"{name}.conv1.weight"], stride=stride, padding=1)
        hidden = norm_relu(hidden, f"{name}.norm2")
        shortcut = state.get(f"{name}.shortcut.weight")
        x = x if shortcut is None else F.conv2d(activated, shortcut, stride=stride)
        x = x + F.conv2d(hidden, state[f"{name}.conv2.weight"], padding=1)
    return norm_relu(x, "norm").mean((2, 3)) @ state["head.weight"].T + state["head.bias"]


def test_the_forward_pass_is_the_published_one():
    torch.manual_seed(0)
    network = WideResNet(5, 16, 2, 0.3, MEAN, STD).double().eval()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.uniform_(-1, 1)
            module.running_var.uniform_(0.5, 2)
            nn.init.uniform_(module.weight, 0.5, 2)
            nn.init.uniform_(module.bias, -1, 1)
    images = torch.rand(2, 3, 12, 12, dtype=torch.float64)
    expected = published_logits(network.state_dict(), normalize(images, MEAN, STD))
    torch.testing.assert_close(network(images), expected)


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last], ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_dropout_drops_values_independently_and_keeps_the_mean(layout, dtype):
    ones = torch.ones(16, 32, 31, 33, dtype=dtype).contiguous(memory_format=layout)
    torch.manual_seed(0)
    result = Dropout(0.3)(ones)
    assert result.dtype == dtype
    assert result.is_contiguous(memory_format=layout)
    remaining = result[result != 0]
    torch.testing.assert_close(remaining, torch.full_like(remaining, 1 / 0.7))
    variance = 0.3 * 0.7
    deviations = (result == 0).double() - 0.3
    # All limits are four standard deviations of a mean.
    assert abs(deviations.mean()) < 4 * (variance / ones.numel()) ** 0.5
    for dim in range(4):
        pair_count = ones.shape[dim] - 1
        first = deviations.narrow(dim, 0, pair_count)
        products = first * deviations.narrow(dim, 1, pair_count)
        assert abs(products.mean()) < 4 * variance / products.numel() ** 0.5


def test_dropout_passes_gradients_where_it_passes_values_and_draws_nothing_without_a_rate():
    x = torch.randn(4, 8, 5, 7, requires_grad=True)
    y = Dropout(0.5)(x)
    y.sum().backward()
    assert torch.equal(x.grad, torch.where(y != 0, 2.0, 0.0))
    state = torch.get_rng_state()
    for dropout in (Dropout(0.5).eval(), Dropout(0.0)):
        assert dropout(x) is x
    assert torch.equal(torch.get_rng_state(), state)


def test_a_torchvision_network_is_torchvisions_own_after_normalization():
    torch.manual_seed(0)
    built = build_network(CLASSES, 32, "torchvision:resnet18", MEAN, STD)
    torch.manual_seed(0)
    own = resnet18(num_classes=3)
    images = torch.rand(2, 3, 32, 32)
    # Another memory layout would round differently.
    normalized = normalize(images, MEAN, STD).contiguous(memory_format=torch.channels_last)
    assert torch.equal(built.eval()(images), own.eval()(normalized))
    assert all(parameter.requires_grad for parameter in built.parameters())


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        ("resnet18", 16, "torchvision:NAME"),
        ("torchvision:resnet19", 16, "resnet18"),
        ("torchvision:vit_b_32", 40, "40 pixels per side"),
        ("python:own_models:of_other_size", 16, "32 pixels per side"),
        ("python:own_models:of_other_classes", 16, "classes such as"),
        ("python:own_models:of_other_logits", 16, "(2, 4)"),
    ],
)
def test_a_network_that_does_not_take_the_data_is_refused_by_name(name, size, message):
    with pytest.raises(InputError, match=rf"^name={name}\W.*{re.escape(message)}"):
        build_network(CLASSES, size, name)


@pytest.mark.parametrize("argument, value", [("depth", 15), ("width", 0), ("depth", 6 * 10**9 + 4)])
def test_an_impossible_architecture_is_refused_by_its_argument(argument, value):
    with pytest.raises(InputError, match=f"{argument}={value}"):
        WideResNet(10, **{argument: value})


@pytest.mark.parametrize(
    ("prefix", "file"), [("", ""), ("run:", ""), ("run:", BEST), ("run:", PUBLISHED)]
)
def test_a_run_is_a_classifier_of_its_own_classes_at_its_own_size(network, tmp_path, prefix, file):
    write(tmp_path, network)
    classifier = load_network(f"{prefix}{tmp_path / file}")
    assert classifier.classes == CLASSES
    assert classifier.size == 48
    assert classifier.name == f"run:{tmp_path / file}"
    images = torch.rand(3, 3, 48, 48)
    # A published network has half precision.
    tolerance = 0.01 if file == PUBLISHED else 0
    torch.testing.assert_close(classifier(images), network(images), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("torchvision:shufflenet_v2_x0_5", "torchvision:shufflenet_v2_x0_5"),
        *product(["python:own_models:build", "python:own_models.build"], repeat=2),
    ],
)
def test_other_networks_are_loaded_by_their_name_and_copied_without_their_code(
    tmp_path, name, given
):
    network = build_network(CLASSES, 16, name, MEAN, STD).eval()
    write(tmp_path, network, describe(network, CLASSES, size=16, encoding="linear", name=name))
    images = torch.rand(2, 3, 16, 16)
    assert torch.equal(load_run(tmp_path / BEST, model=given)(images), network(images))
    if name.startswith("python:"):
        with pytest.raises(InputError, match=f"{name}: set trust=true"):
            load_network(f"run:{tmp_path}")
        trusted = load_network(f"run:{tmp_path}", trust_code=True)
        assert torch.equal(trusted(images), network(images))
    fresh = build_network(CLASSES, 16, name)
    (tmp_path / "own_models.py").write_text("raise SystemExit('code ran')")
    settings = ExperimentSettings(network=str(tmp_path), model=ModelSettings(name=given))
    initial = load_initial(settings)
    initial.copy_to(fresh, {"classes": [*CLASSES], "size": 16, "name": name})
    assert torch.equal(fresh.eval()(images), network(images))


def test_weights_in_safetensors_need_no_versions_of_modules(tmp_path):
    """MNASNet has versions, which safetensors does not store."""
    weights = mnasnet0_5(num_classes=3).state_dict()
    safetensors.torch.save_file(weights, tmp_path / "a.safetensors")
    name = {"network": "torchvision:mnasnet0_5", "weights": "a.safetensors"}
    initial = load_initial(ExperimentSettings(**name, classes=[*CLASSES]))
    state = {"model": initial.weights, "architecture": initial.architecture}
    write_published(tmp_path / PUBLISHED, state)
    network = load_run(tmp_path).network
    again = load_initial(ExperimentSettings(network=str(tmp_path)))
    again.copy_to(network, again.architecture)
    first = next(iter(weights))
    assert torch.equal(
        dict(network.state_dict())[f"network.{first}"], weights[first].half().float()
    )


@pytest.mark.parametrize(
    "changes",
    [
        *({"version": 99}, {"size": None}, {"size": 10**9}, {"depth": "10"}, {"heads": 3}),
        {"classes": ["fig", "lime"]},
    ],
    ids=str,
)
def test_a_description_of_other_weights_is_refused_in_one_sentence(network, tmp_path, changes):
    write(tmp_path, network, **changes)
    for name in (BEST, PUBLISHED):
        with pytest.raises(InputError, match=rf"^checkpoint {tmp_path / name}:? [^\n]+$"):
            load_run(tmp_path / name)


def test_an_initial_network_that_contradicts_the_run_is_refused(network, tmp_path):
    source, state = load_selected(write(tmp_path, network))
    initial = Initial(source, state["architecture"], state["model"])
    other_classes = {"classes": ["pear", "apple", "orange"]}
    with pytest.raises(InputError, match=f"network={initial.source} .* classes"):
        initial.copy_to(network, description_of(network) | other_classes)
    with pytest.raises(InputError, match=f"{initial.source} is from another architecture"):
        initial.copy_to(WideResNet(3, 16, 1), description_of(network))


def test_a_published_network_has_the_weights_in_half_precision(network, tmp_path):
    write(tmp_path, network)
    _, published = load_selected(tmp_path / PUBLISHED)
    for name, value in network.state_dict().items():
        rounded = published["model"][name]
        assert rounded.dtype == value.dtype
        error = (rounded.double() - value.double()).abs()
        # Values are rounded to 11 bits, and below 2⁻¹⁴ to multiples of 2⁻²⁴.
        assert (error <= value.double().abs() * 2**-11 + 2**-25).all(), name


@pytest.mark.parametrize("name", ["pretrained/none", "pretrained/none/model.safetensors"])
def test_a_network_of_the_package_is_found_from_any_folder_unless_that_has_its_name(tmp_path, name):
    assert load_run(name).name == f"run:{name}"
    (tmp_path / "pretrained" / "none").mkdir(parents=True)
    with pytest.raises(InputError, match=r"run=pretrained/none has no"):
        load_run("pretrained/none")
