"""Images of objects whose vertices, colors, gloss or lamps change, view by view; moved views are rasterized again.

Shadows and bounces of environment light are frozen at a shape close by, with the mesh's gloss (`FrozenTransport`);
shadows of local lights are those of the moved shape itself (`renderer.transport.lamp_paths`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from augment.scene.objects import SceneObject
from renderer.camera import Camera
from renderer.geometry.mesh import Mesh
from renderer.light.basis import Basis, split_light
from renderer.settings import ImageSettings
from renderer.shaded_view import PixelRadiance, ShadedView
from renderer.surface.albedo import painted_albedo, surface_albedo
from renderer.surface.gloss import Gloss
from renderer.transport.lamp_paths import LocalLightView
from renderer.transport.precomputed import build_transport
from renderer.transport.rays import Rays, Surface
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import Rasterizer

if TYPE_CHECKING:
    from augment.scene.conditions import Conditions

NEAR = 0.001  # world units: shadows and bounces are computed again once a coordinate has moved farther


class FrozenTransport:
    """The radiance that shadows and bounces add to views of a mesh, per unit of each coefficient of environment light.

    It stays in place in the image, as the outline does for derivatives, and is scaled with the albedo of its pixel.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis):
        self.mesh, self._settings = mesh, settings
        self._transport = build_transport(mesh, settings, albedo_scale, basis)
        self.views: dict[Camera, tuple[Tensor, Tensor] | None] = {}

    def is_near(self, vertices: np.ndarray) -> bool:
        """Whether vertices (V, 3) are near the mesh's."""
        return bool(np.abs(vertices - self.mesh.vertices).max() <= NEAR)

    def add(self, camera: Camera, fragments: Fragments, albedo: Tensor) -> None:
        """Add a view of the mesh, with its albedo at the samples (S, 3)."""
        surface = Surface(self.mesh, fragments.to("cpu"), self._settings)
        change = self._transport.change(surface, albedo.cpu().double()) if self._transport else None
        self.views[camera] = None
        if change is not None:
            canvas = change.new_zeros(*change.shape[:2], fragments.size**2)
            canvas[..., surface.fragments.pixels] = change
            self.views[camera] = canvas.to(albedo), _by_pixel(fragments, albedo)

    def radiance(self, camera: Camera, fragments: Fragments, albedo: Tensor, light: Tensor) -> Tensor:
        """(3, P) at the fragments of an added view, with albedo (S, 3) in light (size, 3); differentiable in both."""
        view = self.views[camera]
        if view is None:
            return light.new_zeros(3, len(fragments.pixels))
        change, before = (values[..., fragments.pixels] for values in view)
        added = torch.einsum("ckp,kc->cp", change.to(light), light)
        now = _by_pixel(fragments, albedo)[:, fragments.pixels]
        return added * torch.where(before > 0, now / before.masked_fill(before == 0, 1), 1).to(light)


def _by_pixel(fragments: Fragments, albedo: Tensor) -> Tensor:
    """(3, size²) the sum of the samples' albedo (S, 3) over each pixel."""
    pixel = fragments.pixels[fragments.pixel]
    return albedo.new_zeros(3, fragments.size**2).index_add(1, pixel, albedo.T)


@dataclass(eq=False, repr=False)
class Reshading:
    """Views of objects, which are given by their numbers.

    basis: of the lights. like: has the dtype and the device of the images. cached: keep the views of unmoved objects.
    """

    objects: Sequence[SceneObject]
    settings: ImageSettings
    rasterizer: Rasterizer
    basis: Basis
    like: Tensor
    cached: bool = True

    def __post_init__(self) -> None:
        self._views: dict[tuple[int, Camera], tuple[Fragments, Tensor]] = {}
        self._local_views: dict[tuple[int, Camera], LocalLightView] = {}
        self._rays: dict[int, Rays] = {}
        self._unmoved_transport: dict[int, FrozenTransport] = {}  # of objects
        self._moved_transport: dict[int, FrozenTransport] = {}  # of examples

    @cached_property
    def vertices(self) -> list[Tensor]:
        """(V, 3) of each unmoved object."""
        return [torch.from_numpy(item.mesh.vertices).to(self.like) for item in self.objects]

    def view(self, number: int, camera: Camera) -> tuple[Fragments, Tensor]:
        """Fragments of an unmoved object, and its albedo at the samples (S, 3)."""
        key = number, camera
        view = self._views.get(key) or self._rasterized(*key, self.objects[number].mesh.vertices)
        if self.cached:
            self._views[key] = view
        return view

    def local_view(self, number: int, camera: Camera) -> LocalLightView:
        """An unmoved object in local light."""
        key = number, camera
        if key not in self._local_views:
            fragments, _ = self.view(*key)
            shape = self.objects[number].mesh
            rays = self._rays_among(number)
            self._local_views[key] = LocalLightView(rays, shape, fragments, self.settings)
        return self._local_views[key]

    def radiance(
        self,
        example: int,
        number: int,
        camera: Camera,
        light: Tensor,
        changed: Conditions,
        background: Tensor,
    ) -> PixelRadiance:
        """Compute the radiance of an object, differentiable in all tensors.

        With `settings.silhouettes`, it is also differentiable in tensors among
        the fields of the camera.

        Args:
            example: Number of the example. The shapes of one example change
                little from call to call.
            number: Number of the object.
            camera: The camera.
            light: Coefficients of the basis, shape (size, 3).
            changed: A row of conditions, without their light and cameras.
            background: Image values behind the object, shape (3 or 1, size²).

        Returns:
            The radiance of the view's pixels.
        """
        item = self.objects[number]
        fixed_camera = camera.fixed()
        is_moved = changed.vertices is not None
        if changed.vertices is None:
            vertices = self.vertices[number]
            positions = item.mesh.vertices
            fragments, albedo = self.view(number, fixed_camera)
        else:
            vertices = changed.vertices
            positions = vertices.detach().cpu().double().numpy()
            fragments, albedo = self._rasterized(number, fixed_camera, positions)
        if changed.albedo is not None:
            painted = item.mesh, fragments, self.settings.encoding, item.albedo_scale
            albedo = painted_albedo(*painted, changed.albedo, changed.hue)
        gloss = None
        if changed.gloss is not None:
            gloss = Gloss(*changed.gloss.unbind(1), textured=True)
        split = split_light(self.basis, light)
        rays = None
        lamp_view = None
        if split.local_lights:
            rays = Rays(replace(item.mesh, vertices=positions)) if is_moved else self._rays_among(number)
            if not is_moved and gloss is None:
                lamp_view = self.local_view(number, fixed_camera)
        indirect = None
        if self.settings.global_illumination:
            is_kept = camera is fixed_camera
            frozen = _FrozenView(self, example, number, fixed_camera, fragments, positions, is_kept)
            indirect = frozen.radiance
        shares_normals = not is_moved and self.settings.normals == "smooth"
        shown = ShadedView(
            mesh=item.mesh,
            fragments=fragments,
            settings=self.settings,
            vertices=vertices,
            albedo=albedo,
            light=split,
            rays=rays,
            is_moved=is_moved,
            gloss=gloss,
            vertex_normals=self._vertex_normals(number) if shares_normals else None,
            lamp_view=lamp_view,
            indirect=indirect,
            lamp_positions=changed.positions,
        )
        return shown.pixel_radiance(camera, background)

    def _rays_among(self, number: int) -> Rays:
        """Return rays among the faces of an unmoved object."""
        return self._rays.setdefault(number, Rays(self.objects[number].mesh))

    def _vertex_normals(self, number: int) -> Tensor:
        """Return the normals (V, 3) of an unmoved object, which all its views share."""
        return torch.from_numpy(self.objects[number].mesh.vertex_normals).to(self.like.device)

    def transport_near(self, example: int, number: int, camera: Camera, vertices: np.ndarray) -> FrozenTransport:
        """The transport of a shape near the vertices (V, 3) of an example, with the camera's view of that shape."""
        mesh, fixed = self.objects[number].mesh, (self.settings, self.objects[number].albedo_scale, self.basis)
        if number not in self._unmoved_transport:
            self._unmoved_transport[number] = FrozenTransport(mesh, *fixed)
        frozen = self._unmoved_transport[number]
        if not frozen.is_near(vertices):
            frozen = self._moved_transport.get(example, frozen)
            if not frozen.is_near(vertices):
                frozen = FrozenTransport(replace(mesh, vertices=vertices), *fixed)
            self._moved_transport[example] = frozen
        if camera not in frozen.views:
            frozen.add(camera, *self._rasterized(number, camera, frozen.mesh.vertices))
        return frozen

    def _rasterized(self, number: int, camera: Camera, vertices: np.ndarray) -> tuple[Fragments, Tensor]:
        """Fragments of an object with these vertices, and its albedo at the samples (S, 3)."""
        item, settings = self.objects[number], self.settings
        drawn = vertices, item.mesh.faces, [camera], settings, self.rasterizer
        fragments = build_fragments(*drawn, closed=item.mesh.closed)[0].to(self.like.device)
        return fragments, (surface_albedo(item.mesh, fragments, settings.encoding) * item.albedo_scale).to(self.like)


@dataclass(frozen=True, eq=False)
class _FrozenView:
    """Shadows and bounces in one view of a shape, frozen at a shape close by.

    Attributes:
        reshading: What keeps the frozen shapes.
        example: Number of the example.
        number: Number of the object.
        camera: The camera.
        fragments: The samples of the view, in P pixels.
        positions: Positions of the shape's vertices, shape (V, 3).
        is_kept: Whether the camera will come back.
    """

    reshading: Reshading
    example: int
    number: int
    camera: Camera
    fragments: Fragments
    positions: np.ndarray
    is_kept: bool

    def radiance(self, albedo: Tensor, light: Tensor) -> Tensor:
        """Return the radiance (3, P) that they add, with albedo (S, 3) in light (size, 3)."""
        frozen = self.reshading.transport_near(self.example, self.number, self.camera, self.positions)
        added = frozen.radiance(self.camera, self.fragments, albedo, light)
        if not self.is_kept:
            del frozen.views[self.camera]
        return added
