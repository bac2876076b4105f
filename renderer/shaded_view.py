"""Radiance of one view of a shape, with everything that its samples are shaded with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.camera import Camera
from renderer.geometry.mesh import Mesh
from renderer.image import decode
from renderer.light.basis import SplitLight
from renderer.settings import ImageSettings
from renderer.shading.gloss import Gloss, SampleGloss, sample_gloss
from renderer.shading.shading import glossy_radiance, normals_in_sight, radiance
from renderer.transport.lamp_paths import LocalLightView
from renderer.transport.rays import Rays
from renderer.visibility.fragments import Fragments
from renderer.visibility.silhouettes import moving_outlines


class PixelRadiance(NamedTuple):
    """Radiance of the P pixels of a view that a shape covers or may come to cover.

    Attributes:
        pixels: Row-major indices of the pixels, shape (P,).
        coverage: The fraction of each pixel that the shape covers, shape (P,).
        radiance: Linear radiance, weighted with coverage, shape (3, P).
    """

    pixels: Tensor
    coverage: Tensor
    radiance: Tensor


@dataclass(frozen=True, eq=False)
class ShadedView:
    """One view of a shape in its light.

    The shape has the faces of a mesh, and the mesh's vertices or others. The
    radiance is the sum of shaded environment light, of what shadows and bounces
    change of it, and of local lights.

    Attributes:
        mesh: The mesh of V vertices and F faces.
        fragments: The S samples of the view in which the shape is seen.
        settings: Settings of the image.
        vertices: Positions of the shape's vertices, shape (V, 3).
        albedo: Linear albedo at the samples, shape (S, 3).
        light: The lights with their coefficients.
        rays: Rays among the faces of the shape. They are needed where local lights
            shine and their view is not kept.
        is_moved: Whether the vertices stand in for those of the mesh. Derivatives
            by the vertices then see how outlines move, if the settings say so.
        gloss: Gloss of the shape. The default is that of the mesh.
        vertex_normals: Unit normals of the vertices, shape (V, 3). By default,
            they are computed where they are needed.
        lamp_view: The view in local light, if it is kept. By default, it is made.
        indirect: Function of the albedo and of coefficients of environment light
            that returns the radiance (3, P) that shadows and bounces add to P
            covered pixels. None without shadows and bounces.
        lamp_positions: Positions of the lights that can be moved, shape (L, 3).
            The default is those of their basis.
    """

    mesh: Mesh
    fragments: Fragments
    settings: ImageSettings
    vertices: Tensor
    albedo: Tensor
    light: SplitLight
    rays: Rays | None = None
    is_moved: bool = True
    gloss: Gloss | None = None
    vertex_normals: Tensor | None = None
    lamp_view: LocalLightView | None = None
    indirect: Callable[[Tensor, Tensor], Tensor] | None = None
    lamp_positions: Tensor | None = None

    def radiance(self) -> Tensor:
        """Return the linear radiance (3, P) of the covered pixels, weighted with coverage."""
        # Autograd sums gradients in the reverse of this order, which decides about their last bits.
        parts = [
            *self._shade_environment(self.fragments),
            *self._indirect_radiance(),
            *self._shade_lamps(self.fragments),
        ]
        return self._sum(parts, self.fragments)

    def pixel_radiance(self, camera: Camera, background: Tensor) -> PixelRadiance:
        """Compute the radiance of the view's pixels, differentiable in outlines if they move.

        Args:
            camera: The camera. With moving outlines, the radiance is also
                differentiable in those of its fields that are tensors.
            background: Image values behind the shape, shape (3 or 1, size²).

        Returns:
            The covered pixels, followed by those beside them into which outlines
            may move.
        """
        if self.settings.silhouettes and self.is_moved:
            linear = decode(background, self.settings.encoding).expand(3, -1)
            return self._with_outlines(camera, linear)
        shade = self.radiance()
        coverage = self.fragments.coverage.to(shade)
        return PixelRadiance(self.fragments.pixels, coverage, shade)

    def _shade_environment(self, fragments: Fragments) -> Iterator[Tensor]:
        """Yield the radiance (3, P) of pixels of fragments in environment light."""
        environment = self.light.environment
        if environment is None:
            return
        shaded = fragments, self.vertices, environment, self.albedo, self._normals
        if self._sample_gloss is None:
            yield radiance(*shaded)
        else:
            yield glossy_radiance(*shaded, self._sample_gloss)

    def _indirect_radiance(self) -> Iterator[Tensor]:
        """Yield what shadows and bounces of environment light add to the covered pixels (3, P)."""
        environment = self.light.environment
        if environment is not None and self.indirect is not None:
            yield self.indirect(self.albedo, environment)

    def _shade_lamps(self, fragments: Fragments) -> Iterator[Tensor]:
        """Yield the radiance (3, P) of pixels of fragments in each local light."""
        for basis, coefficients in self.light.local_lights:
            yield self._view_of_lamps.radiance(
                basis, self.albedo, coefficients, self.lamp_positions, fragments
            )

    def _sum(self, parts: list[Tensor], fragments: Fragments) -> Tensor:
        """Add radiances (3, P), in darkness none."""
        if not parts:
            return torch.zeros(3, len(fragments.pixels)).to(self.albedo)
        return reduce(torch.add, parts)

    def _with_outlines(self, camera: Camera, background: Tensor) -> PixelRadiance:
        """Compute radiance whose gradients include the motion of silhouettes.

        See `renderer.visibility.silhouettes`. The method needs the radiance of
        each sample, but shadows and bounces are known per pixel. They are
        divided among the samples of the pixel in proportion to the albedo. The
        background is linear, shape (3, size²).
        """
        fragments = self.fragments
        pixel = fragments.pixel
        by_sample = fragments.by_sample()
        direct = [*self._shade_environment(by_sample), *self._shade_lamps(by_sample)]
        at_samples = self._sum(direct, by_sample)
        summed = at_samples.new_zeros(3, len(fragments.pixels)).index_add(1, pixel, at_samples)
        summed = summed / fragments.samples**2
        values = at_samples.detach()
        for added in self._indirect_radiance():
            summed = summed + added
            albedo = self.albedo.detach().T.to(values)
            total = values.new_zeros(summed.shape).index_add(1, pixel, albedo)
            scaled = added.detach() * fragments.samples**2
            per_albedo = scaled / total.masked_fill(total == 0, 1)
            values = values + per_albedo[:, pixel] * self.albedo.detach().T
        beside, zeros = moving_outlines(
            fragments, camera, self.vertices, self._faces, values, background
        )
        coverage = F.pad(fragments.coverage.to(summed), (0, len(beside)))
        shade = F.pad(summed, (0, len(beside))) + zeros
        return PixelRadiance(torch.cat([fragments.pixels, beside]), coverage, shade)

    @cached_property
    def _faces(self) -> Tensor:
        """Vertex indices of the faces (F, 3), on the device of the vertices."""
        return torch.from_numpy(self.mesh.faces).to(self.vertices.device)

    @cached_property
    def _normals(self) -> Tensor | None:
        """Normals (V, 3) to interpolate, or None for a normal per face."""
        if self.settings.normals == "flat":
            return None
        if self.vertex_normals is not None:
            return self.vertex_normals
        return normals_in_sight(self.fragments, self.vertices, self._faces)

    @cached_property
    def _sample_gloss(self) -> SampleGloss | None:
        """Gloss at the samples, or None for a matte shape."""
        return sample_gloss(self.mesh, self.fragments, self.gloss)

    @cached_property
    def _view_of_lamps(self) -> LocalLightView:
        """View in local light, which is made if none was given."""
        if self.lamp_view is not None:
            return self.lamp_view
        assert self.rays is not None
        vertices = self.vertices if self.is_moved else None
        return LocalLightView(
            self.rays, self.mesh, self.fragments, self.settings, vertices, self.gloss
        )
