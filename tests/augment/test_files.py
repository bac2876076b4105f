import io
import json
import pickle
import zipfile
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from torch import nn
from torchvision.models import mnasnet0_5

from augment.files import NetworkFacts, read_weights
from augment.sources import load_classifier
from augment.tasks.detection import Detection
from renderer.errors import InputError

SIZE = 8


def small_network() -> nn.Module:
    torch.manual_seed(0)
    layers = [nn.Conv2d(3, 4, 3), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(4, 3)]
    return nn.Sequential(*layers).eval()


def save_torchscript(network: nn.Module, folder: Path) -> Path:
    path = folder / "network.pt"
    torch.jit.trace(network, torch.rand(2, 3, SIZE, SIZE), check_trace=False).save(path)
    return path


class Structured(nn.Module):
    """The small network, whose logits are in a structure such as a dictionary."""

    def __init__(self, structure):
        super().__init__()
        self.network = small_network()
        self.structure = structure

    def forward(self, images: torch.Tensor):
        return self.structure(self.network(images))


def save_exported(network: nn.Module, folder: Path) -> Path:
    path = folder / "network.pt2"
    # The batch has one image, as in torch's own examples.
    torch.export.save(torch.export.export(network, (torch.rand(1, 3, SIZE, SIZE),)), path)
    return path


def save_bounded(network: nn.Module, folder: Path) -> Path:
    path = folder / "network.pt2"
    shapes = ({0: torch.export.Dim("batch", min=2, max=4)},)
    images = torch.rand(3, 3, SIZE, SIZE)
    torch.export.save(torch.export.export(network, (images,), dynamic_shapes=shapes), path)
    return path


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("save", [save_torchscript, save_exported, save_bounded])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_file_gives_the_logits_and_the_gradient_of_its_network(tmp_path, save, count):
    network = small_network()
    path = save(network, tmp_path)
    classifier = load_classifier(str(path), classes=["a", "b", "c"], size=SIZE, trust_code=True)
    images = torch.rand(count, 3, SIZE, SIZE, requires_grad=True)
    expected = network(images)
    found = classifier(images)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    (gradient,) = torch.autograd.grad(found.sum(), images)
    (expected_gradient,) = torch.autograd.grad(expected.sum(), images)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-5, atol=1e-6)


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("structure", [lambda x: {"logits": x}, lambda x: (x, x), lambda x: [x]])
def test_an_exported_network_of_one_image_may_return_a_structure(tmp_path, structure):
    path = save_exported(Structured(structure).eval(), tmp_path)
    classifier = load_classifier(str(path), size=SIZE, trust_code=True)
    images = torch.rand(3, 3, SIZE, SIZE)
    torch.testing.assert_close(classifier(images), small_network()(images))


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_a_file_of_one_image_whose_outputs_are_not_those_of_each_image_is_refused(tmp_path):
    """It could return the boxes of one image, which cannot be told from those of the next."""
    rows = Structured(lambda x: (x.repeat(5, 2)[:, :4], x.flatten().repeat(2)[:5])).eval()
    path = str(save_exported(rows, tmp_path))
    task = Detection(decode=lambda raw: [{"boxes": raw[0], "scores": raw[1][:, None]}])
    with pytest.raises(InputError, match=r"one row for each image.*without suppression"):
        load_classifier(path, classes=["a"], size=SIZE, trust_code=True, task=task)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("save", [save_torchscript, save_exported])
@pytest.mark.parametrize("layer", [nn.Dropout(0.5), nn.BatchNorm2d(4)])
def test_a_file_of_a_network_in_training_mode_is_refused(tmp_path, save, layer):
    """The mode is part of such a file, so `eval()` could not change it."""
    convolution, *rest = small_network()
    network = nn.Sequential(convolution, layer, *rest)
    load_classifier(str(save(network.eval(), tmp_path)), size=SIZE, trust_code=True)
    path = save(network.train(), tmp_path)
    with pytest.raises(InputError, match=r"training mode.*eval"):
        load_classifier(str(path), size=SIZE, trust_code=True)


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_a_copy_of_a_torchscript_network_is_trained_without_the_original(tmp_path):
    path = save_torchscript(small_network(), tmp_path)
    original = load_classifier(str(path), size=SIZE, trust_code=True).network
    copied = deepcopy(original)
    images = torch.rand(2, 3, SIZE, SIZE)
    before = original(images)
    torch.testing.assert_close(copied(images), before)
    copied.requires_grad_(True)
    copied(images).sum().backward()
    torch.optim.SGD(copied.parameters(), 0.1).step()
    assert not torch.allclose(copied(images), before)
    torch.testing.assert_close(original(images), before)


class Masked(nn.Module):
    def forward(self, images: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return (images * mask).mean((2, 3))


def test_an_exported_network_of_several_inputs_is_refused_with_their_names(tmp_path):
    path = tmp_path / "network.pt2"
    given = torch.rand(1, 3, SIZE, SIZE), torch.ones(1, 1, SIZE, SIZE)
    torch.export.save(torch.export.export(Masked(), given), path)
    with pytest.raises(InputError, match="takes images, mask: export it for images alone"):
        load_classifier(str(path), trust_code=True)


class Payload:
    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def replace_member(path: Path, ending: str, content: bytes) -> bytes:
    """Write an archive again with other content of a member, and return its former content."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    [changed] = [name for name in members if name.endswith(ending)]
    former = members[changed]
    with zipfile.ZipFile(path, "w") as archive:
        for name, kept in members.items():
            archive.writestr(name, content if name == changed else kept)
    return former


class Overwriting(nn.Module):
    def __init__(self, path: str):
        super().__init__()
        self.path = path

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        victim = torch.from_file(self.path, True, 4, dtype=torch.uint8)
        return images.mean((2, 3)) + victim.zero_().sum()


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("suffix", ["pt", "PT"])
def test_torchscript_cannot_overwrite_files_unless_it_is_trusted(tmp_path, suffix):
    victim = tmp_path / "victim.txt"
    victim.write_bytes(b"text")
    path = tmp_path / f"network.{suffix}"
    torch.jit.script(Overwriting(str(victim))).save(path)
    with pytest.raises(InputError, match="trust=true"):
        load_classifier(str(path), size=SIZE)
    with pytest.raises(InputError):
        load_classifier("torchvision:squeezenet1_1", path)
    assert victim.read_bytes() == b"text"
    load_classifier(str(path), size=SIZE, trust_code=True)
    assert victim.read_bytes() == bytes(4)


def pickled(value: object) -> bytes:
    content = io.BytesIO()
    torch.save(value, content)
    return content.getvalue()


@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize("variant", ["example inputs", "use_pickle"])
def test_a_pickle_in_an_exported_network_does_not_run(tmp_path, variant, trusted):
    path = save_exported(small_network(), tmp_path)
    created = tmp_path / "created"
    if variant == "example inputs":
        replace_member(path, "sample_inputs/model.pt", pickled(Payload(created)))
    else:
        config = json.loads(replace_member(path, "weights_config.json", b""))
        first = next(iter(config["config"].values()))
        first["use_pickle"] = True
        replace_member(path, "weights_config.json", json.dumps(config).encode())
        replace_member(path, first["path_name"], pickled(Payload(created)))
    with pytest.raises(InputError, match="any code"):
        load_classifier(str(path), size=SIZE, trust_code=trusted)
    assert not created.exists()
    with pytest.raises(Exception):  # noqa: B017 - the payload is no tensor
        torch.export.load(path)
    assert created.exists(), "the file has no payload"


@pytest.mark.parametrize(
    "name", ["data/constants/opaque_obj_0", "data/constants/custom_obj_0", "data/aotinductor/a.so"]
)
def test_objects_that_are_no_tensors_are_refused_in_an_exported_network(tmp_path, name):
    path = save_exported(small_network(), tmp_path)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(f"network/{name}", pickle.dumps(Payload(tmp_path / "created")))
    with pytest.raises(InputError, match="any code"):
        load_classifier(str(path), size=SIZE, trust_code=True)


def test_a_file_of_class_names_of_windows_gives_the_names(tmp_path):
    """Notepad may write a byte-order mark and UTF-16, and ends lines by two characters."""
    path = tmp_path / "classes.txt"
    path.write_bytes(b"\xef\xbb\xbforange\r\ncup\r\n")
    assert NetworkFacts(path).classes == ("orange", "cup")
    path.write_bytes("orange\ncup\n".encode("utf-16"))
    with pytest.raises(InputError, match="UTF-8"):
        NetworkFacts(path)


@pytest.mark.parametrize("module", [b"numpy._core.", b"numpy.core."])
@pytest.mark.parametrize("number", [np.float64(70), np.float32(0.5), np.int64(3), np.bool_(True)])
def test_a_checkpoint_may_have_numbers_of_new_and_old_versions_of_numpy(tmp_path, number, module):
    content = io.BytesIO()
    checkpoint = {"state_dict": {"weight": torch.ones(2)}, "best": number}
    torch.save(checkpoint, content, _use_new_zipfile_serialization=False)
    path = tmp_path / "a.pth"
    path.write_bytes(content.getvalue().replace(b"numpy._core.", module))
    assert read_weights(path)["weight"].tolist() == [1, 1]


@pytest.mark.parametrize("names", [("state_dict", "state_dict_ema"), ("model", "ema")])
@pytest.mark.parametrize("has_average", [False, True])
def test_the_weights_of_a_checkpoint_count_and_an_average_is_named(
    tmp_path, caplog, names, has_average
):
    states = [{"weight": torch.full((2,), float(value))} for value in (1, 2)]
    checkpoint = dict(zip(names[: 1 + has_average], states, strict=False))
    torch.save({"epoch": 3, "optimizer": {}, **checkpoint}, tmp_path / "a.pth")
    assert read_weights(tmp_path / "a.pth")["weight"].tolist() == [1, 1]
    assert [names[1] in record.getMessage() for record in caplog.records] == [True] * has_average


def test_weights_of_an_average_by_torch_are_read_with_the_versions_of_modules(tmp_path):
    """MNASNet cannot load a state dict without the versions."""
    network = mnasnet0_5(num_classes=2)
    average = torch.optim.swa_utils.AveragedModel(mnasnet0_5(num_classes=2))
    torch.save({"state_dict": average.state_dict()}, tmp_path / "a.pth")
    network.load_state_dict(read_weights(tmp_path / "a.pth"))
    assert torch.equal(network.layers[0].weight, average.module.layers[0].weight)


def test_the_suffix_of_safetensors_may_be_in_upper_case(tmp_path):
    path = tmp_path / "a.SAFETENSORS"
    safetensors.torch.save_file({"weight": torch.ones(2)}, path)
    assert read_weights(path)["weight"].tolist() == [1, 1]
