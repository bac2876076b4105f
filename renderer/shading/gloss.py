"""Gloss (specular reflection) of surfaces in the terms of glTF 2.0.

A surface has roughness, metallic m and specular_factor s (glTF's `specularFactor`), and
an albedo ρ. Its specular reflection has two parts, both of `renderer.shading.lobes`.
A dielectric one with the factor (1 - m) s is white. A metallic one with the
factor m has the color of the metal: it is Schlick's approximation with
F0 = ρ and F90 = 1. The reflected radiance per irradiance is

    ρ (diffuse + colored) + white.

The diffuse surface lies below the dielectric layer, which is called coat here.
The unit vectors n, l and v are the normal, the direction to the light and the
direction to the camera. Let E(μ) be the fraction of a beam with the cosine μ
that the coat reflects (`coat_albedo`), and E_avg = 2 ∫ E(μ) μ dμ its mean. Then

    diffuse = (1 - m) (1 - s E(n·l)) (1 - s E(n·v)) / (1 - s E_avg)

(Kulla and Conty 2017, "Revisiting physically based shading at Imageworks"). This
is reciprocal. A white surface with its coat reflects each beam entirely: the coat
reflects s E(n·l), and the surface below reflects 1 - s E(n·l). Of environment
light with the coefficients U_lm, the irradiance Σ (A_l - s B_l) U_lm Y_lm(n)
passes the coat, with the A_l of `lambertian_factors` and the B_l of `coat_bands`.

Shapes use these letters: a view has S samples of a mesh with F faces. K is the
number of SH coefficients, (degree + 1)².
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
from renderer.shading.lobes import (
    ViewFrame,
    along,
    coat_albedo,
    coat_bands,
    coat_mean,
    lobe_functions,
)
from renderer.surface.albedo import Texture, sample_textures
from renderer.surface.microfacets import DIELECTRIC, EDGE, SCHLICK, reflectance
from renderer.validation import as_tensor, require_flag
from renderer.vectors import unit
from renderer.visibility.fragments import Fragments

if TYPE_CHECKING:
    from jaxtyping import Float

_NAMES = ("roughness", "metallic", "specular_factor")
# Percentile of the roughness of a texture that `smoothest` returns. Fewer texels
# are smoother.
_SMOOTHEST_PERCENT = 1
# Irradiance 1 of uniform light is radiance 1/π, whose first SH coefficient is:
_UNIFORM_COEFFICIENT = math.sqrt(4 * math.pi) / math.pi


@dataclass(frozen=True, eq=False)
class Gloss:
    """Specular reflection of a surface.

    Each of the three values is a number in [0, 1] for all of a mesh, a tensor of
    shape (), or a tensor of shape (F,) with a number for each face.

    Attributes:
        roughness: Roughness as in glTF. Below 0.2, it is taken for 0.2.
        metallic: Fraction of the surface that is metal.
        specular_factor: Factor of the dielectric reflection (`specularFactor` of
            KHR_materials_specular).
        textured: Whether the gloss textures of the mesh multiply the values.
            Otherwise the textures are ignored.

    Example:
        >>> import norm_balls as nb
        >>> varnished = nb.Gloss(roughness=0.3).on(nb.solid("orange"))
        >>> varnished.gloss.shape == varnished.faces.shape
        True
    """

    roughness: float | Float[Tensor, ...] = 0.5
    metallic: float | Float[Tensor, ...] = 0.0
    specular_factor: float | Float[Tensor, ...] = 1.0
    textured: bool = field(default=False, kw_only=True)

    def on(self, mesh: Mesh) -> Mesh:
        """Return a copy of a mesh with this gloss instead of its own.

        Args:
            mesh: The mesh.

        Raises:
            InputError: If a value is out of range, NaN or has another shape.
        """
        require_mesh("mesh", mesh)
        face_count = len(mesh.faces)
        columns = []
        for values in self.checked(face_count):
            columns.append(values.detach().cpu().expand(face_count))
        textures = mesh.gloss_textures if self.textured else ()
        by_face = torch.stack(columns, dim=1).float().numpy()
        return replace(mesh, gloss=by_face, gloss_textures=textures)

    def checked(self, faces: int) -> list[Tensor]:
        """Return roughness, metallic and specular factor as tensors of shape (1,) or (F,).

        Args:
            faces: Number of faces of the mesh, F.

        Raises:
            InputError: If a value is out of range, NaN or has another shape.
        """
        require_flag("textured", self.textured)
        checked = []
        for name in _NAMES:
            given = getattr(self, name)
            values = as_tensor(f"gloss: {name}", given)
            if isinstance(given, int | float):
                # A Python number keeps its precision.
                values = torch.tensor(float(given), dtype=torch.float64)
            require_bounded(**{name: values})
            has_shape = values.shape in ((), (1,), (faces,))
            if not has_shape or not (values.min() >= 0 and values.max() <= 1):
                raise InputError(
                    f"gloss: {name} of shape {tuple(values.shape)}: "
                    f"give one number or {faces}, in [0, 1]"
                )
            checked.append(values.reshape(-1))
        return checked


class SampleGloss(NamedTuple):
    """The gloss at the samples of a view.

    Each tensor has the shape (S,), or (1,) if all samples have the same value.

    Attributes:
        roughness: Roughness in [0.2, 1].
        metallic: Fraction that is metal in [0, 1].
        specular_factor: Factor of the dielectric reflection in [0, 1].
    """

    roughness: Tensor
    metallic: Tensor
    specular_factor: Tensor

    @property
    def metal(self) -> bool:
        """Return whether any sample is metallic, or may become so by differentiation."""
        return self.metallic.requires_grad or bool(self.metallic.any())

    def at(self, samples: Tensor | slice) -> SampleGloss:
        """Return the gloss at some of the samples.

        Args:
            samples: Indices of samples, or a slice.
        """
        return SampleGloss(*(at_samples(values, samples) for values in self))

    def to(self, like: Tensor) -> SampleGloss:
        """Return the gloss in the dtype and on the device of another tensor.

        Args:
            like: The other tensor.
        """
        return SampleGloss(*(values.to(like) for values in self))

    def lobes(self, cosine: Tensor, degree: int) -> tuple[Tensor | None, Tensor]:
        """Compute the specular lobes as functions of the direction to the camera.

        Args:
            cosine: Cosine between normal and direction to the camera, n·v, shape
                (S,).
            degree: Degree of the light.

        Returns:
            The colored and the white lobe, in the M functions of
            `renderer.shading.lobes.lobe_functions`, shape (M, S) each. The colored
            lobe is None if no sample is metallic.
        """
        terms = (DIELECTRIC, SCHLICK, EDGE) if self.metal else (DIELECTRIC,)
        dielectric, *of_metals = lobe_functions(cosine, self.roughness, degree, terms)
        white = (1 - self.metallic) * self.specular_factor * dielectric
        if not of_metals:
            return None, white
        schlick, edge = of_metals
        return self.metallic * schlick, white + self.metallic * edge

    def even(self, normals: Tensor, toward: Tensor) -> tuple[Tensor | None, Tensor]:
        """Compute the specular reflection of uniform light of irradiance 1.

        Args:
            normals: Unit normals, shape (S, 3).
            toward: Unit vectors to the camera, shape (S, 3) or (1, 3).

        Returns:
            The colored and the white radiance, shape (S,) each. The colored one
            is None if no sample is metallic.
        """
        cosine = (normals * toward).sum(1).clamp(0, 1)
        colored, white = self.lobes(cosine, degree=0)
        white_radiance = white[0] * _UNIFORM_COEFFICIENT
        if colored is None:
            return None, white_radiance
        return colored[0] * _UNIFORM_COEFFICIENT, white_radiance

    def entering(self, cosine: Tensor) -> Tensor:
        """Compute the fraction of light that passes the coat, 1 - s E(μ).

        The result is differentiable.

        Args:
            cosine: Cosine μ between normal and direction, any shape. Negative
                ones count as 0.

        Returns:
            Fractions in [0, 1], with the shape of `cosine`.
        """
        return 1 - self.specular_factor * coat_albedo(cosine.clamp(0, 1), self.roughness)

    def entering_bands(self, degree: int) -> Tensor:
        """Compute the factors A_l - s B_l of environment light below the coat.

        With these factors, the coefficients of the light become the irradiance of
        the diffuse surface. The result is differentiable.

        Args:
            degree: Degree of the light, at most `DIFFUSE_DEGREE`.

        Returns:
            A factor for each coefficient, shape (K, S), or (K, 1) if all samples
            have the same gloss.
        """
        reflected = coat_bands(degree).to(self.roughness) @ along(self.roughness)
        factors = lambertian_factors(degree).to(self.roughness)
        return factors[:, None] - self.specular_factor * reflected[bands(degree)]

    def diffuse(self, normals: Tensor, toward: Tensor) -> Tensor:
        """Compute how much of the diffuse radiance below the coat the camera sees.

        This is the factor (1 - m) (1 - s E(n·v)) / (1 - s E_avg) of the albedo and
        of the light that passes the coat. The result is differentiable.

        Args:
            normals: Unit normals, shape (S, 3).
            toward: Unit vectors to the camera, shape (S, 3) or (1, 3).

        Returns:
            Factors, shape (S,).
        """
        leaving = self.entering((normals * toward).sum(1))
        return (
            (1 - self.metallic) * leaving / (1 - self.specular_factor * coat_mean(self.roughness))
        )

    def transfer(
        self, normals: Tensor, toward: Tensor, degree: int
    ) -> tuple[Tensor | None, Tensor, ViewFrame]:
        """Compute the specular radiance per unit of each coefficient of environment light.

        The coefficients are those in the axes of the view. The result is
        differentiable.

        Args:
            normals: Unit normals, shape (S, 3).
            toward: Unit vectors to the camera, shape (S, 3) or (1, 3).
            degree: Degree of the light.

        Returns:
            The colored radiance, which the albedo multiplies, shape (K, S), or
            None if no sample is metallic; the white radiance, shape (K, S); and
            the frame of the view, which turns coefficients to world axes
            (`to_world`).
        """
        frame = ViewFrame.from_directions(normals, toward)
        colored, white = self.lobes(frame.cosine, degree)
        colored_transfer = None if colored is None else frame.harmonics(colored)
        return colored_transfer, frame.harmonics(white), frame

    def along(self, normals: Tensor, toward: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the specular radiance per irradiance from single directions.

        The result is differentiable.

        Args:
            normals: Unit normals, shape (..., 3).
            toward: Unit vectors to the camera, shape (..., 3).
            directions: Unit vectors to the light, shape (..., 3).

        Returns:
            The colored radiance, which the albedo multiplies, and the white
            radiance, shape (...) each.
        """
        schlick, edge, dielectric = reflectance(normals, toward, directions, self.roughness)
        white = self.metallic * edge + (1 - self.metallic) * self.specular_factor * dielectric
        return self.metallic * schlick, white


def smoothest(mesh: Mesh) -> float:
    """Return the smallest roughness of the faces of a mesh that have gloss.

    The hundredth of a texture that is smoothest does not count. The result is 1
    for a matte mesh.

    Args:
        mesh: The mesh.
    """
    if mesh.gloss is None:
        return 1.0
    factors = [
        np.percentile(texture[..., 0], _SMOOTHEST_PERCENT) / 255 for texture in mesh.gloss_textures
    ]
    # The last factor is that of faces without a texture, whose index is -1.
    factors.append(1.0)
    factor_of_face = np.take(factors, mesh.texture_ids if mesh.gloss_textures else -1)
    roughness = mesh.gloss[:, 0] * factor_of_face
    has_gloss = mesh.gloss[:, 1:].any(1)
    return float(roughness.min(initial=1, where=has_gloss))


def at_samples(values: Tensor, samples: Tensor | slice) -> Tensor:
    """Return the values at some samples.

    Args:
        values: Values of all samples, shape (S, ...), or (1, ...) if all samples
            share one.
        samples: Indices of samples, or a slice.

    Returns:
        The chosen values, or the shared one.
    """
    return values if len(values) == 1 else values[samples]


def sample_gloss(
    mesh: Mesh, fragments: Fragments, gloss: Gloss | None = None
) -> SampleGloss | None:
    """Look up the gloss at the samples of a view.

    The result is differentiable in a given gloss. A warning is issued if
    roughness is raised to its minimum.

    Args:
        mesh: The mesh.
        fragments: Samples of the view.
        gloss: Gloss instead of that of the mesh. None for that of the mesh.

    Returns:
        The gloss in float64, or None for a matte surface.

    Raises:
        InputError: If a value is out of range, NaN or has another shape.
    """
    textures = mesh.gloss_textures if gloss is None or gloss.textured else ()
    if gloss is None:
        gloss = _gloss_of_mesh(mesh)
    if gloss is None:
        return None
    columns = [values.to(fragments.coverage) for values in gloss.checked(len(mesh.faces))]
    roughness, metallic, specular_factor = (_by_sample(column, fragments) for column in columns)
    if textures:
        sources = []
        for texture in textures:
            factors = torch.from_numpy(texture).to(fragments.coverage) / 255
            sources.append(Texture.from_values(factors))
        roughness_factor, metallic_factor = sample_textures(sources, mesh, fragments)
        roughness = roughness * roughness_factor
        metallic = metallic * metallic_factor
    if (roughness < MIN_ROUGHNESS).any():
        warnings.warn(
            f"Roughness below {MIN_ROUGHNESS} is shaded as {MIN_ROUGHNESS}, "
            "the smallest roughness that light of degree 40 shows.",
            stacklevel=2,
        )
    return SampleGloss(roughness.clamp(min=MIN_ROUGHNESS), metallic, specular_factor)


def _gloss_of_mesh(mesh: Mesh) -> Gloss | None:
    """Return the gloss of a mesh, with one row if all faces agree, or None if it is matte."""
    if mesh.gloss is None:
        return None
    is_even = (mesh.gloss == mesh.gloss[0]).all()
    rows = mesh.gloss[:1] if is_even else mesh.gloss
    roughness, metallic, specular_factor = torch.from_numpy(rows).unbind(1)
    return Gloss(roughness, metallic, specular_factor)


def _by_sample(column: Tensor, fragments: Fragments) -> Tensor:
    """Return values (S,) of the samples, given values (F,) of the faces, or one value as it is."""
    if len(column) == 1:
        return column
    return column.index_select(0, fragments.faces).index_select(0, fragments.face)


def toward_camera(fragments: Fragments, vertices: Tensor) -> Tensor:
    """Compute unit vectors from the samples to the camera.

    Args:
        fragments: Samples of the view.
        vertices: Positions, shape (V, 3).

    Returns:
        Unit vectors, shape (S, 3), or (1, 3) without perspective, where all are
        equal. They have the dtype of the vertices, and are differentiable in
        them.
    """
    # The last number is 1 for a position, and 0 for a direction.
    eye = fragments.eye.to(vertices)
    if not eye[3]:
        return eye[None, :3]
    points = fragments.interpolate(vertices[fragments.corners])
    return unit((eye[:3] - points).T).T
