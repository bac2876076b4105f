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
    """error: its type and message, None where nothing was raised."""

    condition: str
    error: str | None


def refusals() -> Iterator[Refusal]:
    for condition, attempt in (_attempts() | _degenerate_settings()).items():
        try:
            attempt()
        except ValueError as error:
            yield Refusal(condition, f"`{type(error).__name__}`: {error}")
        else:
            yield Refusal(condition, None)


def _attempts() -> dict[str, Callable[[], object]]:
    """Tensors with NaN, infinity or huge numbers in them."""
    [operator] = build_operators(TRIANGLE, [CAMERA], SETTINGS, BACKEND)
    [fragments] = build_fragments(TRIANGLE.vertices, TRIANGLE.faces, [CAMERA], SETTINGS, BACKEND)
    vertices, albedo = torch.from_numpy(TRIANGLE.vertices), torch.ones(len(fragments.pixel), 3, dtype=torch.float64)
    faces, good, bad, black = torch.from_numpy(TRIANGLE.faces), light(), light() * nan, torch.zeros(3, 1)
    colored = Mesh.plain(TRIANGLE.vertices, TRIANGLE.faces, (nan, 1, 1))
    return {
        "`build_operators`, vertices of NaN": lambda: _build(replace(TRIANGLE, vertices=nan * TRIANGLE.vertices)),
        "`build_operators`, vertices of ∞": lambda: _build(replace(TRIANGLE, vertices=inf * TRIANGLE.vertices)),
        "`build_operators`, colours of NaN": lambda: _build(colored),
        "`Operator.radiance`, a light of NaN": lambda: operator.radiance(bad),
        "`Operator.radiance`, a light of 10³¹": lambda: operator.radiance(1e31 * good),
        "`Operator.light_gradient`, NaN": lambda: operator.light_gradient(nan * operator.radiance(good)),
        "`shading.radiance`, vertices of NaN": lambda: radiance(fragments, nan * vertices, good, albedo),
        "the same with vertex normals": lambda: radiance(fragments, nan * vertices, good, albedo, faces),
        "`shading.radiance`, a light of NaN": lambda: radiance(fragments, vertices, bad, albedo),
        "`shading.radiance`, albedo of NaN": lambda: radiance(fragments, vertices, good, nan * albedo),
        "`shading.irradiance`, normals of NaN": lambda: irradiance(nan * vertices, good),
        "`textured_albedo`, texels of NaN": lambda: textured_albedo(TRIANGLE, fragments, [bad[None]], "linear"),
        "`face_albedo`, NaN": lambda: face_albedo(nan * albedo[:1], fragments),
        "`basis`, directions of NaN": lambda: basis(nan * vertices, 6),
        "`rotate`, a light of NaN": lambda: rotate(bad, torch.eye(3)),
        "`develop`, radiance of NaN": lambda: develop(nan * black, black[:1] + 1, black),
        "`develop`, a background of NaN": lambda: develop(black, black[:1], nan * black),
    }


def _degenerate_settings() -> dict[str, Callable[[], object]]:
    [operator] = build_operators(TRIANGLE, [CAMERA], SETTINGS, BACKEND)
    return {
        "a light of another degree than the operator's": lambda: operator.radiance(light(2)),
        "degree 21": lambda: _build(basis=Harmonics(MAX_DEGREE + 1)),
        "a gain of NaN": lambda: _build(gain=nan),
        "a camera at NaN": lambda: _build(camera=OrthographicCamera(nan, 0, 2)),
        "a frame of no width": lambda: OrthographicCamera(0, 0, 0),
        "an image of no pixels": lambda: ImageSettings(size=0),
    }


def _build(mesh: Mesh = TRIANGLE, camera: OrthographicCamera = CAMERA, **options: Any) -> None:
    build_operators(mesh, [camera], SETTINGS, BACKEND, **options)
