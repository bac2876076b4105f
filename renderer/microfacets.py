"""Specular reflectance of rough surfaces (microfacet model of glTF and Mitsuba).

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
from jaxtyping import Float
from torch import Tensor

from renderer.vectors import unit

# One number, or one vector, for each of any number of points.
Numbers = Float[Tensor, " ..."]
Vectors = Float[Tensor, "... 3"]
# Refractive index of dielectric (non-metallic) surfaces. 1.5 is typical of varnish, and
# the default of glTF.
REFRACTIVE_INDEX = 1.5

# Indices of the three Fresnel terms in the results of `fresnel` and `reflectance`. A metal
# reflects the fraction F0 · SCHLICK + F90 · EDGE (Schlick's approximation), with the
# fractions F0 at 0° and F90 at 90°. Other surfaces reflect the fraction DIELECTRIC.
SCHLICK, EDGE, DIELECTRIC = range(3)


def reflectance(
    normals: Vectors, toward: Vectors, directions: Vectors, roughness: Numbers
) -> Float[Tensor, "3 ..."]:
    """Compute π times the specular reflectance (BRDF) for light from single directions.

    In the units of this project, a diffuse surface reflects the radiance
    albedo · irradiance, without the usual division by π. A specular surface
    therefore reflects π · BRDF · irradiance. The result is differentiable with
    respect to all arguments. The first axis is for SCHLICK, EDGE and DIELECTRIC. Normals
    that face away count as a cosine of 0. The vectors are the normal n, v to the camera
    (`toward`), and l to the light (`directions`).
    """
    # Unit half vectors h. `unit` takes vectors with their components along the first axis.
    half = unit((toward + directions).movedim(-1, 0)).movedim(0, -1)
    # The width parameter of the distribution is α = roughness².
    alpha_squared = roughness**4
    # The next lines compute π D G / (4 (n·l) (n·v)) with the distribution D and the masking
    # term G. The denominator cancels with a factor of G.
    without_fresnel = distribution((half * normals).sum(-1), alpha_squared)
    for direction in (toward, directions):
        cosine = (direction * normals).sum(-1)
        without_fresnel = without_fresnel / masking_denominator(cosine, alpha_squared)
    fresnel_terms = fresnel((half * toward).sum(-1).clamp(0, 1))
    return torch.stack([without_fresnel * term for term in fresnel_terms])


def distribution(cosine: Numbers, alpha_squared: Numbers) -> Numbers:
    """Compute π times the GGX distribution D of the normals of microfacets.

    D = α² / (π ((n·h)² (α² - 1) + 1)²), Walter et al. (2007), equation 33. `alpha_squared`
    is the fourth power of the roughness. The cosine is n·h, between the normal and the half
    vector.
    """
    return alpha_squared / (cosine**2 * (alpha_squared - 1) + 1) ** 2


def masking_denominator(cosine: Numbers, alpha_squared: Numbers) -> Numbers:
    """Compute the denominator of Smith's masking term G₁(c).

    G₁(c) is 2 c / (c + √(α² + (1 - α²) c²)). The BRDF contains
    G₁(n·l) G₁(n·v) / (4 (n·l) (n·v)), in which the numerators 2 c cancel. So only
    the denominators are needed, and the BRDF stays finite at grazing angles. Negative
    cosines count as 0. The cosine c is that between the normal n and the direction l to the
    light or v to the camera.
    """
    facing_cosine = cosine.clamp(min=0)
    return facing_cosine + (alpha_squared + (1 - alpha_squared) * facing_cosine**2).sqrt()


def fresnel(cosine: Numbers) -> Float[Tensor, "3 ..."]:
    """Compute three Fresnel terms, which depend on the angle between light and microfacet.

    A metal reflects the fraction F0 · SCHLICK + F90 · EDGE (Schlick's
    approximation), with SCHLICK = 1 - (1 - c)⁵, EDGE = (1 - c)⁵ and the cosine c
    of the angle of incidence. The fractions at 0° and 90° are F0 and F90. Other
    surfaces reflect the fraction DIELECTRIC of unpolarized light. With
    g² = n² - 1 + c² and the refractive index n (REFRACTIVE_INDEX), it is
    ((g - c) / (g + c))² (1 + ((c (g + c) - 1) / (c (g - c) + 1))²) / 2
    (Walter et al. 2007, equation 22).
    """
    # Refractive index times the cosine of the refracted ray (Snell's law).
    refracted = (REFRACTIVE_INDEX**2 - 1 + cosine**2).sqrt()
    # Reflected fraction of the amplitude of light that is polarized perpendicular to the
    # plane of incidence.
    perpendicular = (refracted - cosine) / (refracted + cosine)
    # Reflected fraction of the amplitude of light that is polarized parallel to this plane.
    numerator = cosine * (refracted + cosine) - 1
    denominator = cosine * (refracted - cosine) + 1
    parallel = perpendicular * numerator / denominator
    edge = (1 - cosine) ** 5
    dielectric = (perpendicular**2 + parallel**2) / 2
    return torch.stack([1 - edge, edge, dielectric])
