import numpy as np
import pytest
import torch
from scipy.special import softmax
from torch import nn

import augment
from augment.attack_settings import PARAMETER_NAMES
from augment.attacks.problem import SceneProblem
from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from renderer.light.files import load_light
from renderer.light.nonnegative import project_nonnegative

LIGHTING = augment.StepSettings("linf", 0.2)
OPTIMIZERS = ["random_search", "cma_es"]
BALLS = [augment.StepSettings("linf", 0.05), augment.StepSettings("l2", 0.2)]


@pytest.mark.parametrize(("optimizer", "ball"), [*zip(OPTIMIZERS, BALLS, strict=True)])
def test_no_candidate_leaves_the_ball_or_has_negative_light(attacked, monkeypatch, optimizer, ball):
    rendered = []
    render = SceneProblem.render

    def record(problem, values, *arguments, **options):
        rendered.append(values)
        return render(problem, values, *arguments, **options)

    monkeypatch.setattr(SceneProblem, "render", record)
    result = attacked(
        {"lighting": ball}, optimizer=optimizer, max_queries=20, margin=100.0, allow_negative=False
    )
    values = torch.cat(rendered)
    offsets = values - result.problem.start
    order = torch.inf if ball.norm == "linf" else 2
    # Float32 rounds the center plus the radius.
    assert offsets.norm(order, dim=1).max() <= ball.radius * (1 + 1e-4)
    assert offsets.norm(order, dim=1).max() > ball.radius / 2
    lights = values.unflatten(1, (-1, 3))
    torch.testing.assert_close(project_nonnegative(lights), lights, rtol=0, atol=1e-5)


@pytest.mark.parametrize("parameter", PARAMETER_NAMES)
def test_search_lowers_the_cost_of_every_parameter(attacked, parameter):
    result = attacked(parameter, optimizer="random_search", max_queries=20, margin=100.0)
    assert result.minimum.cost < result.minimum.cost_before
    assert not result.minimum.zero_gradient.any()


def logits_of_means(images: np.ndarray) -> np.ndarray:
    assert isinstance(images, np.ndarray)
    return 30 * np.stack([images[:, 0].mean((1, 2)), images[:, 2].mean((1, 2))], axis=1)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(("optimizer", "noise"), [("random_search", 1.0), ("cma_es", 0.0)])
@pytest.mark.filterwarnings("ignore:the light is negative")
def test_queries_are_the_images_that_a_function_was_given_each_once(optimizer, noise, shared):
    seen = []

    def function(images: np.ndarray) -> np.ndarray:
        scores = logits_of_means(images) + np.array([0, 7.5])
        seen.extend(image.tobytes() for image in images)
        return scores

    options = {"shared": shared, "rasterizer": "numpy"}
    if shared:  # Similar views are fooled together.
        options["cameras"] = [OrthographicCamera(60.0, azimuth, 2.2) for azimuth in (0.0, 2.0)]
    scene = augment.build_scene([("solid:orange", 0)], 8, views=2, **options)
    options = {"max_queries": 40, "allow_negative": True, "quantized": False, "noise_margin": 1.0}
    options |= {"optimizer": optimizer, "sensor_noise": noise}
    settings = augment.AttackSettings(lighting=LIGHTING, **options)
    gray = 2  # images with which the network is checked
    result = augment.attack(function, scene, settings=settings, force=True)
    probes = 1
    assert result.success[0]  # so that images with noise are counted, too
    assert len(seen) == int(result.queries.sum()) + gray + probes
    assert len(set(seen)) >= int(result.queries.sum())
    assert result.backward_passes.tolist() == [0] * len(scene)
    assert (result.minimum.queries <= 40).all()


@pytest.mark.parametrize("optimizer", ["gradient", *OPTIMIZERS])
@pytest.mark.parametrize("max_queries", [1, 20])
def test_all_starts_together_show_at_most_that_number_of_images(attacked, optimizer, max_queries):
    steps = {"lighting": augment.StepSettings("l2", 0.1)}
    options = {"optimizer": optimizer, "restarts": 2, "margin": 100.0}
    result = attacked(steps, max_queries=max_queries, **options)
    assert not result.success.any()
    assert (result.queries <= max_queries).all()
    expected = result.queries if optimizer == "gradient" else 0 * result.queries
    assert torch.equal(result.backward_passes, expected)
    if optimizer != "cma_es" and max_queries > 1:
        # The share is used up. The first start shows the initial image without a step.
        share = max_queries // 3
        assert result.queries.item() == 3 * share
        assert result.steps.item() == 3 * (share - 1)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:You are using the legacy")
def test_a_numpy_function_and_a_file_of_onnx_give_the_adversary_of_the_torch_network(tmp_path):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        layers = [nn.Flatten(), nn.Linear(192, 8), nn.ReLU(), nn.Linear(8, 3)]
        network = nn.Sequential(*layers).eval()
    weights = [parameter.detach().numpy() for parameter in network.parameters()]

    def numpy_network(images: np.ndarray) -> np.ndarray:
        features = np.maximum(images.reshape(-1, 192) @ weights[0].T + weights[1], 0)
        return features @ weights[2].T + weights[3]

    path = tmp_path / "network.onnx"
    options = {"input_names": ["images"], "dynamic_axes": {"images": {0: "N"}}}
    torch.onnx.export(network, (torch.rand(1, 3, 8, 8),), path, dynamo=False, **options)
    search = {"optimizer": "random_search", "max_queries": 40, "allow_negative": True}
    functions = [network, numpy_network, augment.load_classifier(str(path))]
    torch_result, *others = [attack_orange(function, **search) for function in functions]
    assert torch_result.minimum.cost < torch_result.minimum.cost_before
    for other in others:
        assert torch.equal(other.minimum.values, torch_result.minimum.values)
        torch.testing.assert_close(other.logits, torch_result.logits, rtol=1e-4, atol=1e-5)


def attack_orange(network, classes=None, **settings) -> augment.AttackResult:
    scene = augment.build_scene([("solid:orange", 0)], 8, rasterizer="numpy")
    chosen = augment.AttackSettings(lighting=LIGHTING, **settings)
    return augment.attack(network, scene, settings=chosen, classes=classes, force=True)


def test_a_function_without_gradients_is_attacked_by_random_search_with_one_sentence():
    with pytest.warns(UserWarning, match="random search attacks it with at most 5 queries"):
        result = attack_orange(logits_of_means, max_queries=5)
    assert result.settings.optimizer == "random_search"


class Changed(nn.Module):
    """A network with weights that gets images of which a function lost the gradient."""

    def __init__(self, change):
        super().__init__()
        self.change, self.scale = change, nn.Parameter(torch.tensor(30.0))

    def forward(self, images):
        means = self.change(images).mean((2, 3))
        return self.scale * means[:, [0, 2]]


LOSSES = {
    "bytes": lambda images: (images * 255).round().byte() / 255,
    "detached": lambda images: images.detach(),
    "rounded": lambda images: (images * 255).round() / 255,
}


@pytest.mark.parametrize("lost", LOSSES)
@pytest.mark.parametrize("is_module", [True, False])
def test_networks_whose_images_lose_their_gradient_are_searched_or_refused(lost, is_module):
    network = Changed(LOSSES[lost]).eval()
    given = network if is_module else lambda images: network(images)
    with pytest.warns(UserWarning, match="random search attacks it"):
        result = attack_orange(given, ["red", "blue"], max_queries=5)
    assert result.settings.optimizer == "random_search"
    if lost != "rounded":
        with pytest.raises(InputError, match="without a gradient"):
            attack_orange(given, ["red", "blue"], optimizer="gradient")
        service = augment.AugmentationService.from_meshes([("solid:orange", 0)], 8, views=1)
        with pytest.raises(InputError, match="without a gradient"):
            service.regenerate(network, 0)


@pytest.mark.parametrize("is_plain", [True, False])
def test_a_function_that_takes_only_the_scenes_dtype_keeps_its_gradients(make_linear, is_plain):
    network = make_linear(2).eval()

    def function(images):
        return network(images)  # float64 alone

    light = load_light("grace").double()
    scene = augment.build_scene([("solid:orange", 0)], 6, light=light, rasterizer="numpy")
    settings = augment.AttackSettings(lighting=augment.StepSettings(step_size=0.5), max_steps=2)
    attacked = function if is_plain else augment.Classifier(function, 6, ["0", "1"])
    result = augment.attack(attacked, scene, settings=settings, force=True)
    assert result.settings.optimizer is None
    expected = augment.attack(network, scene, settings=settings, force=True)
    assert torch.equal(result.images, expected.images)
    assert (result.backward_passes > 0).all()


@pytest.mark.parametrize(
    "function",
    [
        lambda images: images.mean((2, 3)),
        lambda images: images.numpy().mean((2, 3)),
        lambda images: np.asarray(images, dtype=np.float64).mean((2, 3)).tolist(),
        lambda images: images.astype(np.float32).mean(axis=(2, 3)),
    ],
    ids=["tensors", "tensors to arrays", "lists", "arrays"],
)
def test_a_function_may_take_and_return_tensors_or_arrays(function):
    classifier = augment.Classifier(function, 4, ["red", "green", "blue"])
    images = torch.rand(2, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    for _ in range(2):
        torch.testing.assert_close(classifier(images), images.mean((2, 3)))


def test_a_function_of_arrays_may_call_a_network_in_mixed_precision():
    """NumPy has no bfloat16, which autocast would return from the network in the function."""
    network = torch.nn.Linear(3, 2).eval()
    classifier = augment.Classifier(
        lambda images: network(torch.from_numpy(images.mean((2, 3)))).detach().numpy(),
        4,
        ["a", "b"],
    )
    images = torch.rand(2, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    with torch.autocast("cpu", torch.bfloat16):
        scores = classifier(images)
    torch.testing.assert_close(scores, network(images.mean((2, 3))))


@pytest.mark.parametrize(
    ("class_count", "rounded"),
    [(3, lambda scores: np.round(scores, 3)), (100, lambda scores: scores.astype(np.float16))],
    ids=["three decimals", "float16"],
)
def test_rounded_probabilities_become_their_logarithms(class_count, rounded):
    logits = np.random.default_rng(1).normal(size=(6, class_count))
    logits[0] = 0.0  # Three equal probabilities are rounded to 0.333.
    probabilities = rounded(softmax(logits, axis=1))
    deviation = probabilities.astype(np.float64).sum(1) - 1
    assert np.abs(deviation).max() > 1e-5
    classes = [str(index) for index in range(class_count)]
    classifier = augment.Classifier(lambda images: probabilities, 4, classes)
    found = classifier(torch.full((6, 3, 4, 4), 0.5)).exp()
    torch.testing.assert_close(found, torch.from_numpy(probabilities).float())


@pytest.mark.parametrize("is_enough", [True, False])
def test_cma_es_warns_exactly_if_the_queries_of_a_start_pay_for_no_step(
    attacked, caplog, is_enough
):
    steps = {"lighting": augment.StepSettings("l2", 0.1)}
    options = {"optimizer": "cma_es", "restarts": 1, "margin": 100.0}
    result = attacked(steps, max_queries=200 if is_enough else 18, **options)
    assert (result.steps > 0).all() == is_enough
    assert ("max_queries" in caplog.text) != is_enough
