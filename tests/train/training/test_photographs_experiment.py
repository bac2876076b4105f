"""experiment=photographs learns from unlabeled photographs in the light of a projector."""

import csv

import pytest
import torch
from torch.distributions import Categorical, kl_divergence
from torchvision.models import mnasnet0_5

import norm_balls as nb
from augment.random_streams import generator
from renderer.image import to_unit
from tests.runs import completed_run
from tests.train.helpers import SHORT_TRAINING
from train.__main__ import main as train_command
from train.checkpoints import load
from train.commands import experiment
from train.data.sets import Split
from train.device import MixedPrecision
from train.results.page import PAGE
from train.run_folder import BEFORE, BEST, LAST, read_metrics
from train.settings import PHOTOGRAPHS_FIRST, TrainSettings
from train.training import run
from train.training.augmentations import Augmentation, relit
from train.training.averages import FACTORS, INTERPOLATION, interpolate, mix, predict
from train.training.recipe import TrainingLoss

GRAY = Split(torch.full((64, 3, 24, 24), 180, dtype=torch.uint8), torch.zeros(64).long())


@pytest.fixture(scope="module")
def small(weights, photographs) -> list[str]:
    return [*SHORT_TRAINING, f"weights={weights}", f"unlabeled={photographs}"]


@pytest.mark.slow
def test_the_weights_lie_on_the_line_between_original_and_trained_ones(small, weights, tmp_path):
    words = ["experiment=photographs", "train.epochs=2", "train.learning_rate=0.003", *small]
    folder = tmp_path / "run"
    scores = completed_run(train_command.read([*words, f"out={folder}"]), folder)
    best = load(folder / BEST)
    factor = best[INTERPOLATION]
    assert factor in FACTORS
    assert scores["test/interpolation"] == factor
    last = load(folder / LAST)["model"]
    begin = torch.load(weights)
    assert not torch.equal(last["network.conv1.0.weight"], begin["conv1.0.weight"])
    for name, start in begin.items():
        trained = last[f"network.{name}"]
        # The statistics of batches stay those of the original.
        assert "running" not in name or torch.equal(trained, start)
        if start.is_floating_point():
            expected = start + factor * (trained - start)
            value = best["model"][f"network.{name}"]
            torch.testing.assert_close(value, expected, atol=1e-6, rtol=1e-5)


@pytest.fixture(scope="module")
def chain(small):
    def start(folder, *overrides):
        meshes = ["label='950'", "meshes=[solid:orange]", "hard_negatives=[solid:lemon]"]
        scene = ["scene.backgrounds=[0.5]", "scene.views=1", "evaluate.laboratory_setups=0"]
        words = ["experiment=classifier", "photographs_first=true", "train.epochs=1"]
        words += [*small, *meshes, *scene, f"out={folder}", *overrides]
        experiment.train(train_command.compose(words), words)

    return start


@pytest.mark.slow
def test_one_command_trains_on_photographs_then_the_last_layer_on_renders(
    chain, weights, photographs, tmp_path, monkeypatch
):
    folder = tmp_path / "run"
    # Both trainings change many answers.
    monkeypatch.setattr(
        experiment, "SHARED_IN_TRAIN", (*experiment.SHARED_IN_TRAIN, "learning_rate")
    )
    chain(folder, f"photos={photographs}", "train.learning_rate=0.01")
    original = torch.load(weights)
    relit = torch.load(folder / PHOTOGRAPHS_FIRST / "weights.pt")
    hardened = torch.load(folder / "weights.pt")
    first_epochs = [line for line in read_metrics(folder / PHOTOGRAPHS_FIRST) if "epoch" in line]
    assert len(first_epochs) == train_command.compose(["experiment=photographs"]).train.epochs
    assert not torch.equal(relit["conv1.0.weight"], original["conv1.0.weight"])
    changed = {name for name in original if not torch.equal(relit[name], hardened[name])}
    assert changed == {"fc.weight", "fc.bias"}
    # What the run calls the network before hardening is that of the user, in the same precision.
    with (folder / BEFORE / "photographs/predictions.csv").open() as file:
        scored = [float(row["orange_log_odds"]) for row in csv.DictReader(file)]
    network = nb.load_classifier(
        SHORT_TRAINING[0].removeprefix("network="), weights=weights, size=32
    )
    scores = nb.evaluate(network, photographs, label="orange", precision="float32")
    assert scores.predicted.predictions.log_odds == pytest.approx(scored, abs=1e-4)
    page = (folder / PAGE).read_text()
    for stage in (folder / PHOTOGRAPHS_FIRST, folder):
        assert f"{stage}:" in page


@pytest.mark.slow
def test_a_command_stopped_in_its_first_training_ends_the_same(chain, tmp_path, monkeypatch):
    whole = tmp_path / "whole"
    chain(whole)
    stopped = tmp_path / "stopped"
    interpolated = run.interpolate

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "interpolate", stop)
    with pytest.raises(KeyboardInterrupt):
        chain(stopped)
    monkeypatch.setattr(run, "interpolate", interpolated)
    chain(stopped, "train.resume=true")
    expected = torch.load(whole / "weights.pt")
    for name, value in torch.load(stopped / "weights.pt").items():
        assert torch.equal(value, expected[name])
    # Both trainings are finished. The command repeats neither.
    trained_at = (stopped / PHOTOGRAPHS_FIRST / LAST).stat().st_mtime_ns
    chain(stopped, "train.resume=true")
    assert (stopped / PHOTOGRAPHS_FIRST / LAST).stat().st_mtime_ns == trained_at


def test_the_second_training_states_no_fact_that_the_first_network_defines(chain, monkeypatch):
    trained = []
    monkeypatch.setattr(experiment, "_train_in", lambda _, settings, *__: trained.append(settings))
    given = "classes=[a,b]", "normalization=imagenet", "prompt='a photo of a {}'", "size=32"
    chain("run", *given, "label=a")
    facts = [(one.weights, one.classes, one.normalization, one.prompt) for one in trained]
    assert None not in facts[0]
    assert facts[1] == (None, None, None, None)


def test_weights_are_interpolated_by_predictions_in_the_light_of_the_training():
    def brightness(light: str) -> float:
        shown = predict(
            lambda x: x.mean((1, 2, 3))[:, None], GRAY, torch.device("cpu"), 0, light=light
        )
        return float(shown.median())

    assert brightness("low_light") < 0.6 * 180 / 255 < brightness("relight")


def test_stripes_are_gray_in_two_of_five_images():
    red = torch.tensor([200, 60, 60], dtype=torch.uint8).view(1, 3, 1, 1).expand(1000, 3, 8, 8)
    shown = relit(red, 0, "stripes")
    is_gray = (shown == shown[:, :1]).flatten(1).all(1)
    # Four standard errors.
    assert is_gray.double().mean() == pytest.approx(0.4, abs=4 * (0.4 * 0.6 / 1000) ** 0.5)


@pytest.mark.parametrize(("weights", "expected"), [((1, 1e-6), 0), ((1e-6, 1), 1)])
def test_the_interpolation_minimizes_the_loss_with_the_larger_weight(weights, expected):
    def network(scale: float) -> MixedPrecision:
        linear = torch.nn.Linear(3, 2, bias=False)
        linear.weight.data = torch.tensor([[scale] * 3, [0.0] * 3])
        layers = torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), linear
        return MixedPrecision(torch.nn.Sequential(*layers), "float32")

    # Larger logits make up for low light, and are too large in the light as it is.
    initial, trained = network(2.0), network(4.0).network.state_dict()
    names = ("distillation_weight", "consistency_weight")
    recipe = TrainSettings(augmentation="low_light", **dict(zip(names, weights, strict=True)))
    _, factor = interpolate(initial, network(0.0), trained, GRAY, recipe, 0)
    assert factor == expected


def test_interpolated_weights_keep_the_versions_of_modules():
    """MNASNet cannot load a state dict without the versions."""
    first, last = (mnasnet0_5(num_classes=2) for _ in range(2))
    mixed = mix(first.state_dict(), last.state_dict(), 0.25)
    first.load_state_dict(mixed)
    assert torch.equal(first.layers[0].weight, mixed["layers.0.weight"])


@pytest.mark.parametrize("weight", [2.0, 0.0])
def test_the_loss_compares_relit_and_unchanged_images_with_the_teacher(weight):
    torch.manual_seed(0)
    flat = torch.nn.Flatten()
    model = torch.nn.Sequential(flat, torch.nn.Linear(12, 3))
    teacher = torch.nn.Sequential(flat, torch.nn.Linear(12, 3))
    settings = TrainSettings(distillation_weight=weight, consistency_weight=0.5)
    unchanged = torch.randint(0, 256, (4, 3, 2, 2), dtype=torch.uint8)
    relit = torch.randint(0, 256, (4, 3, 2, 2), dtype=torch.uint8)
    loss = TrainingLoss(model, settings, (), teacher, labeled=False)
    no_renders = torch.zeros(4, dtype=torch.bool)
    value, _ = loss.compute(unchanged, torch.zeros(4, dtype=torch.int64), no_renders, relit)

    def predicted(network, images):
        return Categorical(logits=network(to_unit(images)))

    wanted = predicted(teacher, unchanged)
    distilled, consistent = (
        kl_divergence(wanted, predicted(model, images)).mean() for images in (unchanged, relit)
    )
    torch.testing.assert_close(value, weight * distilled + 0.5 * consistent)


def test_gradient_steps_lower_the_confidence_of_relit_batches():
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.AvgPool2d(4), torch.nn.Flatten(), torch.nn.Linear(12, 5))
    network[2].weight.data *= 10
    images = torch.randint(0, 256, (16, 3, 8, 8), dtype=torch.uint8, generator=generator(0))
    labels = torch.zeros(16, dtype=torch.int64)
    confidence = {}
    for steps in (0, 3):
        chosen = TrainSettings(augmentation="relight", consistency_weight=1.0, relight_steps=steps)
        batches = Augmentation(chosen, network, network, seed=0)
        relit = batches.apply(images, labels, step=0)
        assert torch.equal(relit, batches.apply(images, labels, step=0))
        assert not torch.equal(relit, batches.apply(images, labels, step=1))
        source = network(to_unit(images)).argmax(1, keepdim=True)
        confidence[steps] = network(to_unit(relit)).softmax(1).gather(1, source).mean()
    assert confidence[3] < confidence[0]
