"""Radiance of one view of a shape, from all kinds of light."""

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
    """Radiance of N pixels of a view.

    These are the covered pixels and, if gradients of moving outlines are needed,
    uncovered pixels into which outlines may move.

    Attributes:
        pixels: Row-major indices of the pixels, shape (N,).
        coverage: Fraction of each pixel that the shape covers, shape (N,).
        radiance: Linear radiance times the coverage, shape (3, N).
    """

    pixels: Tensor
    coverage: Tensor
    radiance: Tensor


@dataclass(frozen=True, eq=False)
class ShadedView:
    """One view of a shape with its lights.

    The shape has the faces of a mesh, and either the vertices of the mesh or
    moved vertices. The radiance is the sum of three parts: shaded environment
    light, the change of this light by shadows and bounces, and local light from
    lamps and projectors.

    Shapes use these letters: the mesh has V vertices and F faces. The view has S
    covered samples in P pixels.

    Attributes:
        mesh: Mesh of the shape.
        fragments: Covered samples of the view.
        settings: Settings of the image.
        vertices: Vertex positions of the shape in world axes, shape (V, 3).
        albedo: Linear albedo at the samples, shape (S, 3).
        light: Environment light and local lights with their coefficients.
        rays: Rays among the faces of the shape. They are needed if there are
            local lights and `lamp_view` is None.
        is_moved: True if `vertices` are not those of the mesh. Gradients by the
            vertices then include the movement of outlines, if
            `settings.silhouettes` is true.
        gloss: Gloss of the shape. None uses the gloss of the mesh.
        vertex_normals: Unit normals of the vertices, shape (V, 3). None computes
            the normals if they are needed.
        lamp_view: View in local light of an earlier render, which is reused. None
            creates a new one.
        indirect: Function that takes the albedo at the samples and the SH
            coefficients of environment light, and returns the radiance that
            shadows and bounces add to the covered pixels, shape (3, P). None
            without shadows and bounces.
        lamp_positions: Positions to which the L movable lamps have moved,
            shape (L, 3). None uses the positions of their basis.
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
        """Compute the linear radiance of the P covered pixels, times their coverage.

        Returns:
            Radiance, shape (3, P).
        """
        # Autograd adds up gradients in the reverse of this order. Another order would
        # change their last bits.
        parts = [
            *self._shade_environment(self.fragments),
            *self._indirect_radiance(),
            *self._shade_lamps(self.fragments),
        ]
        return self._sum(parts, self.fragments)

    def pixel_radiance(self, camera: Camera, background: Tensor) -> PixelRadiance:
        """Compute the radiance of the pixels of the view.

        If `settings.silhouettes` and `is_moved` are true, gradients include how
        outlines and surfaces move in the image.

        Args:
            camera: Camera of the view. Gradients of moving outlines also reach
                fields of the camera that are tensors.
            background: Image values behind the shape, shape (3, size²) or
                (1, size²).

        Returns:
            The covered pixels, followed by uncovered pixels into which outlines
            may move.
        """
        if self.settings.silhouettes and self.is_moved:
            linear_background = decode(background, self.settings.encoding).expand(3, -1)
            return self._with_outlines(camera, linear_background)
        pixel_radiance = self.radiance()
        coverage = self.fragments.coverage.to(pixel_radiance)
        return PixelRadiance(self.fragments.pixels, coverage, pixel_radiance)

    def _shade_environment(self, fragments: Fragments) -> Iterator[Tensor]:
        """Compute the radiance of pixels under environment light, without shadows and bounces.

        Args:
            fragments: The samples of the view, grouped into P pixels of the image
                or of a finer image.

        Yields:
            Radiance, shape (3, P), if there is environment light. Otherwise
            nothing.
        """
        environment = self.light.environment
        if environment is None:
            return
        arguments = fragments, self.vertices, environment, self.albedo, self._normals
        if self._sample_gloss is None:
            yield radiance(*arguments)
        else:
            yield glossy_radiance(*arguments, self._sample_gloss)

    def _indirect_radiance(self) -> Iterator[Tensor]:
        """Compute the radiance that shadows and bounces add to the P covered pixels.

        Yields:
            Radiance, shape (3, P), which is negative in shadows. Nothing if there
            are no shadows, or no environment light.
        """
        environment = self.light.environment
        if environment is not None and self.indirect is not None:
            yield self.indirect(self.albedo, environment)

    def _shade_lamps(self, fragments: Fragments) -> Iterator[Tensor]:
        """Compute the radiance of pixels under each local light.

        Args:
            fragments: The samples of the view, grouped into P pixels of the image
                or of a finer image.

        Yields:
            Radiance under the next local light, shape (3, P).
        """
        for basis, coefficients in self.light.local_lights:
            yield self._view_of_lamps.radiance(
                basis, self.albedo, coefficients, self.lamp_positions, fragments
            )

    def _sum(self, parts: list[Tensor], fragments: Fragments) -> Tensor:
        """Add up radiances. Without any light, the sum is 0.

        Args:
            parts: Radiances, shape (3, P) each.
            fragments: Samples of the view in P pixels.

        Returns:
            Sum, shape (3, P).
        """
        if not parts:
            return torch.zeros(3, len(fragments.pixels)).to(self.albedo)
        return reduce(torch.add, parts)

    def _with_outlines(self, camera: Camera, background: Tensor) -> PixelRadiance:
        """Compute radiance whose gradients include the movement of silhouettes and surfaces.

        `renderer.visibility.silhouettes` needs the radiance of each sample, but
        the radiance of shadows and bounces is only known for each pixel. It is
        divided among the samples of the pixel in proportion to their albedo.

        Args:
            camera: Camera of the view.
            background: Linear background, shape (3, size²).

        Returns:
            The covered pixels, followed by uncovered pixels into which
            silhouettes may move.
        """
        fragments = self.fragments
        sample_to_pixel = fragments.sample_to_pixel
        # Shade each sample as a pixel of a finer image.
        finer_fragments = fragments.by_sample()
        direct = [*self._shade_environment(finer_fragments), *self._shade_lamps(finer_fragments)]
        at_samples = self._sum(direct, finer_fragments)
        zeros = at_samples.new_zeros(3, len(fragments.pixels))
        at_pixels = zeros.index_add(1, sample_to_pixel, at_samples)
        at_pixels = at_pixels / fragments.samples**2
        # Radiance of each sample without a graph, shape (3, S).
        sample_radiance = at_samples.detach()
        for indirect in self._indirect_radiance():
            at_pixels = at_pixels + indirect
            albedo = self.albedo.detach().T.to(sample_radiance)
            no_albedo = sample_radiance.new_zeros(at_pixels.shape)
            pixel_albedo = no_albedo.index_add(1, sample_to_pixel, albedo)
            scaled = indirect.detach() * fragments.samples**2
            # Indirect radiance of a sample per albedo, shape (3, P).
            per_albedo = scaled / pixel_albedo.masked_fill(pixel_albedo == 0, 1)
            indirect_at_samples = per_albedo[:, sample_to_pixel] * self.albedo.detach().T
            sample_radiance = sample_radiance + indirect_at_samples
        uncovered_pixels, zeros_with_gradient = moving_outlines(
            fragments, camera, self.vertices, self._faces, sample_radiance, background
        )
        uncovered_count = len(uncovered_pixels)
        return PixelRadiance(
            pixels=torch.cat([fragments.pixels, uncovered_pixels]),
            coverage=F.pad(fragments.coverage.to(at_pixels), (0, uncovered_count)),
            radiance=F.pad(at_pixels, (0, uncovered_count)) + zeros_with_gradient,
        )

    @cached_property
    def _faces(self) -> Tensor:
        """Vertex indices of the faces, on the device of the vertices, shape (F, 3)."""
        return torch.from_numpy(self.mesh.faces).to(self.vertices.device)

    @cached_property
    def _normals(self) -> Tensor | None:
        """Vertex normals for smooth shading, shape (V, 3), or None for flat shading."""
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
        """View in local light: `lamp_view` if it was given, and otherwise a new one."""
        if self.lamp_view is not None:
            return self.lamp_view
        assert self.rays is not None
        vertices = self.vertices if self.is_moved else None
        return LocalLightView(
            self.rays, self.mesh, self.fragments, self.settings, vertices, self.gloss
        )
