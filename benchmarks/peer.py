"""Images by plain autograd that keeps all it can from one light to the next, as an expert would write it.

The peer keeps visibility, counts the samples of one face in one pixel once, and keeps A_l Y_lm of the faces in sight.
It shares the rasterizer with the library and nothing else. Faces are flat and of one color each.
"""

import numpy as np
import torch
from torch import Tensor

from benchmarks import reference
from renderer.camera import Camera
from renderer.geometry.mesh import Mesh
from renderer.visibility.rasterizers import Rasterizer


class Peer:
    """Images of one view of a mesh, differentiable in the light by plain autograd.

    Attributes:
        pixels: Row-major indices of the P covered pixels, shape (P,).
        coefficients: Indices of the K harmonics that reach a diffuse surface, shape (K,).
        irradiance: A_l Y_lm at the normals of the G faces in sight, shape (K, G).
        face: The face of each of the R pairs of a pixel and a face, indices into the G faces, shape (R,).
        pixel: The pixel of each pair, indices into the P pixels, shape (R,).
        weight: The fraction of the pixel that the face covers times the face's albedo, shape (3, R).
        behind: What the background adds to each pixel of the image, shape (3, size²).
    """

    def __init__(
        self,
        mesh: Mesh,
        camera: Camera,
        size: int,
        samples: int,
        degree: int,
        rasterizer: Rasterizer,
        background: float = 0.5,
        device: str = "cpu",
    ):
        """Rasterize the mesh, and compute in float32 what does not depend on the light.

        Args:
            mesh: Closed, so that every face in sight shows its front, and of one color per face.
            camera: The view.
            size: Pixels per side of the image.
            samples: Samples per side of a pixel.
            degree: Of the light's harmonics.
            rasterizer: That of the library's operator.
            background: Gray value in [0, 1].
            device: Where the images are computed.
        """
        points = camera.project(mesh.vertices)[None]
        ids = rasterizer.rasterize(points, mesh.faces, size * samples, closed=mesh.closed)[0].ravel()
        hits = np.flatnonzero(ids >= 0)
        row, column = np.divmod(hits, size * samples)
        key = (row // samples * size + column // samples) * len(mesh.faces) + ids[hits]
        pair, count = np.unique(key, return_counts=True)
        pixel_of_pair, face_of_pair = np.divmod(pair, len(mesh.faces))
        pixels, pixel = np.unique(pixel_of_pair, return_inverse=True)
        faces, face = np.unique(face_of_pair, return_inverse=True)
        covered = torch.from_numpy(count / samples**2).float()

        corners = torch.from_numpy(mesh.vertices[mesh.faces[faces]])
        normals = reference.face_normals(corners)
        matrix, coefficients, factors = reference.reaching_harmonics(normals, degree)
        colors = torch.from_numpy(mesh.corner_colors[faces, 0])

        self.size = size
        self.pixels = torch.from_numpy(pixels).to(device)
        self.coefficients = coefficients.to(device)
        self.irradiance = (matrix.T * factors).float().contiguous().to(device)
        self.face = torch.from_numpy(face).to(device)
        self.pixel = torch.from_numpy(pixel).to(device)
        self.weight = (covered * colors[face].T).contiguous().to(device)
        coverage = torch.zeros(size**2).index_add(0, torch.from_numpy(pixel_of_pair), covered)
        self.behind = ((1 - coverage) * background).expand(3, -1).contiguous().to(device)
        self._pixel_in_image = self.pixels[self.pixel]

    def radiance(self, light: Tensor) -> Tensor:
        """Compute the radiance of the covered pixels, shape (3, P), in a light of shape ((degree + 1)², 3)."""
        black = light.new_zeros(3, len(self.pixels))
        return black.index_add(1, self.pixel, self._radiance_of_pairs(light))

    def image(self, light: Tensor) -> Tensor:
        """Compute the image, shape (3, size, size), in a light of shape ((degree + 1)², 3)."""
        unclamped = self.behind.index_add(1, self._pixel_in_image, self._radiance_of_pairs(light))
        return unclamped.clamp(0, 1).view(3, self.size, self.size)

    def _radiance_of_pairs(self, light: Tensor) -> Tensor:
        """Shade each face once, and weight it in each of its pixels, shape (3, R)."""
        at_faces = light[self.coefficients].T @ self.irradiance
        return at_faces.index_select(1, self.face) * self.weight
