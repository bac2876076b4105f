"""A run recognizes the light of its training, and a switch shows it only images in this light."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import nn

import norm_balls as nb
from augment.switch import LIT_NAME, Recognizer, statistics
from renderer import InputError
from renderer.image import to_unit
from tests.runs import completed_run
from tests.train.helpers import SHORT_TRAINING
from train.__main__ import main as train_command
from train.checkpoints import load_network
from train.data.sets import Split
from train.training import recognition
from train.training.augmentations import relit
from train.training.recognition import DECAY, fit_recognizer, logistic_weights, recognizing_layers

SIZE = 32


def smooth_images(count: int, seed: int) -> torch.Tensor:
    """Return smooth random images, uint8, shape (count, 3, SIZE, SIZE)."""
    rng = torch.Generator().manual_seed(seed)
    coarse = 255 * torch.rand(count, 3, 4, 4, generator=rng)
    smooth = nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bilinear")
    return (smooth + 20 * torch.rand(smooth.shape, generator=rng)).clamp(0, 255).byte()


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    layers = nn.Conv2d(3, 16, 3), nn.ReLU(), nn.Conv2d(16, 16, 3, stride=2), nn.ReLU()
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(16, 3)).eval()


def test_the_statistics_of_convolutions_and_tokens_are_those_of_each_channel():
    class Tokens(nn.Module):
        """Linear layer for tokens, whose channels are last, before a linear layer for images."""

        def __init__(self):
            super().__init__()
            self.patches, self.mix = nn.Conv2d(3, 5, 4, stride=4), nn.Linear(5, 7)
            self.head = nn.Linear(7, 2)

        def forward(self, images):
            return self.head(self.mix(self.patches(images).flatten(2).mT).mean(1))

    torch.manual_seed(0)
    network = Tokens()
    images = torch.rand(3, 3, 8, 8)
    with torch.no_grad():
        patches = network.patches(images)
        tokens = network.mix(patches.flatten(2).mT).numpy()
        logits = network(images).numpy()
    rows = patches.numpy().reshape(3, 5, 4)
    expected = [rows.mean(2), rows.std(2), tokens.mean(1), tokens.std(1), logits, 0 * logits]
    found = statistics(network, ["patches", "mix", "head"], images)
    np.testing.assert_allclose(found, np.concatenate(expected, 1), atol=1e-6)


def test_the_weights_are_the_optimum_that_scipy_finds():
    rng = np.random.default_rng(0)
    is_positive = np.arange(90) < 30
    values = rng.normal(size=(90, 4)) * [1, 10, 0.1, 0] + [0, 3, -1, 2] + 0.3 * is_positive[:, None]
    # Rounding makes the last value differ between images.
    values[:, 3] = 2.0 + 1e-9 * is_positive
    deviations = values.std(0, ddof=1)
    standardized = (values - values.mean(0)) / np.where(deviations > 1e-6, deviations, np.inf)

    def loss(parameters):
        odds = standardized @ parameters[:4] + parameters[4]
        losses = np.logaddexp(0, np.where(is_positive, -odds, odds))
        means = losses[is_positive].mean() / 2 + losses[~is_positive].mean() / 2
        return means + DECAY / 2 * (parameters[:4] ** 2).sum()

    optimum = minimize(loss, np.zeros(5), options={"gtol": 1e-8}).x[:4]
    # Most values never differ, such as the deviations of logits within an image.
    given = np.concatenate([values, np.ones((90, 9))], 1)
    found = logistic_weights(torch.from_numpy(given), torch.from_numpy(is_positive)).numpy()
    np.testing.assert_allclose(found[:3], optimum[:3] / deviations[:3], rtol=1e-3)
    assert abs(found[3]) < 1
    assert not found[4:].any()


@pytest.mark.parametrize("count", [2, 30, 250])
def test_the_expected_errors_are_those_of_random_scores(count):
    scores = torch.rand(20_000, count, generator=torch.Generator().manual_seed(0)).double()
    thresholds = scores.quantile(recognition.KEPT, dim=1, interpolation="higher")
    # A further score between 0 and 1 exceeds the threshold with this probability.
    expected = (1 - thresholds).mean().item()
    assert recognition.expected_errors(count) == pytest.approx(expected, rel=0.02)


def test_stripes_are_recognized_and_unchanged_images_are_not(network):
    train_split, kept_aside = (
        Split(smooth_images(count, seed), torch.zeros(count).long())
        for count, seed in ((200, 0), (50, 1))
    )
    recognizes = Recognizer(
        network, **fit_recognizer(network, train_split, kept_aside, 0, "stripes")
    )
    assert not recognizes(to_unit(kept_aside.images)).any()
    others = smooth_images(200, 2)
    assert recognizes(to_unit(others)).double().mean() < 0.05
    assert recognizes(to_unit(relit(others, 3, "stripes"))).double().mean() > 0.5


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_a_network_without_layers_of_torch_recognizes_no_light(network):
    traced = torch.jit.trace(network, torch.rand(1, 3, SIZE, SIZE))
    with pytest.raises(InputError, match=r"^recognize=true .*recognize=false"):
        recognizing_layers(traced, SIZE)


def test_layers_of_positions_and_of_windows_recognize_no_light(network):
    class Positioned(nn.Module):
        """Network with a layer that gets positions, and one that gets the quarters of an image."""

        def __init__(self):
            super().__init__()
            self.network, self.bias, self.quarter = network, nn.Linear(1, 3), nn.Conv2d(3, 3, 1)

        def forward(self, images):
            quarters = torch.cat([images[:, :, :16], images[:, :, 16:]])
            positions = self.bias(torch.ones(1, 1)) + self.quarter(quarters).mean()
            return self.network(images) + positions

    found = recognizing_layers(Positioned(), SIZE)
    assert found == [f"network.{name}" for name in recognizing_layers(network, SIZE)]


def test_a_run_gets_the_images_in_the_light_of_its_training(weights, photographs, tmp_path):
    name, run = "torchvision:shufflenet_v2_x0_5", tmp_path / "run"
    words = [*SHORT_TRAINING, f"weights={weights}", f"unlabeled={photographs}", f"out={run}"]
    words += ["train.epochs=1", "train.learning_rate=0.003"]
    completed_run(train_command.read(["experiment=stripes", *words]), run)
    plain = load_network(name, weights, size=SIZE)
    lit = nb.load_run(run)
    switched = load_network(f"{LIT_NAME}{name}+run:{run}", weights, size=SIZE)
    images = to_unit(torch.cat([smooth_images(20, 5), relit(smooth_images(20, 6), 7, "stripes")]))
    is_lit = lit.recognizer(images)
    assert 0 < is_lit.sum() < len(images)
    expected = torch.where(is_lit[:, None], lit(images), plain(images))
    torch.testing.assert_close(switched(images), expected)
    # The weights of a published network have 16 bits.
    nb.publish(run, tmp_path / "published")
    agrees = nb.load_run(tmp_path / "published").recognizer(images) == is_lit
    assert agrees.double().mean() > 0.9
    with pytest.raises(InputError, match="recognizes no light"):
        lit.with_lit(plain)


def test_a_hardened_classifier_recognizes_the_light_of_its_training(weights, photographs, tmp_path):
    plain = load_network("torchvision:shufflenet_v2_x0_5", weights, size=SIZE)
    settings = {"recognize": True, "augmentation": "stripes", "epochs": 1, "batch_size": 8}
    settings |= {"freeze": None, "eval_mode": False, "ranking_weight": 0.0}
    options = {"train": settings, "augment": {"mode": "none"}, "device": "cpu"}
    options |= {"data": {"validation": 0.25}, "out": tmp_path / "run"}
    for normalize_light in (None, True):
        network = plain.normalizing_light(normalize_light)
        lit = nb.harden(network, [], photographs, overwrite=True, **options)
        images = to_unit(torch.cat([smooth_images(9, 5), relit(smooth_images(9, 6), 7, "stripes")]))
        expected = nb.load_run(tmp_path / "run").recognizer(images)
        assert (lit.recognizer(images) == expected).all()
        switched = plain.with_lit(lit)
        assert not len(switched(images[:0]))
        torch.testing.assert_close(
            switched(images), torch.where(expected[:, None], lit(images), plain(images))
        )
    with pytest.raises(InputError, match=r"^train\.recognize"):
        nb.harden(plain.network, [], photographs, size=SIZE, **options)
