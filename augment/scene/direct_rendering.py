"""Render objects whose vertices, colors, gloss or lamps change, one view at a time.

Each view of moved vertices is rasterized again. The shadows and bounces of environment light are
not computed again for each motion: `FrozenTransport` keeps those of a shape nearby, with the gloss
of the mesh. The shadows of local lights are those of the moved shape itself
(`renderer.transport.lamp_paths`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from augment.scene.objects import SceneObject
from renderer.camera import Camera
from renderer.geometry.mesh import Mesh
from renderer.light.basis import Basis, split_light
from renderer.settings import ImageSettings
from renderer.shaded_view import PixelRadiance, ShadedView
from renderer.shading.gloss import Gloss
from renderer.surface.albedo import paint_faces, surface_albedo
from renderer.transport.lamp_paths import LocalLightView
from renderer.transport.precomputed import build_transport
from renderer.transport.rays import Rays, Surface
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import Rasterizer

if TYPE_CHECKING:
    from augment.scene.conditions import Conditions

# `FrozenTransport.is_near` allows this change of each coordinate of each vertex, in world
# units. Shadows and bounces are computed again if a vertex has moved further.
NEAR = 0.001


class FrozenView(NamedTuple):
    """Radiance that shadows and bounces add to a view of a mesh with a known albedo.

    Attributes:
        change: Radiance that is added per unit of each of K coefficients of the
            light, for each channel and pixel, shape (3, K, size²).
        albedo_sums: Sum of the albedo of all samples of each pixel, shape
            (3, size²).
    """

    change: Tensor
    albedo_sums: Tensor


class FrozenTransport:
    """The radiance that shadows and bounces of environment light add to views of a mesh.

    The added radiance of each pixel is scaled with the albedo of this pixel. It
    does not move with the object in the image.

    Attributes:
        mesh: The mesh that casts the shadows.
        views: What was added for each camera. None if nothing was added.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis):
        """Precompute the transport of a mesh.

        Args:
            mesh: The mesh.
            settings: Settings of the images.
            albedo_scale: Factor of the albedo of the mesh.
            basis: Basis of the light.
        """
        self.mesh = mesh
        self.views: dict[Camera, FrozenView | None] = {}
        self._settings = settings
        self._transport = build_transport(mesh, settings, albedo_scale, basis)

    def is_near(self, vertices: np.ndarray) -> bool:
        """Return whether all coordinates of vertices (V, 3) are within `NEAR` of the mesh."""
        return bool(np.abs(vertices - self.mesh.vertices).max() <= NEAR)

    def add(self, camera: Camera, fragments: Fragments, albedo: Tensor) -> None:
        """Compute and keep what is added to a view of the mesh.

        Args:
            camera: The camera of the view.
            fragments: The S samples of the mesh in the view.
            albedo: Albedo of the mesh at the samples, shape (S, 3).
        """
        self.views[camera] = None
        if not self._transport:
            return
        surface = Surface(self.mesh, fragments.to("cpu"), self._settings)
        change = self._transport.change(surface, albedo.cpu().double())
        if change is None:
            return
        # `change` has the covered pixels only. All pixels of the image are kept, because
        # a shape nearby may cover other pixels. Shape (3, K, size²).
        all_pixels = change.new_zeros(*change.shape[:2], fragments.size**2)
        all_pixels[..., surface.fragments.pixels] = change
        self.views[camera] = FrozenView(all_pixels.to(albedo), _sum_by_pixel(fragments, albedo))

    def radiance(
        self, camera: Camera, fragments: Fragments, albedo: Tensor, light: Tensor
    ) -> Tensor:
        """Compute the added radiance of a view, differentiable in albedo and light.

        Args:
            camera: A camera whose view was added.
            fragments: The S samples of the shape, in P pixels. The shape may
                differ a little from the mesh.
            albedo: Albedo at the samples, shape (S, 3).
            light: Coefficients of the environment light, shape (K, 3).

        Returns:
            The added radiance, shape (3, P).
        """
        view = self.views[camera]
        if view is None:
            return light.new_zeros(3, len(fragments.pixels))
        change = view.change[..., fragments.pixels]
        old_sums = view.albedo_sums[..., fragments.pixels]
        new_sums = _sum_by_pixel(fragments, albedo)[:, fragments.pixels]
        # Shape (3, P).
        added = torch.einsum("ckp,kc->cp", change.to(light), light)
        # The added radiance is proportional to the albedo of the pixel. If the albedo of
        # the mesh is 0 there, no ratio exists, and the radiance is not scaled.
        ratios = new_sums / old_sums.masked_fill(old_sums == 0, 1)
        return added * torch.where(old_sums > 0, ratios, 1).to(light)


def _sum_by_pixel(fragments: Fragments, albedo: Tensor) -> Tensor:
    """Sum the albedo of the samples in each pixel of an image.

    Args:
        fragments: The S samples, in P of the size² pixels of the image.
        albedo: Albedo at the samples, shape (S, 3).

    Returns:
        Sum of each channel in each pixel, shape (3, size²). It is 0 in pixels without samples.
    """
    # Row-major index in the image of the pixel of each sample, shape (S,).
    pixel_of_sample = fragments.pixels[fragments.sample_to_pixel]
    sums = albedo.new_zeros(3, fragments.size**2)
    return sums.index_add(1, pixel_of_sample, albedo.T)


@dataclass(eq=False, repr=False)
class DirectRenderer:
    """Renders objects directly, without precomputed transfer operators.

    Attributes:
        objects: The objects. The argument `number` of methods is an index into them.
        settings: Settings of the images.
        rasterizer: The rasterizer.
        basis: Basis of the lights.
        like: A tensor with the dtype and the device of the images.
        cached: Whether the samples of unmoved objects are kept.
    """

    objects: Sequence[SceneObject]
    settings: ImageSettings
    rasterizer: Rasterizer
    basis: Basis
    like: Tensor
    cached: bool = True

    def __post_init__(self) -> None:
        """Create empty caches."""
        # The keys of these two caches are the index of an object, and a camera.
        self._views: dict[tuple[int, Camera], tuple[Fragments, Tensor]] = {}
        self._local_views: dict[tuple[int, Camera], LocalLightView] = {}
        # The keys are indices of objects.
        self._rays: dict[int, Rays] = {}
        self._transport_of_object: dict[int, FrozenTransport] = {}
        # The keys are indices of examples whose shape has moved away from the object's mesh.
        self._transport_of_example: dict[int, FrozenTransport] = {}

    @cached_property
    def vertices(self) -> list[Tensor]:
        """Return the vertices of each unmoved object, shape (V, 3)."""
        return [torch.from_numpy(item.mesh.vertices).to(self.like) for item in self.objects]

    def view(self, number: int, camera: Camera) -> tuple[Fragments, Tensor]:
        """Rasterize an unmoved object.

        Args:
            number: Index of the object.
            camera: The camera.

        Returns:
            The S samples of the object, and the albedo at the samples, shape
            (S, 3).
        """
        key = (number, camera)
        view = self._views.get(key)
        if view is None:
            view = self._rasterize(number, camera, self.objects[number].mesh.vertices)
        if self.cached:
            self._views[key] = view
        return view

    def local_view(self, number: int, camera: Camera) -> LocalLightView:
        """Prepare a view of an unmoved object for local lights.

        Args:
            number: Index of the object.
            camera: The camera.

        Returns:
            The view. It is computed once for each object and camera.
        """
        key = (number, camera)
        if key not in self._local_views:
            fragments, _ = self.view(number, camera)
            mesh = self.objects[number].mesh
            rays = self._rays_among(number)
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
    ) -> PixelRadiance:
        """Compute the radiance of an object, differentiable in all tensors.

        With `settings.silhouettes`, it is also differentiable in tensors among
        the fields of the camera.

        Args:
            example: Index of the example. The shapes of one example change
                little from call to call.
            number: Index of the object.
            camera: The camera.
            light: Coefficients of the basis, shape (K, 3).
            changed: A row of conditions, without their light and cameras.
            background: Image values behind the object, shape (3 or 1, size²).

        Returns:
            The radiance of the view's pixels.
        """
        item = self.objects[number]
        fixed_camera = camera.fixed()
        is_moved = changed.vertices is not None
        # Below, `vertices` is a tensor with a gradient, and `positions` the same as an array.
        if changed.vertices is None:
            vertices = self.vertices[number]
            positions = item.mesh.vertices
            fragments, albedo = self.view(number, fixed_camera)
        else:
            vertices = changed.vertices
            positions = vertices.detach().cpu().double().numpy()
            fragments, albedo = self._rasterize(number, fixed_camera, positions)
        if changed.albedo is not None:
            painted = (item.mesh, fragments, self.settings.encoding, item.albedo_scale)
            albedo = paint_faces(*painted, changed.albedo, changed.hue)
        gloss = None
        if changed.gloss is not None:
            gloss = Gloss(*changed.gloss.unbind(1), textured=True)
        split = split_light(self.basis, light)
        # Local lights need rays for their shadows. The view of an unmoved object in local
        # light is prepared once. An unmoved object with another gloss cannot use this view.
        rays = None
        lamp_view = None
        if split.local_lights:
            moved_mesh = replace(item.mesh, vertices=positions)
            rays = Rays(moved_mesh) if is_moved else self._rays_among(number)
            if not is_moved and gloss is None:
                lamp_view = self.local_view(number, fixed_camera)
        indirect = None
        if self.settings.global_illumination:
            # `camera.fixed()` returns the camera itself if none of its fields is a tensor. A
            # field is a tensor if the camera is attacked. Such a camera changes in every call,
            # so its views are not kept.
            is_kept = camera is fixed_camera
            indirect = _IndirectLight(
                self, example, number, fixed_camera, fragments, positions, is_kept
            ).radiance
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
        """Return the ray tracer of an unmoved object, which is built once."""
        if number not in self._rays:
            self._rays[number] = Rays(self.objects[number].mesh)
        return self._rays[number]

    def _vertex_normals(self, number: int) -> Tensor:
        """Return the normals (V, 3) of an unmoved object, which all its views share."""
        return torch.from_numpy(self.objects[number].mesh.vertex_normals).to(self.like.device)

    def transport_near(
        self, example: int, number: int, camera: Camera, vertices: np.ndarray
    ) -> FrozenTransport:
        """Return shadows and bounces of a shape that is close to the shape of an example.

        Args:
            example: Index of the example. One moved shape is kept for each.
            number: Index of the object.
            camera: The camera.
            vertices: Vertices of the shape, shape (V, 3).

        Returns:
            The transport of a shape within `NEAR`, to which the view from the
            camera has been added.
        """
        frozen = self._transport_of_object.get(number)
        if frozen is None:
            frozen = self._freeze(number, self.objects[number].mesh)
            self._transport_of_object[number] = frozen
        # The unmoved mesh is tried first, then the shape that was kept for the example, and
        # otherwise the transport of the new shape is computed.
        if not frozen.is_near(vertices):
            frozen = self._transport_of_example.get(example, frozen)
            if not frozen.is_near(vertices):
                moved = replace(self.objects[number].mesh, vertices=vertices)
                frozen = self._freeze(number, moved)
            self._transport_of_example[example] = frozen
        if camera not in frozen.views:
            frozen.add(camera, *self._rasterize(number, camera, frozen.mesh.vertices))
        return frozen

    def _freeze(self, number: int, mesh: Mesh) -> FrozenTransport:
        """Compute the shadows and bounces of an object's mesh, whose vertices may be moved."""
        return FrozenTransport(mesh, self.settings, self.objects[number].albedo_scale, self.basis)

    def _rasterize(
        self, number: int, camera: Camera, vertices: np.ndarray
    ) -> tuple[Fragments, Tensor]:
        """Rasterize an object with given vertices.

        Args:
            number: Index of the object.
            camera: The camera.
            vertices: Vertices of the object's mesh, which may be moved, shape (V, 3).

        Returns:
            The S samples of the object, and the albedo at the samples, shape (S, 3).
        """
        item = self.objects[number]
        [fragments] = build_fragments(
            vertices,
            item.mesh.faces,
            [camera],
            self.settings,
            self.rasterizer,
            closed=item.mesh.closed,
        )
        fragments = fragments.to(self.like.device)
        albedo = surface_albedo(item.mesh, fragments, self.settings.encoding)
        return fragments, (albedo * item.albedo_scale).to(self.like)


@dataclass(frozen=True, eq=False)
class _IndirectLight:
    """Shadows and bounces in one view of a shape, taken from a shape nearby.

    Attributes:
        direct_rendering: Keeps the transport of shapes.
        example: Index of the example.
        number: Index of the object.
        camera: The camera.
        fragments: The S samples of the shape, in P pixels.
        positions: Vertices of the shape, shape (V, 3).
        is_kept: Whether the view is kept for further calls.
    """

    direct_rendering: DirectRenderer
    example: int
    number: int
    camera: Camera
    fragments: Fragments
    positions: np.ndarray
    is_kept: bool

    def radiance(self, albedo: Tensor, light: Tensor) -> Tensor:
        """Compute the radiance that shadows and bounces add to the P pixels of the view.

        Args:
            albedo: Albedo of the S samples, shape (S, 3).
            light: Coefficients of the environment light, shape (K, 3).

        Returns:
            Added radiance, shape (3, P).
        """
        frozen = self.direct_rendering.transport_near(
            self.example, self.number, self.camera, self.positions
        )
        added = frozen.radiance(self.camera, self.fragments, albedo, light)
        if not self.is_kept:
            del frozen.views[self.camera]
        return added
