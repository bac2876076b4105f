from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor

from augment.attacks.result import AttackResult
from augment.classifier import Classifier
from augment.scene.scene import Scene
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.light.files import probe
from renderer.visibility import opengl
from scripts.attack import main as attack_command
from tests.runs import loaded_run
from tests.train.helpers import read_quickly
from train.command_settings import AttackExperimentSettings
from train.commands.attack import attacks


def configured(*arguments: str) -> AttackExperimentSettings:
    small = ["renderer.rasterizer=numpy", "renderer.shadows=false", "attack.max_steps=8"]
    return read_quickly(attack_command, [*small, "attack.margin=0", "device=cpu"], arguments)


def by_color(classes: tuple[str, ...] = ("orange", "lime", "sky")) -> Classifier:
    return Classifier(lambda images: 30 * images.mean((2, 3)), 8, classes, "by_color")


def attacked(*arguments: str, classifier: Classifier | None = None) -> AttackResult:
    settings = configured(*arguments)
    ((_, _, result),) = attacks(settings, classifier or by_color())
    return result


def test_examples_are_each_view_before_all_backgrounds_at_equal_azimuths():
    scene = "scene.views=3", "scene.backgrounds=[0.2,0.6]", "scene.polar=90", "scene.azimuth=30"
    result = attacked(*scene, "attack.allow_negative=true", "attack.max_steps=0")
    cameras = []
    for camera in orbit_cameras(3, 2.0, 90.0, 30.0):
        cameras += [(camera,), (camera,)]
    scene = result.problem.scene
    assert scene.cameras == cameras
    corners = result.images_before[:, :, 0, 0]
    grays = torch.tensor([0.2, 0.6] * 3)[:, None].expand(-1, 3)
    torch.testing.assert_close(corners, grays, rtol=1e-6, atol=0)
    assert torch.equal(scene.lights, probe("grace").expand(6, -1, -1))


def test_exposure_multiplies_the_light_and_albedo_scale_the_surface():
    # Light that is made physical is only exact up to the tolerance of this step.
    unchanged = "attack.max_steps=0", "attack.force=true", "attack.allow_negative=true"
    whiter_mesh = "meshes=[{mesh: 'solid:orange:0', albedo_scale: 1.5}]"
    same = attacked(*unchanged).images_before
    brighter = attacked(*unchanged, "scene.exposure=1.5").images_before
    whiter = attacked(*unchanged, whiter_mesh).images_before
    torch.testing.assert_close(brighter, whiter, rtol=0, atol=1e-6)
    assert not torch.equal(brighter, same)


def test_a_class_whose_name_is_a_number_is_a_target():
    classifier = by_color(("orange", "7", "8"))
    result = attacked("target=7", "attack.max_steps=1", classifier=classifier)
    assert result.criterion.target.tolist() == [[1]]


def test_a_scene_that_is_classified_correctly_is_attacked_as_it_is_and_rendered_once(monkeypatch):
    render = Mock(side_effect=Scene.render)
    monkeypatch.setattr(Scene, "render", lambda *given: render(*given))
    settings = configured("attack.max_steps=0")
    ((_, scene, result),) = attacks(settings, by_color())
    assert result.clean_correct.all()
    assert scene == settings.scene
    # Images before the attack, and the initial values of the search.
    assert render.call_count == 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the first gradient")  # it sees the background alone
def test_a_scene_in_which_the_mesh_is_recognized_is_searched_for():
    """The classifier knows oranges before light gray alone."""

    def is_light(images: Tensor) -> Tensor:
        score = 100 * (images[..., 0, 0].mean(1) - 0.8)
        return torch.stack([score, -score], dim=1)

    classifier = Classifier(is_light, 8, ("orange", "other"))
    settings = configured()
    ((name, scene, result),) = attacks(settings, classifier)
    assert name == "solid:orange:0"
    assert result.clean_correct.all()
    assert scene == replace(settings.scene, backgrounds=[0.9])
    with pytest.raises(InputError, match=r"^attack\.force=.* 1 of 1 images"):
        attacked("scene.search=0", classifier=classifier)


def test_a_rasterizer_that_does_not_start_is_an_error_of_its_key(monkeypatch, tiny, tmp_path):
    monkeypatch.setattr(opengl, "open_context", Mock(side_effect=InputError("no EGL device")))
    with pytest.raises(InputError, match=r"^renderer\.rasterizer: no EGL device$"):
        attacked("renderer.rasterizer=opengl")
    with pytest.raises(InputError, match=r"^renderer\.rasterizer: no EGL device$"):
        loaded_run(tiny("renderer.rasterizer=opengl"), tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["attack.restarts=2"], "restarts draws from the norm-balls"),
        (["target=[lime]", "scene.views=2", "attack.shared=true"], "one for each of the 2 views"),
        (["meshes=[{mesh: 'solid:orange:0', wight: 2}]"], r"meshes\[0\]"),
        (["meshes=[[{mesh: a}, {mesh: 3}]]"], r"^meshes\[0\]\.others\[0\]\.mesh is"),
        (["meshes=[[{mesh: a, at: [1, 0]}, b]]"], r"^meshes\[0\]\.at"),
        (["meshes=[[a, {mesh: b, at: [1]}]]"], r"others\[0\]\.at=\[1\]"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_refused_in_one_sentence(arguments, message):
    with pytest.raises(InputError, match=message) as refused:
        attacked(*arguments)
    assert "\n" not in str(refused.value)
