import pytest
import torch
from torchvision.ops import masks_to_boxes

import norm_balls as nb
from augment.attack_settings import StepSettings
from augment.augmentation_settings import AugmentationSettings, TrainingAttackSettings
from augment.service import AugmentationService
from augment.tasks.detection import Detection
from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from tests.detectors import BrightBox

SIZE = 32
CLASSES = ("background", "cup", "bottle")
# Objects of two classes, and one without a class.
MESHES = [("solid:bottle", 2), ("solid:ball", -1), ("solid:cup", 1)]


def serve(task=None, classes=CLASSES, camera=None, **options) -> AugmentationService:
    scene = {"samples": 1, "backgrounds": [0.5], "rasterizer": "numpy"}
    scene |= {"cameras": [camera]} if camera else {"views": 2}
    given = AugmentationSettings(**options)
    task = task or Detection()
    return AugmentationService.from_meshes(MESHES, SIZE, given, task=task, classes=classes, **scene)


def test_targets_are_the_pixels_that_differ_from_the_background():
    renders = serve(mode="random").regenerate(BrightBox((0, 0, SIZE, SIZE)), 0)
    is_object = (renders.images != 0.5).any(1)
    for shown, label, target in zip(is_object, renders.labels, renders.targets, strict=True):
        count = int(label >= 0)
        assert torch.equal(target["masks"].bool(), shown.expand(count, -1, -1))
        # The corners of torchvision are centers of pixels.
        corners = masks_to_boxes(target["masks"]) + torch.tensor([0, 0, 1, 1])
        assert torch.equal(target["boxes"], corners)
        assert target["labels"].tolist() == [int(label)] * count
        assert (target["boxes"].shape, target["boxes"].dtype) == ((count, 4), torch.float32)
        assert (target["labels"].dtype, target["masks"].dtype) == (torch.int64, torch.uint8)


def test_an_attack_hides_objects_and_draws_random_light_for_images_without_a_class():
    attack = TrainingAttackSettings(max_steps=9, lighting=StepSettings(step_size=2.0))
    service = serve(task=Detection(threshold=0.45, iou=0.1), mode="adversarial", attack=attack)
    renders = service.regenerate(BrightBox((0, 0, SIZE, SIZE), 2), 0)
    assert renders.diagnostics["attack_success"] == 1
    assert (renders.images[renders.labels == 2].mean((1, 2, 3)) < 0.45).all()
    assert [len(target["labels"]) for target in renders.targets] == [1, 1, 0, 0, 1, 1]
    other = service.regenerate(BrightBox((0, 0, SIZE, SIZE), 2), 1)
    assert not torch.equal(other.images[renders.labels < 0], renders.images[renders.labels < 0])


def test_all_objects_of_an_image_are_targets_except_those_without_a_class():
    names = ("bottle", "cup", "")
    others = [nb.ObjectSettings(f"solid:{name or 'ball'}", label=name) for name in names]
    settings = AugmentationSettings(mode="random")
    scene = {"views": 1, "samples": 1, "backgrounds": [0.5], "width": 8, "rasterizer": "numpy"}
    options = {"task": Detection(), "classes": CLASSES, **scene}
    service = AugmentationService.from_meshes([others], SIZE, settings, **options)
    (target,) = service.regenerate(BrightBox((0, 0, SIZE, SIZE)), 0).targets
    assert target["labels"].tolist() == [2, 1]
    corners = masks_to_boxes(target["masks"]) + torch.tensor([0, 0, 1, 1])
    assert torch.equal(target["boxes"], corners)
    assert not target["masks"].prod(0).any()


@pytest.mark.parametrize("mode", ["random", "adversarial"])
def test_images_without_an_object_have_an_empty_target(mode):
    away = OrthographicCamera(60, 0, 3, right=10.0)
    renders = serve(mode=mode, camera=away).regenerate(BrightBox((0, 0, SIZE, SIZE)), 0)
    for target in renders.targets:
        assert target["boxes"].shape == (0, 4)
        assert target["masks"].shape == (0, SIZE, SIZE)


@pytest.mark.parametrize(("classes", "message"), [(("background", "cup"), "2"), ((), "classes")])
def test_a_label_without_a_name_is_refused(classes, message):
    with pytest.raises(InputError, match=message):
        serve(classes=classes)
