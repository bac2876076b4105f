"""Named lights, lights from files, and random perturbations of lights.

A light is a tensor of SH coefficients, shape (K, 3) with K = (degree + 1)² and
three color channels. The default degree is 6, with 49 coefficients. The
coefficients describe linear RGB radiance in world axes (z up), in the order of
`renderer.light.harmonics`.
"""

import math
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from renderer.errors import InputError, as_path, require_bounded
from renderer.image import LUMINANCE
from renderer.light.basis import COEFFICIENTS, DEGREE, Harmonics
from renderer.light.environment import SUFFIXES, read_panorama
from renderer.light.files import read_light
from renderer.light.harmonics import (
    basis,
    degree_of,
    nonzero_coefficients,
    project,
    require_degree,
    rotate,
)
from renderer.light.ringing import window_without_ringing
from renderer.mesh import Y_UP_TO_Z_UP

# Coefficients of three light probes, as RGB rows in the order L00, L1-1, L10,
# L11, L2-2, L2-1, L20, L21, L22, in the axes of the probes, whose y is up.
# Source: Ramamoorthi and Hanrahan 2001, "An Efficient Representation for
# Irradiance Environment Maps", figure 2.
_PUBLISHED_PROBES = {
    "grace": [
        (0.79, 0.44, 0.54),
        (0.39, 0.35, 0.60),
        (-0.34, -0.18, -0.27),
        (-0.29, -0.06, 0.01),
        (-0.11, -0.05, -0.12),
        (-0.26, -0.22, -0.47),
        (-0.16, -0.09, -0.15),
        (0.56, 0.21, 0.14),
        (0.21, -0.05, -0.30),
    ],
    "eucalyptus": [
        (0.38, 0.43, 0.45),
        (0.29, 0.36, 0.41),
        (0.04, 0.03, 0.01),
        (-0.10, -0.10, -0.09),
        (-0.06, -0.06, -0.04),
        (0.01, -0.01, -0.05),
        (-0.09, -0.13, -0.15),
        (-0.06, -0.05, -0.04),
        (0.02, 0.00, -0.05),
    ],
    "st_peters": [
        (0.36, 0.26, 0.23),
        (0.18, 0.14, 0.13),
        (-0.02, -0.01, 0.00),
        (0.03, 0.02, 0.01),
        (0.02, 0.01, 0.00),
        (-0.05, -0.03, -0.01),
        (-0.09, -0.08, -0.07),
        (0.01, 0.00, 0.00),
        (-0.08, -0.03, 0.00),
    ],
}
# Names of the light probes.
PROBES = tuple(_PUBLISHED_PROBES)
# Name with which `load_light` creates light with the same radiance from all directions.
UNIFORM = "uniform"
# `load_light` scales environment maps to the mean luminance of this probe.
_REFERENCE_PROBE = "grace"


def load_light(
    light: str | Path, degree: int | None = DEGREE, roughness: float | None = None
) -> Tensor:
    """Load environment light by name or from a file.

    The unit of environment maps is unknown. They are therefore scaled so that
    their mean luminance is the one of the probe "grace". SH coefficients from a
    file are not scaled.

    Args:
        light: One of four kinds: the name of a measured light probe ("grace",
            "eucalyptus" or "st_peters"); "uniform", the same radiance from all
            directions, so that a surface shows its albedo; the path of an
            environment map (.npy, .hdr or .exr); the path of SH coefficients
            (.json, as `nb.save_light` writes it).
        degree: Degree of the result. None for the degree of a file of
            coefficients, or 6 for any other light.
        roughness: Roughness in [0, 1] of the smoothest surface that the light
            shines on. With it, the coefficients of an environment map are damped
            where a highlight on this surface would get dark rings. None for no
            damping.

    Returns:
        SH coefficients, shape ((degree + 1)², 3), float32.

    Raises:
        InputError: If the name is unknown, if the file does not exist or holds no
            light, or if the light has a higher degree than `degree`.

    Example:
        >>> import norm_balls as nb
        >>> nb.load_light("grace").shape
        torch.Size([49, 3])
        >>> uniform = nb.load_light("uniform")  # the same radiance from everywhere
        >>> bool((uniform[1:] == 0).all())
        True
    """
    as_path("light", light)
    light = str(light)
    if degree is not None:
        require_degree(degree)
    suffix = Path(light).suffix.lower()
    if light in _PUBLISHED_PROBES:
        coefficients = probe(light)
    elif light == UNIFORM:
        coefficients = ambient(torch.full((3,), 1 / math.pi))
    elif suffix == ".json":
        _, coefficients = read_light(Path(light), Harmonics)
    elif suffix in SUFFIXES:
        map_degree = DEGREE if degree is None else degree
        coefficients = _read_light_map(Path(light), map_degree, roughness)
    else:
        raise InputError(
            f"light {light!r} is not known: choose {', '.join(PROBES)}, {UNIFORM} or "
            f"the path of an environment map ({', '.join(SUFFIXES)}) or of coefficients (.json)",
        )
    # Number of coefficients of the result. Only zeros may be appended or removed.
    size = len(coefficients) if degree is None else Harmonics(degree).size
    if coefficients[size:].any():
        raise InputError(
            f"light {light} has harmonics beyond degree={degree}: give a higher degree"
        )
    return F.pad(coefficients, (0, 0, 0, size - len(coefficients)))


def probe(name: str) -> Float[Tensor, "49 3"]:
    """Return a published light probe, the measured light of a real place.

    The published coefficients have y up and are rotated to z up. Coefficients of degree 3
    to 6 are 0.
    """
    published = torch.tensor(_PUBLISHED_PROBES[name], dtype=torch.float64)
    coefficients = torch.zeros(COEFFICIENTS, 3)
    z_up = rotate(published, torch.from_numpy(Y_UP_TO_Z_UP[:3, :3])).float()
    coefficients[: len(published)] = z_up
    return coefficients


def ambient(color: Float[Tensor, " 3"]) -> Float[Tensor, "49 3"]:
    """Create light with the same radiance from every direction.

    The irradiance of a surface in this light is π times the radiance.
    """
    require_bounded(color=color)
    coefficients = torch.zeros(COEFFICIENTS, 3, dtype=color.dtype)
    coefficients[0] = math.sqrt(4 * math.pi) * color
    return coefficients


def directional(
    direction: Float[Tensor, "... 3"], color: Float[Tensor, " 3"], degree: int = DEGREE
) -> Tensor:
    """Approximate parallel light from one direction by spherical harmonics.

    At degree 6, the error of the irradiance is at most 0.043 times the irradiance
    of a surface that faces the light. Directions lead toward the light, and `color` is the
    linear irradiance of a surface that faces it.
    """
    require_bounded(color=color)
    return basis(direction, degree)[..., None] * color


def perturb(
    light: Float[Tensor, "K 3"],
    count: int,
    amplitude: float,
    radius: float | None,
    generator: torch.Generator,
) -> Float[Tensor, "count K 3"]:
    """Draw random lights around a light.

    A uniform random number in [-amplitude, amplitude] is added to each
    coefficient, as in the random mode of the paper (amplitude 0.5). With `radius`, the L2
    norm to which a change is scaled, only coefficients that change the irradiance of a
    diffuse surface are changed. None changes all and does not scale.
    """
    require_bounded(light=light)
    offsets = (torch.rand(count, *light.shape, generator=generator) * 2 - 1) * amplitude
    if radius is not None:
        diffuse_indices = nonzero_coefficients(degree_of(light))
        # 1 for coefficients that change the irradiance of a surface, 0 for the others.
        mask = torch.zeros(len(light), 1).index_fill_(0, diffuse_indices, 1.0)
        offsets = offsets * mask
        norms = offsets.flatten(1).norm(dim=1).clamp(min=1e-12)
        offsets = offsets * (radius / norms)[:, None, None]
    return light + offsets.to(light)


def mean_luminance(coefficients: Float[Tensor, "K 3"]) -> float:
    """Compute √(4π) times the mean luminance of a light over all directions.

    Only the first row counts.
    """
    weights = torch.tensor(LUMINANCE, dtype=torch.float64)
    return float(coefficients[0].cpu().double() @ weights)


def _read_light_map(path: Path, degree: int, roughness: float | None) -> Tensor:
    """Read an environment map, and scale it to the mean luminance of the grace probe.

    `roughness` is that of the smoothest surface, whose highlights must not get dark rings, or None.
    """
    coefficients = project(read_panorama(path), degree)
    if roughness is not None:
        coefficients = coefficients * window_without_ringing(coefficients, roughness)[:, None]
    luminance = mean_luminance(coefficients)
    if luminance <= 0:
        raise InputError(f"environment map {path} is black: give a map with positive radiance")
    scale = mean_luminance(probe(_REFERENCE_PROBE)) / luminance
    return (coefficients * scale).float()
