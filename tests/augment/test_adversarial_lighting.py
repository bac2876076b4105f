import numpy as np
import pytest
import torch
from torch import nn
from torchvision import tv_tensors

import norm_balls as nb
from augment.classifier import as_network
from renderer.errors import InputError
from tests.detectors import BrightBox, RawCells


class Mean(nn.Module):
    """Classifier whose first logit is the mean of the image, and whose second is .3."""

    def __init__(self):
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(10.0))
        self.seen = 0

    def forward(self, images):
        self.seen += len(images)
        mean = images.mean((1, 2, 3))
        return self.scale * torch.stack([mean, 0 * mean + 0.3], dim=1)


@pytest.fixture
def images() -> torch.Tensor:
    draws = torch.Generator().manual_seed(0)
    return torch.randint(120, 200, (8, 3, 16, 16), generator=draws, dtype=torch.uint8)


LABELS = torch.zeros(8, dtype=torch.int64)


def seeded(transform, *given):
    torch.manual_seed(0)
    return transform(*given)


SMOOTH = ["projected_slide", "cast_shadow", "directional", "point", "lamps", "linear", "fractal"]


@pytest.mark.parametrize("light", [*SMOOTH, "low_light"])
def test_steps_lower_the_evidence_of_the_class_in_most_images(images, light):
    model = Mean()
    start = seeded(nb.RandomLighting(light), images)
    found = seeded(nb.AdversarialLighting(model, steps=2, lights=light), images, LABELS)
    before, after = (model(shown / 255)[:, 0] for shown in (start, found))
    assert found.dtype == torch.uint8 and found.shape == images.shape
    assert ((after < before).sum() >= 5) and (after <= before + 0.05).all()


@pytest.mark.parametrize("dtype", [torch.half, torch.bfloat16, torch.double])
def test_a_network_of_another_precision_gets_images_of_its_own(images, dtype):
    floats = (images / 255).to(dtype)
    found = [
        seeded(nb.AdversarialLighting(model, steps=1, lights="linear"), given, LABELS)
        for model, given in ((Mean().to(dtype), floats), (Mean(), floats.float()))
    ]
    assert found[0].dtype == dtype
    # Costs of half precision may differ in the sign of a small gradient.
    assert (found[0] - found[1]).abs().mean() < (0.02 if dtype != torch.double else 1e-6)


def test_networks_with_one_logit_or_without_a_gradient_are_refused(images):
    first = nn.Sequential(nn.Flatten(), nn.Linear(3 * 16**2, 1))

    class Detached(Mean):
        def forward(self, images):
            return super().forward(images.detach())

    for labels in (None, LABELS):
        with pytest.raises(InputError, match="at least two"):
            nb.AdversarialLighting(first)(images, labels)
        with pytest.raises(InputError, match="without a gradient"):
            nb.AdversarialLighting(Detached())(images, labels)


def test_a_detector_that_finds_nothing_has_nothing_to_hide(images):
    class Nothing(nn.Module):
        def forward(self, images):
            empty = {"boxes": torch.zeros(0, 4), "scores": torch.zeros(0)}
            return [{**empty, "labels": torch.zeros(0, dtype=torch.int64)} for _ in images]

    targets = [{"boxes": [[2.0, 3.0, 10.0, 12.0]], "labels": [0]}] * len(images)
    options = {"task": nb.Detection(), "classes": ["ball", "lamp"], "lights": "linear"}
    found = nb.AdversarialLighting(Nothing(), **options)(images, targets)
    assert found.shape == images.shape


def test_each_image_is_seen_as_often_as_stated_and_the_network_stays_as_it_was(images):
    model = Mean().train()
    for steps, targets, extra in ((1, LABELS, 0), (2, None, 1)):
        model.seen = 0
        lighting = nb.AdversarialLighting(model, steps=steps, lights="linear")
        lighting(images, targets)
        assert model.seen == 8 * (lighting.forward_passes + extra) == 8 * (steps + 1 + extra)
        assert lighting.backward_passes == steps
    assert model.training and model.scale.requires_grad and model.scale.grad is None


def test_gradients_of_the_caller_are_left_alone(images):
    """A module before the light is in training, too, and the images have a gradient."""
    before = nn.Conv2d(3, 3, 1)
    given = (images / 255).requires_grad_()
    model = Mean()
    model.offset = torch.zeros(1, requires_grad=True)
    lighting = nb.AdversarialLighting(model, steps=2, lights="linear")
    shown = lighting(before(given).sigmoid(), LABELS)
    tensors = (before.weight, given, model.offset)
    assert all(tensor.grad is None for tensor in tensors)
    model(shown).sum().backward()
    assert before.weight.grad.abs().sum() > 0


DETECTOR = BrightBox((2.0, 2.0, 12.0, 12.0))


def hiding(**options):
    """Return light that hides a lamp from the detector."""
    classes = ["background", "lamp"]
    return nb.AdversarialLighting(DETECTOR, nb.Detection(), classes=classes, **options)


def test_light_hides_boxes_from_a_detector(images):
    target = {"boxes": torch.tensor([[2.0, 2.0, 12.0, 12.0]]), "labels": torch.tensor([1])}
    start = seeded(nb.RandomLighting("low_light"), images)
    found = seeded(hiding(steps=2, lights="low_light"), images, [target] * 8)
    scores = [[item["scores"] for item in DETECTOR(shown / 255)] for shown in (start, found)]
    assert torch.cat(scores[1]).mean() < torch.cat(scores[0]).mean()


def test_a_network_with_a_decode_gets_the_light_of_its_raw_network_and_the_task_that_is_given():
    images = torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    network, classes = RawCells().eval(), ["background", "ball"]
    low, high = (nb.Detection(threshold, decode=RawCells.decode) for threshold in (0.4, 0.99))
    loaded = as_network(network, 32, classes, task=low)
    given = {"lights": "linear"}
    expected = seeded(nb.AdversarialLighting(network, low, classes=classes, **given), images)
    for model in (loaded, loaded.with_dim(loaded)):
        found = seeded(nb.AdversarialLighting(model, **given), images)
        torch.testing.assert_close(found, expected)
    # Without an object, the light is the random one.
    random = seeded(nb.RandomLighting("linear"), images)
    assert not torch.equal(expected, random)
    assert torch.equal(seeded(nb.AdversarialLighting(loaded, high, **given), images), random)


def test_neither_the_mode_of_gradients_nor_the_bits_of_a_pixel_matter(images):
    lighting = nb.AdversarialLighting(Mean(), steps=2, lights="point")
    found = []
    of_16_bits = (images.int() * 257).to(torch.uint16)
    modes = torch.enable_grad, torch.no_grad, torch.inference_mode
    for mode, given in zip(modes, (images / 255, of_16_bits, of_16_bits), strict=True):
        with mode():
            found.append(seeded(lighting, given, LABELS))
    torch.testing.assert_close(found[1].float() / 65535, found[0], rtol=0, atol=1e-4)
    assert torch.equal(found[1], found[2])


@pytest.mark.parametrize("given", [list, np.array, lambda labels: torch.tensor(labels).int()])
def test_labels_may_be_lists_arrays_and_tensors_of_any_integers(images, given):
    labels = [0, 1, 1, 0, 1, 0, 0, 1]
    lighting = nb.AdversarialLighting(Mean(), lights="linear")
    targets = given(labels), torch.tensor(labels)
    assert torch.equal(*(seeded(lighting, images, each) for each in targets))


def test_boxes_may_be_whole_numbers_lists_or_those_of_a_sample(images):
    box, size = [2, 2, 12, 12], images.shape[-2:]
    formats = {"XYXY": box, "XYWH": [2, 2, 10, 10], "CXCYWH": [7, 7, 10, 10]}
    of_samples = [
        tv_tensors.BoundingBoxes([sides], format=name, canvas_size=size)
        for name, sides in formats.items()
    ]
    found = []
    for boxes in (torch.tensor([box]).float(), torch.tensor([box]), [box], *of_samples):
        targets = [{"boxes": boxes, "labels": [1]}] * 7 + [{"boxes": [], "labels": []}]
        found.append(seeded(hiding(steps=1), images, targets))
    assert all(torch.equal(found[0], other) for other in found[1:])


# Older versions of torchvision have no rotated boxes.
@pytest.mark.parametrize(
    "name", sorted({*tv_tensors.BoundingBoxFormat.__members__} - {"XYXY", "XYWH", "CXCYWH"})
)
def test_rotated_boxes_are_refused(images, name):
    sides = torch.ones(1, 8 if name == "XYXYXYXY" else 5)
    boxes = tv_tensors.BoundingBoxes(sides, format=name, canvas_size=images.shape[-2:])
    with pytest.raises(InputError, match=name):
        hiding()(images, [{"boxes": boxes, "labels": [1]}] * 8)


class Pixels(nn.Module):
    """Segmenter whose logits of two classes are the mean of a pixel and .3."""

    def forward(self, images):
        mean = 10 * images.mean(1)
        return torch.stack([torch.full_like(mean, 3.0), mean], dim=1)


def segment(images, targets):
    options = {"lights": "low_light", "classes": ["background", "lamp"]}
    return seeded(nb.AdversarialLighting(Pixels(), nb.Segmentation(), **options), images, targets)


@pytest.mark.parametrize("change", [lambda x: x.float(), lambda x: (x / 255 - 0.5) / 0.2])
def test_floats_of_bytes_and_normalized_images_are_refused(images, change):
    with pytest.raises(InputError, match="images has values from"):
        nb.AdversarialLighting(Mean())(change(images), LABELS)


@pytest.mark.parametrize("label", [255, -1, -100])
def test_pixels_without_a_class_count_as_background(images, label):
    targets = torch.ones(8, 16, 16, dtype=torch.int64)
    targets[:, :4] = 0
    expected = segment(images, targets)
    assert torch.equal(segment(images, targets.where(targets == 1, label)), expected)


@pytest.mark.parametrize("label", [2, 254])
def test_label_maps_of_other_classes_are_refused(images, label):
    with pytest.raises(InputError, match=f"label {label}.* 0 to 1"):
        segment(images, torch.full((8, 16, 16), label))


@pytest.fixture
def one_process():
    torch.distributed.init_process_group(
        "gloo", store=torch.distributed.HashStore(), rank=0, world_size=1
    )
    yield
    torch.distributed.destroy_process_group()


def test_the_search_makes_no_passes_of_ddp_which_wait_for_other_processes(images, one_process):
    model = nn.parallel.DistributedDataParallel(Mean())
    model.register_forward_pre_hook(lambda *_: pytest.fail("a pass of DDP"))
    found = seeded(nb.AdversarialLighting(model), images, LABELS)
    assert torch.equal(found, seeded(nb.AdversarialLighting(model.module), images, LABELS))


class Flat(nn.Sequential):
    def __init__(self):
        super().__init__(nn.Flatten(), nn.Linear(3 * 16 * 16, 2))


@pytest.mark.filterwarnings("ignore:Dynamo detected")  # The tests check shapes.
def test_a_compiled_step_leaves_the_search_out(images):
    relight = nb.AdversarialLighting(Mean(), steps=1)
    graphs = []
    # The compiler shows each of its graphs to the backend.
    compiled = torch.compile(lambda x: relight(x) * 2, backend=lambda g, _: graphs.append(g) or g)
    assert torch.equal(seeded(compiled, images), seeded(relight, images) * 2)
    assert len(graphs) == 1


@pytest.mark.filterwarnings("ignore:.torch.jit.script:FutureWarning")
def test_scripted_networks_are_searched_like_others(images):
    model = Flat()
    lightings = map(nb.AdversarialLighting, (model, torch.jit.script(model)))
    assert torch.equal(*(seeded(lighting, images, LABELS) for lighting in lightings))


def test_networks_of_torch_export_are_refused_with_the_remedy(images):
    model = torch.export.export(Flat(), (torch.rand(8, 3, 16, 16),)).module()
    with pytest.raises(InputError, match="load_classifier"):
        nb.AdversarialLighting(model)(images, LABELS)
