"""Images of objects whose vertices, colors, gloss or lamps change, view by view; moved views are rasterized again.

Shadows and bounces of environment light are frozen at a shape close by, with the mesh's gloss (`FrozenTransport`);
shadows of local lights are those of the moved shape itself (`renderer.transport.local`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from augment.objects import SceneObject
from renderer.albedo import painted_albedo, surface_albedo
from renderer.camera import Camera
from renderer.fragments import Fragments, build_fragments
from renderer.gloss import Gloss, sample_gloss
from renderer.image import ImageSettings, decode
from renderer.light.basis import Basis, parts_of
from renderer.mesh import Mesh
from renderer.rasterizer import Rasterizer
from renderer.rendering import Shading, view_radiance, view_with_outlines
from renderer.shading import normals_in_sight
from renderer.transport.local import LocalLightView
from renderer.transport.precomputed import build_transport
from renderer.transport.rays import Rays, Surface

if TYPE_CHECKING:
    from augment.scene import Conditions

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

    @cached_property
    def _faces(self) -> list[Tensor]:
        return [torch.from_numpy(item.mesh.faces).to(self.like.device) for item in self.objects]

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
            mesh, (fragments, _) = self.objects[number].mesh, self.view(*key)
            rays = self._rays.setdefault(number, Rays(mesh))
            self._local_views[key] = LocalLightView(rays, mesh, fragments, self.settings)
        return self._local_views[key]

    def radiance(
        self,
        example: int,
        number: int,
        camera: Camera,
        light: Tensor,
        changed: Conditions,
        background: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Pixels (P,) of an object, their coverage (P,), and its radiance (3, P) in a light (size, 3); differentiable
        in all tensors, with `settings.silhouettes` also in tensors among the camera's fields.

        example: whose shapes change little from call to call. changed: a row of conditions, of which light and cameras
        are those given. background: image values behind the object, (3 or 1, size²).
        """
        item, settings, moving_camera, camera = self.objects[number], self.settings, camera, camera.fixed()
        vertices, gloss = changed.vertices, None
        if vertices is None:
            corners, shape = self.vertices[number], item.mesh.vertices
            fragments, albedo = self.view(number, camera)
        else:
            corners, shape = vertices, vertices.detach().cpu().double().numpy()
            fragments, albedo = self._rasterized(number, camera, shape)
        if changed.albedo is not None:
            painted = item.mesh, fragments, settings.encoding, item.albedo_scale, changed.albedo
            albedo = painted_albedo(*painted, changed.hue)
        if changed.gloss is not None:
            gloss = Gloss(*changed.gloss.unbind(1), textured=True)
        if settings.normals == "flat":
            normals = None
        elif vertices is None:
            normals = torch.from_numpy(item.mesh.vertex_normals).to(self.like.device)  # which all views share
        else:
            normals = normals_in_sight(fragments, corners, self._faces[number])
        lights = [(part, light[where]) for where, part in parts_of(self.basis)]

        @cache  # called only where the scene has local lights
        def local_view() -> LocalLightView:
            if vertices is None and gloss is None:
                return self.local_view(number, camera)
            moved = replace(item.mesh, vertices=shape)
            rays = self._rays.setdefault(number, Rays(moved)) if vertices is None else Rays(moved)
            return LocalLightView(rays, item.mesh, fragments, settings, vertices, gloss)

        def indirect(albedo: Tensor, light: Tensor) -> Tensor:
            frozen = self._transport_near(example, number, camera, shape)
            added = frozen.radiance(camera, fragments, albedo, light)
            if camera is not moving_camera:  # it will not come back
                del frozen.views[camera]
            return added

        extra = indirect if settings.global_illumination else None
        shine = sample_gloss(item.mesh, fragments, gloss)
        shading = Shading(corners, albedo, lights, normals, local_view, extra, changed.positions, shine)
        if vertices is None or not settings.silhouettes:
            return fragments.pixels, fragments.coverage.to(self.like), view_radiance(fragments, shading)
        behind = decode(background, settings.encoding).expand(3, -1)
        return view_with_outlines(moving_camera, fragments, self._faces[number], behind, shading)

    def _transport_near(self, example: int, number: int, camera: Camera, vertices: np.ndarray) -> FrozenTransport:
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
