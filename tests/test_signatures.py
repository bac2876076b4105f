"""The shapes in signatures are those that functions take and return, and cost no import."""

import ast
import sys
import typing
from collections.abc import Callable, Iterable
from dataclasses import fields
from inspect import signature
from pathlib import Path
from types import UnionType

import jaxtyping
import pytest
import torch
from torch import Tensor, nn

import renderer
from augment.attacks.criteria import Goal, adversarial_cost
from augment.attacks.descent import DescentResult, DescentSettings, descend
from augment.attacks.parameters import AttackProblem, Lighting, StepSettings
from augment.classifiers import Classifier
from augment.scene import Scene
from augment.service import AugmentationService, Renders
from augment.utils import Phases
from renderer import harmonics, image, normals, shading
from renderer.camera import orbit_cameras
from renderer.transfer import TransferOperator

ROOT, PACKAGES = Path(__file__).parents[1], ("renderer", "augment", "train")
MESH, CAMERAS, LIGHT = renderer.solid("plate"), orbit_cameras(2, 2.0), renderer.load_light("grace")
VERTICES, FACES = torch.from_numpy(MESH.vertices), torch.from_numpy(MESH.faces)
DIRECTIONS = torch.rand(4, 5, 3)


class Wrong(AssertionError):
    """A tensor that is not what its annotation says."""


def check(named: Iterable[tuple[str, object]], hints: dict[str, object]) -> None:
    for name, value in named:
        hint = hints.get(name, object)
        pairs = zip(value, typing.get_args(hint), strict=True) if isinstance(value, tuple) else [(value, hint)]
        for tensor, told in pairs:
            union = typing.get_origin(told) in (UnionType, typing.Union)
            choices = [each for each in (typing.get_args(told) if union else [told]) if isinstance(each, type)]
            if isinstance(tensor, Tensor) and not any(isinstance(tensor, choice) for choice in choices):
                raise Wrong(f"{name}: {tuple(tensor.shape)} {tensor.dtype} is not {hint}")


def hints_of(annotated: object, module: str) -> dict[str, object]:
    return typing.get_type_hints(annotated, {**vars(jaxtyping), **vars(sys.modules[module])})


def checked(function: Callable) -> Callable:
    """The function with its tensors held against its annotations: an axis of one name has one length."""
    hints = hints_of(function, function.__module__)

    def call(*arguments: object, **keywords: object) -> object:
        with jaxtyping.jaxtyped("context"):
            check(signature(function).bind(*arguments, **keywords).arguments.items(), hints)
            result = function(*arguments, **keywords)
            check([("return", result)], hints)
        return result

    return call


def check_fields(item: object) -> None:
    with jaxtyping.jaxtyped("context"):
        named = [(field.name, getattr(item, field.name)) for field in fields(item)]
        check(named, hints_of(type(item), type(item).__module__))


def test_of_rendering():
    render = checked(renderer.render)
    for background in (0.5, torch.rand(3), torch.rand(1, 8, 8), torch.rand(2, 3, 8, 8)):
        render(MESH, CAMERAS, LIGHT, 8, background)
    render(MESH, CAMERAS, LIGHT, 8, vertices=VERTICES, albedo=torch.rand(FACES.shape))
    with pytest.raises(Wrong, match="vertices"):
        render(MESH, CAMERAS, LIGHT, 8, vertices=VERTICES[:, :2])


def test_of_operators():
    [operator] = renderer.precompute_transfer(MESH, CAMERAS[:1], 8)
    check_fields(operator)
    for lights in (LIGHT, LIGHT.expand(5, 4, -1, -1)):
        checked(TransferOperator.image)(operator, lights, torch.rand(3, 8, 8))
        seen = checked(TransferOperator.radiance)(operator, lights)
        checked(TransferOperator.light_gradient)(operator, seen)
        behind = checked(image.composite)(seen, operator.coverage, operator.pixels, torch.rand(3, 8, 8))
        assert checked(image.to_unit)(checked(image.to_bytes)(behind)).shape[-2:] == (8, 8)
        checked(image.tonemap)(seen, operator.coverage[None], torch.rand(1, 1))


def test_of_harmonics_and_normals():
    for function in (harmonics.basis, harmonics.basis_gradient, harmonics.irradiance_basis):
        for directions in (DIRECTIONS, DIRECTIONS[0, 0], DIRECTIONS.double()):
            checked(function)(directions, 6)
    for function in (
        harmonics.bands,
        harmonics.lambertian_factors,
        harmonics.nonzero_coefficients,
        harmonics.quadrature,
    ):
        checked(function.__wrapped__ if hasattr(function, "cache_info") else function)(6)
    directions, _ = checked(harmonics.equirectangular)(4, 8)
    light = checked(harmonics.project)(directions, 2)
    checked(harmonics.rotate)(light, torch.eye(3))
    for function in (normals.face_normals, normals.vertex_normals, normals.area_vectors):
        checked(function)(VERTICES.float(), FACES)
    checked(shading.irradiance)(DIRECTIONS[0], LIGHT)


class Bright(nn.Module):
    """Two classes, by the mean of the image."""

    def forward(self, images: Tensor) -> Tensor:
        mean = images.mean((1, 2, 3))
        return torch.stack([mean, 1 - mean], dim=1)


def test_of_scenes_attacks_and_the_service():
    service = AugmentationService.from_meshes([("solid:plate", 0)], 8, views=2, backgrounds=[0.5], samples=1)
    classifier = Classifier(Bright(), 8, ["bright", "dark"])
    renders = service.regenerate(classifier, 0)
    assert isinstance(renders, Renders)
    check_fields(renders)
    logits = checked(Classifier.forward)(classifier, renders.images)
    checked(adversarial_cost)(logits, renders.labels, 1 - renders.labels)

    scene = service.scene
    problem, everything = AttackProblem(scene, [Lighting(scene, StepSettings())]), torch.arange(2)
    conditions = checked(Scene.conditions)(scene, everything)
    check_fields(conditions)
    checked(Scene.render)(scene, conditions, everything)
    checked(Scene.clamped_fraction)(scene, conditions, everything)
    goal = Goal(renders.labels[:, None])
    check_fields(goal)
    result = descend(classifier, problem, goal, DescentSettings(max_steps=1), Phases())
    assert isinstance(result, DescentResult)
    check_fields(result)
    checked(Goal.reached)(goal, result.predicted)
    checked(Goal.reached_in_views)(goal, result.predicted)


def test_shapes_cost_no_import():
    """jaxtyping is imported for type checkers alone."""
    imports = []
    texts = [path.read_text() for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    for text in (text for text in texts if "jaxtyping" in text):
        nodes = list(ast.walk(ast.parse(text)))
        guards = [node for node in nodes if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
        unseen = {inner for guard in guards for inner in ast.walk(guard)}
        found = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
        imports += [node in unseen for node in found if "jaxtyping" in ast.unparse(node)]
    assert len(imports) >= 10 and all(imports)
