import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from torch import nn

import norm_balls as nb
from augment.attack_settings import RelightingSettings
from augment.classifier import as_network
from augment.lighting import relight_photographs
from augment.photographs import ADVERSARIAL, LIGHTS, RANDOM, attack_photographs
from augment.random_streams import generator
from augment.scene.patterns import ProjectedLight, draw_projected_light
from renderer.errors import InputError
from renderer.image import LUMINANCE, encode, to_unit

SIZE = 16
SETTINGS = RelightingSettings(gain=2.0, cells=3, passes=9, slides=2)


class HueNetwork(nn.Module):
    """Network with a class for each channel, which is the brightest part of the upper half."""

    def __init__(self):
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(20.0))

    def forward(self, images):
        return self.scale * images[:, :, : SIZE // 2].mean((2, 3))


@pytest.fixture(scope="module")
def photographs():
    coarse = torch.rand(12, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    return (255 * nn.functional.interpolate(coarse, SIZE)).to(torch.uint8)


@pytest.fixture(scope="module")
def result(photographs):
    return attack_photographs(HueNetwork().eval(), photographs, SETTINGS, seed=1)


def test_a_result_has_predictions_of_its_images_and_gains_within_the_norm_ball(result, photographs):
    means = to_unit(photographs)[:, :, : SIZE // 2].mean((2, 3))
    assert torch.equal(result.source, means.argmax(1))
    for log_gain in result.log_gain.values():
        assert log_gain.abs().max() <= math.log(2) + 1e-6
    network = HueNetwork()
    for light in LIGHTS:
        for index in range(len(result.photographs)):
            image = to_unit(result.image(index, light, slide=1))
            assert network(image[None]).argmax() == result.predicted[light][index, 1]
        is_other = result.predicted[light] != result.source[:, None]
        assert (is_other | ~result.changed[light]).all()


def test_searches_change_what_the_slide_changes_and_the_gradient_changes_most(result):
    counts = [int(result.changed[light].sum()) for light in LIGHTS]
    for light in (RANDOM, ADVERSARIAL):
        assert (result.changed[light] | ~result.changed["slide"]).all()
    assert counts[0] <= counts[1] < counts[2]


def test_a_gain_of_one_changes_nothing_more_than_the_slide(photographs):
    settings = RelightingSettings(gain=1.0, passes=5)
    result = attack_photographs(HueNetwork().eval(), photographs, settings)
    assert torch.equal(result.changed[RANDOM], result.changed["slide"])
    assert torch.equal(result.changed[ADVERSARIAL], result.changed["slide"])


def test_photographs_are_attacked_alike_in_inference_mode(result, photographs):
    network = HueNetwork().eval()
    with torch.inference_mode():
        # An array is taken like a tensor.
        again = attack_photographs(network, photographs.numpy(), SETTINGS, seed=1)
    for light, changed in result.changed.items():
        assert torch.equal(again.changed[light], changed)


def test_photographs_are_in_the_same_light_with_another_default_type_of_torch(result, photographs):
    network = HueNetwork().eval()
    try:
        torch.set_default_dtype(torch.float64)
        found = attack_photographs(network, photographs, SETTINGS, seed=1)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(found.predicted["slide"], result.predicted["slide"])
    assert {gain.dtype for gain in found.log_gain.values()} == {torch.float32}


def test_photographs_are_attacked_alike_in_any_batch(result, photographs):
    again = attack_photographs(HueNetwork().eval(), photographs, SETTINGS, batch_size=5, seed=1)
    for light in LIGHTS:
        assert torch.equal(again.changed[light], result.changed[light])
        torch.testing.assert_close(again.log_gain[light], result.log_gain[light])


def test_a_photograph_has_the_same_light_if_others_are_left_out(photographs):
    # Slides may show any attacked photograph. So all are the same.
    network, same = HueNetwork().eval(), photographs[:1].expand(5, -1, -1, -1)
    whole, few = (attack_photographs(network, same, SETTINGS, limit=limit) for limit in (None, 2))
    assert few.index.tolist() == [0, 4]
    for row, slide in product(range(2), range(SETTINGS.slides)):
        expected = whole.image(4 * row, "slide", slide)
        assert torch.equal(few.image(row, "slide", slide), expected)


def test_the_random_search_and_the_gradient_have_as_many_passes(photographs):
    calls = {"forward": 0, "backward": 0}

    class Counted(HueNetwork):
        def forward(self, images):
            calls["forward"] += 1
            if images.requires_grad:
                images.register_hook(lambda _: calls.update(backward=calls["backward"] + 1))
            return super().forward(images)

    def count(passes):
        calls.update(forward=0, backward=0)
        settings = RelightingSettings(gain=1.0 + 1e-6, passes=passes)
        attack_photographs(Counted().eval(), photographs, settings, sensor_noise=0.0)
        return calls["forward"], calls["backward"]

    few = count(5)
    many = count(9)
    # Four more draws, and two more steps with a forward and a backward pass each.
    assert many[0] - few[0] == 4 + 2
    assert many[1] - few[1] == 2


def test_a_function_without_gradients_is_attacked_by_random_search(photographs):
    def brightest(images):
        return np.asarray(images.detach())[:, :, : SIZE // 2].mean((2, 3))

    def rounded(images):  # has a gradient, which is 0
        return ((images * 255).round() / 255)[:, :, : SIZE // 2].mean((2, 3))

    for function in (brightest, rounded):
        result = attack_photographs(function, photographs[:2], SETTINGS)
        assert RANDOM in result.changed
        assert ADVERSARIAL not in result.changed
    assert torch.equal(result.kept(), result.kept(RANDOM))
    with pytest.raises(InputError, match="light=adversarial"):
        result.kept(ADVERSARIAL)


def test_photographs_of_another_size_or_without_detections_are_an_error(photographs):
    classifier = as_network(HueNetwork().eval(), SIZE, None)
    with pytest.raises(InputError, match="use the size of its images, 16"):
        attack_photographs(classifier, photographs[:, :, :8, :8])
    with pytest.raises(InputError, match="no detections in"):
        attack_photographs(find_bright, 0 * photographs, SETTINGS, classes=["a", "b"])


def test_a_camera_sees_albedo_times_light_at_its_exposure():
    albedo = torch.rand(2, 3, SIZE, SIZE, generator=generator(7))
    light = draw_projected_light(2, SIZE, generator(0))
    log_gain = torch.linspace(-1, 1, 2 * 3).view(2, 3, 1, 1)
    relit = light.expose(albedo, log_gain)

    albedo = albedo.double().numpy()
    gain = np.exp(log_gain.double().numpy())
    slide = light.slide.double().numpy() * gain * light.shading.double().numpy()
    radiance = albedo * (slide + light.ambient.double().numpy())
    weights = np.array(LUMINANCE)[:, None, None]
    wanted = (albedo * weights).sum(1).mean((1, 2)) * 2 ** light.stops.double().numpy().ravel()
    given = (radiance * weights).sum(1).mean((1, 2))
    exposed = radiance * (wanted / given)[:, None, None, None]
    expected = encode(torch.from_numpy(exposed.clip(0, 1)), "srgb")
    torch.testing.assert_close(relit.double(), expected, atol=1e-5, rtol=0)


def test_gains_between_the_cells_stay_within_the_bound():
    radius = math.log(3)
    draws = torch.Generator().manual_seed(0)
    log_gain = radius * (2 * torch.randint(0, 2, (1, 3, 6, 6), generator=draws) - 1.0)
    zero = torch.zeros(1, 1, 1, 1)
    white = torch.ones(1, 3, SIZE, SIZE)
    gain = ProjectedLight(white, white[:, :1], zero, zero).light(log_gain)
    assert gain.max() <= 3 + 1e-5
    assert gain.min() >= 1 / 3 - 1e-5
    # The bound is reached.
    torch.testing.assert_close(gain.max(), torch.tensor(3.0))


def test_the_gradient_of_the_gain_agrees_with_finite_differences():
    light = draw_projected_light(1, SIZE, generator(3))
    slide, shading, ambient, stops = (values.double() for values in light)
    # Dim photographs, none of whose values is clamped.
    albedo = 0.01 + 0.05 * torch.rand(1, 3, SIZE, SIZE, generator=generator(7)).double()
    light = ProjectedLight(slide, shading, ambient + 0.5, stops - 3)
    log_gain = torch.linspace(-0.5, 0.5, 12, dtype=torch.float64).view(1, 3, 2, 2)
    log_gain.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda value: light.expose(albedo, value), log_gain)


def test_relit_photographs_repeat_with_their_seed(photographs):
    first = relight_photographs(photographs, seed=1, slides=photographs)
    again = relight_photographs(photographs, seed=1, slides=photographs)
    # Flipped twice, the array has negative strides, as images of OpenCV in RGB have.
    array = photographs.flip(1).numpy()[:, ::-1]
    assert torch.equal(relight_photographs(array, seed=1, slides=array), first)
    linear = [relight_photographs(each, lights=["linear"]) for each in (array, photographs)]
    assert torch.equal(*linear)
    other = relight_photographs(photographs, seed=2, slides=photographs)
    assert first.dtype == torch.uint8
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("options", [{"strength": 0.5}, {"slides": ..., "lights": ["linear"]}])
def test_settings_that_would_not_count_are_refused(photographs, options):
    given = {name: photographs if value is ... else value for name, value in options.items()}
    with pytest.raises(InputError, match=f"^{next(iter(given))} "):
        relight_photographs(photographs, **given)


def find_bright(images):
    """Detect the left and the right half of each image, if their green light is above 0.4."""
    boxes = torch.tensor([[0.0, 0, 8, 16], [8, 0, 16, 16]])
    halves = images[:, 1].unflatten(-1, (2, 8)).mean((1, 3))
    labels, scores = torch.tensor([0, 1]), (10 * (halves - 0.4)).sigmoid()
    return [{"boxes": boxes, "labels": labels, "scores": one} for one in scores]


def test_what_a_detector_finds_in_unchanged_photographs_is_attacked_one_by_one(photographs):
    photographs, settings = photographs[:4], replace(SETTINGS, slides=1)
    options = {"classes": ["a", "b"], "task": nb.Detection(threshold=0.5)}
    result = attack_photographs(find_bright, photographs, settings, **options)
    halves = (photographs[:, 1].float() / 255).unflatten(-1, (2, 8)).mean((1, 3))
    index, source = (halves >= 0.4).nonzero(as_tuple=True)
    assert torch.equal(result.index, index)
    assert torch.equal(result.source, source)
    for row, light in product(range(len(index)), result.changed):
        image = to_unit(result.image(row, light))
        is_found = find_bright(image[None])[0]["scores"][source[row]] >= 0.5
        expected = int(source[row]) if is_found else 2
        assert int(result.predicted[light][row, 0]) == expected
    assert result.kept("adversarial").sum() < result.kept("slide").sum()
    few = attack_photographs(find_bright, photographs, settings, limit=2, **options)
    assert few.index.tolist() == [int(index[0]), int(index[-1])]


def test_each_segment_of_a_photograph_is_attacked_by_itself(photographs):
    def find_green(images):
        green = 20 * (images[:, 1] - 0.3)
        return torch.stack([0 * green, green], dim=1)

    classes = ["background", "green"]
    settings = replace(SETTINGS, slides=1)
    result = attack_photographs(find_green, photographs, settings, classes=classes)
    area = (find_green(to_unit(photographs)).argmax(1) == 1).float().mean((1, 2))
    assert result.index.tolist() == (area >= 0.01).nonzero()[:, 0].tolist()
    assert (result.source == 1).all()
    assert result.kept("adversarial").sum() <= result.kept("slide").sum()
