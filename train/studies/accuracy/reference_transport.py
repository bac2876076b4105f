"""The wide reference of shadows and bounces: rays, which sample casts them and where they start are the renderer's."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from train.studies.accuracy.reference import MP, View, added, as_in, basis, cross, normals_of, reflected, unit


@dataclass(frozen=True)
class Patches:
    """N patches of F faces' sides, which look from S samples in D directions.

    corners: (F, 3 corners, 3) extended. albedo: (F, 3). points: (S, 3) where rays start. face, side, patch, share: (S,)
    of each, the side ±1, the share of the patch's area. looking: (M,) patches, and dealt: (M, D) the sample of each
    that looks in each direction. of_side: (2, F) the patches of the faces' fronts and backs.
    """

    corners: np.ndarray
    albedo: np.ndarray
    points: np.ndarray
    face: np.ndarray
    side: np.ndarray
    patch: np.ndarray
    share: np.ndarray
    looking: np.ndarray
    dealt: np.ndarray
    of_side: np.ndarray

    def normals(self) -> np.ndarray:
        """(F, 3)"""
        first, second, third = self.corners.transpose(1, 2, 0)
        return unit(cross(second - first, third - first)).T

    def met(self, faces: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(D,) the patch on the side of the face (D,) that a ray in each direction (D, 3) meets."""
        return self.of_side[((self.normals()[faces] * directions).sum(axis=1) > 0).astype(int), faces]


def shadow(view: View, points: np.ndarray, corners: np.ndarray, directions: np.ndarray, degree: int) -> np.ndarray:
    """(P, (degree + 1)², 3) what an image loses, per unit of each coefficient, since faces of corners (F, 3 corners, 3)
    are in the way of rays from the samples (S, 3) in directions (D, 3), which share the sphere equally."""
    sky = basis(directions.T, degree)[:, :, None].repeat(3, axis=2)
    return _gathered(view, points, corners, directions, lambda faces, some: sky[some])


def bounced(view: View, points: np.ndarray, patches: Patches, sent: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(P, (degree + 1)², 3) what an image gains of what patches send (N, (degree + 1)², 3)."""
    return _gathered(
        view, points, patches.corners, directions, lambda faces, some: sent[patches.met(faces, directions[some])]
    )


def _gathered(
    view: View,
    points: np.ndarray,
    corners: np.ndarray,
    directions: np.ndarray,
    radiance: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """What pixels reflect of a radiance: (H,) faces that are met, (H,) in which directions → (H, coefficients, 3)."""
    normals, solid_angle = normals_of(view).T[view.face], as_in(points, 4 * MP.pi) / len(directions)
    seen = []
    for face, point, normal in zip(view.face, points, normals, strict=True):
        cosine, met = (directions @ normal).clip(0), _met(point, directions, corners)
        [some] = np.nonzero((met >= 0) & (cosine > 0))
        seen.append(np.tensordot(cosine[some], radiance(met[some], some), axes=1) * view.albedo[face] * solid_angle)
    return added(len(view.pixels), view.pixel, np.stack(seen)) / view.samples


def radiosity(patches: Patches, directions: np.ndarray, degree: int, bounces: int) -> np.ndarray:
    """(N, (degree + 1)², 3) what patches send per unit of each coefficient, after light has bounced so often."""
    sky, normals = basis(directions.T, degree), patches.normals()[patches.face] * patches.side[:, None]
    solid_angle = as_in(patches.points, 4 * MP.pi) / len(directions)
    count, samples = patches.patch.max() + 1, np.bincount(patches.patch)
    open_sky = np.zeros((len(normals), sky.shape[1]), dtype=sky.dtype)
    for index, values in reflected(normals.T, degree).items():
        open_sky[:, index] = values
    from_sky = added(count, patches.patch, open_sky * patches.share[:, None])
    links = np.zeros((count, count), dtype=sky.dtype)
    for patch, dealt in zip(patches.looking, patches.dealt, strict=True):
        weight = (normals[dealt] * directions).sum(axis=1).clip(0) * patches.share[dealt] * samples[patch] * solid_angle
        for sample in np.unique(dealt):
            [some] = np.nonzero((dealt == sample) & (weight > 0))
            met = _met(patches.points[sample], directions[some], patches.corners)
            some, met = some[met >= 0], met[met >= 0]
            from_sky[patch] -= weight[some] @ sky[some]
            np.add.at(links[patch], patches.met(met, directions[some]), weight[some])
    albedo = added(count, patches.patch, patches.albedo[patches.face] * patches.share[:, None]) / as_in(sky, MP.pi)
    sent = from_sky[:, :, None] * albedo[:, None]
    for _ in range(bounces - 1):
        sent = (from_sky[:, :, None] + np.tensordot(links, sent, axes=1)) * albedo[:, None]
    return sent


def _met(point: np.ndarray, directions: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(D,) the first face that rays from a point (3,) meet, -1 where there is none: they pass all the edges of those
    that they meet on the side that the face is on."""
    a, b, c = (corners[:, corner] - point for corner in range(3))
    passed = np.stack([directions @ np.cross(first, second).T for first, second in ((a, b), (b, c), (c, a))])
    volume = (a * np.cross(b, c)).sum(axis=1)
    ahead, across = (passed * np.sign(volume) > 0).all(axis=0), directions @ np.cross(b - a, c - a).T
    distance = np.where(ahead, volume / np.where(ahead, across, 1), np.inf)
    return np.where(ahead.any(axis=1), distance.argmin(axis=1), -1)
