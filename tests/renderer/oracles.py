"""Independent references for tests: SciPy's harmonics, the sRGB standard, and test meshes."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import ArrayLike
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.special import roots_sh_legendre, sph_harm_y_all

from renderer.camera import Camera
from renderer.io.meshes import load_mesh
from renderer.light.environment import write_map
from renderer.light.harmonics import lambertian_factors
from renderer.mesh import Mesh, normalize
from renderer.mitsuba_scene import SCENE, mitsuba_map, render_mitsuba_scene, write_mitsuba_scene
from renderer.operators.apply import TransferOperator
from renderer.operators.build import build_operators
from renderer.settings import ImageSettings
from renderer.solids import SOLIDS, solid
from renderer.visibility import choose
from renderer.visibility.fragments import Fragments, build_fragments

SCANS = Path(__file__).parents[3] / "shared" / "data" / "meshes"


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    """Draw standard normal numbers in float64."""
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def draw_uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    """Draw numbers in [0, 1) in float64."""
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def random_directions(count: int, seed: int = 0) -> torch.Tensor:
    """Draw unit vectors, float64, shape (count, 3)."""
    return torch.nn.functional.normalize(draw(count, 3, seed=seed))


def real_harmonics(complex_values: np.ndarray) -> np.ndarray:
    """Combine complex harmonics (L, M, ...) into real ones (L², ...) without the sign."""
    rows = []
    for l in range(len(complex_values)):
        for m in range(-l, l + 1):
            value = complex_values[l, abs(m)]
            part = value.real if m >= 0 else value.imag
            rows.append(part if m == 0 else math.sqrt(2) * (-1) ** m * part)
    return np.stack(rows)


def scipy_basis(directions: np.ndarray | torch.Tensor, degree: int) -> np.ndarray:
    """Compute harmonics, shape (N, K), for directions (N, 3) of any length."""
    x, y, z = np.asarray(directions, dtype=np.float64).T
    polar = np.arctan2(np.hypot(x, y), z)
    azimuth = np.arctan2(y, x)
    return real_harmonics(sph_harm_y_all(degree, degree, polar, azimuth)).T


def scipy_irradiance(normals, light) -> np.ndarray:
    """Compute the irradiance Σ A_l U_lm Y_lm(n), (N, 3). test_harmonics.py checks the factors."""
    degree = math.isqrt(len(light)) - 1
    factors = lambertian_factors(degree).numpy()
    reflected = factors[:, None] * np.asarray(light, dtype=np.float64)
    return scipy_basis(normals, degree) @ reflected


def patchwork(vertices: np.ndarray, faces: np.ndarray, seed: int = 0) -> Mesh:
    """Dent a mesh, and give its faces one of two textures or none, with coordinates of any size."""
    rng = np.random.default_rng(seed)
    face_count = len(faces)
    dents = rng.uniform(0.7, 1, (len(vertices), 1))
    colors = rng.uniform(0.1, 1, (face_count, 3, 3))
    uvs = rng.uniform(-1, 2, (face_count, 3, 2))
    sizes = ((3, 4, 3), (2, 3, 3))
    textures = tuple(rng.integers(0, 256, size, dtype=np.uint8) for size in sizes)
    ids = np.arange(face_count, dtype=np.int32) % 3 - 1
    corners = {"corner_colors": np.float32(colors), "corner_uvs": np.float32(uvs)}
    plain = Mesh.plain(vertices * dents, faces)
    return replace(plain, **corners, texture_ids=ids, textures=textures)


def textured(mesh: Mesh, uvs: ArrayLike, texture: np.ndarray, texture_ids=0) -> Mesh:
    """Return a mesh with texture coordinates (F, 3, 2) and a texture, by default on all faces."""
    ids = np.broadcast_to(np.int32(texture_ids), len(mesh.faces)).copy()
    return replace(mesh, corner_uvs=np.float32(uvs), texture_ids=ids, textures=(texture,))


def mesh_of(shape: trimesh.Trimesh, color: ArrayLike = (1.0, 1.0, 1.0)) -> Mesh:
    return Mesh.plain(shape.vertices, shape.faces, color)


def named_mesh(name: str) -> Mesh:
    """Return a solid, or the scan in a file, normalized. Without the file, the test is skipped."""
    if name in SOLIDS:
        return normalize(solid(name))
    if not (SCANS / name).exists():
        pytest.skip(f"{name} is not there")
    return normalize(load_mesh(SCANS / name))


def square(half: float, center: ArrayLike = (0, 0, 0), color: ArrayLike = (1, 1, 1)) -> Mesh:
    """Return two triangles in a plane of constant z that face upward."""
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Mesh.plain(corners + center, [[0, 1, 2], [0, 2, 3]], color)


def fragments_of(mesh: Mesh, camera: Camera, settings: ImageSettings, closed=False) -> Fragments:
    rasterizer = choose("numpy")
    [view] = build_fragments(mesh.vertices, mesh.faces, [camera], settings, rasterizer, closed)
    return view


def operator_of(mesh: Mesh, camera: Camera, settings: ImageSettings, **options) -> TransferOperator:
    [operator] = build_operators(mesh, [camera], settings, choose("numpy"), **options)
    return operator


def path_traced(
    folder: Path,
    mesh: Mesh,
    cameras: Sequence[Camera],
    light: torch.Tensor,
    settings: ImageSettings,
    albedo_scale: float = 1.0,
    lights=(),
) -> torch.Tensor:
    """Render the files of a scene with Mitsuba: radiance and coverage (views, 4, H, W)."""
    write_map(folder / "light.exr", mitsuba_map(light, 256))
    scene = folder / "mitsuba"
    write_mitsuba_scene(scene, mesh, albedo_scale, cameras, settings, "../light.exr", lights)
    return render_mitsuba_scene(scene / SCENE, len(cameras), settings.shape).double()


def relative_error(found: ArrayLike, expected: ArrayLike) -> float:
    expected = np.asarray(expected)
    return float(np.linalg.norm(np.asarray(found) - expected) / np.linalg.norm(expected))


def corners_of(mesh: Mesh) -> np.ndarray:
    """Return the positions of the corners of all faces, shape (F, 3 corners, 3)."""
    return mesh.vertices[mesh.faces]


def image_of(operator: TransferOperator, light: torch.Tensor) -> torch.Tensor:
    """Return the radiance and the coverage of an operator's view, float64, (4, size, size)."""
    size = operator.settings.size
    image = torch.zeros(4, size**2, dtype=torch.float64)
    image[:3, operator.pixels] = operator.radiance(light).double()
    image[3, operator.pixels] = operator.coverage.double()
    return image.unflatten(1, (size, size))


def bilinear(texels: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Interpolate texels (H, W, C), which repeat, at places (N,) in units from center to center."""
    place = np.stack([row, column])
    channels = np.moveaxis(texels, 2, 0)
    values = [map_coordinates(one, place, order=1, mode="grid-wrap") for one in channels]
    return np.stack(values, axis=1)


def srgb_of(linear: ArrayLike) -> np.ndarray:
    """Encode linear values by IEC 61966-2-1."""
    linear = np.asarray(linear)
    curve = 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve)


def linear_of(srgb: ArrayLike) -> np.ndarray:
    """Decode values by IEC 61966-2-1."""
    srgb = np.asarray(srgb)
    curve = ((srgb + 0.055) / 1.055) ** 2.4
    return np.where(srgb <= 0.04045, srgb / 12.92, curve)


def encoded(texels: np.ndarray | Image.Image) -> bytes:
    content = io.BytesIO()
    (texels if isinstance(texels, Image.Image) else Image.fromarray(texels)).save(content, "PNG")
    return content.getvalue()


def png_of(*color: int) -> bytes:
    return encoded(np.full((2, 2, len(color)), color, dtype=np.uint8))


def smith_masking(cosine: ArrayLike, roughness: float) -> np.ndarray:
    """Evaluate Smith's masking of one direction for GGX, by the appendix of glTF 2.0."""
    cosine = np.asarray(cosine)
    alpha_squared = roughness**4
    return 2 * cosine / (cosine + np.sqrt(alpha_squared + (1 - alpha_squared) * cosine**2))


def dielectric_fresnel(cosine: np.ndarray, index: float = 1.5) -> np.ndarray:
    """Evaluate Fresnel's equations for unpolarized light by Snell's law."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (index * cosine - inside) / (index * cosine + inside)
    return (across**2 + along**2) / 2


def toward(cosine: float) -> torch.Tensor:
    """Return the direction (1, 3) to a camera on the -x side, at a cosine from +z."""
    return torch.tensor([[-math.sqrt(1 - cosine**2), 0, cosine]], dtype=torch.float64)


@dataclass(frozen=True)
class Lobe:
    """A microfacet lobe by the appendix of glTF 2.0.

    f0 and f90 are Fresnel terms at normal and grazing incidence. Without f0 it is a dielectric
    with a refractive index of 1.5, by Fresnel's equations.
    """

    roughness: float
    f0: float | None = None
    f90: float = 1.0

    def reflectance(self, cosine: float, light: np.ndarray) -> np.ndarray:
        """Evaluate the reflectance (N,) for light (N, 3), and a camera at a cosine from +z."""
        view = toward(cosine)[0].numpy()
        half = (light + view) / np.linalg.norm(light + view, axis=1, keepdims=True)
        return self.of_cosines(light[:, 2], cosine, half[:, 2], np.clip(half @ view, 0, 1))

    def of_cosines(self, n_dot_l, n_dot_v, n_dot_h, v_dot_h) -> np.ndarray:
        """Evaluate the reflectance for the cosines between normal, light, camera and their half."""
        alpha = self.roughness**2
        distribution = alpha**2 / (np.pi * (n_dot_h**2 * (alpha**2 - 1) + 1) ** 2)
        masking = smith_masking(n_dot_l, self.roughness) * smith_masking(n_dot_v, self.roughness)
        if self.f0 is None:
            fresnel = dielectric_fresnel(v_dot_h)
        else:
            fresnel = self.f0 + (self.f90 - self.f0) * (1 - v_dot_h) ** 5  # by Schlick
        return np.pi * fresnel * distribution * masking / (4 * n_dot_l * n_dot_v)


def directions_of(z: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    radius = np.sqrt(1 - z**2)
    x = radius * np.cos(azimuth)
    y = radius * np.sin(azimuth)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1).reshape(-1, 3)


@cache
def half_hemisphere() -> tuple[np.ndarray, np.ndarray]:
    """Return directions with y > 0, densest where lobes are narrow, and twice their weights."""
    root, weight = (values[:, None] for values in roots_sh_legendre(100))
    fraction, step = roots_sh_legendre(50)
    solid_angles = 4 * weight * root * 3 * math.pi * fraction**2 * step
    return directions_of(root**2, math.pi * fraction**3), solid_angles.ravel()


@cache
def coat_albedo(cosine: float, roughness: float) -> float:
    """Integrate the fraction of a beam that the specular layer of a dielectric reflects."""
    directions, solid_angles = half_hemisphere()
    lobe = Lobe(roughness).reflectance(cosine, directions)
    return float(lobe * directions[:, 2] @ solid_angles) / math.pi
