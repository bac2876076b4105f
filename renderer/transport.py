"""Light that a mesh keeps from itself: precomputed radiance transfer (Sloan, Kautz and Snyder 2002), per pixel.

A pixel's transfer is that under an open sky, in closed form, less what its samples lose in the directions that the mesh
blocks. All pixels look in the same directions, which are dealt out among the samples of each: so an edge of shadow, of
albedo or of the mesh is averaged as any other, and a pixel costs as many rays however many samples it has. Pixels from
which no other surface is to be seen, all of a convex mesh, cast none.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from renderer.basis import Basis, Harmonics
from renderer.errors import InputError
from renderer.fragments import Fragments
from renderer.harmonics import per_degree, unit_vectors
from renderer.image import ImageSettings
from renderer.mesh import Mesh
from renderer.normals import face_normals
from renderer.shading import smooth_normals

DIRECTIONS = 512  # over the whole sphere; a flat pixel casts rays in half of them
OFFSET = 1e-5  # of the mesh's extent: rays start so far above the surface, since Embree computes in float32
BLOCK = 2**17  # directions of pixels at a time: bounds the memory


@dataclass(frozen=True)
class Receivers:
    """P pixels that receive light at S samples, those of a pixel side by side, on G faces.

    planes, corners: (G, 3) float64, the faces' unit normals on the side that is lit, and a corner of each. points,
    normals: (S, 3) float64, of unit length. face: (S,). weights: (S, C), of a sample's irradiance in its pixel. first,
    count: (P,), a pixel's samples.
    """

    planes: Tensor
    corners: Tensor
    points: Tensor
    normals: Tensor
    face: Tensor
    weights: Tensor
    first: Tensor
    count: Tensor


class Transport:
    """What the surfaces of one mesh do to the light of each other. InputError where Embree is not installed."""

    def __init__(self, mesh: Mesh, normals: str):
        """normals: flat or smooth."""
        self._vertices = torch.from_numpy(mesh.vertices)
        self._smooth_faces = torch.from_numpy(mesh.faces) if normals == "smooth" else None
        self._offset = OFFSET * float(np.abs(mesh.vertices).max())
        self._outermost = torch.from_numpy(_outermost(mesh.vertices[np.unique(mesh.faces)]))
        self._scene = _embree_scene(mesh)

    def change(self, fragments: Fragments, albedo: Tensor, basis: Basis) -> Tensor | None:
        """(C, size, P) float64: what is added to the radiance of a view's pixels per unit coefficient, weighted with
        coverage; None where nothing is. albedo: (S, C) linear, at the samples.
        """
        weights = albedo / fragments.samples**2
        receivers = self._receivers(fragments, weights)
        pixels = self._overlooked(receivers)
        if not len(pixels):
            return None
        directions = sphere(DIRECTIONS)
        radiance = basis.radiance(directions) * (4 * math.pi / DIRECTIONS)
        change = radiance.new_zeros(weights.shape[1], radiance.shape[1], len(receivers.count))
        for some in pixels.split(BLOCK // DIRECTIONS):
            sample, cosine, met = self._look(receivers, some, directions)
            lost = torch.where(met >= 0, cosine, 0) * receivers.count[some, None]
            for channel, weight in zip(change, weights.T, strict=True):
                channel[:, some] = -((lost * weight[sample]) @ radiance).T
        return change

    def radiance(self, fragments: Fragments, albedo: Tensor, light: Tensor) -> Tensor:
        """(3, P) in the light's dtype: what `change` makes of harmonics ((degree + 1)², 3); differentiable in them."""
        change = self.change(fragments, albedo, Harmonics(math.isqrt(len(light)) - 1))
        if change is None:
            return light.new_zeros(3, len(fragments.pixels))
        return torch.einsum("ckp,kc->cp", change.to(light), light)

    def _receivers(self, fragments: Fragments, weights: Tensor) -> Receivers:
        corners = self._vertices[fragments.corners]
        planes = face_normals(self._vertices, fragments.corners) * fragments.facing
        if self._smooth_faces is None:
            normals = planes.index_select(0, fragments.face)
        else:
            normals = unit_vectors(smooth_normals(fragments, self._vertices, self._smooth_faces).T)[0].T
        count = fragments.pixel.bincount(minlength=len(fragments.pixels))
        return Receivers(
            planes,
            corners[:, 0],
            fragments.interpolate(corners),
            normals,
            fragments.face,
            weights,
            count.cumsum(0) - count,
            count,
        )

    def _look(self, receivers: Receivers, pixels: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """From pixels (B,) in directions (D, 3), (B, D) each: the sample that looks, the cosine at it, and the face
        that the ray meets, -1 where there is none.

        No ray is cast into the sample's own face, on which smooth normals shade the light nevertheless.
        """
        turn = _shuffled(len(directions)) + pixels[:, None]
        sample = receivers.first[pixels, None] + turn % receivers.count[pixels, None]
        cosine = torch.einsum("bdi,di->bd", receivers.normals[sample], directions).clamp(min=0)
        above = torch.einsum("bdi,di->bd", receivers.planes[receivers.face[sample]], directions)
        cast = torch.nonzero((cosine > 0) & (above > 0), as_tuple=True)
        origins = receivers.points + receivers.planes[receivers.face] * self._offset
        met = torch.full_like(sample, -1).index_put_(cast, self._meet(origins[sample[cast]], directions[cast[1]]))
        return sample, cosine, met

    def _overlooked(self, receivers: Receivers) -> Tensor:
        """The pixels with a sample on a face above whose plane the mesh rises."""
        reach = torch.cat([(part @ self._outermost.T).amax(1) for part in receivers.planes.split(BLOCK // 2**7)])
        rises = reach - (receivers.planes * receivers.corners).sum(1) > self._offset
        pixel = torch.arange(len(receivers.count)).repeat_interleave(receivers.count)
        return pixel[rises[receivers.face]].unique()

    def _meet(self, origins: Tensor, directions: Tensor) -> Tensor:
        """(N,) the face that each ray of (N, 3) meets first, -1 where there is none."""
        rays = (np.ascontiguousarray(part.numpy(), dtype=np.float32) for part in (origins, directions))
        return torch.from_numpy(self._scene.run(*rays)).long()


@per_degree
def sphere(count: int) -> Tensor:
    """(count, 3) float64 directions that share the sphere equally: the spherical Fibonacci lattice."""
    index = torch.arange(count, dtype=torch.float64)
    z, azimuth = 1 - (2 * index + 1) / count, math.pi * (3 - math.sqrt(5)) * index
    radius = (1 - z**2).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=1)


@per_degree
def _shuffled(count: int) -> Tensor:
    """0 to count - 1 in an order that has nothing to do with that of `sphere`, for all to be everywhere in a pixel."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))


def build_transport(mesh: Mesh, settings: ImageSettings) -> Transport | None:
    """None where light goes from the sky to a surface and from there to the camera only."""
    return None if settings.transport == "direct" else Transport(mesh, settings.normals)


def _outermost(vertices: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) in whose convex hull all of them are: those of the hull itself, unless they lie in a plane."""
    try:
        return vertices[ConvexHull(vertices).vertices]
    except QhullError:
        return vertices


def _embree_scene(mesh: Mesh) -> Any:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise InputError("renderer.transport: rays are cast by Embree: pip install embreex") from error
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    return scene
