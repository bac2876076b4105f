import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import ConcatDataset, DataLoader

from augment.losses import complementary_label
from augment.parameter_settings import StepSettings
from augment.progress import Phases
from augment.scene.build import build_scene
from augment.scene.conditions import Conditions
from augment.scene.scene import Scene
from augment.service import AugmentationService, Renders
from augment.settings import AugmentationSettings, RandomLightSettings, TrainingAttackSettings, VariationSettings
from renderer.errors import InputError
from renderer.geometry.shapes import solid
from renderer.light.presets import probe

EPS32 = torch.finfo(torch.float32).eps
LIGHT = probe("grace")
CLASSES = {"plate": 0, "table": 2}
SHORT = TrainingAttackSettings(max_steps=5)
FRACTIONS = {"attack_success_before", "attack_success", "used_all_steps", "zero_gradient"}


def small(views: int, *backgrounds: float) -> Scene:
    meshes = [(f"solid:{name}", name) for name in CLASSES]
    return build_scene(meshes, 8, views, backgrounds=backgrounds, normals="flat", rasterizer="numpy")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The paper's 2 meshes × 10 views × 5 backgrounds, small."""
    return small(10, 0, 0.25, 0.5, 0.75, 1)


def render(scene: Scene, lights: Tensor) -> Tensor:
    return scene.render(Conditions(lights), torch.arange(len(scene)))[:, 0]


@pytest.fixture(scope="module")
def labels(scene) -> Tensor:
    return torch.tensor([CLASSES[label] for label in scene.labels])


@pytest.fixture(scope="module")
def model(scene, labels) -> nn.Module:
    """A small network that has learned the two solids in the initial light, so that an attack can succeed."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        features = nn.Conv2d(3, 16, 3, padding=1), nn.BatchNorm2d(16), nn.ReLU(), nn.Dropout(0.1), nn.Flatten()
        network = nn.Sequential(*features, nn.Linear(1024, 3))
        optimizer = torch.optim.Adam(network.parameters(), lr=0.003)
        images = render(scene, LIGHT.expand(100, -1, -1))
        for _ in range(60):
            optimizer.zero_grad()
            nn.functional.cross_entropy(network(images), labels).backward()
            optimizer.step()
    return network


@pytest.fixture
def serve(scene, labels):
    def service(
        seed: int = 0, labels: Tensor = labels, studied: tuple[int, ...] = (), **settings
    ) -> AugmentationService:
        choices = AugmentationSettings(**{"attack": SHORT, **settings})
        return AugmentationService(choices, scene, labels, seed, Phases(), studied)

    return service


@torch.no_grad()
def logits_of(model: nn.Module, images: Tensor) -> Tensor:
    """In eval mode, and back."""
    logits = model.eval()(images)
    model.train()
    return logits


@pytest.mark.parametrize("settings", [{"arm": "none"}, {"arm": "random", "examples": 0}])
def test_without_an_arm_or_examples_the_batch_is_empty_and_no_scene_is_needed(model, settings):
    choices, none = AugmentationSettings(**settings), torch.zeros(0, dtype=torch.int64)
    renders = AugmentationService(choices, None, none, 0, Phases()).regenerate(model, 0)
    assert len(renders.images) == len(renders.labels) == 0 and renders.diagnostics == {}


@pytest.mark.parametrize("arm", ["random", "adversarial"])
def test_renders_come_with_labels_and_finite_diagnostics(serve, model, scene, arm):
    service = serve(arm=arm)
    renders = service.regenerate(model, 0)
    assert renders.images.shape == (100, 3, 8, 8) and not renders.images.requires_grad
    assert renders.images.min() >= 0 and renders.images.max() <= 1
    assert [CLASSES[name] for name in scene.labels] == renders.labels.tolist()
    assert renders.labels.dtype == torch.int64
    assert all(type(value) is float and math.isfinite(value) for value in renders.diagnostics.values())
    assert all(0 <= renders.diagnostics[name] <= 1 for name in FRACTIONS & renders.diagnostics.keys())
    assert renders.diagnostics["light_change"] > 0
    assert service.phases.take().keys() == {"attack_classifier"}


@pytest.mark.parametrize("settings", [{"arm": "random"}, {"arm": "adversarial", "init": "random"}])
def test_the_seed_and_the_epoch_decide_the_draw(serve, model, settings):
    images = serve(seed=1, **settings).regenerate(model, 3).images
    resumed = serve(seed=1, **settings)
    resumed.regenerate(model, 2)
    torch.rand(5)
    torch.testing.assert_close(resumed.regenerate(model, 3).images, images, rtol=0, atol=0)
    assert (resumed.regenerate(model, 4).images != images).any()
    assert (serve(seed=2, **settings).regenerate(model, 3).images != images).any()


@pytest.mark.parametrize("examples, shown", [(3, 3), (None, 7), (10, 10)])
def test_a_folders_images_are_all_shown_before_any_is_shown_again_and_the_round_decides_which(examples, shown):
    images, labels = torch.arange(7, dtype=torch.uint8)[:, None, None, None].expand(-1, 3, 8, 8), torch.arange(7) % 3
    model = nn.Sequential(nn.Flatten(), nn.Linear(192, 3))
    nn.init.zeros_(model[1].weight).data[0] = model[1].bias.data[0] = 1.0
    settings = AugmentationSettings(arm="folder", folder="unread", examples=examples)
    service = AugmentationService(settings, None, labels, 5, Phases(), images=images)
    rounds = [service.regenerate(model, number) for number in range(21)]
    drawn = torch.cat([made.images[:, 0, 0, 0] * 255 for made in rounds]).round().long()
    assert len(service) == shown and len(drawn) == 21 * shown
    passes = drawn.view(-1, 7)
    assert torch.equal(passes.sort(1).values, torch.arange(7).expand_as(passes)) and len(passes.unique(dim=0)) > 1
    assert torch.equal(torch.cat([made.labels for made in rounds]), drawn % 3)
    assert rounds[4].diagnostics["attack_success"] == pytest.approx(float((rounds[4].labels > 0).float().mean()))


@pytest.mark.parametrize(("classified", "rows"), [(250, range(100)), (4, [0, 33, 66, 99])])
def test_random_light_has_its_norm_and_diagnostics_of_its_images(serve, model, monkeypatch, classified, rows):
    monkeypatch.setattr("augment.service.CLASSIFIED", classified)
    renders = serve(arm="random").regenerate(model, 0)
    logits, labels = logits_of(model, renders.images[rows]), renders.labels[rows]
    assert renders.diagnostics["attack_success"] == pytest.approx((logits.argmax(1) != labels).double().mean())
    loss = nn.functional.cross_entropy(logits.double(), labels)
    assert renders.diagnostics["loss"] == pytest.approx(float(loss), rel=100 * EPS32)
    # ±0.5 on 147 coefficients: a norm of 3.5, with a standard deviation of 0.13 that 100 examples bring to 0.013.
    assert renders.diagnostics["light_change"] == pytest.approx(math.sqrt(147 / 12), abs=5 * 0.013)
    renders = serve(arm="random", random_light=RandomLightSettings(radius=1.5)).regenerate(model, 0)
    assert renders.diagnostics["light_change"] == pytest.approx(1.5, rel=8 * EPS32)


@pytest.mark.parametrize("step", ["unit", "sign"])
def test_adversarial_images_are_those_of_the_papers_loop(serve, model, scene, labels, step):
    """The loop spelt out, with every example looked at in every step."""
    renders = serve(attack=TrainingAttackSettings(step=step, max_steps=10, batch_size=32)).regenerate(model, 0)
    lights, steps = LIGHT.repeat(len(scene), 1, 1), torch.zeros_like(labels)
    model.eval()
    for index in range(11):
        lights.requires_grad_(True)
        images = render(scene, lights)
        logits = model(images)
        losses, success = nn.functional.cross_entropy(logits, labels, reduction="none"), logits.argmax(1) != labels
        if index == 0:
            expected = {"attack_success_before": success, "loss_before": losses.detach()}
        if index < 10:
            (uphill,) = torch.autograd.grad(losses.sum(), lights)
            move = uphill.sign() if step == "sign" else uphill / uphill.flatten(1).norm(dim=1)[:, None, None]
            lights = torch.where(success[:, None, None], lights, lights + 0.05 * move).detach()
            steps += ~success
    model.train()
    expected |= {"attack_success": success, "loss": losses.detach(), "steps": steps, "used_all_steps": steps == 10}
    expected["light_change"] = (lights - LIGHT).detach().flatten(1).norm(dim=1)
    # Ten steps of products in float32 in another order, through a network that amplifies their rounding.
    torch.testing.assert_close(renders.images, images.detach(), rtol=0, atol=10 * 64 * EPS32)
    for name, values in expected.items():
        assert renders.diagnostics[name] == pytest.approx(float(values.double().mean()), rel=1e-4), name
    assert 0 < renders.diagnostics["attack_success"] < 1 and renders.diagnostics["zero_gradient"] == 0


def test_a_warm_start_continues_the_last_attack_also_after_a_resume(serve, model):
    service = serve(warm_start=True, init="random")
    first = service.regenerate(model, 0)
    state = {name: value.clone() for name, value in service.state_dict().items()}
    second = service.regenerate(model, 1)
    assert second.diagnostics["loss_before"] == pytest.approx(first.diagnostics["loss"], rel=8 * EPS32)
    assert second.diagnostics["attack_success_before"] == first.diagnostics["attack_success"]
    assert second.diagnostics["loss"] > first.diagnostics["loss"]

    resumed = serve(warm_start=True, init="random")
    resumed.load_state_dict(state)
    torch.testing.assert_close(resumed.regenerate(model, 1).images, second.images, rtol=0, atol=0)
    with pytest.raises(InputError, match=r"^state.* continues 3 examples and the scene has"):
        resumed.load_state_dict({**state, "values": torch.zeros(3, 147)})


@pytest.mark.parametrize("arm", ["random", "adversarial"])
def test_a_label_beyond_the_classes_of_the_network_is_refused(serve, model, labels, arm):
    with pytest.raises(InputError, match=r"label=53 must be at least 0 and at most \d"):
        serve(arm=arm, labels=labels + 51).regenerate(model, 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AugmentationSettings(init="dark"), "init=dark: choose one of scene, random"),
        (lambda: AugmentationSettings(warm_start=True, vary=VariationSettings(instances=True)), "warm_start=True"),
        (
            lambda: AugmentationSettings("random", attack=TrainingAttackSettings(albedo=StepSettings())),
            "radius is None",
        ),
        (lambda: RandomLightSettings(amplitude=math.nan), "amplitude=nan"),
        (lambda: AugmentationService(AugmentationSettings(), None, torch.zeros(0), 0, Phases()), "give a scene"),
    ],
)
def test_settings_that_are_out_of_range_or_contradict_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize("arm", ["random", "adversarial"])
def test_both_arms_change_shape_and_albedo_within_their_norm_balls(model, arm):
    """Of both meshes from one view over one gray, since shapes are rasterized in every step."""
    balls = {"geometry": StepSettings("linf", 0.02, "sign", 0.01), "albedo": StepSettings("linf", 0.1, "sign", 0.05)}
    attack, scene = TrainingAttackSettings(**balls, max_steps=2, shorten=True), small(1, 0.5)
    labels = torch.tensor(list(CLASSES.values()))
    service = AugmentationService(AugmentationSettings(arm=arm, examples=2, attack=attack), scene, labels, 0, Phases())
    first, again = (service.regenerate(model, 0) for _ in range(2))
    assert first.images.shape == (2, 3, 8, 8) and torch.equal(first.images, again.images)
    diagnostics, values = first.diagnostics, 3 * max(len(item.mesh.vertices) for item in scene.objects)
    assert 0 < diagnostics["vertices_change"] <= 0.02 * values**0.5 and diagnostics["albedo_change"] > 0
    assert diagnostics["light_change"] == 0
    if arm == "adversarial":
        assert diagnostics["loss"] > diagnostics["loss_before"]


def test_a_service_works_in_any_loop_and_its_renders_are_a_data_set(model, monkeypatch, tmp_path):
    """Built from meshes, label indices and a size; its renders equal those of a service around the same scene."""
    monkeypatch.chdir(tmp_path)
    meshes = [("solid:plate", 0), (solid("table"), 2)]
    attack = TrainingAttackSettings(max_steps=2)
    settings = AugmentationSettings(warm_start=True, attack=attack)
    choices = dict(views=2, backgrounds=[0.25, 0.75], samples=2, rasterizer="numpy")
    service = AugmentationService.from_meshes(meshes, 8, settings, **choices)
    renders = service.regenerate(model, 0)
    assert renders.labels.tolist() == [0] * 4 + [2] * 4 and len(service) == len(renders) == 8

    scene = small(2, 0.25, 0.75)
    same = AugmentationService(AugmentationSettings(examples=8, attack=attack), scene, renders.labels, 0, Phases())
    assert torch.equal(same.regenerate(model, 0).images, renders.images)

    data = ConcatDataset([[(torch.zeros(3, 8, 8), 0)] * 5, renders])
    images, labels = next(iter(DataLoader(data, batch_size=13)))
    assert torch.equal(images[5:], renders.images) and labels.tolist() == [0] * 5 + renders.labels.tolist()

    resumed = AugmentationService.from_meshes(meshes, 8, settings, **choices)
    resumed.load_state_dict(service.state_dict())
    assert torch.equal(resumed.regenerate(model, 1).images, service.regenerate(model, 1).images)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", [int, np.int64], ids=["number", "NumPy"])
@pytest.mark.parametrize("renders_first", [True, False])
def test_a_data_set_with_numbers_as_labels_goes_into_batches_with_renders(kind, renders_first):
    data, renders = [(torch.zeros(3, 8, 8), kind(1))] * 5, Renders(torch.ones(3, 3, 8, 8), torch.tensor([2, 3, 4]), {})
    both = ConcatDataset([renders, data] if renders_first else [data, renders])
    batches = list(DataLoader(both, batch_size=4))
    labels = torch.cat([labels for _, labels in batches])
    assert labels.tolist() == ([2, 3, 4] + [1] * 5 if renders_first else [1] * 5 + [2, 3, 4])
    assert labels.dtype == torch.int64 and {type(labels) for _, labels in batches} == {torch.Tensor}
    F.cross_entropy(torch.rand(8, 5), labels)


def test_hard_negatives_are_attacked_towards_the_label_and_the_label_away_from_it(serve, scene, model, labels):
    """Tables are complementary to a plate: there every step raises the plate's probability."""
    other = torch.where(labels == 0, labels, complementary_label(0))
    renders = serve(labels=other, studied=(0,)).regenerate(model, 0)
    sides = render(scene, LIGHT.expand(100, -1, -1)), renders.images
    before, after = (logits_of(model, images).softmax(1)[:, 0] for images in sides)
    rises = torch.where(labels == 0, before - after, after - before)
    assert (rises >= -1e-5).all() and (rises[labels == 0] > 0).any() and (rises[labels != 0] > 0).any()
    assert torch.equal(renders.labels, other)
    renders = serve(studied=(0,)).regenerate(model, 0)  # tables with their class succeed as plates alone
    success = (logits_of(model, renders.images).argmax(1) == 0) == (labels != 0)
    assert renders.diagnostics["attack_success"] == pytest.approx(success.double().mean())


def test_hard_negatives_of_several_classes_are_attacked_towards_each_in_turn(serve, scene, model, labels):
    other = torch.where(labels == 0, complementary_label(1), labels)  # plates are of neither class, tables of theirs
    images = serve(labels=other, studied=(1, 2)).regenerate(model, 0).images
    sides = render(scene, LIGHT.expand(100, -1, -1)), images
    rises = logits_of(model, sides[1]).softmax(1) - logits_of(model, sides[0]).softmax(1)
    turns = torch.arange(100) % 2
    for turn, target in enumerate((1, 2)):
        towards = rises[(labels == 0) & (turns == turn), target]
        assert (towards >= -1e-5).all() and (towards > 0).any()
    assert (rises[labels == 2, 2] <= 1e-5).all()


def test_attack_examples_are_new_successes_before_and_after(serve, scene, model):
    renders = serve(attack=TrainingAttackSettings(max_steps=30, step_size=0.5)).regenerate(model, 0)
    examples = renders.attack_examples
    assert renders.diagnostics["attack_success"] > renders.diagnostics["attack_success_before"]
    assert 0 < len(examples) <= 4 and torch.equal(examples.lights[0], LIGHT.expand(len(examples), -1, -1))
    sides = zip(examples.images, examples.lights, examples.predictions, (True, False), strict=True)
    for images, lights, predictions, right in sides:
        everything = [render(scene, light.expand(len(scene), -1, -1)) for light in lights]
        gaps = [(image - shown).flatten(1).abs().amax(1).min() for image, shown in zip(images, everything, strict=True)]
        assert max(gaps) < 100 * EPS32
        torch.testing.assert_close(predictions, logits_of(model, images).softmax(1))
        assert ((predictions.argmax(1) == examples.labels) == right).all()


def test_attack_examples_do_not_show_those_that_were_wrong_before(serve, model, labels):
    """Half of the examples are given the class that the network does not see in them."""
    wrong = torch.where(torch.arange(100) % 2 == 0, labels, 1)
    settings = TrainingAttackSettings(max_steps=30, step_size=0.5)
    renders = serve(labels=wrong, attack=settings).regenerate(model, 0)
    examples = renders.attack_examples
    assert renders.diagnostics["attack_success_before"] >= 0.5 and len(examples) > 0
    assert (examples.labels != 1).all()
    assert (examples.predictions[0].argmax(1) == examples.labels).all()
