"""Render objects whose vertices, colors, gloss or lamps change, one view at a time.

Each view of moved vertices is rasterized again. The shadows and bounces of environment light take
long to compute. `FrozenTransport` keeps them for one shape, and they are used again while the
vertices are within `NEAR` of this shape. The shadows of projector and lamps are always those of
the moved shape itself (`renderer.operators.lamp_paths`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.scene.objects import SceneObject
from renderer.camera import Camera
from renderer.light.basis import Basis, split_light
from renderer.mesh import Mesh
from renderer.operators.lamp_paths import LocalLightView
from renderer.operators.rays import Rays, Surface
from renderer.operators.shadows import build_transport
from renderer.settings import ImageSettings
from renderer.shaded_view import PixelRadiance, ShadedView
from renderer.surface.albedo import paint_faces, surface_albedo
from renderer.surface.gloss import Gloss
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizer import Rasterizer

if TYPE_CHECKING:
    from augment.scene.conditions import Conditions

# Shadows and bounces are computed again if a coordinate of a vertex has changed by more than this
# distance in world units.
NEAR = 0.001


class FrozenView(NamedTuple):
    """What shadows and bounces of light add to one view of a mesh.

    Attributes:
        added_transfer: Radiance that is added to each channel of each pixel, for
            each of the K harmonic coefficients of the light, shape (3, K, size²).
        albedo_sums: Sum of the albedo of the samples of each pixel with which
            `added_transfer` was computed, shape (3, size²).
    """

    added_transfer: Float[Tensor, "3 K size²"]
    albedo_sums: Float[Tensor, "3 size²"]


class FrozenTransport:
    """Radiance that shadows and bounces of environment light add to views of a mesh.

    It is computed once, and approximates that of shapes that differ little from
    the mesh: the added radiance of a pixel stays the same, except that it is
    scaled with the albedo of the pixel.

    Attributes:
        mesh: The mesh that casts the shadows.
        views: Added radiance for each camera. None if shadows and bounces add
            nothing.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis):
        """Trace the paths of light between the faces of a mesh."""
        self.mesh = mesh
        self.views: dict[Camera, FrozenView | None] = {}
        self._settings = settings
        self._transport = build_transport(mesh, settings, albedo_scale, basis)

    def is_near(self, vertices: Float[np.ndarray, "V 3"]) -> bool:
        """Return whether a shape is so close to the mesh that shadows and bounces are the same."""
        return bool(np.abs(vertices - self.mesh.vertices).max() <= NEAR)

    def add(self, camera: Camera, fragments: Fragments, albedo: Float[Tensor, "S 3"]) -> None:
        """Compute and keep the radiance that shadows and bounces add to a view of the mesh."""
        # None says that shadows and bounces add nothing to the view.
        self.views[camera] = None
        if not self._transport:
            return
        surface = Surface(self.mesh, fragments.to("cpu"), self._settings)
        # Added radiance for each of the K harmonic coefficients of the light, in the P pixels
        # that the mesh covers, shape (3, K, P).
        added_transfer = self._transport.change(surface, albedo.cpu().double())
        if added_transfer is None:
            return
        # A slightly different shape may cover other pixels, so expand the radiance to all pixels
        # of the image, shape (3, K, size²).
        all_pixels = added_transfer.new_zeros(*added_transfer.shape[:2], fragments.size**2)
        all_pixels[..., surface.fragments.pixels] = added_transfer
        # The method `radiance` scales the added radiance of a pixel by the ratio of its new albedo
        # to this albedo.
        albedo_sums = _sum_by_pixel(fragments, albedo)
        self.views[camera] = FrozenView(all_pixels.to(albedo), albedo_sums)

    def radiance(
        self,
        camera: Camera,
        fragments: Fragments,
        albedo: Float[Tensor, "S 3"],
        light: Float[Tensor, "K 3"],
    ) -> Float[Tensor, "3 P"]:
        """Compute the radiance that shadows and bounces add to a view of a shape.

        It is differentiable in albedo and light. `add` has been called for the camera, and the
        shape may differ a little from the mesh. There are S samples in P pixels.
        """
        view = self.views[camera]
        if view is None:
            return light.new_zeros(3, len(fragments.pixels))
        added_transfer = view.added_transfer[..., fragments.pixels]
        old_sums = view.albedo_sums[..., fragments.pixels]
        new_sums = _sum_by_pixel(fragments, albedo)[:, fragments.pixels]
        # Radiance with the albedo of the mesh, shape (3, P).
        added = torch.einsum("ckp,kc->cp", added_transfer.to(light), light)
        # Scale the radiance by the ratio of new to old albedo. Where the old albedo is 0, there
        # is no ratio, and the radiance is not scaled.
        ratios = new_sums / old_sums.masked_fill(old_sums == 0, 1)
        return added * torch.where(old_sums > 0, ratios, 1).to(light)


def _sum_by_pixel(fragments: Fragments, albedo: Float[Tensor, "S 3"]) -> Float[Tensor, "3 pixels"]:
    """Sum the albedo of the samples in each pixel of an image."""
    # Row-major index of the pixel in which each sample lies, shape (S,).
    pixel_of_sample = fragments.pixels[fragments.sample_to_pixel]
    sums = albedo.new_zeros(3, fragments.size**2)
    return sums.index_add(1, pixel_of_sample, albedo.T)


@dataclass(eq=False, repr=False)
class DirectRenderer:
    """Render objects directly, without precomputed matrices from light to image.

    Attributes:
        objects: The objects, which methods select by the argument `object_index`.
        settings: Settings of the images.
        rasterizer: The rasterizer.
        basis: Basis of the lights.
        like: A tensor with the dtype and the device of the images.
        cached: Whether the rasterized views of unmoved objects are kept.
    """

    objects: Sequence[SceneObject]
    settings: ImageSettings
    rasterizer: Rasterizer
    basis: Basis
    like: Tensor
    cached: bool = True

    def __post_init__(self) -> None:
        """Create empty caches."""
        # Rasterized views of unmoved objects. A key has the index of the object, and the camera.
        self._views: dict[tuple[int, Camera], tuple[Fragments, Tensor]] = {}
        # Views of unmoved objects that were prepared for the light of projector and lamps.
        self._local_views: dict[tuple[int, Camera], LocalLightView] = {}
        # Ray tracers, and shadows and bounces, of unmoved objects by their indices.
        self._rays: dict[int, Rays] = {}
        self._transport_of_object: dict[int, FrozenTransport] = {}
        # Shadows and bounces of moved shapes, by the indices of their examples.
        self._transport_of_example: dict[int, FrozenTransport] = {}

    @cached_property
    def vertices(self) -> list[Tensor]:
        """Return the vertices of each object before any change, each of shape (V, 3)."""
        return [torch.from_numpy(item.mesh.vertices).to(self.like) for item in self.objects]

    def view(self, object_index: int, camera: Camera) -> tuple[Fragments, Tensor]:
        """Rasterize an object whose vertices have not moved.

        Return the S samples that the camera sees, and the albedo at the samples, shape (S, 3).
        """
        key = (object_index, camera)
        view = self._views.get(key)
        if view is None:
            view = self._rasterize(object_index, camera, self.objects[object_index].mesh.vertices)
        if self.cached:
            self._views[key] = view
        return view

    def local_view(self, object_index: int, camera: Camera) -> LocalLightView:
        """Prepare a view of an unmoved object for the light of projector and lamps.

        The result is computed once for each object and camera.
        """
        key = (object_index, camera)
        if key not in self._local_views:
            fragments, _ = self.view(object_index, camera)
            mesh = self.objects[object_index].mesh
            rays = self._rays_among(object_index)
            self._local_views[key] = LocalLightView(rays, mesh, fragments, self.settings)
        return self._local_views[key]

    def radiance(
        self,
        example: int,
        object_index: int,
        camera: Camera,
        light: Float[Tensor, "K 3"],
        changed: Conditions,
        background: Float[Tensor, "_ pixels"],
    ) -> PixelRadiance:
        """Render a view of an object with changed shape, colors, gloss or lamps.

        The result is differentiable in the light and in all changes. With
        `settings.silhouettes`, it is also differentiable in fields of the
        camera that are tensors.
        """
        item = self.objects[object_index]
        fixed_camera = camera.fixed()
        is_moved = changed.vertices is not None
        # `vertices` is a tensor, which may have a gradient. `positions` is the same as an array.
        if changed.vertices is None:
            vertices = self.vertices[object_index]
            positions = item.mesh.vertices
            fragments, albedo = self.view(object_index, fixed_camera)
        else:
            vertices = changed.vertices
            positions = vertices.detach().cpu().double().numpy()
            fragments, albedo = self._rasterize(object_index, fixed_camera, positions)
        if changed.albedo is not None:
            albedo = paint_faces(
                item.mesh,
                fragments,
                self.settings.encoding,
                item.albedo_scale,
                changed.albedo,
                changed.hue,
            )
        gloss = None
        if changed.gloss is not None:
            gloss = Gloss(*changed.gloss.unbind(1), textured=True)
        split = split_light(self.basis, light)
        # Projector and lamps need rays for their shadows. For an unmoved object with its own
        # gloss, the view is prepared once.
        rays = None
        lamp_view = None
        if split.local_lights:
            moved_mesh = replace(item.mesh, vertices=positions)
            rays = Rays(moved_mesh) if is_moved else self._rays_among(object_index)
            if not is_moved and gloss is None:
                lamp_view = self.local_view(object_index, fixed_camera)
        indirect = None
        if self.settings.global_illumination:
            # A camera whose fields are tensors is attacked, so it differs in each call. Its views
            # are not kept. `fixed` returns the same camera if no field is a tensor.
            is_kept = camera is fixed_camera
            indirect = _IndirectLight(
                self, example, object_index, fixed_camera, fragments, positions, is_kept
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
            corner_normals=self._corner_normals(object_index) if shares_normals else None,
            lamp_view=lamp_view,
            indirect=indirect,
            lamp_positions=changed.positions,
        )
        return shown.pixel_radiance(camera, background)

    def _rays_among(self, object_index: int) -> Rays:
        """Return the ray tracer of an unmoved object with the given index. It is built once."""
        if object_index not in self._rays:
            self._rays[object_index] = Rays(self.objects[object_index].mesh)
        return self._rays[object_index]

    def _corner_normals(self, object_index: int) -> Tensor:
        """Return the normals at the corners of an unmoved object, shape (F, 3, 3)."""
        return torch.from_numpy(self.objects[object_index].mesh.corner_normals).to(self.like.device)

    def transport_near(
        self, example: int, object_index: int, camera: Camera, vertices: Float[np.ndarray, "V 3"]
    ) -> FrozenTransport:
        """Return the shadows and bounces of a shape, or of a kept shape that is close to it.

        One shape is kept for each example, in addition to the unmoved objects.
        """
        frozen = self._transport_of_object.get(object_index)
        if frozen is None:
            frozen = self._freeze(object_index, self.objects[object_index].mesh)
            self._transport_of_object[object_index] = frozen
        # If the unmoved mesh is not close to the shape, try the shape that was kept for the
        # example. If that is not close either, compute shadows and bounces of the new shape.
        if not frozen.is_near(vertices):
            frozen = self._transport_of_example.get(example, frozen)
            if not frozen.is_near(vertices):
                moved = replace(self.objects[object_index].mesh, vertices=vertices)
                frozen = self._freeze(object_index, moved)
            self._transport_of_example[example] = frozen
        if camera not in frozen.views:
            frozen.add(camera, *self._rasterize(object_index, camera, frozen.mesh.vertices))
        return frozen

    def _freeze(self, object_index: int, mesh: Mesh) -> FrozenTransport:
        """Trace the shadows and bounces of light on an object."""
        return FrozenTransport(
            mesh, self.settings, self.objects[object_index].albedo_scale, self.basis
        )

    def _rasterize(
        self, object_index: int, camera: Camera, vertices: Float[np.ndarray, "V 3"]
    ) -> tuple[Fragments, Tensor]:
        """Rasterize an object with given vertices."""
        item = self.objects[object_index]
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
    """Shadows and bounces of environment light in one view of a shape.

    Attributes:
        renderer: Renderer that keeps the shadows and bounces of shapes.
        example: Index of the example that has the shape.
        object_index: Index of the object.
        camera: The camera.
        fragments: The S samples of the shape that the camera sees, in P pixels.
        positions: Vertices of the shape, shape (V, 3).
        is_kept: Whether the view of this camera is kept for further calls.
    """

    renderer: DirectRenderer
    example: int
    object_index: int
    camera: Camera
    fragments: Fragments
    positions: Float[np.ndarray, "V 3"]
    is_kept: bool

    def radiance(
        self, albedo: Float[Tensor, "S 3"], light: Float[Tensor, "K 3"]
    ) -> Float[Tensor, "3 P"]:
        """Compute the radiance that shadows and bounces add to the P pixels of the view."""
        frozen = self.renderer.transport_near(
            self.example, self.object_index, self.camera, self.positions
        )
        added = frozen.radiance(self.camera, self.fragments, albedo, light)
        # A view that is not needed again is removed, which saves memory.
        if not self.is_kept:
            del frozen.views[self.camera]
        return added
