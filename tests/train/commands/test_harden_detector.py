"""`nb.harden` trains detectors of torchvision on boxes in renders, and keeps those in photographs.

The detector of these tests is trained for a second to find a bottle in natural light.
"""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn
from torch.distributions import Bernoulli, kl_divergence
from torchvision.models import get_model
from torchvision.ops import box_iou

import norm_balls as nb
from augment.augmentation_settings import AugmentationSettings
from augment.service import AugmentationService
from augment.tasks.detection import Detection
from renderer.errors import InputError
from renderer.image import to_bytes, to_unit
from tests.detectors import BrightBox, OneBox, RawCells, small_detector
from train.data.sets import load_unlabeled
from train.results.store import summarize
from train.settings import ExperimentSettings, TrainSettings
from train.training.augmentations import Augmentation
from train.training.detection import candidate_loss, detected, losses_of
from train.training.inputs import load_initial
from train.training.loop import Trainer

SIZE = 32
CLASSES = ["background", "bottle"]
TASK = Detection(threshold=0.4)
SHORT = {"train": {"epochs": 2, "batch_size": 8, "learning_rate": 0.001}, "data": {"workers": 0}}
SHORT |= {"scene": {"views": 4, "backgrounds": [0.5]}, "augment": {"mode": "random"}}
SHORT["renderer"] = {"rasterizer": "numpy", "samples": 1}


def renders(seed: int) -> tuple[torch.Tensor, list[dict[str, torch.Tensor]]]:
    settings = AugmentationSettings(mode="random")
    options = {"views": 6, "samples": 1, "rasterizer": "numpy", "task": TASK, "classes": CLASSES}
    meshes = [("solid:bottle", 1), ("solid:ball", -1)]
    service = AugmentationService.from_meshes(meshes, SIZE, settings, seed=seed, **options)
    made = service.regenerate(BrightBox((0, 0, SIZE, SIZE)), 0)
    return made.images, made.targets


@pytest.fixture(scope="module")
def detector() -> nn.Module:
    network = OneBox(SIZE).train()
    images, targets = renders(0)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.02)
    for _ in range(80):
        optimizer.zero_grad()
        sum(network(images, targets).values()).backward()
        optimizer.step()
    return network.eval()


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Return a folder of pictures that show bottles, or none."""
    folder = tmp_path_factory.mktemp("photographs")
    for index, image in enumerate(to_bytes(renders(1)[0])):
        pixels = np.asarray(image.permute(1, 2, 0))
        Image.fromarray(pixels).save(folder / f"{index:02}.png")
    return folder


def harden(network, photographs, meshes=("solid:bottle",), **options):
    given = {"classes": CLASSES, "size": SIZE, "task": TASK} | SHORT | options
    return nb.harden(network, meshes, photographs, **given)


def as_batch(folder) -> torch.Tensor:
    arrays = [np.asarray(Image.open(path)) for path in sorted(folder.glob("*.png"))]
    return torch.tensor(np.stack(arrays)).permute(0, 3, 1, 2)


def kept(detector: nn.Module, hardened: nn.Module, images: Tensor) -> float:
    """Return the fraction of the boxes of a detector that a hardened one finds, too."""
    pairs = zip(detected(detector, images, TASK), detected(hardened, images, TASK), strict=True)
    overlaps = [
        box_iou(old["boxes"], new["boxes"]).amax() if len(new["boxes"]) else torch.tensor(0.0)
        for old, new in pairs
        if len(old["boxes"])
    ]
    assert len(overlaps) >= 5
    return float((torch.stack(overlaps) >= TASK.iou).float().mean())


def test_the_loss_in_low_light_falls_and_boxes_in_unchanged_light_stay(detector, photographs):
    weights = deepcopy(detector.state_dict())
    train = {"epochs": 5, "batch_size": 12, "learning_rate": 0.002, "augmentation": "low_light"}
    hardened = harden(detector, photographs, (), train=train, augment=None)
    assert all(value.equal(weights[name]) for name, value in detector.state_dict().items())
    assert type(hardened) is type(detector) and not hardened.training
    images = as_batch(photographs)
    boxes = detected(detector, images, TASK)
    dark = to_unit(Augmentation(LOW_LIGHT, None, seed=9).apply(images, torch.zeros(len(images)), 0))
    losses = [
        losses_of(deepcopy(network).train(), dark, boxes).item() for network in (detector, hardened)
    ]
    assert losses[1] < losses[0]
    assert kept(detector, hardened, images) >= 0.8


@pytest.mark.slow
def test_without_boxes_of_the_teacher_renders_change_those_in_photographs(detector, photographs):
    train = SHORT["train"] | {"learning_rate": 0.003}
    free = train | {"distillation_weight": 1e-9, "consistency_weight": 0.0}
    both = (harden(detector, photographs, train=one) for one in (train, free))
    with_teacher, without = (kept(detector, one, as_batch(photographs)) for one in both)
    assert with_teacher > without


@pytest.mark.slow
def test_a_resumed_run_gives_the_same_weights(detector, photographs, tmp_path, monkeypatch):
    def fail_after_an_epoch(trainer: Trainer, *options) -> bool:
        if trainer.epoch:
            raise KeyboardInterrupt
        return train_epoch(trainer, *options)

    whole = harden(detector, photographs)
    train_epoch = Trainer._train_epoch
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "_train_epoch", fail_after_an_epoch)
        harden(detector, photographs, out=tmp_path)
    train = SHORT["train"] | {"resume": True}
    resumed = harden(detector, photographs, train=train, out=tmp_path)
    assert torch.equal(resumed.layer.weight, whole.layer.weight)


def test_a_detector_of_torchvision_is_trained_without_meshes(photographs):
    network = small_detector(len(CLASSES), SIZE)
    hardened = harden(network, photographs, (), augment=None, train={"epochs": 1, "batch_size": 12})
    assert hardened.state_dict().keys() == network.state_dict().keys()
    weights = zip(hardened.parameters(), network.parameters(), strict=True)
    assert not all(torch.equal(*pair) for pair in weights)


def test_the_run_of_a_detector_is_scored_by_the_boxes_that_it_keeps(
    detector, photographs, tmp_path
):
    train = {"epochs": 1, "batch_size": 8, "learning_rate": 0.03}
    data = {"test_fraction": 0.5, "workers": 0}
    hardened = harden(detector, photographs, train=train, data=data, out=tmp_path)
    images = load_unlabeled(str(photographs), SIZE, 0.5, False, 0).test.images
    expected = kept(detector, hardened, images)
    assert 0 < expected < 1
    assert summarize(tmp_path).accuracy == pytest.approx(expected)


LOW_LIGHT = TrainSettings(augmentation="low_light")
RAW = {"task": Detection(decode=RawCells.decode), "augment": None}


def test_a_raw_network_keeps_its_candidates_in_low_light(photographs):
    network = RawCells().eval()
    train = {"epochs": 4, "batch_size": 12, "learning_rate": 0.1, "augmentation": "low_light"}
    train["images_per_epoch"] = 24
    hardened = harden(network, photographs, (), train=train, **RAW)
    images = as_batch(photographs)
    dark = to_unit(Augmentation(LOW_LIGHT, None, seed=9).apply(images, torch.zeros(len(images)), 0))
    expected = network(to_unit(images)).sigmoid()
    changes = [(one(dark).sigmoid() - expected).abs().mean() for one in (network, hardened)]
    assert changes[1] < 0.9 * changes[0]


class OfTwoOutputs(RawCells):
    """The same network, whose logits are the second of its outputs, as those of ONNX can be."""

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        return images, super().forward(images)


def test_all_outputs_of_a_raw_network_are_decoded_in_its_training(photographs):
    hardened = harden(RawCells().eval(), photographs, (), **RAW)
    task = Detection(decode=lambda outputs: RawCells.decode(outputs[1]))
    found = harden(OfTwoOutputs().eval(), photographs, (), **RAW | {"task": task})
    for name, weight in found.state_dict().items():
        assert torch.equal(weight, hardened.state_dict()[name])
    assert not torch.equal(found.layer.weight, RawCells().layer.weight)


def test_the_loss_of_candidates_is_the_divergence_of_scores_and_the_overlap_of_boxes():
    boxes = torch.tensor([[0.0, 0.0, 2.0, 2.0], [4.0, 4.0, 6.0, 8.0]])
    moved = torch.tensor([[1.0, 0.0, 3.0, 2.0], [4.0, 4.0, 6.0, 8.0]])
    old, new = torch.tensor([[0.2, 0.8], [0.5, 0.1]]), torch.tensor([[0.4, 0.6], [0.5, 0.3]])
    divergence = kl_divergence(Bernoulli(old), Bernoulli(new)).sum()
    # The moved box has 2 of 6 squares in common, and the box around both has 6.
    expected = divergence + 0.8 * (1 - 2 / 6)
    loss = candidate_loss([(moved, new)], [(boxes, old)], favor=1.0)
    assert loss.item() == pytest.approx(float(expected))


def test_favor_multiplies_the_odds_with_the_lowest_loss():
    boxes, old = torch.tensor([[0.0, 0.0, 2.0, 2.0]]), torch.tensor([[0.2]])
    scores = torch.linspace(0.01, 0.99, 99)[:, None, None]
    losses = [float(candidate_loss([(boxes, one)], [(boxes, old)], favor=3.0)) for one in scores]
    # Odds of 1 / 4 times 3 are 3 / 4, a score of 3 / 7.
    assert float(scores[np.argmin(losses)]) == pytest.approx(3 / 7, abs=0.01)
    assert min(losses) == pytest.approx(0, abs=1e-3)


def without_losses() -> nn.Module:
    network = BrightBox((0, 0, SIZE, SIZE))
    network.register_parameter("weight", nn.Parameter(torch.ones(1)))
    return network


def bright_box(raw: Tensor) -> list[dict[str, Tensor]]:
    """Return a box with its label instead of the scores of all classes."""
    return BrightBox((0, 0, 9, 9))(raw[:, :3, None, None].sigmoid())


WITHOUT_SCORES = {"task": Detection(threshold=0.1, decode=bright_box), "augment": None}


@pytest.mark.parametrize(
    ("network", "meshes", "options", "reason"),
    [
        *[
            (OneBox(SIZE), (), {"train": {name: value}}, f"^train.{name}=")
            for name, value in (
                ("interpolate", True),
                ("relight_steps", 1),
                ("label_smoothing", 0.1),
                ("ranking_weight", 0.1),
                ("freeze", "all_but_last"),
                ("augmentation", "pgd"),
                ("augmentation", "trivial_augment"),
                ("augmentation", "augmix"),
                ("augmentation", "color_jitter+augmix"),
            )
        ],
        (RawCells(), ("solid:bottle",), RAW, "meshes: a raw network"),
        (RawCells(), (), WITHOUT_SCORES, "labels"),
        (without_losses(), ("solid:bottle",), {}, "training mode"),
    ],
)
def test_networks_and_settings_that_cannot_train_a_detector_are_refused(
    photographs, network, meshes, options, reason
):
    with pytest.raises(InputError, match=reason):
        harden(network.eval(), photographs, meshes, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("fasterrcnn_mobilenet_v3_large_320_fpn", 64),
        ("maskrcnn_resnet50_fpn", 64),
        ("retinanet_resnet50_fpn", 64),
        ("fcos_resnet50_fpn", 64),
        ("ssdlite320_mobilenet_v3_large", 320),
    ],
)
def test_detectors_of_torchvision_learn_from_one_object_several_and_none(photographs, name, size):
    options = {"weights": None, "weights_backbone": None, "num_classes": 3}
    options |= {} if name.startswith("ssd") else {"min_size": size, "max_size": size}
    if "rcnn" in name:
        options |= {"rpn_post_nms_top_n_test": 20, "rpn_post_nms_top_n_train": 50}
        options |= {"box_detections_per_img": 5}
    torch.manual_seed(0)
    network = get_model(name, **options).eval()
    bottle, cup = (nb.ObjectSettings(f"solid:{name}", label=name) for name in ("bottle", "cup"))
    meshes = [bottle, [cup, replace(bottle, at=(2.0, 0.0))]]
    train = {"epochs": 1, "batch_size": 4, "images_per_epoch": 4}
    choices = {"classes": [*CLASSES, "cup"], "size": size, "train": train}
    hardened = harden(network, photographs, meshes, hard_negatives=["solid:ball"], **choices)
    pairs = zip(hardened.parameters(), network.parameters(), strict=True)
    changed = [not torch.equal(*pair) for pair in pairs]
    # Layers of anchors that match no object have no gradient.
    assert sum(changed) >= 0.75 * len(changed)


def test_a_detector_on_the_command_line_is_refused(tmp_path, monkeypatch):
    code = "import tests.detectors as d\nmake = lambda: (d.OneBox(32).eval(), 32, ['a', 'b'])\n"
    (tmp_path / "boxes_of_mine.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    settings = ExperimentSettings(network="python:boxes_of_mine:make", trust=True)
    with pytest.raises(InputError, match=r"detection.*nb\.harden"):
        load_initial(settings)
