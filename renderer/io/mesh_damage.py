"""Faces that a deformation of a mesh flipped or collapsed."""

from dataclasses import dataclass

import numpy as np

from renderer.mesh import doubled_area_vectors

# Storing both ends of a face's height as float32 moves each by up to √3 · 2⁻²⁴ of the coordinate, which is 2^-22.2
# together: a height below 2⁻²² of it cannot be distinguished from zero.
_SMALLEST_HEIGHT = 2.0**-22


@dataclass(frozen=True)
class MeshDamage:
    """Faces turned by more than 90°, faces that lost their area, and the largest |displacement| along x, y and z."""

    flipped: int
    degenerate: int
    displacement: tuple[float, float, float]


def mesh_damage(before: np.ndarray, after: np.ndarray, faces: np.ndarray) -> MeshDamage:
    """Compare the vertices (V, 3) before and after a deformation of a mesh with faces (F, 3), in world units.

    A face has no area where its smallest height is at most 2⁻²² of its largest coordinate, which is float32's rounding.
    Faces that had none before are not counted; those that lost it, which have no normal, are not flipped.
    """
    before, after = before.astype(np.float64), after.astype(np.float64)
    old, new = doubled_area_vectors(before, faces), doubled_area_vectors(after, faces)
    had_area, has_area = _has_area(before, faces, old), _has_area(after, faces, new)
    turned = np.einsum("fi,fi->f", old, new) < 0
    return MeshDamage(
        flipped=int((turned & had_area & has_area).sum()),
        degenerate=int((had_area & ~has_area).sum()),
        displacement=tuple(np.abs(after - before).max(axis=0).tolist()),
    )


def _has_area(vertices: np.ndarray, faces: np.ndarray, doubled_areas: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return np.linalg.norm(doubled_areas, axis=1) > _SMALLEST_HEIGHT * np.abs(corners).max(axis=(1, 2)) * longest
