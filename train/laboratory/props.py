"""Meshes made ready for Mitsuba: corners with normals and texture coordinates of their own, and linear albedo."""

from dataclasses import dataclass

import numpy as np
import torch

from renderer.errors import InputError
from renderer.image import decode
from renderer.mesh import Mesh
from renderer.normals import vertex_normals

SHARP = 0.85  # cosine off the vertex normal beyond which a face keeps its own: a right-angled edge has at most 0.82


@dataclass(frozen=True)
class Part:
    """F faces of one texture, or of none.

    positions, normals (F, 3, 3) and uvs (F, 3, 2), the last with v downwards: per corner. albedo: linear in [0, 1],
    of the corners (F, 3, 3), or the texture's (H, W, 3) where `textured`.
    """

    positions: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    albedo: np.ndarray
    textured: bool


def split_parts(mesh: Mesh, albedo_scale: float, name: str) -> list[Part]:
    """The faces of each texture, with the albedo times `albedo_scale` and at most 1.

    InputError, naming the mesh: a texture on corners of different colors.
    """
    return [_part(mesh, index, albedo_scale, name) for index in np.unique(mesh.texture_ids)]


def _part(mesh: Mesh, texture: int, albedo_scale: float, name: str) -> Part:
    faces = mesh.texture_ids == texture
    colors = _linear(mesh.corner_colors[faces])
    if texture >= 0:
        if (colors != colors[0, 0]).any():
            raise InputError(f"{name} has a texture and colors of its vertices, too: paint them into the texture")
        colors = _linear(mesh.textures[texture] / 255) * colors[0, 0]
    return Part(
        positions=mesh.vertices[mesh.faces[faces]],
        normals=corner_normals(mesh)[faces],
        uvs=mesh.corner_uvs[faces] * [1, -1] + [0, 1],
        albedo=np.clip(albedo_scale * colors, 0, 1).astype(np.float32),
        textured=bool(texture >= 0),
    )


def corner_normals(mesh: Mesh) -> np.ndarray:
    """(F, 3, 3) unit normals: the vertices', but a face's own where it meets its neighbors at a sharp edge."""
    smooth = vertex_normals(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)).numpy()[mesh.faces]
    flat = np.broadcast_to(mesh.face_normals()[:, None], smooth.shape)
    return np.where((smooth * flat).sum(axis=-1, keepdims=True) < SHARP, flat, smooth)


def _linear(colors: np.ndarray) -> np.ndarray:
    return decode(torch.from_numpy(np.asarray(colors, dtype=np.float64)), "srgb").numpy()
