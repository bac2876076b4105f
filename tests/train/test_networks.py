import re
import textwrap
from pathlib import Path

import pytest
import torch
from torchvision.models import resnet18

from renderer.errors import InputError
from train.networks import build_network, model_title
from train.run_folder import checkpoint
from train.run_folder.classifier import describe, load_run, start_from
from train.wideresnet import WideResNet

CLASSES = ("apple", "orange", "pear")
MEAN, STD = (0.4, 0.5, 0.6), (0.2, 0.3, 0.25)
SOURCE = """
import torch
from torch import nn

class Network(nn.Module):
    def __init__(self, outputs=3):
        super().__init__()
        self.layer = nn.Linear(3, outputs)

    def forward(self, images):
        return self.layer(images.mean((2, 3)))

def build(): return Network(), 16, ["apple", "orange", "pear"]
def of_other_size(): return Network(), 32, ["apple", "orange", "pear"]
def of_other_classes(): return Network(), 16, ["orange", "apple", "pear"]
def of_other_logits(): return Network(4), 16, ["apple", "orange", "pear"]
"""


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    (tmp_path / "own_models.py").write_text(textwrap.dedent(SOURCE))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def saved(path: Path, network: torch.nn.Module, **shape) -> Path:
    """A checkpoint of a network for images of 16 pixels."""
    described = describe(network, CLASSES, size=16, encoding="linear", **shape)
    checkpoint.save(path / checkpoint.BEST, {"model": network.state_dict(), "architecture": described})
    return path


def test_the_default_is_the_wide_residual_network_itself():
    torch.manual_seed(0)
    built = build_network(CLASSES, 32, mean=MEAN, std=STD, depth=10, width=1, dropout=0.0)
    torch.manual_seed(0)
    own = WideResNet(3, 10, 1, 0.0, MEAN, STD)
    images = torch.rand(2, 3, 32, 32)
    assert torch.equal(built.eval()(images), own.eval()(images))


def test_a_network_of_torchvision_is_torchvisions_behind_the_datas_normalization():
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
@pytest.mark.parametrize(
    ("name", "size"),
    [("vit_b_32", 64), ("inception_v3", 96), ("googlenet", 64), ("densenet121", 32), ("vgg11", 32), ("swin_t", 64)],
)
def test_every_family_of_torchvision_gives_logits_in_training_too(name, size):
    network = build_network(CLASSES, size, f"torchvision:{name}").train()
    assert network(torch.rand(2, 3, size, size)).shape == (2, 3)


def test_a_function_of_ones_own_makes_the_network():
    network = build_network(CLASSES, 16, "python:own_models:build", MEAN, STD)
    assert [name for name, _ in network.named_parameters()] == ["layer.weight", "layer.bias"]
    assert network.training and network.layer.weight.requires_grad


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        ("resnet18", 16, "is not known: choose wideresnet, torchvision:NAME or python:MODULE:FUNCTION"),
        ("torchvision:resnet19", 16, "is no classifier of torchvision: choose one, such as resnet18"),
        ("torchvision:vit_b_32", 40, "takes no images of 40 pixels per side"),
        ("torchvision:alexnet", 16, "takes no images of 16 pixels per side"),
        ("python:own_models", 16, "names no function"),
        ("python:own_models:of_other_size", 16, "is for images of 32 pixels per side, and the data has 16"),
        ("python:own_models:of_other_classes", 16, "has other classes than the data, or in another order"),
        ("python:own_models:of_other_logits", 16, r"gives (2, 4) for 2 images: make it return logits (2, 3)"),
    ],
)
def test_what_is_no_network_for_the_data_is_refused_by_name(name, size, message):
    with pytest.raises(InputError, match=f"^model={name} {re.escape(message)}"):
        build_network(CLASSES, size, name)


def test_a_network_of_torchvision_comes_back_from_its_file(tmp_path):
    network = build_network(CLASSES, 16, "torchvision:shufflenet_v2_x0_5", MEAN, STD).eval()
    loaded = load_run(saved(tmp_path, network, name="torchvision:shufflenet_v2_x0_5"))
    images = torch.rand(2, 3, 16, 16)
    assert torch.equal(loaded(images), network(images))
    assert (loaded.classes, loaded.size) == (CLASSES, 16)


def test_no_file_runs_code_that_the_user_did_not_name(tmp_path):
    run = saved(tmp_path, build_network(CLASSES, 16, "python:own_models:build"), name="python:own_models:build")
    (tmp_path / "own_models.py").write_text("raise SystemExit('code ran')")
    with pytest.raises(InputError, match="give model=python:own_models:build to run that code"):
        load_run(run)


def test_a_network_of_ones_own_comes_back_where_its_function_is_named(tmp_path):
    network = build_network(CLASSES, 16, "python:own_models:build").eval()
    run = saved(tmp_path, network, name="python:own_models:build")
    images = torch.rand(2, 3, 16, 16)
    assert torch.equal(load_run(str(run), model="python:own_models:build")(images), network(images))


def test_one_goes_on_from_a_network_of_ones_own_without_its_code(tmp_path):
    name = "python:own_models:build"
    trained, fresh = (build_network(CLASSES, 16, name) for _ in range(2))
    own = {"classes": list(CLASSES), "size": 16, "name": name}
    start_from(fresh, own, saved(tmp_path, trained, name=name))
    assert torch.equal(fresh.layer.weight, trained.layer.weight)


def test_weights_of_another_kind_of_network_are_refused(tmp_path):
    run = saved(tmp_path, build_network(CLASSES, 16, "python:own_models:build"), name="python:own_models:build")
    network = WideResNet(3, 10, 1)
    own = {"classes": list(CLASSES), "size": 16, "depth": 10, "width": 1}
    with pytest.raises(InputError, match="was trained with name python:own_models:build, not wideresnet"):
        start_from(network, own, run)


def test_titles_name_the_network():
    assert model_title(depth=28, width=10, dropout=0.3) == "WideResNet-28-10, dropout 0.3"
    assert model_title("torchvision:resnet18") == "torchvision:resnet18"
