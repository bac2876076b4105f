"""What several tests compare with: scipy's harmonics, the sRGB standard, and meshes."""

import math
from dataclasses import replace

import numpy as np
import torch
import trimesh
from numpy.typing import ArrayLike
from scipy.special import sph_harm_y_all

from renderer.geometry.mesh import Mesh
from renderer.light.harmonics import lambertian_factors


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    """Normal numbers in float64."""
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def random_directions(count: int, seed: int = 0) -> torch.Tensor:
    """(N, 3) float64 unit vectors."""
    return torch.nn.functional.normalize(draw(count, 3, seed=seed))


def real_harmonics(complex_values: np.ndarray) -> np.ndarray:
    """(K, ...) real combinations of scipy's complex harmonics (L, M, ...), whose sign (-1)^m is taken out."""
    rows = []
    for l in range(len(complex_values)):
        for m in range(-l, l + 1):
            value = complex_values[l, abs(m)]
            part = value.real if m >= 0 else value.imag
            rows.append(part if m == 0 else math.sqrt(2) * (-1) ** m * part)
    return np.stack(rows)


def scipy_basis(directions: np.ndarray | torch.Tensor, degree: int) -> np.ndarray:
    """(N, K) of directions (N, 3) of any length."""
    x, y, z = np.asarray(directions, dtype=np.float64).T
    return real_harmonics(sph_harm_y_all(degree, degree, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x))).T


def scipy_irradiance(normals: np.ndarray | torch.Tensor, light: np.ndarray | torch.Tensor) -> np.ndarray:
    """(N, 3) Σ A_l U_lm Y_lm(n); test_harmonics proves the factors A_l."""
    degree = math.isqrt(len(light)) - 1
    factors = lambertian_factors(degree).numpy()
    return scipy_basis(normals, degree) @ (factors[:, None] * np.asarray(light, dtype=np.float64))


def patchwork(vertices: np.ndarray, faces: np.ndarray, seed: int = 0) -> Mesh:
    """Dented, with two textures and bare faces, colors at all corners, and texture coordinates that wrap around."""
    rng, count = np.random.default_rng(seed), len(faces)
    return replace(
        Mesh.plain(vertices * rng.uniform(0.7, 1, (len(vertices), 1)), faces),
        corner_colors=rng.uniform(0.1, 1, (count, 3, 3)).astype(np.float32),
        corner_uvs=rng.uniform(-1, 2, (count, 3, 2)).astype(np.float32),
        texture_ids=np.arange(count, dtype=np.int32) % 3 - 1,
        textures=tuple(rng.integers(0, 256, (*shape, 3), dtype=np.uint8) for shape in [(3, 4), (2, 3)]),
    )


def mesh_of(shape: trimesh.Trimesh, color: ArrayLike = (1.0, 1.0, 1.0)) -> Mesh:
    return Mesh.plain(shape.vertices, shape.faces, color)


def corners_of(mesh: Mesh) -> np.ndarray:
    """(F, 3, 3) positions."""
    return mesh.vertices[mesh.faces]


def srgb_of(linear: ArrayLike) -> np.ndarray:
    """IEC 61966-2-1."""
    linear = np.asarray(linear)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def linear_of(srgb: ArrayLike) -> np.ndarray:
    """The inverse of `srgb_of`."""
    srgb = np.asarray(srgb)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
