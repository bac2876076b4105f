"""Gloss of a mesh's surface in the words of glTF 2.0, and what it reflects at a view's samples.

With metallic m, strength s and albedo ρ, the F0 of `renderer.microfacets` is m ρ + (1 - m) 0.04 s, and F90 is
m + (1 - m) s: the highlight of a dielectric is white, and that of a metal has its color. Radiance per irradiance is

    ρ (diffuse + colored) + white.

The diffuse part is (1 - m) (1 - s E(n·v)), where s E is what the coat on it reflects of an even sky, so that no energy
is created (Albedo scaling: Kulla and Conty 2017).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from renderer.albedo import Texture, bilinear
from renderer.errors import InputError, require_bounded
from renderer.fragments import Fragments
from renderer.light.harmonics import bands, basis, unit
from renderer.mesh import Mesh
from renderer.microfacets import LEAST, axes, lobe_weights, reflectance

if TYPE_CHECKING:
    from jaxtyping import Float

DIELECTRIC = 0.04  # F0 of a refractive index of 1.5, as of varnish


@dataclass(frozen=True, eq=False)
class Gloss:
    """Roughness, metallic and strength (`specularFactor` of KHR_materials_specular) of a surface, each in [0, 1]: a
    number for all of a mesh, or a tensor (), or (F,) for its faces. Roughness below 0.2 is taken for 0.2. textured:
    multiplied by the mesh's gloss textures, which it replaces otherwise.

    >>> varnished = Gloss(roughness=0.3).on(renderer.solid("orange"))
    >>> varnished.gloss.shape == varnished.faces.shape
    True
    """

    roughness: float | Float[Tensor, ...] = 0.5
    metallic: float | Float[Tensor, ...] = 0.0
    strength: float | Float[Tensor, ...] = 1.0
    textured: bool = field(default=False, kw_only=True)

    def on(self, mesh: Mesh) -> Mesh:
        """The mesh with this gloss in place of its own. InputError: another shape, values beyond [0, 1], NaN."""
        columns = [values.detach().cpu().expand(len(mesh.faces)) for values in self.checked(len(mesh.faces))]
        textures = mesh.gloss_textures if self.textured else ()
        return replace(mesh, gloss=torch.stack(columns, dim=1).float().numpy(), gloss_textures=textures)

    def checked(self, faces: int) -> list[Tensor]:
        """Roughness, metallic and strength as tensors (1,) or (F,), of so many faces. InputError: as `on`."""
        checked = []
        for name in ("roughness", "metallic", "strength"):
            values = getattr(self, name)
            values = values if isinstance(values, Tensor) else torch.tensor(float(values), dtype=torch.float64)
            require_bounded(**{name: values})
            if values.shape not in ((), (1,), (faces,)) or not (values.min() >= 0 and values.max() <= 1):
                raise InputError(f"gloss: {name} of shape {tuple(values.shape)}: give one number or {faces}, in [0, 1]")
            checked.append(values.reshape(-1))
        return checked


class SampleGloss(NamedTuple):
    """At the samples of a view: (S,) each, or (1,) where all have the same."""

    roughness: Tensor
    metallic: Tensor
    strength: Tensor

    def at(self, samples: Tensor | slice) -> SampleGloss:
        """Of some samples."""
        return SampleGloss(*(values if len(values) == 1 else values[samples] for values in self))

    def to(self, like: Tensor) -> SampleGloss:
        return SampleGloss(*(values.to(like) for values in self))

    def split(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """(colored, white) reflection (..., S) of reflection for F0 = 1, F90 = 0 and for F0 = 0, F90 = 1."""
        dielectric = (1 - self.metallic) * self.strength
        return self.metallic * first, dielectric * (DIELECTRIC * first + second) + self.metallic * second

    def even(self, normals: Tensor, toward: Tensor) -> tuple[Tensor, Tensor]:
        """(colored, white) reflection (S,) of an even sky of irradiance 1. normals, toward the camera: (S, 3) unit."""
        cosine = (normals * toward).sum(1)
        first, second = lobe_weights(cosine, self.roughness, 0).sum((1, 2)) / math.pi
        return self.split(first, second)

    def diffuse(self, normals: Tensor, toward: Tensor) -> Tensor:
        """(S,) the fraction of the albedo that is left below the coat: of a dielectric, what that does not reflect."""
        _, coat = self._replace(metallic=torch.zeros_like(self.metallic)).even(normals, toward)
        return (1 - self.metallic) * (1 - coat)

    def transfer(self, normals: Tensor, toward: Tensor, degree: int) -> tuple[Tensor, Tensor]:
        """(colored, white) radiance (S, (degree + 1)²) per unit coefficient of environment light; differentiable."""
        band = bands(degree).to(normals.device)
        weights = self.split(*lobe_weights((normals * toward).sum(1), self.roughness, degree))
        colored = white = normals.new_zeros(())
        for axis, of_colored, of_white in zip(axes(normals, toward, self.roughness), *weights, strict=True):
            values = basis(axis.T, degree)
            colored, white = colored + of_colored.T[:, band] * values, white + of_white.T[:, band] * values
        return colored, white

    def along(self, normals: Tensor, toward: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """(colored, white) radiance (...) per irradiance from directions (..., 3); all unit vectors. Differentiable."""
        return self.split(*reflectance(normals, toward, directions, self.roughness))


def sample_gloss(mesh: Mesh, fragments: Fragments, gloss: Gloss | None = None) -> SampleGloss | None:
    """That of the mesh, or a gloss in its place, in which it is differentiable; float64. None where there is neither.
    InputError: as `Gloss.on`."""
    textures = mesh.gloss_textures if gloss is None or gloss.textured else ()
    if gloss is None:
        if mesh.gloss is None:
            return None
        rows = mesh.gloss[:1] if (mesh.gloss == mesh.gloss[0]).all() else mesh.gloss
        gloss = Gloss(*torch.from_numpy(rows).unbind(1))
    columns = [values.to(fragments.coverage) for values in gloss.checked(len(mesh.faces))]
    values = [column if len(column) == 1 else column[fragments.faces][fragments.face] for column in columns]
    roughness, metallic, strength = values
    if textures:
        faces = fragments.faces.cpu().numpy()
        uvs = fragments.interpolate(torch.from_numpy(mesh.corner_uvs[faces]).to(fragments.coverage)).T
        texture_ids = torch.from_numpy(mesh.texture_ids[faces]).to(fragments.face.device)[fragments.face]
        factors = uvs.new_ones(2, len(fragments.face))
        for index, texture in enumerate(textures):
            here = torch.nonzero(texture_ids == index).squeeze(1)
            texels = torch.from_numpy(texture.reshape(-1, 2).T.copy()).to(uvs) / 255
            source = Texture(texture.shape[0], texture.shape[1], partial(torch.index_select, texels, 1))
            factors[:, here] = bilinear(source, uvs[:, here])
        roughness, metallic = roughness * factors[0], metallic * factors[1]
    if (roughness < LEAST).any():
        warnings.warn(
            f"roughness below {LEAST}: shaded as {LEAST}, the least that light of degree 20 shows", stacklevel=2
        )
    return SampleGloss(roughness.clamp(min=LEAST), metallic, strength)


def toward_camera(fragments: Fragments, vertices: Tensor) -> Tensor:
    """(S, 3) unit vectors at the samples, in the dtype of the vertices (V, 3); differentiable in them."""
    eye = fragments.eye.to(vertices)
    if not eye[3]:
        return eye[:3].expand(len(fragments.face), 3)
    return unit((eye[:3] - fragments.interpolate(vertices[fragments.corners])).T).T
