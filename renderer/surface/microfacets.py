"""Reflectance of rough surfaces, modeled with microfacets.

A surface of roughness r and normal n reflects light from direction l toward the
camera in direction v. With the half vector h = (l + v) / |l + v| and α = r²,
the reflectance (BRDF) is

    f = F D G / (4 (n·l) (n·v))                     (equation 20)
    D = α² / (π ((n·h)² (α² - 1) + 1)²)             (GGX, equation 33)
    G = G₁(n·l) G₁(n·v)                             (Smith, equation 23)
    G₁(c) = 2 c / (c + √(α² + (1 - α²) c²)),        (equation 34)

as in glTF 2.0 and Mitsuba. The equations are those of Walter et al. (2007). The
Fresnel term F depends on the material. A dielectric has the Fresnel term of an
interface with refractive index 1.5. A metal has Schlick's approximation
F0 + (F90 - F0) (1 - v·h)⁵, which is F0 at normal incidence and F90 at grazing
incidence. Reflected light is therefore a linear combination of three terms:
`SCHLICK`, `EDGE` and `DIELECTRIC`. Karis (2013) splits the reflectance in the
same way.
"""

import torch
from torch import Tensor

from renderer.vectors import unit

# Refractive index that `fresnel` uses for dielectrics. It is typical of
# varnish.
REFRACTIVE_INDEX = 1.5

# Indices of the three Fresnel terms along the first axis of tensors. SCHLICK
# has F0 = 1 and F90 = 0, EDGE has F0 = 0 and F90 = 1, and DIELECTRIC has the
# exact term for the refractive index REFRACTIVE_INDEX.
SCHLICK, EDGE, DIELECTRIC = range(3)


def reflectance(normals: Tensor, toward: Tensor, directions: Tensor, roughness: Tensor) -> Tensor:
    """Evaluate π f, the reflectance times π, for light from single directions.

    It is the reflected radiance per irradiance, which for a diffuse surface is
    its albedo. The result is differentiable with respect to all arguments.

    Args:
        normals: Unit surface normals n, shape (..., 3). If a normal faces away
            from the camera or the light, n·v or n·l counts as 0.
        toward: Unit vectors v to the camera, shape (..., 3).
        directions: Unit vectors l to the light, shape (..., 3).
        roughness: Roughness in (0, 1], shape (...).

    Returns:
        π f with each of the three Fresnel terms SCHLICK, EDGE and DIELECTRIC,
        shape (3, ...).
    """
    # `unit` takes the components of vectors along the first axis.
    half = unit((toward + directions).movedim(-1, 0)).movedim(0, -1)
    alpha_squared = roughness**4
    without_fresnel = _distribution((half * normals).sum(-1), alpha_squared)
    for direction in (toward, directions):
        cosine = (direction * normals).sum(-1)
        without_fresnel = without_fresnel / _masking_denominator(cosine, alpha_squared)
    fresnel_terms = fresnel((half * toward).sum(-1).clamp(0, 1))
    return torch.stack([without_fresnel * term for term in fresnel_terms])


def _distribution(cosine: Tensor, alpha_squared: Tensor) -> Tensor:
    """Evaluate π D, the density of half vectors times π, at the cosine n·h."""
    return alpha_squared / (cosine**2 * (alpha_squared - 1) + 1) ** 2


def _masking_denominator(cosine: Tensor, alpha_squared: Tensor) -> Tensor:
    """Evaluate the denominator of G₁ at the cosine n·l or n·v.

    The numerators 2 (n·l) and 2 (n·v) of the two factors of G cancel with the
    denominator 4 (n·l) (n·v) of f. Without them, the reflectance stays finite
    at grazing angles.
    """
    facing_cosine = cosine.clamp(min=0)
    return facing_cosine + (alpha_squared + (1 - alpha_squared) * facing_cosine**2).sqrt()


def fresnel(cosine: Tensor) -> Tensor:
    """Evaluate the three Fresnel terms.

    The term of the dielectric is equation 22 of Walter et al. (2007), for
    unpolarized light.

    Args:
        cosine: Cosine v·h of the angle of incidence, in [0, 1], shape (...).

    Returns:
        F for SCHLICK, EDGE and DIELECTRIC, in [0, 1], shape (3, ...).
    """
    # Snell's law gives REFRACTIVE_INDEX times the cosine of the refracted ray.
    refracted = (REFRACTIVE_INDEX**2 - 1 + cosine**2).sqrt()
    # These are the reflected fractions of the amplitude, for light that is
    # polarized perpendicular and parallel to the plane of incidence.
    perpendicular = (refracted - cosine) / (refracted + cosine)
    numerator = cosine * (refracted + cosine) - 1
    denominator = cosine * (refracted - cosine) + 1
    parallel = perpendicular * numerator / denominator
    edge = (1 - cosine) ** 5
    dielectric = (perpendicular**2 + parallel**2) / 2
    return torch.stack([1 - edge, edge, dielectric])
