"""Gloss of a mesh's surface in the words of glTF 2.0, and what it reflects at a view's samples.

With metallic m, strength s and albedo ρ, the F of `renderer.surface.microfacets` is (1 - m) s times that of a dielectric, which
is white, and m times Schlick's with F0 = ρ and F90 = 1, which has the metal's color. Radiance per irradiance is

    ρ (diffuse + colored) + white.

The diffuse part lies below the coat. With E(μ), the fraction of a beam that the coat reflects (`coat_albedo`), and its
mean E_avg = 2 ∫ E(μ) μ dμ, the diffuse part of light from direction l, seen from direction v, is

    (1 - m) (1 - s E(n·l)) (1 - s E(n·v)) / (1 - s E_avg)

(Kulla and Conty 2017, "Revisiting physically based shading at Imageworks"). It is reciprocal. Together with the coat,
a white surface reflects each beam entirely: s E(n·l) + (1 - s E(n·l)) = 1. Of environment light, the coat lets the
irradiance Σ (A_l - s B_l) U_lm Y_lm(n) through, with the B_l of `coat_bands`.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from renderer.errors import InputError, require_bounded
from renderer.geometry.mesh import Mesh, require_mesh
from renderer.light.harmonics import bands, lambertian_factors
from renderer.settings import MIN_ROUGHNESS
from renderer.surface.albedo import Texture, sample_textures
from renderer.surface.microfacets import (
    DIELECTRIC,
    EDGE,
    SCHLICK,
    ViewFrame,
    along,
    coat_albedo,
    coat_bands,
    coat_mean,
    lobe_functions,
    reflectance,
)
from renderer.validation import as_tensor, require_flag
from renderer.vectors import unit
from renderer.visibility.fragments import Fragments

if TYPE_CHECKING:
    from jaxtyping import Float


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
        require_mesh("mesh", mesh)
        columns = [values.detach().cpu().expand(len(mesh.faces)) for values in self.checked(len(mesh.faces))]
        textures = mesh.gloss_textures if self.textured else ()
        return replace(mesh, gloss=torch.stack(columns, dim=1).float().numpy(), gloss_textures=textures)

    def checked(self, faces: int) -> list[Tensor]:
        """Roughness, metallic and strength as tensors (1,) or (F,), of so many faces. InputError: as `on`."""
        require_flag("textured", self.textured)
        checked = []
        for name in ("roughness", "metallic", "strength"):
            given = getattr(self, name)
            values = as_tensor(f"gloss: {name}", given)
            if isinstance(given, int | float):
                values = torch.tensor(float(given), dtype=torch.float64)  # a plain number keeps its precision
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

    @property
    def metal(self) -> bool:
        """Whether any of it is metallic, or may become so."""
        return self.metallic.requires_grad or bool(self.metallic.any())

    def at(self, samples: Tensor | slice) -> SampleGloss:
        """Of some samples."""
        return SampleGloss(*(at_samples(values, samples) for values in self))

    def to(self, like: Tensor) -> SampleGloss:
        return SampleGloss(*(values.to(like) for values in self))

    def lobes(self, cosine: Tensor, degree: int) -> tuple[Tensor | None, Tensor]:
        """(colored, white) functions (M, S) of `renderer.surface.microfacets.lobe_functions` at n·v (S,); None for no color."""
        terms = (DIELECTRIC, SCHLICK, EDGE) if self.metal else (DIELECTRIC,)
        white, *of_metals = lobe_functions(cosine, self.roughness, degree, terms)
        white = (1 - self.metallic) * self.strength * white
        if not of_metals:
            return None, white
        return self.metallic * of_metals[0], white + self.metallic * of_metals[1]

    def even(self, normals: Tensor, toward: Tensor) -> tuple[Tensor | None, Tensor]:
        """(colored, white) reflection (S,) of an even sky of irradiance 1. normals, toward the camera: (S, 3) unit."""
        constant = math.sqrt(4 * math.pi) / math.pi  # the band's coefficient of such a sky
        colored, white = self.lobes((normals * toward).sum(1).clamp(0, 1), 0)
        return colored if colored is None else colored[0] * constant, white[0] * constant

    def entering(self, cosine: Tensor) -> Tensor:
        """Compute 1 - s E(μ), the fraction of light from a direction that passes the coat. Differentiable.

        Args:
            cosine: Cosine μ between normal and direction, any shape; negative ones count as 0.

        Returns:
            The fraction, of the shape of `cosine`.
        """
        return 1 - self.strength * coat_albedo(cosine.clamp(0, 1), self.roughness)

    def entering_bands(self, degree: int) -> Tensor:
        """Compute A_l - s B_l, by which environment light below the coat becomes irradiance. Differentiable.

        Args:
            degree: Degree of the light, at most `DIFFUSE_DEGREE`.

        Returns:
            A factor for each coefficient of the light, shape ((degree + 1)², S), or (..., 1) of an even gloss.
        """
        reflected = coat_bands(degree).to(self.roughness) @ along(self.roughness)
        factors = lambertian_factors(degree).to(self.roughness)
        return factors[:, None] - self.strength * reflected[bands(degree)]

    def diffuse(self, normals: Tensor, toward: Tensor) -> Tensor:
        """Compute (1 - m) (1 - s E(n·v)) / (1 - s E_avg), by which the light below the coat is seen. Differentiable.

        Args:
            normals: Unit normals, shape (S, 3).
            toward: Unit vectors to the camera, shape (S, 3) or (1, 3).

        Returns:
            Factors of albedo and of the light that passes the coat, shape (S,).
        """
        leaving = self.entering((normals * toward).sum(1))
        return (1 - self.metallic) * leaving / (1 - self.strength * coat_mean(self.roughness))

    def transfer(self, normals: Tensor, toward: Tensor, degree: int) -> tuple[Tensor | None, Tensor, ViewFrame]:
        """Compute the radiance per unit coefficient of environment light, along the axes of a view. Differentiable.

        Args:
            normals: Unit normals, shape (S, 3).
            toward: Unit vectors to the camera, shape (S, 3) or (1, 3).
            degree: Degree of the light.

        Returns:
            What is multiplied by the albedo, shape (K, S), K = (degree + 1)², or None for no color; what is not, of the
            same shape; and the frame of the view, which turns coefficients into those of the world (`to_world`).
        """
        frame = ViewFrame.of(normals, toward)
        colored, white = self.lobes(frame.cosine, degree)
        return colored if colored is None else frame.harmonics(colored), frame.harmonics(white), frame

    def along(self, normals: Tensor, toward: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """(colored, white) radiance (...) per irradiance from directions (..., 3); all unit vectors. Differentiable."""
        schlick, edge, dielectric = reflectance(normals, toward, directions, self.roughness)
        return self.metallic * schlick, self.metallic * edge + (1 - self.metallic) * self.strength * dielectric


def smoothest(mesh: Mesh) -> float:
    """The least roughness of faces that have gloss, of textures all but a hundredth included; 1 where none has."""
    if mesh.gloss is None:
        return 1.0
    factors = [*(np.percentile(texture[..., 0], 1) / 255 for texture in mesh.gloss_textures), 1.0]  # -1: no texture
    by_face = mesh.gloss[:, 0] * np.take(factors, mesh.texture_ids if mesh.gloss_textures else -1)
    return float(by_face.min(initial=1, where=mesh.gloss[:, 1:].any(1)))


def at_samples(values: Tensor, samples: Tensor | slice) -> Tensor:
    """Values (S, ...) of some samples; all of (1, ...), which all samples share."""
    return values if len(values) == 1 else values[samples]


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
    by_face = [column if len(column) == 1 else column.index_select(0, fragments.faces) for column in columns]
    values = [column if len(column) == 1 else column.index_select(0, fragments.face) for column in by_face]
    roughness, metallic, strength = values
    if textures:
        sources = [Texture.of(torch.from_numpy(texture).to(fragments.coverage) / 255) for texture in textures]
        factors = sample_textures(sources, mesh, fragments)
        roughness, metallic = roughness * factors[0], metallic * factors[1]
    if (roughness < MIN_ROUGHNESS).any():
        warnings.warn(
            f"roughness below {MIN_ROUGHNESS}: shaded as {MIN_ROUGHNESS}, the least that light of degree 40 shows",
            stacklevel=2,
        )
    return SampleGloss(roughness.clamp(min=MIN_ROUGHNESS), metallic, strength)


def toward_camera(fragments: Fragments, vertices: Tensor) -> Tensor:
    """(S, 3) unit vectors at the samples, or (1, 3) where all have the same, in the dtype of the vertices (V, 3);
    differentiable in them."""
    eye = fragments.eye.to(vertices)
    if not eye[3]:
        return eye[None, :3]
    return unit((eye[:3] - fragments.interpolate(vertices[fragments.corners])).T).T
