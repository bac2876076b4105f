"""Faces that a deformation of a mesh flipped or collapsed."""

import numpy as np

from renderer.mesh import doubled_area_vectors

# Storing both ends of a face's height as float32 moves each by up to √3 · 2⁻²⁴ of the coordinate, which is 2^-22.2
# together: a height below 2⁻²² of it cannot be distinguished from zero.
_SMALLEST_HEIGHT = 2.0**-22


def mesh_damage(before: np.ndarray, after: np.ndarray, faces: np.ndarray) -> dict[str, int | list[float]]:
    """Compare the vertices (V, 3) before and after a deformation of a mesh with faces (F, 3), in world units.

    flipped: faces turned by more than 90°. degenerate: faces that lost their area, whose smallest height is at most
    2⁻²² of their largest coordinate, float32's rounding; they are not flipped. Faces that had none before do not count.
    displacement: the largest along x, y and z in either direction.
    """
    shapes = before.astype(np.float64), after.astype(np.float64)
    areas = [doubled_area_vectors(vertices, faces) for vertices in shapes]
    had_area, has_area = map(_has_area, shapes, [faces, faces], areas)
    turned = np.einsum("fi,fi->f", *areas) < 0
    return {
        "flipped": int((turned & had_area & has_area).sum()),
        "degenerate": int((had_area & ~has_area).sum()),
        "displacement": np.abs(shapes[1] - shapes[0]).max(axis=0).tolist(),
    }


def _has_area(vertices: np.ndarray, faces: np.ndarray, doubled_areas: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return np.linalg.norm(doubled_areas, axis=1) > _SMALLEST_HEIGHT * np.abs(corners).max(axis=(1, 2)) * longest
