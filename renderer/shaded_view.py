"""Radiance of one view of a shape, from all kinds of light.

A view is the image that one camera takes. Each pixel has several samples. A
sample is covered if it shows the shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial, reduce
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from renderer.camera import Camera
from renderer.image import decode
from renderer.light.basis import SplitLight
from renderer.mesh import Mesh
from renderer.operators.rays import LocalLightView
from renderer.settings import ImageSettings
from renderer.surface.gloss import Gloss, sample_gloss
from renderer.surface.shading import glossy_radiance, normals_in_sight, radiance
from renderer.visibility.fragments import Fragments
from renderer.visibility.silhouettes import moving_outlines


class PixelRadiance(NamedTuple):
    """Radiance of N pixels of an image.

    These are the pixels that the shape covers. If gradients include the movement
    of silhouettes, there are also uncovered pixels into which silhouettes may
    move.

    Attributes:
        pixels: Row-major indices of the pixels in the image, shape (N,).
        coverage: Fraction of each pixel that the shape covers, shape (N,).
        radiance: Linear radiance times the coverage, shape (3, N).
    """

    pixels: Int[Tensor, " N"]
    coverage: Float[Tensor, " N"]
    radiance: Float[Tensor, "3 N"]


@dataclass(frozen=True, eq=False)
class ShadedView:
    """A shape with its lights, as one camera sees it.

    The shape has the faces of a mesh, and either the vertices of the mesh or
    moved vertices. The radiance is a sum of three summands: shaded environment
    light, the change of this light by shadows and bounces, and local light from
    lamps and projectors.

    Arrays use these letters: the mesh has V vertices and F faces, of which G are
    seen. S samples in P pixels of the image are covered: they show the shape.

    Attributes:
        mesh: Mesh of the shape.
        fragments: Covered samples of the image.
        settings: Settings of the image.
        vertices: Vertex positions of the shape in world axes, shape (V, 3).
        albedo: Linear albedo at the samples, shape (S, 3).
        light: Environment light and local lights with their coefficients.
        lamp_view: The shape in local light. It is not needed without local lights.
        is_moved: True if `vertices` are not those of the mesh. If
            `settings.silhouettes` is also True, gradients with respect to the
            vertices include the movement of silhouettes.
        gloss: Gloss (specular reflection) of the shape. None uses the gloss of the
            mesh.
        indirect: Function that takes the albedo at the samples and the SH
            coefficients of environment light, and returns the radiance that
            shadows and bounces add to the covered pixels, shape (3, P). None
            without shadows and bounces.
        lamp_positions: Positions to which the L movable lamps have moved,
            shape (L, 3). None uses the positions in `light`.
    """

    mesh: Mesh
    fragments: Fragments
    settings: ImageSettings
    vertices: Float[Tensor, "V 3"]
    albedo: Float[Tensor, "S 3"]
    light: SplitLight
    lamp_view: LocalLightView | None = None
    is_moved: bool = True
    gloss: Gloss | None = None
    indirect: Callable[[Tensor, Tensor], Tensor] | None = None
    lamp_positions: Float[Tensor, "L 3"] | None = None

    def pixel_radiance(self, camera: Camera, background: Tensor) -> PixelRadiance:
        """Compute the radiance of the pixels that the shape covers.

        If `settings.silhouettes` and `is_moved` are True, gradients include how
        silhouettes and surfaces move in the image. Uncovered pixels into which silhouettes
        may move then follow the covered ones. The background is encoded, shape (3, height · width)
        or (1, height · width).
        """
        fragments = self.fragments
        if not (self.settings.silhouettes and self.is_moved):
            pixel_radiance = self._sum(fragments, has_indirect=True)
            coverage = fragments.coverage.to(pixel_radiance)
            return PixelRadiance(fragments.pixels, coverage, pixel_radiance)
        # Silhouettes move between the mesh and the background, whose linear values are needed.
        background = decode(background, self.settings.encoding).expand(3, -1)
        # Each sample becomes a pixel of a finer image, so that it is shaded alone.
        at_samples = self._sum(fragments.by_sample(camera), has_indirect=False)
        zeros = at_samples.new_zeros(3, len(fragments.pixels))
        at_pixels = zeros.index_add(1, fragments.sample_to_pixel, at_samples)
        at_pixels = at_pixels / fragments.samples**2
        # Radiance of each sample as a constant, through which no gradients flow.
        sample_radiance = at_samples.detach()
        indirect = self._indirect_radiance()
        if indirect is not None:
            at_pixels = at_pixels + indirect
            sample_radiance = sample_radiance + self._divide_among_samples(indirect.detach())
        # Adding these zeros to the radiance adds the gradients of moving silhouettes.
        uncovered_pixels, zeros_with_gradient = moving_outlines(
            fragments, camera, self.vertices, self.mesh.faces, sample_radiance, background
        )
        uncovered_count = len(uncovered_pixels)
        pixels = torch.cat([fragments.pixels, uncovered_pixels])
        coverage = F.pad(fragments.coverage.to(at_pixels), (0, uncovered_count))
        pixel_radiance = F.pad(at_pixels, (0, uncovered_count)) + zeros_with_gradient
        return PixelRadiance(pixels, coverage, pixel_radiance)

    def _indirect_radiance(self) -> Float[Tensor, "3 P"] | None:
        """Compute the radiance of bounces and shadows (negative), or None if nothing is added."""
        environment = self.light.environment
        if environment is None or self.indirect is None:
            return None
        return self.indirect(self.albedo, environment)

    def _sum(self, fragments: Fragments, has_indirect: bool) -> Float[Tensor, "3 P"]:
        """Add up the radiance of all lights; `fragments` may assign samples to other pixels."""
        # Autograd adds up gradients in the reverse of this order, so another order would change the
        # last bits of gradients.
        summands = []
        if self.light.environment is not None:
            arguments = (fragments, self.vertices, self.light.environment, self.albedo)
            gloss = sample_gloss(self.mesh, self.fragments, self.gloss)
            shade = radiance if gloss is None else partial(glossy_radiance, gloss=gloss)
            summands.append(shade(*arguments, self._normals))
        # Change of the radiance by shadows and bounces.
        if has_indirect and (indirect := self._indirect_radiance()) is not None:
            summands.append(indirect)
        for basis, coefficients in self.light.local_lights:
            assert self.lamp_view is not None
            shown = basis, self.albedo, coefficients, self.lamp_positions, fragments
            summands.append(self.lamp_view.radiance(*shown))
        if not summands:
            return torch.zeros(3, len(fragments.pixels)).to(self.albedo)
        return reduce(torch.add, summands)

    def _divide_among_samples(self, pixel_radiance: Float[Tensor, "3 P"]) -> Float[Tensor, "3 S"]:
        """Divide the radiance of each pixel among its samples, in proportion to their albedo.

        Radiance of shadows and bounces is only known for whole pixels, but the gradients of
        silhouettes need that of each sample.
        """
        sample_to_pixel = self.fragments.sample_to_pixel
        sample_albedo = self.albedo.detach().T
        zeros = pixel_radiance.new_zeros(pixel_radiance.shape)
        # Sum of the albedo of the covered samples of each pixel, shape (3, P).
        albedo_sums = zeros.index_add(1, sample_to_pixel, sample_albedo.to(zeros))
        radiance_sums = pixel_radiance * self.fragments.samples**2
        radiance_per_albedo = radiance_sums / albedo_sums.masked_fill(albedo_sums == 0, 1)
        return radiance_per_albedo[:, sample_to_pixel] * sample_albedo

    @cached_property
    def _normals(self) -> Tensor | None:
        """Normals at the corners of the G seen faces, shape (G, 3, 3), or None for flat shading."""
        if self.settings.normals == "flat":
            return None
        return normals_in_sight(self.mesh, self.fragments, self.vertices if self.is_moved else None)
