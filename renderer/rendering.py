"""Meshes to images in one call: `render` by all that can be differentiated, `precompute_transfer` for many lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from renderer.albedo import face_albedo, surface_albedo, textured_albedo
from renderer.camera import Camera
from renderer.errors import FACTOR, InputError, require_range
from renderer.fragments import Fragments, build_fragments
from renderer.image import ImageSettings, as_background, composite
from renderer.light.basis import Harmonics
from renderer.light.harmonics import degree_of
from renderer.mesh import Mesh
from renderer.rasterizer import choose
from renderer.shading import radiance
from renderer.transfer import TransferOperator, build_operators
from renderer.transport.precomputed import build_transport
from renderer.transport.surface import Surface

if TYPE_CHECKING:
    from jaxtyping import Float

_choose = cache(choose)  # "auto" asks the driver, which takes longer than an image


def render(
    mesh: Mesh,
    cameras: Camera | Sequence[Camera],
    light: Float[Tensor, "coefficients 3"],
    size: int = 224,
    background: float | Float[Tensor, "*views channels size size"] | Float[Tensor, " 3"] = 0.5,
    *,
    vertices: Float[Tensor, "N 3"] | None = None,
    albedo: Float[Tensor, "F 3"] | Float[Tensor, "height width 3"] | None = None,
    albedo_scale: float = 1.0,
    samples: int = 2,
    encoding: str = "linear",
    normals: str = "smooth",
    shadows: bool = False,
    bounces: int = 0,
    rasterizer: str = "auto",
) -> Float[Tensor, "V 3 size size"]:
    """Images in [0, 1] of a mesh from V cameras; differentiable in light, vertices and albedo.

    light: (degree + 1)² coefficients (`load_light`), whose dtype and device the images have. background: see
    `renderer.image.as_background`; one for all views or an image for each. vertices: in place of the mesh's; the
    gradient holds fixed which face covers each sample. albedo: linear, in place of the mesh's colors per face, or in
    place of the texture of a mesh that has one. albedo_scale multiplies the albedo. samples: per pixel
    side. encoding: linear or srgb. normals: flat or smooth. shadows: that the mesh casts on
    itself. bounces: with shadows and light that its own colors send on so many times; the gradient by vertices and
    albedo holds both fixed.
    rasterizer: auto, opengl, numba or numpy.
    InputError: NaN, shapes that do not fit, unknown choices.
    """
    settings = ImageSettings(size, samples, encoding, normals, shadows, bounces)
    require_range("albedo_scale", albedo_scale, 0, FACTOR)
    if vertices is not None and vertices.shape != mesh.vertices.shape:
        given = tuple(vertices.shape)
        raise InputError(f"vertices of shape {given} does not fit the mesh: give {mesh.vertices.shape}")
    vertices = (torch.from_numpy(mesh.vertices) if vertices is None else vertices).to(light)
    positions = vertices.detach().cpu().double().numpy()
    views = build_fragments(positions, mesh.faces, _listed(cameras), settings, _choose(rasterizer), closed=mesh.closed)
    backgrounds = as_background(background, size, light).expand(len(views), -1, -1, -1)
    smooth_faces = torch.from_numpy(mesh.faces).to(light.device) if normals == "smooth" else None
    moved = replace(mesh, vertices=positions)
    indirect = build_transport(moved, settings, albedo_scale, Harmonics(degree_of(light)))
    images = []
    for view, behind in zip(views, backgrounds, strict=True):
        seen = view.to(light.device)
        colors = _albedo(mesh, seen, albedo, encoding).to(light) * albedo_scale
        shade = radiance(seen, vertices, light, colors, smooth_faces)
        if indirect is not None:
            surface = Surface.of(moved, view, settings)
            shade = shade + indirect.radiance(surface, colors.detach().cpu().double(), light)
        images.append(composite(shade, seen.coverage.to(light), seen.pixels, behind, encoding))
    return torch.stack(images)


def precompute_transfer(
    mesh: Mesh,
    cameras: Camera | Sequence[Camera],
    size: int = 224,
    *,
    albedo_scale: float = 1.0,
    samples: int = 2,
    encoding: str = "linear",
    normals: str = "smooth",
    shadows: bool = False,
    bounces: int = 0,
    rasterizer: str = "auto",
) -> list[TransferOperator]:
    """One operator per camera: images and gradients under any number of lights without another look at the mesh.

    `operator.image(light, background)` is the image that `render` makes, to rounding. Keywords as there.
    """
    settings = ImageSettings(size, samples, encoding, normals, shadows, bounces)
    require_range("albedo_scale", albedo_scale, 0, FACTOR)
    return build_operators(mesh, _listed(cameras), settings, _choose(rasterizer), albedo_scale)


def _listed(cameras: Camera | Sequence[Camera]) -> Sequence[Camera]:
    listed = cameras if isinstance(cameras, Sequence) else [cameras]
    if not listed:
        raise InputError("cameras is empty: give one camera or several")
    return listed


def _albedo(mesh: Mesh, view: Fragments, albedo: Tensor | None, encoding: str) -> Tensor:
    """(S, 3) linear albedo at a view's samples."""
    if albedo is None:
        return surface_albedo(mesh, view, encoding)
    if albedo.shape == mesh.faces.shape:
        return face_albedo(albedo, view)
    if albedo.ndim == 3 and albedo.shape[2] == 3 and len(mesh.textures) == 1:
        return textured_albedo(mesh, view, [albedo], encoding)
    raise InputError(
        f"albedo of shape {tuple(albedo.shape)} does not fit the mesh: give {tuple(mesh.faces.shape)}, a color per "
        "face, or (H, W, 3) for a mesh that has one texture"
    )
