"""Fine-tuning a classifier that this project did not train keeps the names of its weights."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torchvision.models import get_model
from torchvision.transforms.functional import normalize

from augment.exposure import normalize_light
from augment.settings import NormalizedLightSettings
from augment.sources import load_classifier
from renderer.errors import InputError
from tests.runs import completed_run
from tests.train.helpers import SHORT_TRAINING
from train.__main__ import main as train_command
from train.checkpoints import load_run
from train.run_folder import read_metrics
from train.training.inputs import load_data

NAME = "shufflenet_v2_x0_5"
SIZE = 32
SETTINGS = [
    *("experiment=harden", "augment=none", *SHORT_TRAINING, "train.images_per_epoch=16"),
    *("train.learning_rate=0.001", "train.distillation_weight=1"),
]
# Learning rate with which the weights hardly move.
ALMOST_FIXED = "train.learning_rate=1e-12"
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


@pytest.fixture(scope="module")
def tuned(weights, photographs, tmp_path_factory) -> Callable[..., tuple[Path, dict[str, float]]]:
    def run(data: str, *overrides: str) -> tuple[Path, dict[str, float]]:
        folder = tmp_path_factory.mktemp("runs") / "run"
        files = [f"data.path={photographs}", f"unlabeled={photographs}", f"weights={weights}"]
        files.append(f"out={folder}")
        settings = train_command.read([*SETTINGS, f"data={data}", *files, *overrides])
        return folder, completed_run(settings, folder)

    return run


@pytest.fixture(scope="module")
def almost_fixed(tuned) -> tuple[Path, dict[str, float]]:
    return tuned("unlabeled", ALMOST_FIXED, "train.epochs=2")


def normalized_logits(network, images) -> Tensor:
    with torch.no_grad():
        return network.eval()(normalize(images, IMAGENET_MEAN, IMAGENET_STD))


def load_torchvision(path: Path) -> nn.Module:
    network = get_model(NAME)
    network.load_state_dict(torch.load(path))
    return network


@pytest.mark.slow
def test_the_result_loads_where_the_original_did_and_in_every_command(tuned, weights):
    folder, _ = tuned("folder", "train.learning_rate=0.01")
    images = torch.rand(4, 3, SIZE, SIZE)
    expected = normalized_logits(load_torchvision(folder / "weights.pt"), images)
    original = normalized_logits(load_torchvision(weights), images)
    assert not torch.allclose(expected, original)
    assert load_run(folder).size == SIZE
    # Nobody states the normalization of own weights, also not the file of the run.
    assert load_run(folder).inputs.normalization is None
    torch.testing.assert_close(load_run(folder)(images), expected, rtol=1e-4, atol=1e-4)

    initial = [f"network={folder}", "weights=null"]
    continued, _ = tuned("unlabeled", *initial, ALMOST_FIXED)
    torch.testing.assert_close(load_run(continued)(images), expected, rtol=1e-4, atol=1e-4)
    assert load_run(continued).inputs.normalization is None


@pytest.mark.slow
def test_normalized_light_is_remembered_by_the_network_and_by_that_of_the_next_run(tuned, weights):
    """The weights do not change noticeably."""
    light = NormalizedLightSettings(white_balance=1.0)
    images = torch.rand(4, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    expected = normalized_logits(load_torchvision(weights), normalize_light(images, light))
    trained, _ = tuned("unlabeled", ALMOST_FIXED, "normalize_light={white_balance: 1.0}")
    continued, _ = tuned("unlabeled", f"network={trained}", "weights=null", ALMOST_FIXED)
    assert load_run(trained).normalized_light == light
    for run in (trained, continued):
        torch.testing.assert_close(load_run(run)(images), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_network_that_hardly_moves_keeps_its_predictions_at_no_loss(almost_fixed):
    folder, scores = almost_fixed
    assert read_metrics(folder)[0]["train/loss"] < 1e-6
    assert scores["test/agreement"] == 1
    assert scores["test/accuracy"] == 1
    assert scores["test/accuracy_before"] == 1


@pytest.mark.slow
def test_batch_statistics_change_the_predictions_outside_of_eval_mode(tuned):
    folder, _ = tuned("unlabeled", ALMOST_FIXED, "train.eval_mode=false")
    assert read_metrics(folder)[0]["train/loss"] > 0.01


@pytest.mark.slow
def test_of_networks_with_equal_agreement_the_last_one_is_kept(almost_fixed):
    folder, scores = almost_fixed
    first, second, *_ = read_metrics(folder)
    assert first["validation/accuracy"] == second["validation/accuracy"] == 1
    assert scores["test/epoch"] == 2


def test_labeled_folders_are_scored_in_a_networks_classes_before_and_after(
    tuned, weights, photographs
):
    _, scores = tuned("folder", ALMOST_FIXED)
    assert scores["test/agreement"] == 1
    assert scores["test/accuracy"] == scores["test/accuracy_before"]

    files = ["data=folder", f"data.path={photographs}", f"weights={weights}", "out=-"]
    test = load_data(train_command.read([*SETTINGS, *files])).test
    classifier = load_classifier(f"torchvision:{NAME}", weights)
    class_of_label = torch.tensor([classifier.label("lemon"), classifier.label("orange")])
    predicted = classifier.network(test.images / 255.0).argmax(1)
    is_correct = predicted == class_of_label[test.labels]
    assert scores["test/accuracy_before"] == pytest.approx(is_correct.float().mean().item())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("network=torchvision:resnet18", r"weights=.*torchvision:resnet18 "),
        ("model.name=torchvision:resnet18", "^model.name=torchvision:resnet18"),
        ("train.distillation_weight=0", "set network and train.distillation_weight"),
        ("network=pretrained/detector weights=null", "for detection: train it by nb.harden"),
    ],
)
def test_settings_that_do_not_fit_the_network_are_refused(tuned, change, message):
    with pytest.raises(InputError, match=message):
        tuned("unlabeled", "augment=random", *change.split())


def test_weights_without_their_network_are_refused_with_the_remedy(tuned, weights, tmp_path):
    alone = shutil.copy(weights, tmp_path / "weights.bin")
    with pytest.raises(InputError, match=r"no architecture: give both, as in .* weights=.*\.bin"):
        tuned("unlabeled", f"network={alone}", "weights=null")
