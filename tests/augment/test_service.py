import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment.attack_settings import StepSettings
from augment.augmentation_settings import (
    AugmentationSettings,
    RandomLightSettings,
    TrainingAttackSettings,
    VariationSettings,
)
from augment.progress import Phases
from augment.scene.build import build_scene
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from augment.service import AugmentationService
from augment.settings import SceneSettings
from augment.tasks.classification import complementary_label
from renderer.errors import InputError
from renderer.light.files import probe
from renderer.solids import solid

EPS32 = torch.finfo(torch.float32).eps
LIGHT = probe("grace")
CLASSES = {"plate": 0, "table": 2}
EXAMPLE_COUNT = 100
SHORT = TrainingAttackSettings(max_steps=5)
LONG = TrainingAttackSettings(max_steps=30, step_size=0.5)


def built(views: int, *backgrounds: float) -> Scene:
    meshes = [(f"solid:{name}", name) for name in CLASSES]
    options = {"normals": "flat", "rasterizer": "numpy"}
    return build_scene(meshes, 8, views, backgrounds=backgrounds, **options)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Return 2 meshes × 10 views × 5 backgrounds, as in the paper."""
    return built(10, 0, 0.25, 0.5, 0.75, 1)


def render(scene: Scene, lights: Tensor) -> Tensor:
    return scene.render(Conditions(lights), torch.arange(len(scene)))[:, 0]


def render_in(scene: Scene, light: Tensor) -> Tensor:
    return render(scene, light.expand(len(scene), -1, -1))


@pytest.fixture(scope="module")
def labels(scene) -> Tensor:
    return torch.tensor([CLASSES[label] for label in scene.labels])


@pytest.fixture(scope="module")
def model(scene, labels) -> nn.Module:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        layers = [nn.Conv2d(3, 16, 3, padding=1), nn.BatchNorm2d(16), nn.ReLU(), nn.Dropout(0.1)]
        network = nn.Sequential(*layers, nn.Flatten(), nn.Linear(1024, 3))
        optimizer = torch.optim.Adam(network.parameters(), lr=0.003)
        images = render_in(scene, LIGHT)
        for _ in range(60):
            optimizer.zero_grad()
            F.cross_entropy(network(images), labels).backward()
            optimizer.step()
    return network


@pytest.fixture
def serve(scene, labels):
    def build(
        seed: int = 0, labels: Tensor = labels, positive_classes: tuple[int, ...] = (), **settings
    ) -> AugmentationService:
        choices = AugmentationSettings(**{"attack": SHORT, **settings})
        return AugmentationService(choices, scene, labels, seed, Phases(), positive_classes)

    return build


@torch.no_grad()
def logits_of(model: nn.Module, images: Tensor) -> Tensor:
    logits = model.eval()(images)
    model.train()
    return logits


@pytest.mark.parametrize("settings", [{"mode": "none"}, {"mode": "random", "examples": 0}])
def test_without_an_arm_or_examples_there_are_no_renders_and_no_scene_is_needed(model, settings):
    no_labels = torch.zeros(0, dtype=torch.int64)
    service = AugmentationService(AugmentationSettings(**settings), None, no_labels, 0, Phases())
    renders = service.regenerate(model, 0)
    assert (len(renders.images), len(renders.labels), renders.diagnostics) == (0, 0, {})


@pytest.mark.parametrize("options", [{"mode": "random"}, {"mode": "adversarial", "init": "random"}])
def test_the_seed_and_the_epoch_decide_the_draw(serve, model, options):
    images = serve(seed=1, **options).regenerate(model, 3).images
    resumed = serve(seed=1, **options)
    resumed.regenerate(model, 2)
    torch.rand(5)
    assert torch.equal(resumed.regenerate(model, 3).images, images)
    assert not torch.equal(resumed.regenerate(model, 4).images, images)
    assert not torch.equal(serve(seed=2, **options).regenerate(model, 3).images, images)


def test_renders_that_are_made_in_inference_mode_can_be_trained_on(serve, model):
    settings = {"mode": "adversarial", "init": "random"}
    expected = serve(**settings).regenerate(model, 0).images
    with torch.inference_mode():
        images = serve(**settings).regenerate(model, 0).images
    assert torch.equal(images, expected) and not images.is_inference()


class Always(nn.Module):
    def __init__(self, label: int):
        super().__init__()
        self.bias = 5 * F.one_hot(torch.tensor(label), 3)

    def forward(self, images: Tensor) -> Tensor:
        return images.mean((2, 3)) + self.bias


@pytest.mark.parametrize(("examples", "shown"), [(3, 3), (None, 7), (10, 10)])
def test_all_images_of_a_folder_are_shown_before_any_is_shown_again(examples, shown):
    """21 rounds show seven images of bytes that are filled with their own index."""
    indices = torch.arange(7)
    images = indices.byte()[:, None, None, None].expand(-1, 3, 8, 8)
    settings = AugmentationSettings(mode="folder", folder="unread", examples=examples)
    service = AugmentationService(settings, None, indices % 3, 5, Phases(), images=images)
    assert len(service) == shown
    rounds = [service.regenerate(Always(0), number) for number in range(21)]
    shown_images = torch.cat([renders.images[:, 0, 0, 0] for renders in rounds])
    shown_indices = (255 * shown_images).round().long()
    passes = shown_indices.view(3 * shown, 7)
    assert torch.equal(passes.sort(1).values, indices.expand_as(passes))
    assert len(passes.unique(dim=0)) > 1
    assert torch.equal(torch.cat([renders.labels for renders in rounds]), shown_indices % 3)
    error_rate = (rounds[4].labels > 0).float().mean()
    assert rounds[4].diagnostics["attack_success"] == pytest.approx(float(error_rate))


@pytest.mark.parametrize("classified, rows", [(250, [*range(EXAMPLE_COUNT)]), (4, [0, 33, 66, 99])])
def test_diagnostics_of_random_light_count_its_images(serve, model, monkeypatch, classified, rows):
    monkeypatch.setattr("augment.service.CLASSIFIED", classified)
    renders = serve(mode="random").regenerate(model, 0)
    labels = renders.labels[rows]
    logits = logits_of(model, renders.images[rows])
    error_rate = (logits.argmax(1) != labels).double().mean()
    assert renders.diagnostics["attack_success"] == pytest.approx(float(error_rate))
    loss = F.cross_entropy(logits.double(), labels)
    assert renders.diagnostics["loss"] == pytest.approx(float(loss), rel=100 * EPS32)


def test_random_light_changes_by_half_of_a_unit_or_by_its_radius(serve, model):
    uniform = serve(mode="random").regenerate(model, 0)
    # The norm of 147 numbers in ±1/2 is 3.5. Its standard deviation over 100 examples is 0.013.
    expected = pytest.approx(math.sqrt(147 / 12), abs=5 * 0.013)
    assert uniform.diagnostics["light_change"] == expected
    settings = RandomLightSettings(radius=1.5)
    in_a_ball = serve(mode="random", random_light=settings).regenerate(model, 0)
    assert in_a_ball.diagnostics["light_change"] == pytest.approx(1.5, rel=8 * EPS32)


PAPER_STEPS = 10
PAPER_STEP_SIZE = 0.05


def papers_loop(model, scene, labels, step: str) -> tuple[Tensor, dict[str, Tensor]]:
    """Run the paper's loop; return the images, and what the service reports of each example."""
    lights = LIGHT.repeat(len(scene), 1, 1)
    step_counts = torch.zeros_like(labels)
    before = []
    for number in range(PAPER_STEPS + 1):
        lights.requires_grad_(True)
        images = render(scene, lights)
        logits = model(images)
        # Float32 loses digits of 1 − p, which is the gradient of a class with the probability p.
        losses = F.cross_entropy(logits.double(), labels, reduction="none")
        success = logits.argmax(1) != labels
        before.append((success, losses.detach()))
        if number == PAPER_STEPS:
            break
        (gradient,) = torch.autograd.grad(losses.sum(), lights)
        unit = gradient / gradient.flatten(1).norm(dim=1)[:, None, None]
        moved = lights + PAPER_STEP_SIZE * (gradient.sign() if step == "sign" else unit)
        lights = torch.where(success[:, None, None], lights, moved).detach()
        step_counts += ~success
    reported = {"attack_success": success, "loss": losses.detach(), "steps": step_counts}
    reported["attack_success_before"], reported["loss_before"] = before[0]
    reported["used_all_steps"] = step_counts == PAPER_STEPS
    reported["light_change"] = (lights - LIGHT).detach().flatten(1).norm(dim=1)
    return images.detach(), reported


@pytest.mark.parametrize("step", ["unit", "sign"])
def test_adversarial_images_are_those_of_the_papers_loop(serve, model, scene, labels, step):
    settings = TrainingAttackSettings(step=step, max_steps=PAPER_STEPS, batch_size=32)
    renders = serve(attack=settings).regenerate(model, 0)
    images, diagnostics = papers_loop(model.eval(), scene, labels, step)
    model.train()
    # Ten steps of products in another order, through a network that amplifies their rounding.
    torch.testing.assert_close(renders.images, images, rtol=0, atol=10 * 64 * EPS32)
    for name, values in diagnostics.items():
        expected = pytest.approx(float(values.double().mean()), rel=1e-4)
        assert renders.diagnostics[name] == expected, name
    assert 0 < renders.diagnostics["attack_success"] < 1
    assert renders.diagnostics["zero_gradient"] == 0


def test_steps_of_restarts_count_among_all_steps(serve, model):
    """No step of this length changes a prediction, so each example that is attacked uses all."""
    settings = TrainingAttackSettings(
        lighting=StepSettings("l2", radius=1e-9, step_size=1e-9), max_steps=2, restarts=1
    )
    diagnostics = serve(attack=settings).regenerate(model, 0).diagnostics
    assert diagnostics["attack_success_before"] < 1
    assert diagnostics["used_all_steps"] == 1 - diagnostics["attack_success_before"]
    assert diagnostics["steps"] == 4 * diagnostics["used_all_steps"]


WARM = {"warm_start": True, "init": "random"}


def test_a_warm_start_continues_the_last_attack(serve, model):
    service = serve(**WARM)
    first = service.regenerate(model, 0).diagnostics
    second = service.regenerate(model, 1).diagnostics
    assert second["loss_before"] == pytest.approx(first["loss"], rel=8 * EPS32)
    assert second["attack_success_before"] == first["attack_success"]
    assert second["loss"] > first["loss"]


def test_the_state_of_another_attack_is_refused_when_it_is_loaded(serve, model):
    service, other = (
        serve(**WARM, attack=TrainingAttackSettings(**{name: StepSettings("l2", 0.1)}))
        for name in ("lighting", "albedo")
    )
    service.regenerate(model, 0)
    with pytest.raises(InputError, match="state"):
        other.load_state_dict(service.state_dict())


def test_a_service_that_always_starts_again_leaves_the_last_attack_of_a_state(serve, model):
    warm, resumed = serve(warm_start=True), serve()
    warm.regenerate(model, 0)
    resumed.load_state_dict(warm.state_dict())
    images = serve().regenerate(model, 1).images
    assert torch.equal(resumed.regenerate(model, 1).images, images)


def test_a_warm_start_in_another_environment_lies_in_the_ball_around_it(serve):
    """Every example is misclassified as class 1, so that no step projects its values."""
    vary = VariationSettings(environments=["grace", "eucalyptus", "st_peters"])
    attack = TrainingAttackSettings(lighting=StepSettings("l2", 0.1), max_steps=2)
    service = serve(warm_start=True, vary=vary, attack=attack)
    for number in range(3):
        diagnostics = service.regenerate(Always(1), number).diagnostics
        assert diagnostics["steps"] == 0
        assert diagnostics["light_change"] <= 0.1 * (1 + 64 * EPS32)


@pytest.mark.parametrize("mode", ["random", "adversarial"])
def test_both_arms_change_shape_and_albedo_within_their_norm_balls(model, mode):
    """Shapes are rasterized in every step, so that one view before one background is enough."""
    steps = {"geometry": StepSettings("linf", 0.02, "sign", 0.01)}
    steps["albedo"] = StepSettings("linf", 0.1, "sign", 0.05)
    attack = TrainingAttackSettings(**steps, max_steps=2, backtracking=True)
    scene = built(1, 0.5)
    labels = torch.tensor(list(CLASSES.values()))
    settings = AugmentationSettings(mode=mode, examples=2, attack=attack)
    service = AugmentationService(settings, scene, labels, 0, Phases())
    renders = service.regenerate(model, 0)
    assert renders.images.shape == (2, 3, 8, 8)
    assert torch.equal(service.regenerate(model, 0).images, renders.images)

    diagnostics = renders.diagnostics
    coordinate_count = 3 * max(len(item.mesh.vertices) for item in scene.objects)
    assert 0 < diagnostics["vertices_change"] <= 0.02 * math.sqrt(coordinate_count)
    assert diagnostics["albedo_change"] > 0
    assert diagnostics["light_change"] == 0
    if mode == "adversarial":
        assert diagnostics["loss"] > diagnostics["loss_before"]


def test_the_settings_of_a_scene_keep_their_backgrounds_in_a_service():
    scene = SceneSettings(backgrounds=[0.25])
    settings = AugmentationSettings("random", examples=4)
    service = AugmentationService.from_meshes([("solid:cup", 0)], 8, settings, scene=scene)
    assert torch.equal(service.scene.backgrounds, torch.full((1, 1, 8, 8), 0.25))
    assert len({example.cameras for example in service.scene.examples}) == 4


def test_a_service_from_meshes_renders_as_one_around_the_same_scene(model):
    meshes = [("solid:plate", 0), (solid("table"), 2)]
    settings = AugmentationSettings(examples=8, attack=TrainingAttackSettings(max_steps=2))
    options = {"views": 2, "backgrounds": [0.25, 0.75], "samples": 2, "rasterizer": "numpy"}
    service = AugmentationService.from_meshes(meshes, 8, settings, **options)
    renders = service.regenerate(model, 0)
    assert len(service) == len(renders) == 8
    assert renders.labels.tolist() == [0] * 4 + [2] * 4
    scene = built(2, 0.25, 0.75)
    same = AugmentationService(settings, scene, renders.labels, 0, Phases())
    assert torch.equal(same.regenerate(model, 0).images, renders.images)


def probability_rises(model: nn.Module, scene: Scene, after: Tensor) -> Tensor:
    """Return how much the probability (E, classes) rises above that in the light of the scene."""
    before = render_in(scene, LIGHT)
    return logits_of(model, after).softmax(1) - logits_of(model, before).softmax(1)


def test_negatives_are_attacked_towards_a_label_and_its_objects_away(serve, scene, model, labels):
    """Tables are complementary to a plate, so that every step raises the plate's probability."""
    is_plate = labels == 0
    mixed = torch.where(is_plate, labels, complementary_label(0))
    renders = serve(labels=mixed, positive_classes=(0,)).regenerate(model, 0)
    assert torch.equal(renders.labels, mixed)
    rises = probability_rises(model, scene, renders.images)[:, 0]
    for change in (-rises[is_plate], rises[~is_plate]):
        assert (change >= -1e-5).all()
        assert (change > 0).any()


def test_hard_negatives_with_a_class_succeed_as_the_studied_class_alone(serve, model, labels):
    renders = serve(positive_classes=(0,)).regenerate(model, 0)
    predicts_plate = logits_of(model, renders.images).argmax(1) == 0
    success = predicts_plate == (labels != 0)
    expected = pytest.approx(float(success.double().mean()))
    assert renders.diagnostics["attack_success"] == expected


def test_hard_negatives_are_attacked_towards_several_labels_in_turn(serve, scene, model, labels):
    """Plates belong to neither of the two classes, and tables to the second."""
    is_plate = labels == 0
    mixed = torch.where(is_plate, complementary_label(1), labels)
    images = serve(labels=mixed, positive_classes=(1, 2)).regenerate(model, 0).images
    rises = probability_rises(model, scene, images)
    turns = torch.arange(EXAMPLE_COUNT) % 2
    for turn, target in ((0, 1), (1, 2)):
        towards = rises[is_plate & (turns == turn), target]
        assert (towards >= -1e-5).all()
        assert (towards > 0).any()
        alone = serve(labels=mixed, positive_classes=(target,)).regenerate(model, 0).images
        is_chosen = is_plate & (turns == turn)
        torch.testing.assert_close(images[is_chosen], alone[is_chosen])
    assert (rises[~is_plate, 2] <= 1e-5).all()


def test_attack_examples_show_what_was_right_before_and_is_wrong_after(serve, scene, model, labels):
    """Half of the examples are given a class that the network does not see in them."""
    is_even = torch.arange(EXAMPLE_COUNT) % 2 == 0
    wrong = torch.where(is_even, labels, 1)
    renders = serve(labels=wrong, attack=LONG).regenerate(model, 0)
    examples = renders.attack_examples
    assert 0 < len(examples) <= 4
    assert (examples.labels != 1).all()
    assert torch.equal(examples.predictions[0].argmax(1), examples.labels)
    assert (examples.predictions[1].argmax(1) != examples.labels).all()
    assert torch.equal(examples.lights[0], LIGHT.expand(len(examples), -1, -1))
    for images, predictions, lights in zip(
        examples.images, examples.predictions, examples.lights, strict=True
    ):
        torch.testing.assert_close(predictions, logits_of(model, images).softmax(1))
        for image, light in zip(images, lights, strict=True):
            # The example is one of those of the scene.
            assert (render_in(scene, light) - image).flatten(1).abs().amax(1).min() < 100 * EPS32
