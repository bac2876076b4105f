"""Wrong calls of public functions are refused by the name of the argument: one per sentence.

The kinds of values that the checks of arguments refuse are in tests/renderer/test_errors.py.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor, nn

import augment
import renderer
from augment.attacks.result import AttackResult
from augment.augmentation_settings import RandomLightSettings, TrainingAttackSettings
from augment.progress import Phases
from augment.scene.objects import Conditions
from renderer import InputError, harmonics, skylight
from renderer.errors import describe
from renderer.light.lamps import Lamps, Projector
from tests.detectors import BrightBox
from tests.helpers import bright_or_dark, save_plain
from tests.tetrahedron import (
    CAMERA,
    CLASSIFIER,
    IMAGES,
    LAMP,
    LIGHT,
    MESH,
    SIZE,
    operator,
    render,
    small_scene,
)
from train import load_run
from train.commands.evaluate import evaluate

NAN = math.nan
TRIMESH = trimesh.creation.icosahedron()
INTRINSICS = np.array([[70.0, 0, 27], [0, 76, 39], [0, 0, 1]])
CLASSES = ("orange", "other")
BYTES = IMAGES * 255


def probabilities(images: Tensor) -> Tensor:
    return bright_or_dark(images).softmax(1)


LINEAR = nn.Sequential(nn.Flatten(), nn.Linear(3 * SIZE**2, 2)).eval()


@cache
def small_result() -> AttackResult:
    settings = augment.AttackSettings(lighting=augment.StepSettings("l2", 1.0), max_steps=1)
    return augment.attack(CLASSIFIER, small_scene(), settings=settings, force=True)


def small_service(label: Any = 0, **options: Any) -> augment.AugmentationService:
    settings = augment.AugmentationSettings(warm_start=True)
    given = {"views": 1, "samples": 1, "settings": settings, **options}
    return augment.AugmentationService.from_meshes([(MESH, label)], SIZE, **given)


def shown_examples(examples: Any) -> Tensor:
    return small_scene().render(small_scene().conditions(torch.arange(2)), examples)


def service_of(**changed: Any) -> augment.AugmentationService:
    given: dict[str, Any] = {"scene": small_scene(), "labels": [0, 0], "seed": 0}
    given["phases"] = Phases()
    return augment.AugmentationService(augment.AugmentationSettings(), **given | changed)


def regenerated(model: Any) -> Any:
    return small_service().regenerate(model, 0)


def scene(meshes: Any = ((MESH, "orange"),), size: Any = SIZE, **changed: Any) -> augment.Scene:
    return augment.build_scene(meshes, size, **{"samples": 1, "light": "uniform", **changed})


def changed_scene(**changed: Any) -> augment.Scene:
    return small_scene().changed(**changed)


def attack(classifier: Any = CLASSIFIER, **changed: Any) -> AttackResult:
    shown = changed.pop("scene") if "scene" in changed else small_scene()
    return augment.attack(classifier, shown, **changed)


def rendered_with(**changed: Any) -> Tensor:
    return render(mesh=mesh_of(**changed))


plain_mesh = partial(renderer.Mesh.plain, MESH.vertices)
mesh_of = partial(replace, MESH)
operators = partial(renderer.precompute_transfer, mesh=MESH, cameras=CAMERA, size=SIZE, samples=1)


def calls_of(
    name: str, call: Callable[[Any], object], *values: Any
) -> list[tuple[str, str, Callable[[], object]]]:
    """List a name, a title and a call for each wrong value of an argument."""
    return [(name, f"{name}={_title(value)}", lambda value=value: call(value)) for value in values]


def by_name(call: Callable[..., object], **wrong: list[Any]) -> list[Any]:
    """List the calls with each wrong value of each argument."""
    calls = []
    for name, values in wrong.items():
        calls += calls_of(name, lambda value, name=name: call(**{name: value}), *values)
    return calls


def _title(value: object) -> str:
    """Name a value without the address of an object, which differs between processes."""
    return describe(value)[:60]


RENDERING = [
    *by_name(render, mesh=["orange.glb"], cameras=[None, [], (1.0, 0.5)], size=[16.5, 0]),
    *by_name(render, light=["grace", MESH, LIGHT * NAN], background=[255, "white", [0.1, 0.2]]),
    *by_name(render, lights=[LIGHT, LAMP, [(LAMP, LIGHT)], [(LAMP,)], [(LAMP, [[NAN] * 3])]]),
    *by_name(render, vertices=[1.0, MESH.vertices * NAN], samples=[0, 65], encoding=["sRGB"]),
    *by_name(render, albedo=[torch.full((4, 3), -5.0), 0.5, torch.ones(4, 3) * NAN]),
    *by_name(render, albedo_scale=[-1.0], gloss=[0.3, (0.3, 0, 1)], normals=["Smooth"]),
    *by_name(render, shadows=["no"], bounces=[-1, 101], silhouettes=["yes"], rasterizer=["gpu"]),
    *by_name(operators, mesh=["orange.glb"], cameras=[None], size=[0], gloss=[0.3]),
    *calls_of("lights", lambda x: operator().image(x), "grace", LIGHT.T, LIGHT * NAN, LIGHT * 1e30),
    *calls_of("lights", lambda x: operator().radiance(x), LIGHT[:9]),
    *calls_of("background", lambda x: operator().image(LIGHT, x), 2.0, torch.rand(3, 4, 4)),
    *calls_of("radiance_gradient", lambda x: operator().light_gradient(x), "x", 1.0),
    *calls_of("radiance_gradient", lambda x: operator().light_gradient(x), NAN * torch.ones(3, 13)),
    *calls_of("device", lambda x: operator().to(x), "gpu", 3.5),
]

CAMERAS = [
    *calls_of("views", lambda x: renderer.orbit_cameras(x, 2.0), 0, 2.5),
    *calls_of("width", lambda x: renderer.orbit_cameras(1, x), 0, NAN),
    *by_name(partial(renderer.orbit_cameras, 1, 2.0), polar=[721.0], azimuth=[-721.0], fov=[173.0]),
    *by_name(partial(renderer.OrthographicCamera, 57.3, 0.0), width=[0.0, "wide"]),
    *by_name(partial(renderer.OrthographicCamera, width=2.0, azimuth=0.0), polar=["up", NAN]),
    *by_name(partial(renderer.OrthographicCamera, 57.3, 0.0, 2.0), right=["x"], clip_range=[0.0]),
    *by_name(partial(renderer.PerspectiveCamera, 57.3, 0.0, 2.0), distance=[0, "far"]),
    *by_name(
        partial(
            renderer.PinholeCamera.from_matrix, view=np.eye(4), intrinsics=INTRINSICS, size=SIZE
        ),
        view=[np.eye(3), 2 * np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])],
        intrinsics=[np.eye(4), INTRINSICS + np.eye(3, k=1), INTRINSICS.T],
        size=[0],
        convention=["blender"],
    ),
    *by_name(renderer.ImageSettings, size=[16.5, 0], samples=[0, 65], encoding=["gamma"]),
]

LIGHTS = [
    *calls_of("light", renderer.load_light, None, "sunset"),
    *calls_of("missing.hdr", renderer.load_light, "missing.hdr"),
    *calls_of("degree", lambda x: renderer.load_light("grace", x), 2.5, -1, 41),
    *by_name(partial(renderer.load_light, "grace"), roughness=[-0.1, 2.0, NAN, "0.5"]),
    *calls_of("coefficients", lambda x: renderer.save_light("l.json", x), LIGHT[:9], LIGHT * NAN),
    *calls_of("basis", lambda x: renderer.save_light(Path("l.json"), LIGHT, x), "harmonics"),
    *calls_of("path", lambda x: renderer.save_light(x, LIGHT), None, "light.png"),
    *by_name(partial(renderer.save_light, "l.exr", LIGHT), height=[0]),
    *calls_of("directions", lambda x: harmonics.basis(x, 2), 1.0, torch.ones(2, 3) * NAN),
    *calls_of("degree", lambda x: harmonics.basis(torch.ones(2, 3), x), -1, 41),
    *calls_of("light", harmonics.degree_of, "grace", torch.ones(49)),
    *calls_of("radiance", lambda x: harmonics.project(x, 2), "sky", torch.ones(4, 8, 3) * NAN),
    *calls_of("radiance", lambda x: harmonics.project(lambda _: x, 2), torch.ones(28, 3) * NAN),
    *calls_of("degree", lambda x: harmonics.project(torch.ones(4, 8, 3), x), -1, 2.5),
    *calls_of("coefficients", lambda x: harmonics.rotate(x, torch.eye(3)), LIGHT[:8], LIGHT * NAN),
    *calls_of("rotation", lambda x: harmonics.rotate(LIGHT, x), torch.eye(2), torch.eye(3) * NAN),
    *calls_of("zenith", lambda x: skylight.coefficients(x, 0.0, 3.0), "noon", 91.0, -0.1),
    *calls_of("azimuth", lambda x: skylight.coefficients(0.5, x, 3.0), "south", NAN),
    *calls_of("turbidity", lambda x: skylight.coefficients(0.5, 0.0, x), "clear", 1.0),
    *calls_of("positions", Lamps, 3, (), ((1.0, 2.0),), ((0.0, 0.0, 0.0),), (1.0, 2.0, 3.0)),
    *calls_of("power", lambda x: Lamps(((1.0, 1.0, 1.0),), x), 0, NAN),
    *by_name(Projector, pixels=[0, 257], fov=[173.0, 0]),
]

MESHES = [
    *calls_of("path", renderer.load_mesh, None),
    *calls_of("missing.glb", renderer.load_mesh, "missing.glb"),
    *calls_of("folder.glb", renderer.load_mesh, "folder.glb"),
    *by_name(partial(renderer.load_mesh, "a.glb"), up=["x"], gloss=["yes"]),
    *calls_of("mesh", renderer.normalize, "a.glb"),
    *calls_of("mesh", lambda x: renderer.subdivide(x, 10), "a.glb"),
    *calls_of("vertices", lambda x: renderer.subdivide(MESH, x), 2.5, -1, 10**8),
    *calls_of("mesh", lambda x: renderer.export_mesh(x, "a.glb"), "b.glb"),
    *calls_of("path", lambda x: renderer.export_mesh(MESH, x), None),
    *calls_of("a.obj", lambda x: renderer.export_mesh(MESH, x), "a.obj"),
    *by_name(
        partial(renderer.export_mesh, MESH, "a.glb"),
        normals=["hard"],
        cameras=[3, [None]],
        first=["x", -1],
    ),
    *calls_of("name", renderer.solid, "car", 3),
    *calls_of("seed", lambda x: renderer.solid("orange", x), -1, 1.5),
    *calls_of("vertices", lambda x: renderer.Mesh.plain(x, MESH.faces), "x", np.ones((4, 2))),
    *calls_of("faces", plain_mesh, "x", [[0, 1, 9]], [[0, 1, 2.5]], [[0, 1]]),
    *calls_of("color", partial(plain_mesh, MESH.faces), "red", (1, 1), -0.1),
    *calls_of("faces", lambda x: renderer.Mesh.plain(MESH.faces, x), MESH.vertices / 2),
    *by_name(mesh_of, vertices=[MESH.vertices[:, :2]], faces=[None, MESH.faces + 1]),
    *by_name(mesh_of, corner_colors=[MESH.faces], corner_uvs=[np.ones((4, 3))]),
    *by_name(mesh_of, normal_ids=[MESH.faces - 1, MESH.faces * 1.0, MESH.faces[1:]]),
    *by_name(mesh_of, texture_ids=[None, np.zeros(4, int), [0, 0]]),
    *by_name(mesh_of, textures=["a.png", [np.ones((4, 4, 3))], 3]),
    *by_name(rendered_with, corner_colors=[MESH.corner_colors * 255, MESH.corner_colors * NAN]),
    *by_name(rendered_with, gloss=[0.3, np.full((4, 3), 2.0), renderer.Gloss(0.3)]),
    *by_name(partial(plain_mesh, MESH.faces), crease=[-1]),
    *calls_of("roughness", lambda x: renderer.Gloss(x).on(MESH), "smooth", 2.0),
    *calls_of("metallic", lambda x: renderer.Gloss(0.3, x).on(MESH), 1.5, np.ones((4, 3))),
    *calls_of("specular_factor", lambda x: renderer.Gloss(0.3, 0.0, x).on(MESH), 1.5),
    *calls_of("mesh", renderer.Gloss(0.3).on, "a.glb"),
]

object_of_cup = partial(augment.ObjectSettings, "solid:cup", "cup")
SCENES = [
    *calls_of("meshes", scene, "solid:orange", [], [("solid:orange",)], ["solid:orange"], 3),
    *calls_of("meshes", scene, [(MESH, None)], [(TRIMESH, "orange")], {"orange": MESH}, [()]),
    *by_name(scene, size=[16.5, 0, (8,), (8, True), None], views=[0, 2.5], samples=[0]),
    *by_name(scene, scene=[{"views": 3}, 3], renderer=[{"samples": 3}], device=["gpu", 3.5]),
    *by_name(scene, widht=[2.0], backgrounds=[0.5, [], [255], [True], ["missing.png"]]),
    *by_name(scene, light=[None, "sunset", LIGHT.T, LIGHT * NAN], degree=[2.5, -1, 41]),
    *by_name(scene, exposure=[-1, None], width=[0, NAN], polar=[200.0], azimuth=["east"]),
    *by_name(scene, fov=[200.0]),
    *by_name(scene, vertices=[2.5, -1, None], ground=[[1, 2, 3], "wood", 0.5, [0.5, 0.5]]),
    *by_name(scene, projector=[Projector(), 16], lamps=[LAMP], rasterizer=["gpu"]),
    *by_name(scene, cameras=[[], ["above"]], normalize=[False, "no"], shared=["yes"]),
    *by_name(partial(scene, cameras=renderer.orbit_cameras(3, 2.0)), views=[2]),
    *calls_of(
        "solid:orange",
        lambda x: scene([augment.ObjectSettings("solid:orange", "orange", color=x)]),
        [1.0, 0.0, 0.0],
    ),
    *calls_of("pixels", lambda x: scene(projector=augment.ProjectorSettings(x)), 2.5, 0),
    *calls_of(
        "pattern",
        lambda x: scene(projector=augment.ProjectorSettings(pattern=x)),
        2.0,
        "missing.png",
    ),
    *calls_of("positions", lambda x: scene(lamps=augment.LampsSettings(x)), 3, [], [[1, 2]]),
    *calls_of("start", lambda x: scene(lamps=augment.LampsSettings(start=x)), [1, 2], None),
    *calls_of("mesh", lambda x: augment.ObjectSettings(x, "orange"), None, ""),
    *calls_of("label", lambda x: scene([augment.ObjectSettings("solid:orange", x)]), None, 0.5),
    *by_name(object_of_cup, albedo_scale=[0], color=[0.5, [255, 0, 0], [0, 0]]),
    *by_name(object_of_cup, gloss=["shiny", [], [0.5, 2.0], [-0.1], [0.1] * 4]),
    *by_name(object_of_cup, others=[["solid:cup"], 3], at=[3, [1], [NAN, 0]], scale=[0]),
    *by_name(augment.VariationSettings, shift=[2.0], scale=[2.0, [2, 1]], fov=[30.0, [50, 60]]),
    *by_name(augment.VariationSettings, environments=["grace"], instances=["yes"]),
    *by_name(augment.VariationSettings, gloss=[0.3], camera=[0.3]),
    *by_name(augment.CameraEffectSettings, noise=[2.0, NAN], pattern_fill=[0.5, [0, 2]]),
    *by_name(changed_scene, backgrounds=["gray", BYTES, 0.5], settings=[None, 8]),
    *by_name(changed_scene, lights=["grace", LIGHT[:9], LIGHT * NAN]),
    *by_name(changed_scene, examples=[[], [3]], objects=[[MESH], None, []]),
    *by_name(changed_scene, rasterizer=["numpy"], basis=["harmonics"]),
    *by_name(changed_scene, camera_effects=[3, "blur"]),
    *calls_of("light", lambda x: renderer.light_sphere(x, 8), "grace", 96),
    *calls_of("photograph", lambda x: renderer.fit_scene(x, torch.ones(8, 8), MESH), BYTES[0]),
    *calls_of("mask", lambda x: renderer.fit_scene(IMAGES[0], x, MESH), "mask.png", BYTES[0, 0]),
    *calls_of("seed", lambda x: scene([(f"solid:orange:{x}", "orange")]), "x"),
    *calls_of("conditions", lambda x: small_scene().render(x, torch.arange(2)), None),
    *calls_of("examples", shown_examples, None, [0, 9], torch.arange(1)),
    *calls_of("textured", lambda x: renderer.Gloss(0.3, textured=x).on(MESH), "yes"),
    *calls_of("degree", harmonics.quadrature, "x", -1),
    *calls_of("height", lambda x: harmonics.equirectangular(x, 8), 0, 4.5),
    *calls_of("examples", lambda x: small_scene().conditions(x), "all", [9], 0),
    *calls_of("light", lambda x: small_scene().render(x, [0]), Conditions(LIGHT)),
]


def animated(path: str = "attack.gif", **changed: Any) -> Any:
    return small_result().save_animation(path, **changed)


STEPS = augment.StepSettings()
lit = partial(augment.AttackSettings, lighting=STEPS)
forced = partial(attack, force=True)
ATTACKS = [
    *by_name(augment.StepSettings, norm=["l3", None], step=["adam"], step_size=[0]),
    *calls_of("radius", lambda x: augment.StepSettings("l2", x), "big", -1),
    *by_name(augment.PoseSettings, rotation=[200]),
    *by_name(augment.MaterialSettings, roughness=[2]),
    *by_name(augment.SkylightSettings, zenith=["noon"]),
    *by_name(augment.AttackSettings, lighting=[0.1, True], pose=[STEPS], material=[0.3]),
    *by_name(lit, max_steps=[2.5, -1], restarts=[-1], margin=[-1, NAN], quantized=["yes"]),
    *by_name(lit, allow_negative=["no"], backtracking=["no"], eot=[3], batch_size=[0]),
    *calls_of("classifier", attack, None, LINEAR, small_scene),
    *by_name(attack, scene=[None], settings=[{"lighting": STEPS}], force=["yes"]),
    *by_name(forced, target=[3, "pear", ["other", "other"], 0.5, LIGHT], seed=["x", 1.5, -1]),
    *calls_of("attack", lambda x: attack(settings=x), augment.AttackSettings()),
    *calls_of("orange", forced, augment.Classifier(bright_or_dark, SIZE, ["lemon", "pear"])),
    *calls_of("classifier", forced, augment.Classifier(bright_or_dark, 16, CLASSES)),
    *calls_of("result", augment.check, None),
    *calls_of("result", lambda x: augment.success_by_radius(x, [1.0]), None),
    *calls_of("scales", lambda x: augment.success_by_radius(small_result(), x), 0.5, ["x"], [-1]),
    *calls_of("result", lambda x: augment.transfer(x, [CLASSIFIER]), None),
    *calls_of("classifiers", lambda x: augment.transfer(small_result(), x), ["squeezenet"], 3),
    *calls_of("azimuths", lambda x: augment.transfer(small_result(), azimuths=x), 30.0, ["x"]),
    *calls_of("azimuths", lambda x: augment.transfer(small_result(), azimuths=x), [NAN]),
    *calls_of("objects", lambda x: augment.transfer(small_result(), objects=x), [MESH], MESH),
    *calls_of("result", lambda x: augment.save(x, "out"), None),
    *calls_of("folder", lambda x: augment.save(small_result(), x), None, 3),
    *calls_of("file.txt", lambda x: augment.save(small_result(), x), "file.txt"),
    *calls_of("verify", lambda x: augment.save(small_result(), "out", verify=x), "blender", 3),
    *by_name(animated, path=["attack.mp4"], frame_count=[1], example=[2], view=[2]),
    *calls_of("folder", augment.reload, None, 3),
    *calls_of("file.txt", augment.reload, "file.txt"),
    *calls_of("missing", augment.reload, "missing"),
]


def half_network() -> augment.Classifier:
    network = nn.Sequential(nn.Conv2d(3, 4, 3), nn.Flatten(), nn.Linear(4 * (SIZE - 2) ** 2, 2))
    return augment.Classifier(network.half(), SIZE, CLASSES)


def with_classes(classes: Any) -> augment.Classifier:
    return augment.Classifier(bright_or_dark, SIZE, classes)


def returning(value: Any) -> augment.Classifier:
    return augment.Classifier(lambda images: value, SIZE, CLASSES)


CLASSIFIERS = [
    *calls_of("function", lambda x: augment.Classifier(x, SIZE, CLASSES), None, 3),
    *calls_of("size", lambda x: augment.Classifier(bright_or_dark, x, CLASSES), 16.5, 0),
    *calls_of("classes", with_classes, 3, [], ["a", "a"], [0, 1], {"orange", "other"}),
    *calls_of("images", CLASSIFIER, BYTES, BYTES.to(torch.uint8), IMAGES[0], [[1], [2, 3]]),
    *calls_of("images", CLASSIFIER, IMAGES.permute(0, 2, 3, 1)),
    *calls_of("logits", augment.Classifier(probabilities, SIZE, CLASSES), IMAGES),
    *calls_of("logits", returning(torch.tensor([[0.2, 0.8]] * 3)), IMAGES),
    *calls_of("float16", half_network(), IMAGES),
    *calls_of("float64", augment.Classifier(LINEAR, SIZE, CLASSES), IMAGES.double()),
    *calls_of("logits", forced, augment.Classifier(probabilities, SIZE, CLASSES)),
    *calls_of("float16", forced, half_network()),
    *calls_of("label", CLASSIFIER.label, 3, None, 0.5),
    *calls_of("pear", CLASSIFIER.label, "pear"),
    *calls_of("operating point", CLASSIFIER.detect, IMAGES),
    *calls_of("label", lambda x: CLASSIFIER.detect(IMAGES, x), 3, ["orange"]),
    *calls_of("name", augment.load_classifier, None, 3),
    *calls_of("resnet50", augment.load_classifier, "resnet50"),
    *calls_of("weights", lambda x: augment.load_classifier("torchvision:resnet18", x), 3, "."),
    *calls_of("run", load_run, None, 3),
    *calls_of("missing", load_run, "missing"),
    *calls_of("file.txt", load_run, "file.txt"),
    *by_name(partial(load_run, "pretrained/none"), weights=["a.pt"]),
    *calls_of("size", lambda x: augment.build_scene([("solid:orange", "orange")], x), CLASSIFIER),
]

of_meshes = augment.AugmentationService.from_meshes
SERVICES = [
    *calls_of("mode", augment.AugmentationSettings, "all", None, 3),
    *calls_of("folder", lambda x: augment.AugmentationSettings("folder", x), None, 3),
    *by_name(augment.AugmentationSettings, examples=[2.5, -1], init=["zero"], warm_start=["yes"]),
    *by_name(augment.AugmentationSettings, regenerate_every=[0], vary=[{"shift": 0.1}]),
    *by_name(augment.AugmentationSettings, random_light=[0.5], attack=[STEPS]),
    *by_name(
        partial(augment.AugmentationSettings, warm_start=True),
        vary=[augment.VariationSettings(instances=True)],
    ),
    *calls_of(
        "radius",
        lambda x: augment.AugmentationSettings("random", attack=x),
        TrainingAttackSettings(albedo=STEPS),
    ),
    *calls_of("amplitude", RandomLightSettings, 0),
    *by_name(service_of, scene=[3, MESH], labels=["orange", [0]], positive_classes=["orange"]),
    *by_name(service_of, seed=[None, 0.5]),
    *calls_of(
        "examples", lambda x: small_service(settings=x), augment.AugmentationSettings(examples=0)
    ),
    *calls_of("meshes", lambda x: of_meshes(x, SIZE), [(MESH,)], [MESH], 3),
    *calls_of("label", small_service, "orange", 1.5, None),
    *calls_of("shared", lambda x: small_service(views=2, shared=x), True),
    *calls_of("size", lambda x: of_meshes([(MESH, 0)], x), 16.5, 0),
    *by_name(small_service, settings=[{"mode": "random"}], seed=["x", 1.5, -1]),
    *calls_of("label", lambda x: small_service(x).regenerate(LINEAR, 0), 2),
    *calls_of("model", regenerated, None, 3, nn.Flatten(0), nn.Linear(5, 2)),
    *calls_of("logits", regenerated, nn.Sequential(LINEAR, nn.Softmax(1))),
    *calls_of("number", lambda x: small_service().regenerate(LINEAR, x), "x", 1.5, -1),
    *calls_of("state", lambda x: small_service().load_state_dict(x), {}, None, 3),
    *calls_of("state", lambda x: small_service().load_state_dict(x.state_dict()), LINEAR),
]


def evaluated(network: Any = LINEAR, photos: Any = "photos", **changed: Any) -> Any:
    given: dict[str, Any] = {"label": "orange", "classes": CLASSES, "size": SIZE}
    return evaluate(network, photos, **given | changed)


SCORES = [
    *calls_of("photos", lambda x: evaluated(photos=x), None, 3),
    *calls_of("file.txt", lambda x: evaluated(photos=x), "file.txt"),
    *calls_of("file.txt", lambda x: evaluated(out=x), "file.txt"),
    *calls_of("label", lambda x: evaluated(label=x), "pear", 3, []),
    *calls_of("classes", lambda x: evaluated(classes=x), "orange", 3, ["orange"]),
    *calls_of("size", lambda x: evaluated(size=x), 16.5, True, 0),
    *calls_of("network", lambda x: evaluated(x), None, 3, nn.Linear(5, 2)),
    *calls_of("logits", lambda x: evaluated(x), probabilities),
    *calls_of("by", lambda x: evaluated(by=x), "mesh", "color"),
]

DETECTOR = {"task": augment.Detection(), "classes": CLASSES}
adversarial_light = partial(augment.AdversarialLighting, LINEAR)
BOXES = ([[0, 0, 2, 2]], 99), ([[0, 0, 2, 2]] * 2, 0), ([[NAN] * 4], 0)
RELIGHTING = [
    *by_name(augment.RandomLighting, strength=[NAN], p=[-0.1]),
    *by_name(augment.RandomLighting, lights=["sun", [], 3, {"linear": 0.0}]),
    *calls_of("image", augment.RandomLighting(), torch.ones(5, 4, 4), np.ones((4, 4, 3))),
    *calls_of("image", augment.RandomLighting("low_light"), IMAGES[0] * NAN, IMAGES[0] + 3e38),
    *calls_of("image", augment.RandomLighting(), {"image": np.ones((4, 4, 3)), "mask": IMAGES[0]}),
    *calls_of("images", torch.vmap(augment.RandomLighting("linear")), IMAGES),
    *calls_of(
        "depth",
        lambda x: augment.RandomLighting()({"image": IMAGES[0], "depth": x}),
        torch.ones(5, 4),
        "far",
    ),
    *calls_of("kinds", augment.lights.CastShadow, ("sun",)),
    *calls_of("exposure", lambda x: augment.lights.LowLight(exposure=x), 0),
    *by_name(adversarial_light, steps=[0], strength=[2.0]),
    *calls_of("classes", lambda x: adversarial_light(task=x), augment.Detection()),
    *calls_of("targets", lambda x: adversarial_light()(IMAGES, x), torch.zeros(2).long()),
    *calls_of("-1", lambda x: adversarial_light()(IMAGES, x), torch.full((3,), -1)),
    *calls_of(
        "targets",
        lambda x: augment.AdversarialLighting(BrightBox((1, 1, 4, 4)), **DETECTOR)(IMAGES, x),
        *(3, {"boxes": []}, [{"boxes": []}]),
        *([{"boxes": boxes, "labels": [label]}] * len(IMAGES) for boxes, label in BOXES),
    ),
]

CALLS = [*RENDERING, *CAMERAS, *LIGHTS, *MESHES, *SCENES, *ATTACKS, *CLASSIFIERS]
CALLS += [*SERVICES, *SCORES, *RELIGHTING]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a mesh, a text, a folder named like a mesh, and two photographs."""
    here = tmp_path_factory.mktemp("wrong_calls")
    renderer.export_mesh(MESH, here / "a.glb")
    (here / "file.txt").write_text("text")
    (here / "folder.glb").mkdir()
    for name in ("orange", "other"):
        save_plain(here / "photos" / name / "0.png", name.replace("other", "blue"), (20, 20))
    return here


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "call"), [pytest.param(name, call, id=title) for name, title, call in CALLS]
)
def test_a_wrong_call_is_refused_by_a_sentence_naming_the_argument(folder, monkeypatch, name, call):
    monkeypatch.chdir(folder)
    with pytest.raises(InputError) as refused:
        call()
    sentence = str(refused.value)
    assert name in sentence and "\n" not in sentence, sentence


def test_numbers_of_any_kind_are_factors_and_fields_of_cameras():
    expected = render(albedo_scale=0.5, cameras=renderer.OrthographicCamera(57.0, 115.0, 4.0))
    for kind in (int, np.float32, np.int64, torch.tensor, lambda value: np.array([value])):
        camera = renderer.OrthographicCamera(kind(57.0), kind(115.0), kind(4.0))
        assert torch.equal(render(albedo_scale=np.float32(0.5), cameras=camera), expected)


def test_gradients_reach_fields_of_cameras_and_lists_of_tensors():
    polar = torch.tensor([57.0], requires_grad=True)
    rows = [row.clone().requires_grad_() for row in LIGHT]
    camera = renderer.OrthographicCamera(polar, 28.6, 4.0)
    image = render(cameras=camera, light=rows, silhouettes=True, samples=4)
    gradients = torch.autograd.grad(image.sum(), [polar, *rows[:4]])
    assert gradients[0].shape == (1,)
    assert all(gradient.any() for gradient in gradients[:2])


def test_logits_are_not_taken_for_probabilities():
    """A single image, values outside [0, 1] and sums of 2 prove no softmax."""
    one_image = augment.Classifier(probabilities, SIZE, CLASSES)
    one_image(IMAGES[:1])
    with pytest.raises(InputError, match="logits"):
        one_image(IMAGES[:1])  # the second image proves it
    returning(torch.tensor([[0.2, 0.8], [0.3, 0.9], [0.2, 0.8]]))(IMAGES)
    returning(torch.tensor([[1.2, -0.2]] * 3))(IMAGES)
    returning(bright_or_dark(IMAGES).log_softmax(1))(IMAGES)


def test_a_network_that_returned_logits_may_return_what_looks_like_probabilities():
    answers = [torch.tensor([[2.0, -1.0]] * 3), torch.tensor([[0.2, 0.8]] * 3)]
    classifier = augment.Classifier(lambda images: answers.pop(0), SIZE, CLASSES)
    classifier(IMAGES)
    classifier(IMAGES)
    assert not answers


def test_a_state_is_restored_into_the_same_scene_alone():
    service = small_service()
    service.regenerate(LINEAR, 0)
    state = service.state_dict()
    resumed = small_service()
    resumed.load_state_dict(state)
    assert torch.equal(resumed.regenerate(LINEAR, 1).images, service.regenerate(LINEAR, 1).images)
    longer = replace(MESH, vertices=MESH.vertices * [1.0, 1.0, 1.5])
    others = [{"meshes": [(longer, 0)]}, {"light": 1.5 * LIGHT}, {"backgrounds": [0.1] * 5}]
    others += [{"meshes": [(MESH, 1)]}, {"light": "uniform"}, {"width": 3.0}]
    for changed in others:
        given: dict[str, Any] = {"meshes": [(MESH, 0)], "size": SIZE, "views": 1, "samples": 1}
        other = augment.AugmentationService.from_meshes(**given | changed)
        with pytest.raises(InputError, match="another scene"):
            other.load_state_dict(state)
