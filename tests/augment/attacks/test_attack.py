"""`augment.attack` lowers the cost of what it may change, and refuses impossible requests."""

from copy import deepcopy

import pytest
import torch
from torch import Tensor, nn

import augment
from augment.attack_settings import NORMS, OPTIMIZERS, PARAMETER_NAMES
from augment.attacks.problem import build_problem
from augment.tasks.classification import ClassCriterion
from renderer.errors import InputError
from renderer.image import to_bytes, to_unit
from renderer.light.nonnegative import project_nonnegative

SHARED = {"views": 2, "shared": True}
TWO_BACKGROUNDS = {"backgrounds": [0.4, 0.5]}


@pytest.fixture(scope="module", params=[*PARAMETER_NAMES, "lighting+geometry+pixels"])
def result(request, attacked) -> augment.AttackResult:
    done = attacked(request.param, TWO_BACKGROUNDS, max_steps=3)
    assert [parameter.name for parameter in done.problem.parameters] == request.param.split("+")
    return done


def test_every_parameter_alone_and_with_others_lowers_the_cost(result):
    assert (result.minimum.cost < result.minimum.cost_before).all()
    assert (result.steps > 0).all()


def test_logits_costs_and_success_are_those_of_the_images(result, by_color):
    assert result.images.shape == (2, 3, 8, 8)
    labels = result.criterion.source[:, 0]
    before = (result.images_before, result.logits_before, result.minimum.cost_before)
    after = (result.images, result.logits, result.minimum.cost)
    for images, logits, cost in (before, after):
        assert torch.equal(logits, by_color(images))
        expected = ClassCriterion(labels).cost(logits)
        # Sums of 64 pixels in another order differ by rounding.
        torch.testing.assert_close(cost, expected, rtol=0, atol=1e-4)
    assert torch.equal(result.success, result.logits.argmax(1) != 0)


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_the_sums_of_images_and_attacked_offsets_are_images(attacked, optimizer, norm):
    """Nothing reaches the target, so that a restart is drawn."""
    steps = {"pixels": augment.StepSettings(norm, 0.3, step_size=0.2)}
    scene = SHARED | {"backgrounds": [0.0, 1.0]}
    options = {"max_queries": 120, "max_steps": 4, "margin": 1e4, "restarts": 1, "force": True}
    result = attacked(steps, scene, target="sky", optimizer=optimizer, **options)
    before = result.images_in_views_before.flatten(1)
    starts = result.problem.sample(torch.Generator().manual_seed(0))
    for offsets in (result.minimum.values, starts):
        assert offsets.any(1).all()
        low, high = (before + offsets).aminmax()
        assert 0 <= low <= high <= 1


def test_inference_mode_changes_no_attack(attacked):
    expected = attacked("lighting", {}, max_steps=3)
    with torch.inference_mode():
        found = attacked("lighting", {}, max_steps=3)
        augment.success_by_radius(found, [0.5])
    assert torch.equal(found.minimum.values, expected.minimum.values)


def test_the_images_are_those_of_the_values(result):
    images = result.problem.render(result.minimum.values, torch.arange(2))
    torch.testing.assert_close(images.detach(), result.images_in_views, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("views", "dimensions"), [(1, ()), (2, (2,))])
def test_only_several_views_have_a_dimension_in_results(
    attacked, by_color, tmp_path, views, dimensions
):
    scene = {"views": views, "shared": True, "backgrounds": [0.2, 0.4, 0.6]}
    result = attacked("lighting", scene, by_color, max_steps=0)
    assert result.images.shape == result.images_before.shape == (3, *dimensions, 3, 8, 8)
    assert result.logits.shape == result.logits_before.shape == (3, *dimensions, 4)
    assert torch.equal(result.images, result.images_in_views.view(result.images.shape))
    augment.save(result, tmp_path, verify=())
    adversary = augment.reload(tmp_path / "example_002")
    assert torch.equal(adversary.images, result.images[2])
    assert adversary.render().shape == result.images[2].shape


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("parameters", [*PARAMETER_NAMES, "lighting+geometry+albedo+pixels"])
def test_a_gpu_attacks_as_a_cpu_does_to_rounding(attacked, by_color, parameters):
    """Gradients that are nearly zero may differ in sign, so that pixels are not compared."""
    results = []
    for device in ("cpu", "cuda"):
        scene = {"views": 2, "device": device}
        results.append(attacked(parameters, scene, by_color.to(device), max_steps=1).minimum)
    expected, found = results
    cost_before = found.cost_before.cpu()
    torch.testing.assert_close(cost_before, expected.cost_before, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.cost.cpu(), expected.cost, rtol=1e-2, atol=1e-2)
    assert torch.equal(found.success.cpu(), expected.success)


@pytest.mark.parametrize(
    ("target", "labels"), [("lime", [1, 1]), (["sky", "lime"], [2, 1]), ("least_likely", None)]
)
def test_a_target_is_one_class_for_all_views_or_one_for_each(attacked, target, labels):
    result = attacked("lighting", SHARED | TWO_BACKGROUNDS, target=target, max_steps=1)
    expected = [labels] * 2 if labels else result.logits_before.argmin(2).tolist()
    assert result.criterion.target.tolist() == expected
    assert result.criterion.source.tolist() == [[0, 0]] * 2
    assert result.conditions.light.shape == (2, 49, 3)


def test_the_same_seed_gives_the_same_result(attacked):
    """Nothing reaches the target, so that a restart is drawn."""
    steps = {"lighting": augment.StepSettings("linf", 0.02)}
    options = {"target": "sky", "restarts": 1, "max_steps": 2}
    first = attacked(steps, **options).minimum
    second = attacked(steps, **options).minimum
    assert first.steps.item() == 4
    assert not first.success.any()
    for name, value in vars(first).items():
        assert torch.equal(value, getattr(second, name)), name


@pytest.mark.parametrize("bounces", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_final_images_have_the_shadows_of_the_final_shape_and_colors(by_color, tmp_path, bounces):
    options = {"shadows": True, "bounces": bounces, "rasterizer": "numpy", "width": 2.4}
    scene = augment.build_scene([("solid:cup:3", "orange")], 8, **SHARED, **options)
    steps = augment.StepSettings("linf", 0.05, "sign", 0.03)
    settings = augment.AttackSettings(geometry=steps, albedo=steps, max_steps=2)
    result = augment.attack(by_color, scene, settings=settings, force=True)
    with_initial_shadows = result.problem.images(result.minimum.values)
    assert (with_initial_shadows - result.images_in_views).abs().max() > 0.5 / 255
    (line,) = augment.save(result, tmp_path)
    assert line["versions"]["reload"]["largest_difference"] < 0.1 / 255


@pytest.mark.parametrize(("parameter", "nonnegative"), [("geometry", True), ("albedo", False)])
def test_light_is_nonnegative_unless_negative_light_is_allowed(
    attacked, parameter, nonnegative, tmp_path
):
    """Only then can an environment map show it."""
    result = attacked(parameter, allow_negative=not nonnegative, max_steps=2)
    lights = result.conditions.light
    assert torch.equal(lights, project_nonnegative(lights)) == nonnegative
    augment.save(result, tmp_path)
    assert (tmp_path / "example_000" / "light.exr").is_file() == nonnegative


def sky_in_the_dark(images: Tensor) -> Tensor:
    is_dark = images[:, :1, 0, 0] < 0.1
    return 30 * images.mean((2, 3)) + 30 * is_dark * torch.tensor([0, 0, 1])


def test_success_counts_only_for_examples_that_were_classified_correctly_before(attacked):
    classifier = augment.Classifier(sky_in_the_dark, 8, ("orange", "lime", "sky"))
    scene = {"backgrounds": [0.5, 0.0]}
    result = attacked("lighting", scene, classifier, force=True, max_steps=30)
    assert result.clean_correct.tolist() == [True, False]
    assert result.success.tolist() == [True, False]


def test_a_network_in_training_mode_is_scored_in_eval_mode_and_stays_as_it_was(tmp_path):
    network = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.Flatten(), nn.Linear(144, 3))
    classifier = augment.Classifier(network, 8, ("orange", "lime", "sky"))
    other = augment.Classifier(deepcopy(network), 8, classifier.classes)
    network.train()
    state = deepcopy(network.state_dict())
    settings = augment.AttackSettings(lighting=augment.StepSettings(step_size=0.5), max_steps=2)
    result = augment.attack(classifier, orange_labeled("orange"), settings=settings, force=True)
    torch.testing.assert_close(result.logits_before, other(to_unit(to_bytes(result.images_before))))
    augment.transfer(result, [classifier])
    augment.save(result, tmp_path, verify=())
    assert all(module.training for module in network.modules())
    for name, value in network.state_dict().items():
        assert torch.equal(value, state[name]), name


@pytest.mark.parametrize(
    ("dtype", "optimizer"), [(torch.bfloat16, "gradient"), (torch.float16, "random_search")]
)
def test_a_network_may_return_logits_in_half_precision(tmp_path, dtype, optimizer):
    """The logits are rounded: their differences to float32 are at most ε / 2 of their size."""

    def half_logits(images):
        mean = images.mean((1, 2, 3))
        return torch.stack([mean, 0.3 + 0 * mean], dim=1).to(dtype)

    options = {"max_queries": 40, "allow_negative": True, "eot": augment.EOTSettings(draws=1)}
    lighting = augment.StepSettings(step_size=0.5)
    settings = augment.AttackSettings(lighting=lighting, optimizer=optimizer, **options)
    scene = augment.build_scene([("solid:orange", 0)], 8)
    result = augment.attack(half_logits, scene, settings=settings)
    assert result.logits.dtype == torch.float32
    brightness = to_unit(to_bytes(result.images)).mean((1, 2, 3))
    torch.testing.assert_close(
        result.logits[:, 0], brightness, rtol=torch.finfo(dtype).eps / 2, atol=1e-6
    )
    assert (result.minimum.cost < result.minimum.cost_before).all()
    augment.save(result, tmp_path, verify=())


def orange_labeled(label: str) -> augment.Scene:
    return augment.build_scene([("solid:orange", label)], 8, rasterizer="numpy", width=2.4)


def test_misclassified_examples_are_refused_unless_the_attack_is_forced(by_color):
    scene = orange_labeled("lime")
    with pytest.raises(InputError, match=r"1 of 1 images .*solid:orange"):
        augment.attack(by_color, scene)
    assert augment.attack(by_color, scene, force=True).minimum.success_before.all()


def test_the_least_likely_class_is_never_the_true_one(by_color):
    settings = augment.AttackSettings(lighting=augment.StepSettings(), max_steps=0)
    scene = orange_labeled("night")
    result = augment.attack(by_color, scene, "least_likely", settings, force=True)
    assert result.logits_before.argmin() == 3
    assert result.criterion.target.item() == result.logits_before[0, :3].argmin()


LIT = {"degree": 6, "width": 3.0, "light": "uniform"}
WIDE = {
    "projector": ({"projector": {"pixels": 8, "pattern": 0.3}}, augment.StepSettings),
    "lamps": ({"lamps": {"start": 5.0}}, augment.StepSettings),
    "positions": ({"lamps": {"start": 5.0}}, augment.StepSettings),
    "pose": ({"silhouettes": True}, augment.PoseSettings),
    "material": ({}, augment.MaterialSettings),
}


@pytest.mark.parametrize("name", WIDE)
def test_an_attack_on_wide_images_has_the_middle_rows_of_square_images(by_color, name):
    options, kind = WIDE[name]
    network = augment.Classifier(by_color.network, (4, 8), by_color.classes)
    meshes = [("solid:orange", "orange")]
    scene = augment.build_scene(meshes, network.size, **LIT, **options)
    settings = {name: kind("linf", 0.5, "sign", 0.25), "max_steps": 2, "margin": 100.0}
    result = augment.attack(network, scene, settings=augment.AttackSettings(**settings), force=True)
    square = augment.build_scene(meshes, 8, **LIT, **options)
    problem = build_problem(result.settings, square)
    middle = problem.images(result.minimum.values)[..., 2:6, :]
    assert not torch.equal(result.images, result.images_before)
    torch.testing.assert_close(result.images_in_views, middle, rtol=0, atol=1e-5)
