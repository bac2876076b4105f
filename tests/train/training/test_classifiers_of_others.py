"""Fine-tuning a classifier that this project did not train: its weights come in and go out under their own names."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from PIL import Image
from torchvision.models import get_model

from augment.classifiers import load_classifier
from renderer.errors import InputError
from tests.runs import completed_run
from train.__main__ import main as train_command
from train.data.load import load_data
from train.runs.run_log import read_metrics
from train.runs.saved_networks import load_run

NAME, SIZE = "shufflenet_v2_x0_5", 32
KEYS = [
    "experiment=harden", "augment=none", f"train.init_from=torchvision:{NAME}", f"data.size={SIZE}", "train.device=cpu",
    "train.precision=float32", "train.threads=1", "train.batch_size=8", "train.images_per_epoch=16",
    "train.learning_rate=0.001", "train.distillation=1", "data.test_fraction=0.25", "data.validation=0.25",
]  # fmt: skip


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """Of a network with batch statistics, whose answers differ among images."""
    torch.manual_seed(0)
    network, path = get_model(NAME), tmp_path_factory.mktemp("weights") / "network.pt"
    with torch.no_grad():
        for _ in range(30):
            network(torch.randn(16, 3, SIZE, SIZE))
        network.fc.weight *= 10
    torch.save(network.state_dict(), path)
    return path


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    """32 images in two folders, whose names are ImageNet's; half of each folder's are light, half dark."""
    folder, rng = tmp_path_factory.mktemp("photos"), np.random.default_rng(0)
    for name in ("orange", "lemon"):
        (folder / name).mkdir()
        for number in range(16):
            pixels = rng.integers(0, 100, (40, 36, 3)) + 150 * (number % 2)
            Image.fromarray(pixels.astype(np.uint8)).save(folder / name / f"{number}.png")
    return folder


@pytest.fixture(scope="module")
def tuned(weights, photos, tmp_path_factory) -> Callable[..., tuple[Path, dict[str, float]]]:
    """The folder and the scores of a short fine-tuning, with further settings."""

    def run(data: str, *overrides: str) -> tuple[Path, dict[str, float]]:
        folder = tmp_path_factory.mktemp("runs") / "run"
        keys = [*KEYS, f"data={data}", f"data.path={photos}", f"weights={weights}", f"run={folder}", *overrides]
        settings = train_command.read(keys)
        return folder, completed_run(settings, folder)

    return run


def test_the_result_loads_where_the_original_did_and_in_every_command(tuned, weights):
    folder, _ = tuned("folder", "train.learning_rate=0.01")
    network, images = get_model(NAME), torch.rand(4, 3, SIZE, SIZE)
    network.load_state_dict(torch.load(folder / "weights.pt"))
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    with torch.no_grad():
        expected = network.eval()((images - mean) / std)
        started = get_model(NAME)
        started.load_state_dict(torch.load(weights))
        assert not torch.allclose(expected, started.eval()((images - mean) / std))
    torch.testing.assert_close(load_run(folder)(images), expected, rtol=1e-4, atol=1e-4)
    assert load_run(folder).size == SIZE
    again, _ = tuned("unlabelled", f"train.init_from={folder}", "weights=null", "train.learning_rate=1e-12")
    torch.testing.assert_close(load_run(again)(images), expected, rtol=1e-4, atol=1e-4)


def test_a_network_that_hardly_moves_keeps_its_answers_at_no_loss(tuned):
    """In eval mode distillation is 0 where nothing has changed; otherwise batch statistics change the answers."""
    folder, scores = tuned("unlabelled", "train.learning_rate=1e-12")
    assert read_metrics(folder)[0]["train/loss"] < 1e-6
    assert scores["test/agreement"] == scores["test/accuracy"] == scores["test/accuracy_before"] == 1
    folder, _ = tuned("unlabelled", "train.learning_rate=1e-12", "train.eval_mode=false")
    assert read_metrics(folder)[0]["train/loss"] > 0.01


def test_unlabeled_data_keep_the_last_network_whose_agreement_is_no_better(tuned):
    folder, scores = tuned("unlabelled", "train.learning_rate=1e-12", "train.epochs=2")
    assert [line["validation/accuracy"] for line in read_metrics(folder)[:2]] == [1, 1] and scores["test/epoch"] == 2


def test_labeled_folders_are_scored_in_the_networks_classes_before_and_after(tuned, weights, photos):
    _, scores = tuned("folder", "train.learning_rate=1e-12")
    assert scores["test/agreement"] == 1 and scores["test/accuracy"] == scores["test/accuracy_before"]
    classifier, settings = load_classifier(f"torchvision:{NAME}", weights), ["data=folder", f"data.path={photos}"]
    config = train_command.read([*KEYS, *settings, f"weights={weights}", "run=-"])
    test = load_data(config).test
    labels = torch.tensor([classifier.label(name) for name in ("lemon", "orange")])[test.labels]
    answers = torch.cat([classifier.function(image[None] / 255.0).argmax(1) for image in test.images])
    assert scores["test/accuracy_before"] == pytest.approx((answers == labels).float().mean().item())


@pytest.mark.parametrize(
    "change, message",
    [
        ("label=ornage", "label: 'ornage' is not a class of the model: choose one, such as orange"),
        ("weights=absent.pt", "absent.pt does not exist"),
        ("train.init_from=torchvision:resnet18", r"weights=.* are not of torchvision:resnet18 "),
        ("train.init_from=pretrained/none", "weights=.* is not for train.init_from=pretrained/none"),
        (
            "model.name=torchvision:resnet18",
            f"model.name=torchvision:resnet18: train.init_from=torchvision:{NAME} has its own",
        ),
        ("data.path=absent", "absent is not a folder"),
        ("train.distillation=0", "a network keeps its answers on it: set train.init_from and train.distillation"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(tuned, change, message):
    with pytest.raises(InputError, match=message) as caught:
        tuned("unlabelled", "augment=random", change)
    assert "\n" not in str(caught.value)


def test_photographs_that_stay_on_disk_train_and_score_a_network_of_their_size(tuned, weights):
    folder, scores = tuned("unlabelled", "data.size=96", "data.workers=2", "train.learning_rate=1e-12")
    assert read_metrics(folder)[0]["train/loss"] < 1e-6 and scores["test/agreement"] == 1
    assert load_run(folder)(torch.rand(1, 3, 96, 96)).shape == (1, 1000)


def test_a_truncated_photograph_among_unlabeled_ones_is_skipped_and_counted(tuned, photos, tmp_path, caplog):
    for file in photos.glob("*/*.png"):
        (tmp_path / f"{file.parent.name}_{file.name}").write_bytes(file.read_bytes())
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 not much of a JPEG")
    with pytest.raises(InputError, match=r"1 of 33 photographs cannot be read, .*broken\.jpg.*skip_unreadable"):
        tuned("unlabelled", f"data.path={tmp_path}")
    tuned("unlabelled", f"data.path={tmp_path}", "evaluate.skip_unreadable=true")
    assert "1 of 33 images cannot be read and are skipped: broken.jpg" in caplog.text


def test_timms_networks_take_their_own_normalization_and_weights_from_safetensors(tmp_path):
    timm = pytest.importorskip("timm")
    torch.manual_seed(0)
    network, path = timm.create_model("mobilenetv3_small_050"), tmp_path / "network.safetensors"
    safetensors.torch.save_file(network.state_dict(), path)
    classifier = load_classifier("timm:mobilenetv3_small_050", path)
    images, facts = torch.rand(1, 3, 224, 224), network.pretrained_cfg
    mean, std = (torch.tensor(facts[key]).view(3, 1, 1) for key in ("mean", "std"))
    with torch.no_grad():
        torch.testing.assert_close(classifier(images), network.eval()((images - mean) / std), rtol=1e-4, atol=1e-5)
    for name, message in {
        "mobilenetv3_smal_050": "is not a network of timm: choose one, such as mobilenetv3_small_050",
        "tf_efficientnetv2_s.in21k": "has 21843 classes",
    }.items():
        with pytest.raises(InputError, match=message):
            load_classifier(f"timm:{name}", path)
