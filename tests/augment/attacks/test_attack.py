"""`augment.attack`: what it changes, towards which classes, and what it refuses."""

import pytest
import torch
from torch import Tensor

import augment
from augment.losses import adversarial_cost
from augment.parameter_settings import PARAMETER_NAMES
from renderer.errors import InputError
from renderer.light.nonnegative import project_nonnegative
from renderer.light.presets import directional

SHARED = {"views": 2, "shared": True}


@pytest.mark.parametrize("parameters", [*PARAMETER_NAMES, "lighting+geometry+pixels"])
def test_every_parameter_alone_and_with_others_lowers_the_cost_of_its_own_images(
    attacked, by_color, parameters
):
    """The numbers are those of the images: the cost and the predictions follow from the logits."""
    result = attacked(parameters, {"backgrounds": [0.4, 0.5]}, max_steps=3)
    assert [parameter.name for parameter in result.problem.parameters] == parameters.split("+")
    assert result.images.shape == (2, 1, 3, 8, 8)
    assert (result.descent.cost < result.descent.cost_before).all() and (result.steps > 0).all()
    for images, logits, cost in [
        (result.images_before, result.logits_before, result.descent.cost_before),
        (result.images, result.logits, result.descent.cost),
    ]:
        assert torch.equal(logits[:, 0], by_color(images[:, 0]))
        # Sums of 64 pixels in another order differ by rounding.
        torch.testing.assert_close(
            cost, adversarial_cost(logits[:, 0], result.criterion.source[:, 0]), rtol=0, atol=1e-4
        )
    assert torch.equal(result.success, result.logits[:, 0].argmax(1) != 0)
    again = result.problem.render(result.descent.values, torch.arange(2))
    torch.testing.assert_close(again.detach(), result.images, rtol=0, atol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("parameters", [*PARAMETER_NAMES, "lighting+geometry+albedo+pixels"])
def test_a_gpu_attacks_as_a_cpu_does_to_rounding(attacked, by_color, parameters):
    """After one step; a gradient's sign may differ where it is nearly zero, hence not every pixel is compared."""
    expected, found = (
        attacked(
            parameters, {"views": 2, "device": device}, by_color.to(device), max_steps=1
        ).descent
        for device in ("cpu", "cuda")
    )
    torch.testing.assert_close(found.cost_before.cpu(), expected.cost_before, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.cost.cpu(), expected.cost, rtol=1e-2, atol=1e-2)
    assert torch.equal(found.success.cpu(), expected.success)


@pytest.mark.parametrize(
    ("target", "labels"),
    [(None, None), ("lime", [1, 1]), (["sky", "lime"], [2, 1]), ("least_likely", None)],
)
def test_targets_are_one_for_all_views_one_each_or_the_least_likely_of_each(
    attacked, target, labels
):
    result = attacked("lighting", SHARED | {"backgrounds": [0.4, 0.5]}, target=target, max_steps=1)
    found = result.criterion.target
    if target == "least_likely":
        assert torch.equal(found, result.logits_before.argmin(2))
    else:
        assert found is None if labels is None else found.tolist() == [labels] * 2
    assert result.criterion.source.tolist() == [[0, 0]] * 2 and result.conditions.light.shape == (
        2,
        49,
        3,
    )


@pytest.mark.parametrize("parameter", ["lighting", "geometry"])
def test_the_same_seed_gives_the_same_result(attacked, parameter):
    """Nothing reaches `sky`, so that a restart is drawn."""
    steps = {parameter: augment.StepSettings("linf", 0.02)}
    first, second = (
        attacked(steps, target="sky", restarts=1, max_steps=2).descent for _ in range(2)
    )
    assert all(torch.equal(value, getattr(second, name)) for name, value in vars(first).items())
    assert first.steps.item() == 4 and not first.success.any()


@pytest.mark.parametrize("bounces", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_final_images_have_the_shadows_of_the_final_shape_and_colors(
    by_color, tmp_path, bounces
):
    choices = {**SHARED, "shadows": True, "bounces": bounces, "rasterizer": "numpy", "width": 2.4}
    scene = augment.build_scene([("solid:cup:3", "orange")], 8, **choices)
    steps = {
        name: augment.StepSettings("linf", 0.05, "sign", 0.03) for name in ("geometry", "albedo")
    }
    result = augment.attack(
        by_color, scene, settings=augment.AttackSettings(**steps, max_steps=2), force=True
    )
    with_initial_shadows = result.problem.images(result.descent.values)
    (line,) = augment.save(result, tmp_path)
    assert (with_initial_shadows - result.images).abs().max() > 0.5 / 255
    assert line["versions"]["reload"]["largest_difference"] < 0.1 / 255


@pytest.mark.parametrize(("parameter", "nonnegative"), [("geometry", True), ("albedo", False)])
def test_the_light_can_be_emitted_whatever_is_attacked_unless_negative_light_is_allowed(
    attacked, parameter, nonnegative, tmp_path
):
    """So that the files, whose maps hold no negative radiance, show the same."""
    result = attacked(parameter, allow_negative=not nonnegative, max_steps=2)
    lights = result.conditions.light
    assert torch.equal(lights, project_nonnegative(lights)) == nonnegative
    augment.save(result, tmp_path)
    assert (tmp_path / "example_000" / "light.exr").is_file() == nonnegative


def test_success_counts_only_where_every_view_was_classified_correctly_before(attacked):
    """Before the dark background the image is misclassified, which the attack has not done."""

    def sky_in_the_dark(images: Tensor) -> Tensor:
        return 30 * images.mean((2, 3)) + 30 * (images[:, :1, 0, 0] < 0.1) * torch.tensor([0, 0, 1])

    dark = augment.Classifier(sky_in_the_dark, 8, ("orange", "lime", "sky"))
    result = attacked("lighting", {"backgrounds": [0.5, 0.0]}, dark, force=True, max_steps=30)
    assert result.clean_correct.tolist() == [True, False] and result.success.tolist() == [
        True,
        True,
    ]


def test_misclassified_examples_and_impossible_targets_are_refused_in_one_sentence(by_color):
    def scene(label: str) -> augment.Scene:
        return augment.build_scene([("solid:orange", label)], 8, rasterizer="numpy", width=2.4)

    with pytest.raises(
        InputError, match=r"1 of 1 images of solid:orange are .* \(the first: orange \d+.\d%, "
    ):
        augment.attack(by_color, scene("lime"))
    assert augment.attack(by_color, scene("lime"), force=True).descent.success_before.all()
    for label, target, message in [
        ("mango", None, "'mango' is not a class of the model"),
        ("lime", ["lime", "sky"], "names 2 classes for 1 views"),
        ("lime", "lime", "target=lime is the right class of an example"),
    ]:
        with pytest.raises(InputError, match=message):
            augment.attack(by_color, scene(label), target, force=True)
    with pytest.raises(InputError, match="name what to attack: one or more of lighting, "):
        augment.attack(by_color, scene("orange"), settings=augment.AttackSettings())


def test_the_warning_of_changed_light_names_the_line_that_attacks(by_color):
    """A directional light of degree 6 is negative on its far side."""
    light = directional(torch.tensor([0.0, 0.0, 1.0]), torch.ones(3))
    scene = augment.build_scene([("solid:orange", "orange")], by_color.size, light=light)
    settings = augment.AttackSettings(
        lighting=augment.StepSettings(), max_steps=1, allow_negative=False
    )
    with pytest.warns(UserWarning) as warnings:
        augment.attack(by_color, scene, settings=settings, force=True)
    changed = [warning for warning in warnings if "irradiance" in str(warning.message)]
    assert [warning.filename for warning in changed] == [__file__]
