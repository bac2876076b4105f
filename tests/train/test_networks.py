import math
import re
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import nn
from torchvision.models import resnet18

from renderer.errors import InputError
from train.networks import Dropout, WideResNet, build_network, describe
from train.runs.checkpoint import BEST, save
from train.runs.saved_networks import PUBLISHED, load_network, load_run, load_selected, publish
from train.training.initial import Initial

PRETRAINED = Path(__file__).parents[2] / "pretrained"
CLASSES = ("apple", "orange", "pear")
MEAN, STD = (0.4, 0.5, 0.6), (0.2, 0.3, 0.25)
SOURCE = """
import torch
from torch import nn

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
    """With running statistics as after training."""
    torch.manual_seed(0)
    network = WideResNet(3, 10, 1, 0.0, MEAN, STD)
    with torch.no_grad():
        for _ in range(3):
            network(torch.rand(8, 3, 16, 16))
    return network.eval()


def description_of(network: nn.Module, **changes) -> dict:
    shape = {"size": 48, "encoding": "linear", "depth": 10, "width": 1, "dropout": 0.0} | changes
    return describe(network, CLASSES, **shape)


def initial_of(path: Path) -> Initial:
    """The network of a file, for a run to begin with."""
    source, state = load_selected(path)
    return Initial(source, state["architecture"], state["model"])


def write(folder: Path, network: nn.Module, description: dict | None = None, **changes) -> Path:
    """best.pt and model.safetensors of a network, whose description is changed or another."""
    description = description_of(network) if description is None else description
    state = {"model": network.state_dict(), "architecture": {**description, **changes}}
    save(folder / BEST, state)
    publish(folder / PUBLISHED, state)
    return folder


@pytest.mark.parametrize(
    "classes, depth, width, published", [(10, 40, 4, "8.9"), (10, 28, 10, "36.5"), (100, 16, 4, "2.77202")]
)
def test_parameter_counts_are_those_published(classes, depth, width, published):
    with torch.device("meta"):
        count = sum(parameter.numel() for parameter in WideResNet(classes, depth, width).parameters())
    assert round(count / 1e6, len(published.partition(".")[2])) == float(published)


def test_convolutions_start_with_he_initialization():
    torch.manual_seed(0)
    for name, module in WideResNet(100).named_modules():
        if isinstance(module, nn.Conv2d):
            weight = module.weight.detach()
            expected = math.sqrt(2 / (weight.shape[0] * weight[0, 0].numel()))
            spread = 5 / math.sqrt(2 * weight.numel())  # five standard errors of a standard deviation
            assert weight.std() / expected == pytest.approx(1, abs=spread), name
            assert abs(weight.mean()) < 5 * expected / math.sqrt(weight.numel()), name


def test_the_forward_pass_is_the_published_block_by_block():
    """A functional pass written down from the paper: pre-activation, the shortcut after the first ReLU."""
    torch.manual_seed(0)
    network = WideResNet(5, 16, 2, 0.3, MEAN, STD).double().eval()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.uniform_(-1, 1), module.running_var.uniform_(0.5, 2)
            nn.init.uniform_(module.weight, 0.5, 2), nn.init.uniform_(module.bias, -1, 1)
    state = network.state_dict()

    def norm_relu(x, name):
        parts = (state[f"{name}.{part}"] for part in ("running_mean", "running_var", "weight", "bias"))
        return F.relu(F.batch_norm(x, *parts))

    images = torch.rand(2, 3, 12, 12, dtype=torch.float64)
    mean, std = (torch.tensor(values).double().view(1, 3, 1, 1) for values in (MEAN, STD))  # they began as float32
    x = F.conv2d((images - mean) / std, state["stem.weight"], padding=1)
    for group in range(3):
        for block in range(2):
            name, stride = f"groups.{group}.{block}", 2 if group and not block else 1
            activated = norm_relu(x, f"{name}.norm1")
            hidden = F.conv2d(activated, state[f"{name}.conv1.weight"], stride=stride, padding=1)
            hidden = F.conv2d(norm_relu(hidden, f"{name}.norm2"), state[f"{name}.conv2.weight"], padding=1)
            x = hidden + (x if block else F.conv2d(activated, state[f"{name}.shortcut.weight"], stride=stride))
    logits = norm_relu(x, "norm").mean((2, 3)) @ state["head.weight"].T + state["head.bias"]
    torch.testing.assert_close(network(images), logits)


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_values_are_dropped_independently_or_scaled_so_that_their_mean_stays(layout, dtype):
    x = torch.ones(16, 32, 31, 33, dtype=dtype).contiguous(memory_format=layout)
    torch.manual_seed(0)
    y = Dropout(0.3)(x)
    assert y.dtype == dtype and y.is_contiguous(memory_format=layout)
    factor, passed = torch.tensor(1 / 0.7).to(dtype), y != 0
    # p is a multiple of 2⁻¹⁶
    torch.testing.assert_close(y[passed], factor.expand(int(passed.sum())), rtol=2**-15, atol=0)
    assert abs(passed.double().mean() - 0.7) < 4 * (0.3 * 0.7 / x.numel()) ** 0.5  # four standard deviations
    deviations = (~passed).double() - 0.3
    for dim in range(4):
        pairs = deviations.narrow(dim, 1, x.shape[dim] - 1) * deviations.narrow(dim, 0, x.shape[dim] - 1)
        assert abs(pairs.mean()) < 4 * 0.21 / pairs.numel() ** 0.5  # four standard deviations of a product's mean


def test_the_gradient_passes_where_values_do_and_nothing_is_drawn_in_eval_mode_or_at_zero():
    x = torch.randn(4, 8, 5, 7, requires_grad=True)
    y = Dropout(0.5)(x)
    y.sum().backward()
    assert torch.equal(x.grad, torch.where(y != 0, 2.0, 0.0))
    state = torch.get_rng_state()
    assert Dropout(0.5).eval()(x) is x and Dropout(0.0)(x) is x
    assert torch.equal(torch.get_rng_state(), state)


def test_a_torchvision_network_is_torchvisions_own_after_normalization():
    torch.manual_seed(0)
    built = build_network(CLASSES, 32, "torchvision:resnet18", MEAN, STD)
    torch.manual_seed(0)
    theirs = resnet18(num_classes=3)
    images = torch.rand(2, 3, 32, 32)
    normalized = (images - torch.tensor(MEAN).view(3, 1, 1)) / torch.tensor(STD).view(3, 1, 1)
    normalized = normalized.contiguous(memory_format=torch.channels_last)  # another layout rounds differently
    assert torch.equal(built.eval()(images), theirs.eval()(normalized))
    assert all(parameter.requires_grad for parameter in built.parameters())


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), [("vit_b_32", 64), ("inception_v3", 96), ("googlenet", 64)])
def test_every_family_of_torchvision_gives_logits_in_training_too(name, size):
    network = build_network(CLASSES, size, f"torchvision:{name}").train()
    assert network(torch.rand(2, 3, size, size)).shape == (2, 3)


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        ("resnet18", 16, "choose wideresnet, torchvision:NAME or python:MODULE:FUNCTION"),
        ("torchvision:resnet19", 16, "choose one, such as resnet18"),
        ("torchvision:vit_b_32", 40, "3 logits for images of 40 pixels per side"),
        ("python:own_models:of_other_size", 16, "is for images of 32 pixels per side, and the data has 16"),
        ("python:own_models:of_other_classes", 16, "other classes than the data, or in another order"),
        ("python:own_models:of_other_logits", 16, "it returned (2, 4) for 2 images"),
    ],
)
def test_a_network_that_does_not_take_the_data_is_refused_by_name(name, size, message):
    with pytest.raises(InputError, match=rf"^name={name}\W.*{re.escape(message)}"):
        build_network(CLASSES, size, name)


@pytest.mark.parametrize("settings", [{"depth": 15}, {"width": 0}, {"dropout": 1.0}, {"depth": 6 * 10**9 + 4}], ids=str)
def test_an_impossible_architecture_names_its_key(settings):
    ((key, value),) = settings.items()
    with pytest.raises(InputError, match=f"{key}={value}"):
        WideResNet(10, **settings)


@pytest.mark.parametrize("file", ["", BEST, PUBLISHED], ids=["folder", "checkpoint", "published"])
def test_a_run_is_a_classifier_of_its_own_classes_at_its_own_size(network, tmp_path, file):
    classifier = load_network(f"run:{write(tmp_path, network) / file}")
    assert (classifier.classes, classifier.size) == (CLASSES, 48)
    assert classifier.name == f"run:{tmp_path / file}"
    images = torch.rand(3, 3, 48, 48)
    expected = network(images)
    if file == PUBLISHED:
        torch.testing.assert_close(classifier(images), expected, rtol=0.01, atol=0.01)  # half precision
    else:
        assert torch.equal(classifier(images), expected)


@pytest.mark.parametrize("name", ["torchvision:shufflenet_v2_x0_5", "python:own_models:build"])
def test_other_networks_come_back_from_their_file_code_only_where_it_is_named(tmp_path, name):
    network = build_network(CLASSES, 16, name, MEAN, STD).eval()
    write(tmp_path, network, describe(network, CLASSES, size=16, encoding="linear", name=name))
    images = torch.rand(2, 3, 16, 16)
    assert torch.equal(load_run(tmp_path / BEST, model=name)(images), network(images))
    fresh = build_network(CLASSES, 16, name)
    (tmp_path / "own_models.py").write_text("raise SystemExit('code ran')")
    initial_of(tmp_path / BEST).copy_to(fresh, {"classes": [*CLASSES], "size": 16, "name": name})
    assert torch.equal(fresh.eval()(images), network(images))
    if name.startswith("python:"):
        with pytest.raises(InputError, match=f"give model={name} to run that code"):
            load_run(tmp_path)


@pytest.mark.parametrize(
    "changes",
    [{"version": 99}, {"size": None}, {"size": 10**9}, {"classes": ["fig", "lime"]}, {"depth": "10"}, {"heads": 3}],
    ids=str,
)
def test_a_description_that_does_not_fit_the_weights_is_refused_in_one_sentence(network, tmp_path, changes):
    write(tmp_path, network, **changes)
    for name in (BEST, PUBLISHED):
        with pytest.raises(InputError, match=rf"^checkpoint {tmp_path / name} [^\n]+$"):
            load_run(tmp_path / name)


def test_a_network_starts_with_the_weights_and_the_normalization_of_another(network, tmp_path):
    fresh = WideResNet(3, 10, 1, 0.3, mean=(0.5, 0.5, 0.5))
    initial_of(write(tmp_path, network)).copy_to(fresh, description_of(fresh, dropout=0.3))
    images = torch.rand(3, 3, 32, 32)
    assert torch.equal(fresh.eval()(images), network(images))


@pytest.mark.parametrize(
    "change, fault", [({"classes": ["pear", "apple", "orange"]}, "other classes"), ({"depth": 16}, "depth 10, not 16")]
)
def test_a_start_that_contradicts_the_run_is_one_sentence(network, tmp_path, change, fault):
    initial = initial_of(write(tmp_path, network))
    sentence = f"train.init_from={initial.source} was trained with {fault}: give this run the same"
    with pytest.raises(InputError, match=sentence):
        initial.copy_to(network, {**description_of(network), **change})


def test_a_published_network_is_the_same_to_half_precision_with_all_that_it_takes_to_use_it(network, tmp_path):
    write(tmp_path, network, encoding="srgb")
    published = load_selected(tmp_path / PUBLISHED)[1]
    assert published["architecture"] == load_selected(tmp_path / BEST)[1]["architecture"]
    assert published["architecture"]["mean"] == pytest.approx(MEAN)
    for name, value in network.state_dict().items():
        half = published["model"][name]
        assert half.dtype == value.dtype
        # rounding to 11 bits; below 2⁻¹⁴ half precision is spaced evenly
        bound = value.double().abs() * 2**-11 + 2**-25
        assert ((half.double() - value.double()).abs() <= bound).all(), name


def test_a_published_network_is_found_from_any_folder_unless_that_has_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [load_run(name).name for name in ("pretrained/none", "pretrained/none/model.safetensors")]
    assert names == ["run:pretrained/none", "run:pretrained/none/model.safetensors"]
    assert load_run("pretrained/best").operating_points[0].false_positive_rate == 0.05
    (tmp_path / "pretrained" / "none").mkdir(parents=True)
    with pytest.raises(InputError, match=r"run=pretrained/none holds neither best\.pt nor model\.safetensors"):
        load_run("pretrained/none")


@pytest.mark.parametrize("arm", ["none", "random", "adversarial"])
def test_the_published_networks_are_classifiers_of_cifar_100(arm):
    classifier = load_network(f"run:{PRETRAINED / arm}")
    assert (len(classifier.classes), classifier.size, classifier.label("orange")) == (100, 32, 53)
    images = torch.full((1, 3, 32, 32), 0.5, requires_grad=True)
    (gradient,) = torch.autograd.grad(classifier(images)[0, 53], images)
    assert gradient.isfinite().all() and gradient.any()
