"""Gloss (specular reflection) of surfaces, with the metallic-roughness material of glTF 2.0.

A surface has an albedo ρ, a roughness, a metallic fraction m (`metallic`), and a
specular factor s (`specular_factor`, glTF's `specularFactor`). It reflects light
specularly in two ways. A dielectric reflects (1 - m) s times a reflection that
has the color of the light, called white here. A metal reflects m times
Schlick's approximation with F0 = ρ and F90 = 1. The part with F0 is multiplied
by the albedo, and is called colored here. The part with F90 is white. The
reflected radiance per irradiance is

    ρ (diffuse + colored) + white.

A dielectric surface has a diffuse layer below a dielectric layer, which is
called coat here. The unit vectors n, l and v are the normal, the direction to
the light and the direction to the camera. E(μ) is the fraction of a light beam
that the coat reflects, if μ is the cosine between the normal and the beam
(`coat_albedo`). E_avg = 2 ∫ E(μ) μ dμ is its mean. Then

    diffuse = (1 - m) (1 - s E(n·l)) (1 - s E(n·v)) / (1 - s E_avg)

(Kulla and Conty 2017, "Revisiting physically based shading at Imageworks"). This
model is reciprocal. With ρ = 1, a dielectric reflects each beam entirely: the
coat reflects s E(n·l), and the diffuse layer reflects 1 - s E(n·l).
Environment light with the coefficients U_lm has the irradiance
Σ (A_l - s B_l) U_lm Y_lm(n) below the coat, with A_l from `lambertian_factors`
and B_l from `coat_irradiance_factors`.

Shapes use these letters: a view has S covered samples of a mesh with F faces. K
is the number of SH coefficients of environment light, (degree + 1)².
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from renderer.errors import InputError, as_tensor, require, require_flag
from renderer.light.harmonics import bands, lambertian_factors
from renderer.mesh import Mesh, require_mesh
from renderer.microfacets import DIELECTRIC, EDGE, SCHLICK, Vectors, reflectance
from renderer.settings import MIN_ROUGHNESS
from renderer.surface import lobes
from renderer.surface.albedo import Texture, sample_textures
from renderer.surface.lobes import ViewFrame
from renderer.vectors import unit
from renderer.visibility.fragments import Fragments

# `smallest_roughness` ignores this percentage of the texels of a texture, namely those
# with the smallest roughness.
IGNORED_PERCENT = 1
# The only SH coefficient of uniform light with irradiance 1. Its radiance is 1 / π, and
# the coefficient is √(4π) times the radiance.
_UNIFORM_COEFFICIENT = math.sqrt(4 * math.pi) / math.pi


@dataclass(frozen=True, eq=False)
class Gloss:
    """Specular reflection (gloss) of a surface, as in the material model of glTF.

    Roughness, metallic and specular factor are each a number in [0, 1] for the
    whole mesh, a tensor of shape (), or a tensor of shape (F,) with a number for
    each of the F faces.

    Attributes:
        roughness: Roughness as in glTF. Values below 0.2 are shaded as 0.2.
        metallic: Fraction of the surface that is metal.
        specular_factor: Factor for the specular reflection of the part that is not
            metal (`specularFactor` of the glTF extension KHR_materials_specular).
        textured: True multiplies roughness and metallic by the gloss textures of
            the mesh. False ignores these textures.

    Example:
        >>> import norm_balls as nb
        >>> varnished = nb.Gloss(roughness=0.3).on(nb.solid("orange"))
        >>> varnished.gloss.shape == varnished.faces.shape
        True
    """

    roughness: float | Tensor = 0.5
    metallic: float | Tensor = 0.0
    specular_factor: float | Tensor = 1.0
    textured: bool = field(default=False, kw_only=True)

    def on(self, mesh: Mesh) -> Mesh:
        """Return a copy of a mesh with this gloss instead of its own.

        Args:
            mesh: Mesh with F faces.

        Raises:
            InputError: If a value of the gloss is NaN, not in [0, 1], or has a
                shape other than (), (1,) or (F,).
        """
        require_mesh("mesh", mesh)
        face_count = len(mesh.faces)
        columns = [values.detach().cpu().expand(face_count) for values in self.checked(face_count)]
        textures = mesh.gloss_textures if self.textured else ()
        by_face = torch.stack(columns, dim=1).float().numpy()
        return replace(mesh, gloss=by_face, gloss_textures=textures)

    def checked(self, faces: int) -> list[Tensor]:
        """Check roughness, metallic and specular factor, and convert them to tensors.

        Args:
            faces: Number F of faces of the mesh that gets this gloss.

        Returns:
            Tensors of roughness, metallic and specular factor. Each has the shape
            (1,) or (F,).

        Raises:
            InputError: If a value of the gloss is NaN, not in [0, 1], or has a
                shape other than (), (1,) or (F,).
        """
        require_flag("textured", self.textured)
        checked = []
        for name in ("roughness", "metallic", "specular_factor"):
            given = getattr(self, name)
            values = as_tensor(f"gloss: {name}", given)
            if isinstance(given, int | float):
                # `as_tensor` would round a Python number to float32.
                values = torch.tensor(float(given), dtype=torch.float64)
            has_right_shape = values.shape in ((), (1,), (faces,))
            fault = f"{name} has shape {tuple(values.shape)} or values outside [0, 1]"
            advice = f"give one number, or {faces} numbers (one per face), in [0, 1]"
            error = partial(InputError, f"gloss: {fault}: {advice}")
            if not has_right_shape:
                raise error()
            # A comparison with NaN is False.
            require((values.min() >= 0) & (values.max() <= 1), error)
            checked.append(values.reshape(-1))
        return checked


class SampleGloss(NamedTuple):
    """Gloss at the S covered samples of a view.

    Each tensor has the shape (S,), or (1,) if all samples have the same value.

    Attributes:
        roughness: Roughness in [0.2, 1].
        metallic: Fraction of the surface that is metal, in [0, 1].
        specular_factor: Factor for the specular reflection of the dielectric,
            in [0, 1].
    """

    roughness: Tensor
    metallic: Tensor
    specular_factor: Tensor

    def at(self, samples: Tensor | slice) -> SampleGloss:
        """Return the gloss of some of the samples."""
        return SampleGloss(*(at_samples(values, samples) for values in self))

    def to(self, like: Tensor) -> SampleGloss:
        """Return a copy in the dtype and on the device of another tensor."""
        return SampleGloss(*(values.to(like) for values in self))

    @property
    def lobe_width(self) -> float:
        """Smallest width α = roughness² of the specular lobes. Infinite if no sample has one.

        As in `smallest_roughness`, the 1% of the samples with the smallest roughness do not count.
        """
        roughness, *factors = torch.broadcast_tensors(*(values.detach() for values in self))
        roughness = roughness[(factors[0] > 0) | (factors[1] > 0)]
        rank = 1 + len(roughness) * IGNORED_PERCENT // 100
        return float(roughness.kthvalue(rank).values) ** 2 if len(roughness) else math.inf

    def lobes(self, cosine: Float[Tensor, " S"], degree: int) -> tuple[Tensor | None, Tensor]:
        """Compute the specular lobes of S samples for environment light.

        A lobe is the specular reflectance as a function of the direction to the
        light. It is given by M = (degree + 1) (degree + 2) / 2 numbers, the values
        of `renderer.surface.lobes.lobe_functions`. The first lobe is multiplied by the
        albedo, and None if no sample is metallic. The second has the color of the light.
        The cosine is that between the normal and the direction to the camera.
        """
        # The terms of metals are also needed for the gradient of `metallic`.
        has_metal = self.metallic.requires_grad or bool(self.metallic.any())
        terms = (DIELECTRIC, SCHLICK, EDGE) if has_metal else (DIELECTRIC,)
        dielectric, *metal_terms = lobes.lobe_functions(cosine, self.roughness, degree, terms)
        white = (1 - self.metallic) * self.specular_factor * dielectric
        if not has_metal:
            return None, white
        schlick, edge = metal_terms
        # A metal reflects the fraction albedo · SCHLICK + EDGE. The color of the light stays
        # unchanged in the second term.
        return self.metallic * schlick, white + self.metallic * edge

    def reflect_uniform_light(self, cosine: Float[Tensor, " S"]) -> Float[Tensor, " S"]:
        """Compute the specular radiance of white samples under uniform light of irradiance 1.

        The cosine is that of the angle between the normal and the direction to the camera.
        """
        colored, white = self.lobes(cosine.clamp(0, 1), degree=0)
        total = white if colored is None else white + colored
        return total[0] * _UNIFORM_COEFFICIENT

    def coat_transmittance(self, cosine: Tensor) -> Tensor:
        """Compute the fraction of a light beam that passes the dielectric coat.

        The coat is a transparent layer on a diffuse layer. The fraction is
        1 - s E(μ). E(μ) is the fraction that a coat with the specular factor s = 1
        reflects (`coat_albedo`). The result is differentiable with respect to the
        cosine and to the gloss. Negative cosines μ, between the normal
        and the beam, count as 0.
        """
        return 1 - self.specular_factor * lobes.coat_albedo(cosine.clamp(0, 1), self.roughness)

    def factors_below_coat(self, degree: int) -> Float[Tensor, "K S"]:
        """Compute the factor of each SH coefficient in the irradiance below the dielectric coat.

        The irradiance is Σ_lm (A_l - s B_l) U_lm Y_lm(n), with the coefficients
        U_lm of the light, the harmonics Y_lm, the normal n and the specular
        factor s. A_l is the factor without a coat (`lambertian_factors`), and
        B_l the factor of the light that the coat reflects (`coat_irradiance_factors`). The
        result is differentiable with respect to the gloss. The last axis has size 1 if all
        samples have the same gloss.
        """
        # Factors B_l of the light that the coat reflects: one row for each degree l, one column
        # for each sample.
        polynomials = lobes.roughness_polynomials(self.roughness)
        coat_factors = lobes.coat_irradiance_factors(degree).to(self.roughness) @ polynomials
        # Factors A_l without a coat, one for each SH coefficient of the light.
        uncoated_factors = lambertian_factors(degree).to(self.roughness)
        return uncoated_factors[:, None] - self.specular_factor * coat_factors[bands(degree)]

    def diffuse_factor(self, cosine: Float[Tensor, " S"]) -> Float[Tensor, " S"]:
        """Compute the factor by which metal and coat reduce the diffuse radiance at S samples.

        The diffuse radiance is this factor times the albedo times the irradiance
        below the coat. The factor is (1 - m) (1 - s E(n·v)) / (1 - s E_avg), with
        the metallic fraction m and the specular factor s. E is the fraction of
        light that the coat reflects (`coat_albedo`), and E_avg its mean
        (`coat_mean`). The result is differentiable with respect to the cosine n·v and
        the gloss. n is the normal, and v leads to the camera.
        """
        transmittance = self.coat_transmittance(cosine)
        mean_transmittance = 1 - self.specular_factor * lobes.coat_mean(self.roughness)
        return (1 - self.metallic) * transmittance / mean_transmittance

    def specular_transfer(
        self, normals: Float[Tensor, "S 3"], toward: Float[Tensor, "_ 3"], degree: int
    ) -> tuple[Tensor | None, Tensor, ViewFrame]:
        """Compute the specular radiance of S samples from each spherical harmonic.

        The environment light has K = (degree + 1)² SH coefficients in axes that
        face the camera. The result is differentiable with respect to the vectors
        and the gloss. The results are the radiance of metals, which must be multiplied by
        the albedo (None without metals), all other specular radiance, and the axes that
        face the camera.
        """
        frame = ViewFrame.from_directions(normals, toward)
        colored_lobe, white_lobe = self.lobes(frame.cosine, degree)
        colored_transfer = None if colored_lobe is None else frame.harmonics(colored_lobe)
        return colored_transfer, frame.harmonics(white_lobe), frame

    def reflect_beams(
        self, normals: Vectors, toward: Vectors, directions: Vectors
    ) -> tuple[Tensor, Tensor]:
        """Compute the specular radiance per irradiance for light from single directions.

        The result is differentiable with respect to the vectors and the gloss. The first
        result is multiplied by the albedo, and the second has the color of the light.
        """
        schlick, edge, dielectric = reflectance(normals, toward, directions, self.roughness)
        white = self.metallic * edge + (1 - self.metallic) * self.specular_factor * dielectric
        return self.metallic * schlick, white


def smallest_roughness(mesh: Mesh) -> float:
    """Return the smallest roughness of all faces of a mesh that reflect specularly, 1 if matte.

    In each texture of the roughness, the 1% of the texels with the smallest
    roughness do not count.
    """
    if mesh.gloss is None:
        return 1.0
    # The first channel of a gloss texture is a factor for the roughness.
    smallest = [np.percentile(t[..., 0], IGNORED_PERCENT) / 255 for t in mesh.gloss_textures]
    # Faces without a texture have the texture index -1, which selects the last factor.
    factor_of_face = np.take([*smallest, 1.0], mesh.texture_ids if smallest else -1)
    roughness_of_face = mesh.gloss[:, 0] * factor_of_face
    # Columns 1 and 2 are metallic and specular factor. If both are 0, a face is matte.
    return float(roughness_of_face.min(initial=1, where=mesh.gloss[:, 1:].any(1)))


def at_samples(values: Tensor, samples: Tensor | slice) -> Tensor:
    """Select the values of some samples. A single value counts for all samples.

    It is returned as it is, with size 1 along the first axis.
    """
    return values if len(values) == 1 else values[samples]


def sample_gloss(mesh: Mesh, fragments: Fragments, gloss: Gloss | None) -> SampleGloss | None:
    """Look up the specular material (gloss) at the samples of a view that show the mesh.

    The result is differentiable with respect to `gloss`. A warning is issued if
    a roughness is raised to its minimum 0.2. A `gloss` of None is that of the mesh, and the
    result is None for a matte surface.
    """
    # A given gloss uses the textures of the mesh only if its field `textured` is True.
    gloss_textures = mesh.gloss_textures if gloss is None or gloss.textured else ()
    if gloss is None:
        if mesh.gloss is None:
            return None
        rows = mesh.gloss[:1] if (mesh.gloss == mesh.gloss[0]).all() else mesh.gloss
        gloss = Gloss(*torch.from_numpy(rows).unbind(1))
    columns = [values.to(fragments.coverage) for values in gloss.checked(len(mesh.faces))]
    # A single value, which all faces share, stays as it is.
    roughness, metallic, specular_factor = (
        values
        if len(values) == 1
        else values.index_select(0, fragments.faces).index_select(0, fragments.sample_to_seen_face)
        for values in columns
    )
    if gloss_textures:
        like = fragments.coverage
        factors = [torch.from_numpy(of).to(like, non_blocking=True) for of in gloss_textures]
        textures = [Texture.from_values(values / 255) for values in factors]
        # The two channels of a texture are factors for the roughness and for metallic.
        roughness_factor, metallic_factor = sample_textures(textures, mesh, fragments)
        roughness = roughness * roughness_factor
        metallic = metallic * metallic_factor
    shaded = f"Roughness below {MIN_ROUGHNESS} is shaded as {MIN_ROUGHNESS}"
    reason = "the smallest roughness that light of degree 40 shows."
    require((roughness >= MIN_ROUGHNESS).all(), lambda: UserWarning(f"{shaded}, {reason}"))
    return SampleGloss(roughness.clamp(min=MIN_ROUGHNESS), metallic, specular_factor)


def toward_camera(fragments: Fragments, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "S 3"]:
    """Compute unit vectors from the S samples of a view to the camera.

    The vectors are differentiable with respect to the vertices. They are in world axes.
    Without perspective, all samples of the only view share one vector, and the shape is (1, 3).
    """
    # A row is (x, y, z, 1) with the position of a perspective camera, or (x, y, z, 0) with the
    # direction to an orthographic camera. There is one row for the only view, or for each sample.
    eyes = fragments.eyes.to(vertices, non_blocking=vertices.is_cuda)
    position, w = eyes[:, :3], eyes[:, 3:]
    if len(eyes) == 1 and not fragments.cameras[0].has_perspective:
        return position
    points = fragments.interpolate(vertices[fragments.corners])
    return unit((position - w * points).T).T
