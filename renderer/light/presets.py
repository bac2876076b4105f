"""Lights: named probes, files and random perturbations. Linear RGB radiance.

Distant light has coefficients (49, 3), or of another degree, in world axes (z up), in the order of
`renderer.light.harmonics`.
"""

import math
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.errors import InputError, require_bounded
from renderer.geometry.mesh import Y_UP_TO_Z_UP
from renderer.light.basis import COEFFICIENTS, DEGREE, Harmonics
from renderer.light.environment import SUFFIXES, read_panorama
from renderer.light.harmonics import (
    basis,
    degree_of,
    nonzero_coefficients,
    project,
    require_degree,
    rotate,
)
from renderer.light.light_files import read_light
from renderer.surface.microfacets import window_without_ringing
from renderer.validation import as_path

# Ramamoorthi and Hanrahan 2001, "An Efficient Representation for Irradiance Environment Maps", figure 2: RGB rows
# L00, L1-1, L10, L11, L2-2, L2-1, L20, L21, L22 in the probes' own axes, whose y is up.
_PUBLISHED_PROBES = {
    "grace": [
        (0.79, 0.44, 0.54), (0.39, 0.35, 0.60), (-0.34, -0.18, -0.27), (-0.29, -0.06, 0.01), (-0.11, -0.05, -0.12),
        (-0.26, -0.22, -0.47), (-0.16, -0.09, -0.15), (0.56, 0.21, 0.14), (0.21, -0.05, -0.30),
    ],
    "eucalyptus": [
        (0.38, 0.43, 0.45), (0.29, 0.36, 0.41), (0.04, 0.03, 0.01), (-0.10, -0.10, -0.09), (-0.06, -0.06, -0.04),
        (0.01, -0.01, -0.05), (-0.09, -0.13, -0.15), (-0.06, -0.05, -0.04), (0.02, 0.00, -0.05),
    ],
    "st_peters": [
        (0.36, 0.26, 0.23), (0.18, 0.14, 0.13), (-0.02, -0.01, 0.00), (0.03, 0.02, 0.01), (0.02, 0.01, 0.00),
        (-0.05, -0.03, -0.01), (-0.09, -0.08, -0.07), (0.01, 0.00, 0.00), (-0.08, -0.03, 0.00),
    ],
}  # fmt: skip
PROBES, UNIFORM = tuple(_PUBLISHED_PROBES), "uniform"


def load_light(light: str | Path, degree: int | None = DEGREE, roughness: float | None = None) -> Tensor:
    """Load environment light by name or from a file.

    A map is scaled to the mean luminance of the grace probe, since maps come in any unit. It may be negative in places,
    as series are that were written as a map. Coefficients stay as they are.

    Args:
        light: A named probe; "uniform", in which a surface shows its albedo; the file of an environment map (.npy,
            .hdr, .exr); or a file of coefficients (.json, as `renderer.save_light` writes it).
        degree: Degree of the result. None for that of a file of coefficients, and else 6.
        roughness: Roughness in [0, 1] of the smoothest surface that the light shines on. If it is given, a map is cut
            off by `renderer.surface.microfacets.window_without_ringing`, which changes maps whose highlights would ring.

    Returns:
        Coefficients ((degree + 1)², 3), float32.

    Raises:
        InputError: If the name is unknown, a file is missing or holds no light, or the light has a higher degree.

    >>> load_light("grace").shape
    torch.Size([49, 3])
    >>> bool((load_light("uniform")[1:] == 0).all())  # the same radiance from everywhere
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
        coefficients = read_light(Path(light), Harmonics)[1]
    elif suffix in SUFFIXES:
        coefficients = _read_light_map(Path(light), DEGREE if degree is None else degree, roughness)
    else:
        files = f"the path of an environment map ({', '.join(SUFFIXES)}) or of coefficients (.json)"
        raise InputError(f"light {light!r} is not known: choose {', '.join(PROBES)}, {UNIFORM} or {files}")
    size = len(coefficients) if degree is None else Harmonics(degree).size
    if coefficients[size:].any():
        raise InputError(f"light {light} has harmonics beyond degree={degree}: give a higher degree")
    return F.pad(coefficients, (0, 0, 0, size - len(coefficients)))


def probe(name: str) -> Tensor:
    """Coefficients (49, 3) float32 of a published probe, turned upright; bands 3 to 6 are zero."""
    published = torch.tensor(_PUBLISHED_PROBES[name], dtype=torch.float64)
    coefficients = torch.zeros(COEFFICIENTS, 3)
    coefficients[:9] = rotate(published, torch.from_numpy(Y_UP_TO_Z_UP[:3, :3])).float()
    return coefficients


def ambient(color: Tensor) -> Tensor:
    """Coefficients (49, 3) of the same radiance (3,) from everywhere: irradiance π × color."""
    require_bounded(color=color)
    coefficients = torch.zeros(COEFFICIENTS, 3, dtype=color.dtype)
    coefficients[0] = math.sqrt(4 * math.pi) * color
    return coefficients


def directional(direction: Tensor, color: Tensor, degree: int = DEGREE) -> Tensor:
    """Coefficients (..., (degree + 1)², 3) of parallel light from a unit direction (..., 3), of irradiance color (3,)
    where it meets a surface head on. Truncated at degree 6, the irradiance is off by up to 0.043 of it."""
    require_bounded(color=color)
    return basis(direction, degree)[..., None] * color


def perturb(light: Tensor, count: int, amplitude: float, radius: float | None, generator: torch.Generator) -> Tensor:
    """Random lights (count, K, 3) around one light (K, 3), K = (degree + 1)².

    Uniform in ±amplitude on every coefficient (the paper's random arm: 0.5). With a radius, the perturbation of
    the coefficients that reach a pixel is scaled to that L2 norm, and the others stay.
    """
    require_bounded(light=light)
    offsets = (torch.rand(count, *light.shape, generator=generator) * 2 - 1) * amplitude
    if radius is not None:
        offsets = offsets * torch.zeros(len(light), 1).index_fill_(0, nonzero_coefficients(degree_of(light)), 1.0)
        offsets = offsets * (radius / offsets.flatten(1).norm(dim=1).clamp(min=1e-12))[:, None, None]
    return light + offsets.to(light)


def mean_luminance(coefficients: Tensor) -> float:
    return float(coefficients[0].cpu().double() @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64))


def _read_light_map(path: Path, degree: int, roughness: float | None) -> Tensor:
    """Coefficients ((degree + 1)², 3) float32 of a map, at the grace probe's mean luminance."""
    coefficients = project(read_panorama(path), degree)
    if roughness is not None:
        coefficients = coefficients * window_without_ringing(coefficients, roughness)[:, None]
    luminance = mean_luminance(coefficients)
    if not luminance > 0:
        raise InputError(f"environment map {path} is black: give a map with light in it")
    return (coefficients * (mean_luminance(probe("grace")) / luminance)).float()
