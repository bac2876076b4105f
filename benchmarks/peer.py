"""Images by plain autograd, as an expert would write them for attacks on the light.

`Peer` computes once what all lights share. It keeps the visibility, it counts
the samples of a face in a pixel only once, and it keeps the harmonics A_l Y_lm
at the normals of the visible faces (see `benchmarks.reference`). It shares the
rasterizer with the library and nothing else. Faces are flat and have one color
each.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchmarks import reference
from renderer.camera import Camera
from renderer.mesh import Mesh
from renderer.visibility import Rasterizer


@dataclass(frozen=True)
class PixelFacePairs:
    """Pairs of a pixel and a face that covers a part of it.

    Attributes:
        pixels: Row-major index of the pixel of each pair, shape (R,).
        faces: Index of the face of each pair in the mesh, shape (R,).
        coverage: Fraction of the pixel that the face covers, float32,
            shape (R,).
    """

    pixels: np.ndarray
    faces: np.ndarray
    coverage: Tensor


def find_pairs(
    mesh: Mesh, camera: Camera, size: int, samples: int, rasterizer: Rasterizer
) -> PixelFacePairs:
    """Rasterize a mesh, and count the samples of each face in each pixel.

    Args:
        mesh: Mesh to rasterize.
        camera: Camera of the view.
        size: Pixels per side of the image.
        samples: Samples per side of a pixel.
        rasterizer: Rasterizer to use.

    Returns:
        Pairs with at least one sample.
    """
    samples_per_side = size * samples
    points = camera.project(mesh.vertices)[None]
    face_images = rasterizer.rasterize(points, mesh.faces, samples_per_side, closed=mesh.closed)
    face_of_sample = face_images[0].ravel()
    covered_samples = np.flatnonzero(face_of_sample >= 0)
    row, column = np.divmod(covered_samples, samples_per_side)
    pixel_of_sample = row // samples * size + column // samples
    pair_of_sample = pixel_of_sample * len(mesh.faces) + face_of_sample[covered_samples]
    pairs, counts = np.unique(pair_of_sample, return_counts=True)
    pixels, faces = np.divmod(pairs, len(mesh.faces))
    coverage = torch.from_numpy(counts / samples**2).float()
    return PixelFacePairs(pixels=pixels, faces=faces, coverage=coverage)


class Peer:
    """Images of one view of a mesh, differentiable in the light by plain autograd.

    The view has P covered pixels, G visible faces, K harmonics that reach a
    diffuse surface, and R pairs of a pixel and a face that covers a part of it.

    Args:
        mesh: Closed mesh, so that every visible face shows its front, with one
            color per face.
        camera: Camera of the view.
        size: Pixels per side of the image.
        samples: Samples per side of a pixel.
        degree: Degree of the light's spherical harmonics.
        rasterizer: Rasterizer of the operator that the peer is compared with.
        background: Gray value in [0, 1].
        device: Device on which images are computed.

    Attributes:
        size: Pixels per side of the image.
        pixels: Row-major indices of the covered pixels, shape (P,).
        coefficients: Indices of the harmonics that reach a diffuse surface,
            shape (K,).
        irradiance: Harmonics A_l Y_lm at the normals of the visible faces,
            shape (K, G).
        pair_to_visible_face: Index of each pair's face among the visible faces,
            shape (R,).
        pair_to_covered_pixel: Index of each pair's pixel among the covered
            pixels, shape (R,).
        pair_to_pixel: Row-major index of each pair's pixel in the image,
            shape (R,).
        weight: Fraction of the pixel that the face covers, times the albedo of
            the face in each channel, shape (3, R).
        background_part: What the background contributes to each pixel,
            shape (3, size²).
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
        pairs = find_pairs(mesh, camera, size, samples, rasterizer)
        pixels, pair_to_covered_pixel = np.unique(pairs.pixels, return_inverse=True)
        faces, pair_to_visible_face = np.unique(pairs.faces, return_inverse=True)
        self.size = size
        self.pixels = torch.from_numpy(pixels).to(device)
        self.pair_to_visible_face = torch.from_numpy(pair_to_visible_face).to(device)
        self.pair_to_covered_pixel = torch.from_numpy(pair_to_covered_pixel).to(device)
        self.pair_to_pixel = self.pixels[self.pair_to_covered_pixel]

        # Evaluate the harmonics once for each visible face.
        corners = torch.from_numpy(mesh.vertices[mesh.faces[faces]])
        normals = reference.face_normals(corners)
        harmonics, coefficients, factors = reference.reaching_harmonics(normals, degree)
        self.coefficients = coefficients.to(device)
        self.irradiance = (harmonics.T * factors).float().contiguous().to(device)

        # A face counts with the part of the pixel that it covers. The background
        # has the part of each pixel that no face covers.
        colors = torch.from_numpy(mesh.corner_colors[faces, 0])
        weight = pairs.coverage * colors[pair_to_visible_face].T
        self.weight = weight.contiguous().to(device)
        pixel_of_pair = torch.from_numpy(pairs.pixels)
        coverage = torch.zeros(size**2).index_add(0, pixel_of_pair, pairs.coverage)
        background_part = ((1 - coverage) * background).expand(3, -1)
        self.background_part = background_part.contiguous().to(device)

    def radiance(self, light: Tensor) -> Tensor:
        """Compute the radiance of the covered pixels.

        Args:
            light: SH coefficients, shape ((degree + 1)², 3).

        Returns:
            Radiance, shape (3, P).
        """
        black = light.new_zeros(3, len(self.pixels))
        return black.index_add(1, self.pair_to_covered_pixel, self._radiance_of_pairs(light))

    def image(self, light: Tensor) -> Tensor:
        """Compute the image.

        Args:
            light: SH coefficients, shape ((degree + 1)², 3).

        Returns:
            Image in [0, 1], shape (3, size, size).
        """
        radiance = self._radiance_of_pairs(light)
        unclamped = self.background_part.index_add(1, self.pair_to_pixel, radiance)
        return unclamped.clamp(0, 1).view(3, self.size, self.size)

    def _radiance_of_pairs(self, light: Tensor) -> Tensor:
        """Shade each visible face once, and weight it in each of its pixels, shape (3, R)."""
        irradiance_of_faces = light[self.coefficients].T @ self.irradiance
        irradiance_of_pairs = irradiance_of_faces.index_select(1, self.pair_to_visible_face)
        return irradiance_of_pairs * self.weight
