"""PyTorch3D as its users would set it up for this task: its rasteriser, and a shader of their own under autograd.

Written from its documentation and run against a stand-in with its conventions only: there was no package of it for
the version of torch at hand.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from renderer.harmonics import bands, lambertian_factors, live_coefficients, select_rows
from train.studies.peers import PeerScene

DISTANCE = 4.0  # of the camera from the origin: the whole mesh lies before it


class PyTorch3DPeer:
    """A mesh rasteriser with one face per sample, harmonics on each face's normal, and the mean of a pixel's samples.

    The light's gradient, and `image`, take the fragments that were rasterised once; that of the vertices rasterises
    on each call. The shader runs each time. Outlines count as fixed (its soft rasterisers move them).
    InputError: not installed, or a number of samples that is no square.
    """

    def __init__(self, scene: PeerScene):
        self._side = math.isqrt(scene.samples)
        if self._side**2 != scene.samples:
            raise InputError(f"samples={scene.samples} must be a square for PyTorch3D, such as {self._side**2}")
        self._vertices, self._albedo, self._light = (
            torch.tensor(a, dtype=torch.float32) for a in (scene.vertices, scene.albedo, scene.light)
        )
        self._faces = torch.tensor(scene.faces, dtype=torch.int64)
        self._live = live_coefficients(6)
        self._factors = lambertian_factors(6)[bands(6)][self._live].float()
        self._rasterizer = _rasterizer(scene.camera, scene.size * self._side)
        self._meshes = self._mesh_of(self._vertices)
        self._fragments = self._rasterizer(self._meshes)

    def image(self) -> np.ndarray:
        return self._shade(self._meshes, self._fragments, self._light).numpy()

    def light_gradient(self, image_gradient: np.ndarray) -> np.ndarray:
        light = self._light.clone().requires_grad_()
        image = self._shade(self._meshes, self._fragments, light)
        return _gradient(image, light, image_gradient)

    def vertex_gradient(self, image_gradient: np.ndarray) -> np.ndarray:
        vertices = self._vertices.clone().requires_grad_()
        meshes = self._mesh_of(vertices)
        image = self._shade(meshes, self._rasterizer(meshes), self._light)
        return _gradient(image, vertices, image_gradient)

    def _mesh_of(self, vertices: Tensor) -> Any:
        from pytorch3d.structures import Meshes

        return Meshes(verts=[vertices], faces=[self._faces])

    def _shade(self, meshes: Any, fragments: Any, light: Tensor) -> Tensor:
        """(3, size, size) radiance: each face is shaded, each sample takes its face's, each pixel their mean."""
        harmonics = torch.stack(select_rows(meshes.faces_normals_packed().T, self._live.tolist()), dim=-1)
        shades = self._albedo * ((harmonics * self._factors) @ light[self._live])
        with_background = torch.cat([shades, torch.zeros(1, 3)])  # where no face is, the index is -1
        radiance = with_background[fragments.pix_to_face[0, :, :, 0]]
        return torch.nn.functional.avg_pool2d(radiance.permute(2, 0, 1), self._side)


def _rasterizer(camera: OrthographicCamera, resolution: int) -> Any:
    """A rasteriser of resolution² samples. Its views have x left, y up, z forward, and points are rows: p R + T."""
    try:
        from pytorch3d.renderer import FoVOrthographicCameras, MeshRasterizer, RasterizationSettings
    except ImportError as error:
        raise InputError(
            "pytorch3d is not installed: build it from its repository for this version of torch"
        ) from error
    right, up, back = camera.axes()
    half = camera.field_of_view / 2
    cameras = FoVOrthographicCameras(
        min_x=-half,
        max_x=half,
        min_y=-half,
        max_y=half,
        R=torch.tensor(np.stack([-right, up, -back], axis=1), dtype=torch.float32)[None],
        T=torch.tensor([[0.0, 0.0, DISTANCE]]),
    )
    return MeshRasterizer(cameras, RasterizationSettings(image_size=resolution, faces_per_pixel=1))


def _gradient(image: Tensor, parameter: Tensor, image_gradient: np.ndarray) -> np.ndarray:
    (gradient,) = torch.autograd.grad(image, parameter, torch.from_numpy(image_gradient))
    return gradient.numpy()
