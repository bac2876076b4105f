"""What several tests compare with: scipy's harmonics, a many-colored mesh, and parts of scenes for Mitsuba 3."""

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.special import sph_harm_y_all

from renderer.camera import Camera, PerspectiveCamera
from renderer.light.harmonics import lambertian_factors
from renderer.mesh import Mesh


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


def mitsuba_pose(mi, camera: Camera, distance: float):
    """Mitsuba's transform to the place of a camera at a distance from the plane through the origin."""
    right, up, back = camera.axes()
    target = -camera.right * right - camera.up * up
    return mi.ScalarTransform4f().look_at(origin=list(target + distance * back), target=list(target), up=list(up))


def mitsuba_sensor(mi, camera: Camera, size: int, **others) -> dict:
    """A camera with a box filter and alpha."""
    half = camera.width / 2
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    if isinstance(camera, PerspectiveCamera):
        pose, fov = mitsuba_pose(mi, camera, camera.distance), 2 * math.degrees(math.atan(half / camera.distance))
        return {"type": "perspective", "fov": fov, "to_world": pose, "film": film, **others}
    scale = mi.ScalarTransform4f().scale([half, half, 1])  # Mitsuba's image spans [-1, 1]
    return {"type": "orthographic", "to_world": mitsuba_pose(mi, camera, 4) @ scale, "film": film, **others}


def mitsuba_shape(mi, mesh: Mesh):
    """A diffuse mesh with two sides, corners per face, as our colors are stored, and its texture if it has one."""
    albedo = {"type": "mesh_attribute", "name": "vertex_color"}
    if mesh.textures:
        albedo = {"type": "bitmap", "bitmap": mi.Bitmap(mesh.textures[0]), "raw": True}
    properties = mi.Properties()
    properties["face_normals"] = True
    properties["bsdf"] = mi.load_dict({"type": "twosided", "material": {"type": "diffuse", "reflectance": albedo}})
    corners = 3 * len(mesh.faces)
    shape = mi.Mesh("mesh", corners, len(mesh.faces), props=properties, has_vertex_texcoords=True)
    shape.add_attribute("vertex_color", 3, mesh.corner_colors.ravel())
    buffers = mi.traverse(shape)
    buffers["faces"] = np.arange(corners, dtype=np.uint32)
    buffers["vertex_positions"] = mesh.vertices[mesh.faces].astype(np.float32).ravel()
    buffers["vertex_texcoords"] = (mesh.corner_uvs * [1, -1] + [0, 1]).astype(np.float32).ravel()  # v runs down
    buffers.update()
    return shape
