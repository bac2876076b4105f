"""What is rendered: an ellipsoid of any number of vertices, under a probe and a sun whose bands never end."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import trimesh
from torch import Tensor

from renderer import reference
from renderer.basis import Harmonics
from renderer.camera import OrthographicCamera
from renderer.fragments import Fragments, build_fragments
from renderer.harmonics import basis
from renderer.image import ImageSettings
from renderer.lights import probe
from renderer.mesh import Mesh
from renderer.transfer import Operator, build_operators
from renderer.visibility import Backend

AXES = (1.0, 0.9, 0.8)
ALBEDO = (0.8, 0.5, 0.3)
BACKGROUND = 0.5
CAMERA = OrthographicCamera(1.0, 0.5, 2.4)
SUN_FROM = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
SUN = torch.tensor([0.9, 0.8, 0.6], dtype=torch.float64)  # irradiance head on
PROBE = probe("grace")[:9].double() / 2


def ellipsoid(vertices: int) -> Mesh:
    """A closed mesh of about so many vertices: an icosahedron whose edges are cut into n, V = 10n² + 2, blown up."""
    pieces = max(1, round(((vertices - 2) / 10) ** 0.5))
    solid = trimesh.creation.icosahedron()
    steps = np.array([(i, j, pieces - i - j) for i in range(pieces + 1) for j in range(pieces + 1 - i)])
    number = np.full((pieces + 1, pieces + 1), -1)
    number[steps[:, 0], steps[:, 1]] = np.arange(len(steps))
    i, j = steps[steps[:, 2] > 0, :2].T
    upright = np.stack([number[i + 1, j], number[i, j + 1], number[i, j]], axis=1)
    i, j = steps[steps[:, 2] > 1, :2].T
    inverted = np.stack([number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]], axis=1)
    patch = np.concatenate([upright, inverted])
    points = np.einsum("sc,fcd->fsd", steps / pieces, solid.vertices[solid.faces])
    # A point's name is the same in every patch that has it: its corners of the solid, each with its share.
    shares = np.where(steps > 0, steps + (pieces + 1) * (1 + solid.faces[:, None]), 0)
    names = np.sort(shares, axis=2) @ (len(solid.vertices) * 2 * (pieces + 1)) ** np.arange(3)
    _, first, index = np.unique(names, return_index=True, return_inverse=True)
    faces = index.reshape(names.shape)[:, patch].reshape(-1, 3)
    directions = points.reshape(-1, 3)[first]
    return Mesh.plain(directions / np.linalg.norm(directions, axis=1, keepdims=True) * AXES, faces, ALBEDO)


def coefficients(degree: int) -> Tensor:
    """The light's ((degree + 1)², 3), float64, cut off after `degree`."""
    cut = basis(SUN_FROM, degree)[:, None] * SUN
    kept = min(len(PROBE), len(cut))
    cut[:kept] += PROBE[:kept]
    return cut


def irradiance(normals: Tensor) -> Tensor:
    """(N, 3) under the whole light, at unit normals (N, 3) float64: the sun's series is the clamped cosine."""
    return reference.irradiance(normals, PROBE) + (normals @ SUN_FROM).clamp(min=0)[:, None] * SUN


def image_gradient(size: int) -> Tensor:
    """(3, size, size) float64, what a loss answers to an image: normal numbers, the same in every run."""
    return torch.randn(3, size, size, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@dataclass(frozen=True)
class View:
    """One mesh from one camera at one size, and the paths under test applied to it."""

    mesh: Mesh
    size: int
    backend: Backend
    device: torch.device
    transport: str = "direct"

    def settings(self, samples: int) -> ImageSettings:
        return ImageSettings(self.size, samples, transport=self.transport)

    def operator(self, samples: int, degree: int = 6, dtype: torch.dtype = torch.float32) -> Operator:
        (operator,) = build_operators(
            self.mesh, [CAMERA], self.settings(samples), self.backend, basis=Harmonics(degree), dtype=dtype
        )
        return operator.to(self.device)

    def fragments(self, samples: int, vertices: np.ndarray | None = None) -> Fragments:
        vertices = self.mesh.vertices if vertices is None else vertices
        (fragments,) = build_fragments(
            vertices, self.mesh.faces, [CAMERA], self.settings(samples), self.backend, closed=self.mesh.closed
        )
        return fragments.to(self.device)

    def vertices(self, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.from_numpy(self.mesh.vertices).to(self.device, dtype)

    def canvas(self, values: Tensor, pixels: Tensor, elsewhere: float = 0.0) -> Tensor:
        """(3, size, size) with values (3, P) where the mesh is."""
        empty = values.new_full((3, self.size**2), elsewhere)
        return empty.index_copy(1, pixels, values).unflatten(1, (self.size, self.size))

    @cached_property
    def image_gradient(self) -> Tensor:
        return image_gradient(self.size).to(self.device)

    def upstream(self, pixels: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """(3, P) the image's gradient at the covered pixels."""
        return self.image_gradient.flatten(1)[:, pixels].to(dtype)
