"""A scene as a linear operator on its light: (mesh, camera) → T, rasterised once and multiplied ever after.

Before clamping, every pixel of a diffuse mesh is linear in the lighting coefficients U (the paper's appendix B.2):
radiance = Uᵀ T. The box filter, the texture and the albedo fold into T exactly.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from renderer.harmonics import irradiance_basis
from renderer.image import decode
from renderer.mesh import Mesh
from renderer.visibility import Backend

DEGREE = 6
COEFFICIENTS = (DEGREE + 1) ** 2


@dataclass(frozen=True)
class PictureSettings:
    """How meshes become operators: picture size in pixels, samples per pixel side (InputError if none), encoding."""

    size: int = 32
    samples: int = 8
    encoding: str = "linear"

    def __post_init__(self):
        if self.samples < 1:
            raise InputError(f"renderer.samples={self.samples} must be at least 1")


@dataclass(frozen=True)
class Operator:
    """What is kept of one (mesh, view). K = 31 live coefficients, P covered pixels.

    transfer: (K, 3, P) float32, linear radiance per unit coefficient, weighted with coverage.
    coverage: (P,) float32 in (0, 1], the share of a pixel's samples that the mesh covers.
    pixels: (P,) int64, row-major indices of the covered pixels; row 0 is the top of the picture.
    """

    transfer: Tensor
    coverage: Tensor
    pixels: Tensor


def build_operators(
    mesh: Mesh, cameras: Sequence[OrthographicCamera], settings: PictureSettings, backend: Backend, gain: float = 1.0
) -> list[Operator]:
    """One operator per camera. gain multiplies the albedo, for meshes whose texture is darker than the thing."""
    points = np.stack([camera.project(mesh.vertices) for camera in cameras])
    ids = backend.rasterise(points, mesh.faces, settings.size * settings.samples)
    return [
        _operator(mesh, camera, projected, face_ids, settings, gain)
        for camera, projected, face_ids in zip(cameras, points, ids, strict=True)
    ]


def _operator(
    mesh: Mesh,
    camera: OrthographicCamera,
    projected: np.ndarray,
    face_ids: np.ndarray,
    settings: PictureSettings,
    gain: float,
) -> Operator:
    rows, columns = np.nonzero(face_ids >= 0)
    faces = face_ids[rows, columns]
    sample_pixels = (rows // settings.samples) * settings.size + columns // settings.samples
    pixels, pixel_of_sample = np.unique(sample_pixels, return_inverse=True)
    albedo = _albedo(mesh, projected, face_ids.shape[0], rows, columns, faces, settings.encoding) * gain
    face_of_sample, live_faces = _compact(faces)
    shading = irradiance_basis(torch.from_numpy(_facing_normals(mesh, live_faces, camera)), DEGREE)
    weight = 1 / settings.samples**2
    return Operator(
        transfer=_box_filter(shading, face_of_sample, albedo, pixel_of_sample, len(pixels)).mul_(weight).float(),
        coverage=torch.from_numpy(np.bincount(pixel_of_sample, minlength=len(pixels)) * weight).float(),
        pixels=torch.from_numpy(pixels),
    )


def _compact(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(index into the visible faces per sample, the visible faces): faces that no sample sees are not shaded."""
    visible, index = np.unique(faces, return_inverse=True)
    return index, visible


def _facing_normals(mesh: Mesh, faces: np.ndarray, camera: OrthographicCamera) -> np.ndarray:
    """Unit normals on the side that the camera sees, so that open or inside-out meshes are lit from that side."""
    normals = mesh.face_normals()[faces]
    facing = normals @ camera.axes()[2]
    return normals * np.where(facing < 0, -1.0, 1.0)[:, None]


def _albedo(
    mesh: Mesh,
    projected: np.ndarray,
    resolution: int,
    rows: np.ndarray,
    columns: np.ndarray,
    faces: np.ndarray,
    encoding: str,
) -> Tensor:
    """Albedo (S, 3) float64 at the samples, at the barycentric coordinates of their centres."""
    x = (columns + 0.5) / resolution * 2 - 1
    y = 1 - (rows + 0.5) / resolution * 2
    corners = projected[mesh.faces[faces], :2]
    barycentric = _barycentric(np.stack([x, y], axis=1), corners)
    colors = torch.from_numpy(mesh.colors(faces, barycentric)).double()
    return decode(colors.clamp(0, 1), encoding)


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(S, 3) of points (S, 2) in triangles (S, 3, 2), clipped into the triangle: the rasteriser snaps its corners."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = _cross(b - a, c - a)
    weights = np.stack([_cross(b - points, c - points), _cross(c - points, a - points)], axis=1)
    weights = weights / np.where(area == 0, 1.0, area)[:, None]
    weights = np.concatenate([weights, 1 - weights.sum(axis=1, keepdims=True)], axis=1).clip(0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _box_filter(
    shading: Tensor, face_of_sample: np.ndarray, albedo: Tensor, pixel_of_sample: np.ndarray, pixels: int
) -> Tensor:
    """Sum over each pixel's samples of shading (faces, K) × albedo (S, 3): (K, 3, pixels) float64.

    Samples of the same face in the same pixel share their normal, so their albedo is summed first.
    """
    cells, cell_of_sample = np.unique(pixel_of_sample * len(shading) + face_of_sample, return_inverse=True)
    summed = torch.zeros(len(cells), 3, dtype=torch.float64)
    summed.index_add_(0, torch.from_numpy(cell_of_sample), albedo)
    pixel, face = (torch.from_numpy(part) for part in np.divmod(cells, max(len(shading), 1)))
    transfer = torch.zeros(pixels, shading.shape[1] * 3, dtype=torch.float64)
    transfer.index_add_(0, pixel, (shading[face][:, :, None] * summed[:, None, :]).flatten(1))
    return transfer.T.reshape(shading.shape[1], 3, pixels).contiguous()
