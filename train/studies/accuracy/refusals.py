"""What is no valid input, and the errors that say so."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import inf, nan
from typing import Any

import torch

from renderer.albedo import face_albedo, textured_albedo
from renderer.basis import Harmonics
from renderer.camera import OrthographicCamera
from renderer.fragments import build_fragments
from renderer.harmonics import MAX_DEGREE, basis, rotate
from renderer.image import ImageSettings, develop
from renderer.mesh import Mesh
from renderer.shading import irradiance, radiance
from renderer.transfer import build_operators
from train.studies.accuracy.measure import BACKEND, CAMERA, SETTINGS, light
from train.studies.accuracy.shapes import TRIANGLE


@dataclass(frozen=True)
class Refusal:
    """What a call was given, and whether an error named the argument."""

    call: str
    argument: str
    value: str
    named: bool


def refusals() -> Iterator[Refusal]:
    for (call, argument, value), attempt in _attempts().items():
        try:
            attempt()
        except ValueError as error:
            yield Refusal(call, argument, value, argument in str(error))
        else:
            yield Refusal(call, argument, value, False)


def _attempts() -> dict[tuple[str, str, str], Callable[[], object]]:
    """By call, argument and what it is given."""
    [operator] = build_operators(TRIANGLE, [CAMERA], SETTINGS, BACKEND)
    [fragments] = build_fragments(TRIANGLE.vertices, TRIANGLE.faces, [CAMERA], SETTINGS, BACKEND)
    vertices, albedo = torch.from_numpy(TRIANGLE.vertices), torch.ones(len(fragments.pixel), 3, dtype=torch.float64)
    faces, good, bad, black = torch.from_numpy(TRIANGLE.faces), light(), light() * nan, torch.zeros(3, 1)
    colored = Mesh.plain(TRIANGLE.vertices, TRIANGLE.faces, (nan, 1, 1))
    build, image, shade = "build_operators", "Operator.radiance", "shading.radiance"
    return {
        (build, "vertices", "NaN"): lambda: _build(replace(TRIANGLE, vertices=nan * TRIANGLE.vertices)),
        (build, "vertices", "∞"): lambda: _build(replace(TRIANGLE, vertices=inf * TRIANGLE.vertices)),
        (build, "corner_colors", "NaN"): lambda: _build(colored),
        (build, "gain", "NaN"): lambda: _build(gain=nan),
        (build, "camera", "at NaN"): lambda: _build(camera=OrthographicCamera(nan, 0, 2)),
        (build, "degree", "21"): lambda: _build(basis=Harmonics(MAX_DEGREE + 1)),
        (image, "lights", "NaN"): lambda: operator.radiance(bad),
        (image, "lights", "10³¹"): lambda: operator.radiance(1e31 * good),
        (image, "lights", "of another degree"): lambda: operator.radiance(light(2)),
        ("Operator.light_gradient", "radiance_gradient", "NaN"): lambda: operator.light_gradient(
            nan * operator.radiance(good)
        ),
        (shade, "vertices", "NaN"): lambda: radiance(fragments, nan * vertices, good, albedo),
        (shade, "vertices", "NaN, with vertex normals"): lambda: radiance(
            fragments, nan * vertices, good, albedo, faces
        ),
        (shade, "light", "NaN"): lambda: radiance(fragments, vertices, bad, albedo),
        (shade, "albedo", "NaN"): lambda: radiance(fragments, vertices, good, nan * albedo),
        ("shading.irradiance", "normals", "NaN"): lambda: irradiance(nan * vertices, good),
        ("textured_albedo", "texture", "NaN"): lambda: textured_albedo(TRIANGLE, fragments, [bad[None]], "linear"),
        ("face_albedo", "albedo", "NaN"): lambda: face_albedo(nan * albedo[:1], fragments),
        ("basis", "directions", "NaN"): lambda: basis(nan * vertices, 6),
        ("rotate", "coefficients", "NaN"): lambda: rotate(bad, torch.eye(3)),
        ("develop", "radiance", "NaN"): lambda: develop(nan * black, black[:1] + 1, black),
        ("develop", "background", "NaN"): lambda: develop(black, black[:1], nan * black),
        ("OrthographicCamera", "field_of_view", "0"): lambda: OrthographicCamera(0, 0, 0),
        ("ImageSettings", "size", "0"): lambda: ImageSettings(size=0),
    }


def _build(mesh: Mesh = TRIANGLE, camera: OrthographicCamera = CAMERA, **options: Any) -> None:
    build_operators(mesh, [camera], SETTINGS, BACKEND, **options)
