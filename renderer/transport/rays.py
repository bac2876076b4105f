"""Rays from a view's samples among the faces of a mesh, cast by Embree (Wald et al. 2014).

All pixels look in the same directions, which are dealt out among the samples of each: so an edge of shadow, of albedo
or of the mesh is averaged as any other, and a pixel costs as many rays however many samples it has. Pixels from which
no other surface is to be seen, all of a convex mesh, cast none.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from renderer.errors import InputError
from renderer.light.harmonics import per_degree
from renderer.mesh import Mesh
from renderer.transport.surface import Surface

DIRECTIONS = 512  # over the whole sphere; a flat pixel casts rays in half of them
OFFSET = 1e-5  # of the mesh's extent: rays start so far above the surface, since Embree computes in float32
COMPARISONS = 2**30  # of faces with vertices: about a second
BLOCK = 2**17  # directions of pixels at a time: bounds the memory


@dataclass(frozen=True)
class Looks:
    """What B pixels (B,), numbered among a view's, see of their own mesh in D directions, (B, D) each.

    directions: (D, 3). sample: the one that looks, of the view's. weight: of the radiance from there in the pixel's
    irradiance: solid angle × cosine × the number of the pixel's samples. met: the face that the ray meets, -1 where
    there is none.
    """

    pixels: Tensor
    directions: Tensor
    sample: Tensor
    weight: Tensor
    met: Tensor

    def blocked(self) -> Tensor:
        """The weight where anything is met, else zero."""
        return self.weight.masked_fill(self.met < 0, 0)


class Rays:
    """Rays among the faces of one mesh. InputError, when a ray is cast, where Embree is not installed.

    offset: of where a ray starts above its surface.
    """

    def __init__(self, mesh: Mesh):
        self.offset = OFFSET * float(np.abs(mesh.vertices).max())
        self._mesh = mesh

    def looks(self, surface: Surface, directions: Tensor) -> Iterator[Looks]:
        """Those of a view's pixels that see any other surface, some at a time, in directions (D, 3) of a `sphere`.

        No ray is cast into a sample's own face, on which smooth normals shade the light nevertheless.
        """
        fragments = surface.fragments
        pixels = self._overlooked(surface)
        if not len(pixels):
            return
        planes, normals = surface.planes, surface.normals
        count = fragments.pixel.bincount(minlength=len(fragments.pixels))
        first = count.cumsum(0) - count
        solid_angle = 4 * math.pi / len(directions)
        for some in pixels.split(max(1, BLOCK // len(directions))):
            of_pixel = count[some, None]
            sample = first[some, None] + (_shuffled(len(directions)) + some[:, None]) % of_pixel
            cosine = torch.einsum("bdi,di->bd", normals[sample], directions).clamp(min=0)
            above = torch.einsum("bdi,di->bd", planes[sample], directions)
            cast = torch.nonzero((cosine > 0) & (above > 0), as_tuple=True)
            met = self.meet(surface.points[sample[cast]] + self.offset * planes[sample[cast]], directions[cast[1]])
            met = torch.full_like(sample, -1).index_put_(cast, met)
            yield Looks(some, directions, sample, cosine * of_pixel * solid_angle, met)

    @cached_property
    def _scene(self) -> Any:
        return _embree_scene(self._mesh)

    @cached_property
    def _outermost(self) -> Tensor:
        return torch.from_numpy(_outermost(self._mesh.vertices[np.unique(self._mesh.faces)])).double()

    def _overlooked(self, surface: Surface) -> Tensor:
        """The pixels with a sample on a face above whose plane the mesh rises; all of them, where to find out would
        take longer than to cast the rays."""
        fragments, planes = surface.fragments, surface.face_planes
        if len(planes) * len(self._outermost) > COMPARISONS:
            return torch.arange(len(fragments.pixels))
        parts = planes.split(max(1, 8 * BLOCK // len(self._outermost)))
        reach = torch.cat([(part @ self._outermost.T).amax(1) for part in parts])
        corners = surface.vertices[fragments.corners[:, 0]]
        rises = reach - (planes * corners).sum(1) > self.offset
        return fragments.pixel[rises[fragments.face]].unique()

    def meet(self, origins: Tensor, directions: Tensor, lengths: Tensor | None = None) -> Tensor:
        """(N,) the face that each ray of (N, 3) meets first, -1 where there is none. lengths: (N,) of the rays."""
        rays = [origins, directions] if lengths is None else [origins, directions, lengths]
        return torch.from_numpy(
            self._scene.run(*(np.ascontiguousarray(each.numpy(), np.float32) for each in rays))
        ).long()


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


def _outermost(vertices: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) in whose convex hull all of them are: those of the hull itself, unless they lie in a plane."""
    from scipy.spatial import ConvexHull, QhullError  # takes long to import

    try:
        return vertices[ConvexHull(vertices).vertices]
    except QhullError:
        return vertices


def _embree_scene(mesh: Mesh) -> Any:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise InputError(
            "shadows are found by rays that Embree casts: pip install embreex, or set renderer.shadows=false and "
            "no lights that stand in the scene"
        ) from error
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    return scene
