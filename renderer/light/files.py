"""Lights by name, lights in files, and random perturbations of lights.

An environment light is a tensor of SH coefficients, shape (K, 3) with K = (degree + 1)² and
three color channels. The default degree is 6, with 49 coefficients. The coefficients describe
linear RGB radiance in world axes (z up), in the order of `renderer.light.harmonics`. A .json file
has a basis and its coefficients.
"""

from __future__ import annotations

import json
import math
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from renderer import errors
from renderer.errors import InputError
from renderer.image import LUMINANCE, to_bytes
from renderer.io.files import atomic_write
from renderer.io.images import write_image
from renderer.light import environment, harmonics
from renderer.light.basis import COEFFICIENTS, DEGREE, HARMONICS, Harmonics, LocalBasis
from renderer.light.environment import SUFFIXES
from renderer.light.ringing import window_without_ringing
from renderer.mesh import Y_UP_TO_Z_UP

# Largest number of rows of a written map, which needs 3 GB of memory.
MAX_MAP_HEIGHT = 8192
# Type of the basis that `read_light` returns.
LightBasis = TypeVar("LightBasis", bound=Harmonics | LocalBasis)


def save_light(
    path: str | Path,
    coefficients: Tensor,
    basis: Harmonics | LocalBasis = HARMONICS,
    height: int = 256,
) -> float:
    """Write a light to a .json file, or environment lighting as a map for other software.

    From a .json file of spherical harmonics, `load_light` reads exactly the same
    float32 numbers. `LampsSettings.start` takes that of lamps. For a projector, its
    pattern is also written to an 8-bit .png file with the same name. White in this
    image is the largest coefficient, the attribute `power` of the projector. A map
    (.hdr, .exr or .npy) has no negative radiance and the same mean, so its
    irradiance can differ from that of the light.

    Args:
        path: Path of a .json file or, for spherical harmonics, of a map. Its folder
            is created.
        coefficients: RGB coefficients of the light, shape (size, 3) with the
            number `basis.size` of functions of the basis.
        basis: Basis of the light. The default is spherical harmonics of degree 6.
        height: Number of rows of a map, which has twice as many columns.

    Returns:
        Relative error of the irradiance of the written light, root mean square over
        all normals. It is 0 for a .json file.

    Raises:
        InputError: If the suffix is of no such file, or if the coefficients have another shape
            or hold NaN.
        OSError: If the file cannot be written.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> light = nb.load_light("grace")
        >>> nb.save_light("light.json", light)
        0.0
        >>> torch.equal(nb.load_light("light.json"), light)
        True
        >>> nb.save_light("light.hdr", light) < 0.01
        True
    """
    path = errors.as_path("path", path)
    is_map = path.suffix.lower() in SUFFIXES and isinstance(basis, Harmonics)
    if path.suffix.lower() != ".json" and not is_map:
        fault = f"path={path} is neither a .json file nor, for spherical harmonics, a map"
        raise InputError(f"{fault}: use one of the suffixes .json, {', '.join(SUFFIXES)}")
    expected = "Harmonics(degree), or lamps or a projector"
    errors.require_kind("basis", basis, Harmonics | LocalBasis, expected)
    coefficients = errors.as_tensor("coefficients", coefficients).detach()
    errors.require_bounded(coefficients=coefficients)
    errors.require_shape("coefficients", coefficients, basis.size, 3)
    if isinstance(basis, Harmonics) and is_map:
        errors.require_whole("height", height, environment.FEWEST_ROWS, MAX_MAP_HEIGHT)
        # A map cannot have negative radiance, so a light without it is written.
        physical = basis.project_nonnegative(coefficients)
        environment.write_map(path, environment.to_map(physical, height).clamp(min=0))
        written = harmonics.project(environment.read_map(path), basis.degree).to(coefficients)
        return float(harmonics.irradiance_error(written, coefficients))
    description = {"basis": basis.name, **vars(basis), "coefficients": coefficients.tolist()}
    picture = basis.picture(coefficients)
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, json.dumps(description, allow_nan=False) + "\n")
    if picture is not None:
        write_image(path.with_suffix(".png"), to_bytes(picture.clamp(0, 1)).numpy())
    return 0.0


def read_light(path: str | Path, *kinds: type[LightBasis]) -> tuple[LightBasis, Tensor]:
    """Read a light from a .json file: its basis, and its RGB coefficients (K, 3).

    A plain list of rows [r, g, b] holds SH coefficients. `kinds` are accepted classes, such
    as `Lamps`.
    """
    path = Path(path)
    errors.require_file(path, "give the path of a .json file of coefficients")
    # Classes by the names that files have under "basis".
    kind_of_name = {kind.name: kind for kind in kinds}
    with errors.reading(path, "does not describe a light", "write it again"):
        description = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(description, dict):
            description = {"basis": HARMONICS.name, "coefficients": description}
        coefficients = torch.tensor(description.pop("coefficients"), dtype=torch.float32)
        name = description.pop("basis")
        if name not in kind_of_name:
            known = " or ".join(kind_of_name)
            raise InputError(f"basis is {name!r}: give a light with the basis {known}")
        # All other entries are the fields of the class.
        basis = kind_of_name[name](**description)
        errors.require_shape("coefficients", coefficients, basis.size, 3)
        largest = float(coefficients.abs().max())
        errors.require_range("the largest coefficient", largest, 0, errors.MAX_SCALE)
    return basis, coefficients


# Coefficients of three light probes, as RGB rows in the order L00, L1-1, L10,
# L11, L2-2, L2-1, L20, L21, L22, in the axes of the probes, whose y is up.
# Source: Ramamoorthi and Hanrahan 2001, "An Efficient Representation for
# Irradiance Environment Maps", figure 2.
_PUBLISHED_PROBES = json.loads(Path(__file__).with_name("probes.json").read_text())
# Names of the light probes.
PROBES = tuple(_PUBLISHED_PROBES)
# Name with which `load_light` creates light with the same radiance from all directions.
UNIFORM = "uniform"


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
            light, if the light has a higher degree than `degree`, or if `roughness`
            is not in [0, 1].

    Example:
        >>> import norm_balls as nb
        >>> nb.load_light("grace").shape
        torch.Size([49, 3])
        >>> uniform = nb.load_light("uniform")  # the same radiance from everywhere
        >>> bool((uniform[1:] == 0).all())
        True
    """
    errors.as_path("light", light)
    light = str(light)
    if degree is not None:
        harmonics.require_degree(degree)
    errors.require_range("roughness", roughness, 0, 1)
    suffix = Path(light).suffix.lower()
    if light in _PUBLISHED_PROBES:
        coefficients = probe(light)
    elif light == UNIFORM:
        # Light of irradiance 1 has the radiance 1 / π.
        coefficients = ambient(torch.full((3,), 1 / math.pi))
    elif suffix == ".json":
        _, coefficients = read_light(Path(light), Harmonics)
    elif suffix in SUFFIXES:
        coefficients = _read_light_map(Path(light), DEGREE if degree is None else degree, roughness)
    else:
        names = f"{', '.join(PROBES)}, {UNIFORM}"
        path = f"the path of an environment map ({', '.join(SUFFIXES)}) or of coefficients (.json)"
        raise InputError(f"light {light!r} is not known: choose {names} or {path}")
    # Number of coefficients of the result. Only zeros may be appended or removed.
    size = len(coefficients) if degree is None else Harmonics(degree).size
    if coefficients[size:].any():
        raise InputError(f"light {light} has harmonics beyond degree={degree}: set a higher degree")
    return F.pad(coefficients, (0, 0, 0, size - len(coefficients)))


def probe(name: str) -> Float[Tensor, "49 3"]:
    """Return a published light probe, the measured light of a real place.

    The published coefficients have y up and are rotated to z up. Coefficients of degree 3
    to 6 are 0.
    """
    published = torch.tensor(_PUBLISHED_PROBES[name], dtype=torch.float64)
    z_up = harmonics.rotate(published, torch.from_numpy(Y_UP_TO_Z_UP[:3, :3])).float()
    return F.pad(z_up, (0, 0, 0, COEFFICIENTS - len(z_up)))


def ambient(color: Float[Tensor, " 3"]) -> Float[Tensor, "49 3"]:
    """Create light with the same radiance from every direction.

    The irradiance of a surface in this light is π times the radiance.
    """
    return F.pad(math.sqrt(4 * math.pi) * color[None], (0, 0, 0, COEFFICIENTS - 1))


def directional(
    direction: Float[Tensor, "... 3"], color: Float[Tensor, " 3"], degree: int = DEGREE
) -> Tensor:
    """Approximate parallel light from one direction by spherical harmonics.

    At degree 6, the error of the irradiance is at most 0.043 times the irradiance
    of a surface that faces the light. Directions lead toward the light, and `color` is the
    linear irradiance of a surface that faces it.
    """
    return harmonics.basis(direction, degree)[..., None] * color


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
    # Axes: light, coefficient, color.
    offsets = (torch.rand(count, *light.shape, generator=generator) * 2 - 1) * amplitude
    if radius is not None:
        # True for coefficients that change the irradiance of a surface.
        is_diffuse = harmonics.lambertian_factors(harmonics.degree_of(light)) != 0
        offsets = offsets * is_diffuse[:, None]
        norms = offsets.flatten(1).norm(dim=1).clamp(min=1e-12)
        offsets = offsets * (radius / norms)[:, None, None]
    return light + offsets.to(light)


def mean_luminance(coefficients: Float[Tensor, "K 3"]) -> float:
    """Compute √(4π) times the mean luminance of a light over all directions.

    Only the first row counts.
    """
    return float(coefficients[0].cpu().double() @ torch.tensor(LUMINANCE, dtype=torch.float64))


def _read_light_map(path: Path, degree: int, roughness: float | None) -> Tensor:
    """Read an environment map, and scale it to the mean luminance of the grace probe.

    `roughness` is that of the smoothest surface, whose highlights must not get dark rings, or None.
    """
    errors.require_file(path, "give the path of an .npy, .hdr or .exr file")
    facts = path.stat()
    # A file that is replaced or changed has another state.
    state = facts.st_dev, facts.st_ino, facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns
    coefficients = _project_map(path, state, degree)
    if roughness is not None:
        coefficients = coefficients * window_without_ringing(coefficients, roughness)[:, None]
    luminance = mean_luminance(coefficients)
    if luminance <= 0:
        raise InputError(f"environment map {path} is black: give a map with positive radiance")
    return (coefficients * (mean_luminance(probe("grace")) / luminance)).float()


@lru_cache(maxsize=1)
def _project_map(path: Path, state: tuple[int, ...], degree: int) -> Tensor:
    """Project an environment map. `state` differs if its file is another, or was changed.

    The last result is kept, because scenes load a map with a window and without.
    """
    radiance = environment.read_panorama(path)
    # Harmonics of a high degree vary within a texel of a small map, so its texels are divided.
    parts = degree // len(radiance) + 1
    radiance = radiance.repeat_interleave(parts, 0).repeat_interleave(parts, 1)
    return harmonics.project(radiance, degree)
