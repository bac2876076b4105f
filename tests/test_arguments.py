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

import renderer
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
RESULTS = {"InputError", "TransferOperator"}  # which nobody makes; their methods are below
SMALL = {"samples": 1, "encoding": "linear", "normals": "smooth", "shadows": False, "bounces": 0, "rasterizer": "numpy"}
ARRAYS = ("vertices", "faces", "corner_colors", "corner_uvs", "texture_ids", "textures")
CAMERA = {"polar": 1.0, "azimuth": 0.0, "width": 2.0, "right": 0.0, "up": 0.0, "reach": 2.0}


@cache
def doors() -> dict[str, tuple[Callable[..., object], dict[str, Any]]]:
    """What can be called by name, with arguments that are good."""
    mesh, cameras, light = renderer.solid("plate"), renderer.orbit_cameras(1, 2.2), renderer.load_light("grace")
    image = renderer.ImageSettings(8, 1)
    operator = renderer.precompute_transfer(mesh, cameras, 8, samples=1, rasterizer="numpy")[0]
    whole = {name: getattr(mesh, name) for name in ARRAYS}

    def fields(settings: object) -> dict[str, object]:
        return dict(vars(settings))

    return {
        "render": (renderer.render, {"mesh": mesh, "cameras": cameras, "light": light, "size": 8, "background": 0.5}
                   | {"vertices": None, "albedo": None, "albedo_scale": 1.0} | SMALL),
        "precompute_transfer": (renderer.precompute_transfer,
                                {"mesh": mesh, "cameras": cameras, "size": 8, "albedo_scale": 1.0} | SMALL),
        "orbit_cameras": (renderer.orbit_cameras,
                          {"views": 2, "width": 2.0, "polar": 1.0, "azimuth": 0.0, "fov": None}),
        "OrthographicCamera": (renderer.OrthographicCamera, CAMERA),
        "PerspectiveCamera": (renderer.PerspectiveCamera, CAMERA | {"distance": 4.0}),
        "ImageSettings": (renderer.ImageSettings, fields(image)),
        "load_light": (renderer.load_light, {"light": "grace"}),
        "save_light": (renderer.save_light, {"path": Path("light.json"), "coefficients": light}),
        "load_mesh": (renderer.load_mesh, {"path": "mesh.glb", "up": "auto"}),
        "normalize": (renderer.normalize, {"mesh": mesh}),
        "export_mesh": (renderer.export_mesh, {"mesh": mesh, "path": "mesh.glb", "normals": "flat", "cameras": ()}),
        "solid": (renderer.solid, {"name": "plate", "seed": 0}),
        "subdivide": (renderer.subdivide, {"mesh": mesh, "vertices": 1}),
        "Mesh": (renderer.Mesh, whole),
        "Mesh.plain": (renderer.Mesh.plain, {"vertices": mesh.vertices, "faces": mesh.faces, "color": (1, 1, 1)}),
        "TransferOperator.image": (operator.image, {"lights": light, "background": 0.5}),
        "TransferOperator.radiance": (operator.radiance, {"lights": light}),
        "TransferOperator.light_gradient": (operator.light_gradient, {"radiance_gradient": operator.radiance(light)}),
        "TransferOperator.to": (operator.to, {"device": "cpu"}),
    }  # fmt: skip


def test_every_name_of_the_doors_is_here():
    names = {name for name in renderer.__all__ if name not in RESULTS}
    assert names <= doors().keys()


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
    assert tried > 70 * len(others) and not faults, "\n".join(faults)


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
        renderer.normalize(renderer.solid("plate"), 1)
