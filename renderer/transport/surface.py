"""The visible surface at the samples of a view."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from renderer.fragments import Fragments
from renderer.image import ImageSettings
from renderer.mesh import Mesh
from renderer.normals import face_normals, unit
from renderer.shading import smooth_normals


@dataclass(frozen=True)
class Surface:
    """Points and normals at the S samples of a view, in float64, as they are needed; differentiable in vertices (V, 3).

    smooth_faces: (F, 3), all faces of the mesh, to shade with interpolated vertex normals.
    """

    fragments: Fragments
    vertices: Tensor
    smooth_faces: Tensor | None = None

    @staticmethod
    def of(mesh: Mesh, fragments: Fragments, settings: ImageSettings, vertices: Tensor | None = None) -> "Surface":
        """vertices: (V, 3), in place of the mesh's."""
        smooth_faces = torch.from_numpy(mesh.faces) if settings.normals == "smooth" else None
        vertices = torch.from_numpy(mesh.vertices) if vertices is None else vertices
        return Surface(fragments, vertices.double(), smooth_faces)

    @cached_property
    def planes(self) -> Tensor:
        """(S, 3) unit normals of their faces, on the side that the camera sees."""
        return self.face_planes[self.fragments.face]

    @cached_property
    def face_planes(self) -> Tensor:
        """(G, 3) the same of each visible face."""
        return face_normals(self.vertices, self.fragments.corners) * self.fragments.facing

    @cached_property
    def normals(self) -> Tensor:
        """(S, 3) unit normals to shade with."""
        if self.smooth_faces is None:
            return self.planes
        return unit(smooth_normals(self.fragments, self.vertices, self.smooth_faces).T).T

    @cached_property
    def points(self) -> Tensor:
        """(S, 3)"""
        return self.fragments.interpolate(self.vertices[self.fragments.corners])
