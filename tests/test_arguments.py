"""Every argument of the library's doors, given something else: it is used, or refused in a sentence that names it."""

import math
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import augment
import renderer
from augment.utils import Phases
from renderer.arguments import checked
from renderer.errors import InputError

FEW = [None, -3, math.nan, 10**400, "abc", [None], object(), torch.zeros(7, 3)]
MANY = [
    *FEW,
    *(3, -1, 0, 10**12, 10**400, True, math.inf, 1e300, 1j, "", "a\0b", b"x", int),
    *([], [3], {}, {"a": 1}, Path("/nowhere/x"), lambda given: given, np.zeros(0), np.zeros((2, 3))),
    *(torch.tensor(1), torch.zeros(0), torch.full((49, 3), math.nan)),
    *(torch.zeros(49, 3, dtype=torch.int64), torch.zeros(49, 3, dtype=torch.complex64)),
]
RESULTS = {"AttackResult", "InputError", "Operator"}  # which nobody makes; their methods are below
SMALL = {"samples": 1, "encoding": "linear", "normals": "smooth", "transport": "direct", "visibility": "software"}
OF_SCENE = {"views": 1, "shared": False, "backgrounds": [0.5], "light": "grace", "exposure": 1.0, "projector": None}
OF_SCENE |= {"lamps": None, "ground": None, "polar": 60.0, "azimuth": 0.0, "field_of_view": 2.0, "perspective": None}
ARRAYS = ("vertices", "faces", "corner_colors", "corner_uvs", "texture_ids", "textures")
CAMERA = {"polar": 1.0, "azimuth": 0.0, "field_of_view": 2.0, "right": 0.0, "up": 0.0, "reach": 2.0}


@cache
def doors() -> dict[str, tuple[Callable[..., object], dict[str, Any]]]:
    """What can be called by name, with arguments that are good."""
    mesh, cameras, light = renderer.solid("plate"), renderer.ring(1, 2.2), renderer.load_light("grace")
    image = renderer.ImageSettings(8, 1)
    operator = renderer.operators(mesh, cameras, 8, samples=1, visibility="software")[0]
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * 64, 2))
    classifier = augment.Classifier(network, 8, ["a", "b"])
    scene = augment.build_scene([(mesh, "a")], 8, samples=1, visibility="software")
    settings = augment.AttackSettings(lighting=augment.StepSettings(radius=0.1), max_steps=1)
    attacked = augment.attack(classifier, scene, settings=settings, force=True)
    service = augment.AugmentationService.from_meshes([(mesh, 0)], 8, views=1, samples=1, visibility="software")
    whole = {name: getattr(mesh, name) for name in ARRAYS}

    def fields(settings: object) -> dict[str, object]:
        return dict(vars(settings))

    def built(settings: Callable[..., Any]) -> Callable[..., object]:
        return lambda **given: settings(**given).build()

    return {
        "render": (renderer.render, {"mesh": mesh, "cameras": cameras, "light": light, "size": 8, "background": 0.5}
                   | {"vertices": None, "albedo": None, "gain": 1.0} | SMALL),
        "operators": (renderer.operators, {"mesh": mesh, "cameras": cameras, "size": 8, "gain": 1.0} | SMALL),
        "ring": (renderer.ring, {"views": 2, "field_of_view": 2.0, "polar": 1.0, "azimuth": 0.0, "perspective": None}),
        "OrthographicCamera": (renderer.OrthographicCamera, CAMERA),
        "PerspectiveCamera": (renderer.PerspectiveCamera, CAMERA | {"distance": 4.0}),
        "ImageSettings": (renderer.ImageSettings, fields(image)),
        "load_light": (renderer.load_light, {"light": "grace"}),
        "save_light": (renderer.save_light, {"path": Path("light.json"), "coefficients": light}),
        "load_mesh": (renderer.load_mesh, {"path": "mesh.glb", "up": "auto"}),
        "normalise": (renderer.normalise, {"mesh": mesh}),
        "export_mesh": (renderer.export_mesh, {"mesh": mesh, "path": "mesh.glb", "normals": "flat", "cameras": ()}),
        "solid": (renderer.solid, {"name": "plate", "seed": 0}),
        "subdivide": (renderer.subdivide, {"mesh": mesh, "vertices": 1}),
        "Mesh": (renderer.Mesh, whole),
        "Mesh.plain": (renderer.Mesh.plain, {"vertices": mesh.vertices, "faces": mesh.faces, "color": (1, 1, 1)}),
        "Operator.image": (operator.image, {"lights": light, "background": 0.5}),
        "Operator.radiance": (operator.radiance, {"lights": light}),
        "Operator.light_gradient": (operator.light_gradient, {"radiance_gradient": operator.radiance(light)}),
        "Operator.to": (operator.to, {"device": "cpu"}),
        "Classifier": (augment.Classifier, {"function": network, "size": 8, "classes": ["a", "b"], "name": "x"}),
        "Classifier.forward": (classifier, {"images": torch.zeros(1, 3, 8, 8)}),
        "Classifier.label": (classifier.label, {"class_name": "a"}),
        "load_classifier": (augment.load_classifier, {"name": "none", "weights": "none.pt"}),
        "build_scene": (augment.build_scene, {"meshes": [(mesh, "a")], "size": 8, "vertices": 0, "operators": None}
                        | {"device": "cpu"} | OF_SCENE | SMALL),
        "Scene": (augment.Scene, {"objects": scene.objects, "examples": scene.examples, "lights": light, "taken": None}
                  | {"backgrounds": torch.zeros(1, 3, 8, 8), "settings": image, "backend": scene.backend}),
        "attack": (augment.attack, {"classifier": classifier, "scene": scene, "settings": settings, "force": True}
                   | {"criterion": augment.Misclassification(), "seed": 0}),
        "Targeted": (augment.Targeted, {"classes": "b"}),
        "AttackResult.sweep": (attacked.sweep, {"scales": [1.0]}),
        "AttackResult.transfer": (attacked.transfer, {"classifiers": [], "azimuths": [], "objects": []}),
        "AttackResult.save": (attacked.save, {"folder": Path("saved"), "checks": None, "verify": ()}),
        "AttackSettings": (augment.AttackSettings, fields(settings)),
        "SkylightSettings": (augment.SkylightSettings, {"zenith": 45.0, "azimuth": 0.0, "turbidity": 3.0}),
        "StepSettings": (augment.StepSettings, fields(augment.StepSettings())),
        "AugmentationSettings": (augment.AugmentationSettings, fields(augment.AugmentationSettings())),
        "VariationSettings": (augment.VariationSettings, fields(augment.VariationSettings())),
        "AugmentationService": (augment.AugmentationService, {"settings": augment.AugmentationSettings(), "seed": 0}
                                | {"scene": scene, "labels": torch.zeros(1, dtype=torch.int64), "phases": Phases()}),
        "AugmentationService.from_meshes": (augment.AugmentationService.from_meshes, {"meshes": [(mesh, 0)], "size": 8}
                                            | {"settings": None, "views": 1, "backgrounds": [0.5], "seed": 0} | SMALL),
        "AugmentationService.regenerate": (service.regenerate, {"model": network, "number": 0}),
        "LampsSettings": (built(augment.LampsSettings), fields(augment.LampsSettings())),
        "ProjectorSettings": (built(augment.ProjectorSettings), fields(augment.ProjectorSettings())),
        "CameraEffectSettings": (augment.CameraEffectSettings, fields(augment.CameraEffectSettings())),
        "ObjectSettings": (augment.ObjectSettings, {"mesh": "solid:plate", "label": "a", "gain": 1.0, "color": None}),
        "PropSettings": (augment.PropSettings, fields(augment.PropSettings("solid:plate", [1.0, 1.0]))),
    }  # fmt: skip


def test_every_name_of_the_doors_is_here():
    names = {name for name in (*renderer.__all__, *augment.__all__) if name not in RESULTS}
    without_arguments = {"Misclassification", "LeastLikely"}
    assert names - without_arguments <= doors().keys()


@pytest.mark.filterwarnings("ignore")  # of NumPy and torch, on what is then refused or used
@pytest.mark.parametrize("others", [FEW, pytest.param(MANY, marks=pytest.mark.slow)], ids=["few", "many"])
def test_what_is_given_instead_of_an_argument_is_used_or_refused_by_name(tmp_path, monkeypatch, others):
    monkeypatch.chdir(tmp_path)
    faults, tried = [], 0
    for door, (function, good) in doors().items():
        for name in good:
            for other in others:
                words = {name, str(other), repr(other), "classifier=", "no name", "nothing is to be"}
                fault = fault_of(function, good | {name: other}, words)
                tried += 1
                faults += [f"{door}({name}={other!r}): {fault}"] if fault else []
    assert tried > 150 * len(others) and not faults, "\n".join(faults)


def fault_of(function: Callable[..., object], arguments: dict[str, Any], words: set[str]) -> str | None:
    """What is wrong with how a call ends; a refusal has one of the words."""
    try:
        function(**arguments)
    except InputError as error:
        said = str(error)
        return None if any(word in said for word in words) and "\n" not in said else said
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


@checked
def example(
    mesh: renderer.Mesh, sizes: list[int], scale: float = 1.0, *, at: tuple[int, str] | None = None, **more: int
) -> float:
    return scale


REFUSED = [
    ({"mesh": None}, "mesh is None: give Mesh"),
    ({"sizes": [1, "a"]}, "sizes is [1, 'a']: give list[int]"),
    ({"sizes": (1,)}, "sizes is (1,): give list[int]"),
    ({"scale": True}, "scale is True: give float"),
    ({"scale": torch.zeros(2, dtype=torch.int64)}, "scale is Tensor of torch.int64 (2,): give float"),
    ({"at": (1, 2)}, "at is (1, 2): give tuple[int, str] | None"),
    ({"at": (1,)}, "at is (1,): give tuple[int, str] | None"),
]


@pytest.mark.parametrize("changed, sentence", REFUSED)
def test_a_wrong_argument_is_named_with_what_it_is_and_what_to_give(changed, sentence):
    good = {"mesh": renderer.solid("plate"), "sizes": [1]}
    assert example(**good, scale=np.float32(2), at=(np.int64(1), "a"), anything=None) == 2
    with pytest.raises(InputError, match=f"^{re.escape(sentence)}$"):
        example(**good | changed)


def test_an_argument_too_many_or_too_few_is_pythons_own_error():
    with pytest.raises(TypeError, match="positional argument"):
        example()
    with pytest.raises(TypeError, match="positional argument"):
        renderer.normalise(renderer.solid("plate"), 1)
