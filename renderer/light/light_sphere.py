"""A light as an image: a white ball in it."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from renderer.camera import Camera, OrthographicCamera
from renderer.image import tonemap
from renderer.light.basis import HARMONICS, Basis, LocalBasis, parts_of
from renderer.shading import irradiance

_SAMPLES = 2  # per pixel side
_OBLIQUE = OrthographicCamera(math.pi / 3, 0.0, 2.0)  # the first of `renderer.camera.orbit_cameras`


def light_sphere(light: Tensor, size: int, camera: Camera = _OBLIQUE, basis: Basis = HARMONICS) -> Tensor:
    """A diffuse white ball in a light (basis.size, 3), which fills a square image as the camera sees it, on white.

    The ball is that of radius 1 about the origin, which says how far lights in the scene are. A light in harmonics may
    have any degree. Returns (3, size, size) float32, sRGB-encoded in [0, 1]. The pixel's value before encoding is the
    ball's radiance, so that even light of radiance 1 is white; what is darker than black or brighter than white is
    clamped. A diffuse ball rather than a mirror, which would show the series ringing and the coefficients that reach no
    surface. InputError: NaN.
    """
    side = size * _SAMPLES
    across = (2 * torch.arange(side, dtype=torch.float64) + 1) / side - 1
    up, right = torch.meshgrid(-across, across, indexing="ij")
    back = 1 - right.square() - up.square()
    inside = back > 0
    normals = torch.stack([right, up, back.sqrt()], dim=-1)[inside] @ torch.from_numpy(camera.axes())
    radiance = torch.zeros(3, side, side, dtype=torch.float64)
    light = light.detach().cpu()
    for rows, part in parts_of(basis):
        if isinstance(part, LocalBasis):
            paths = part.connect(normals, normals)  # to the ball's points, which are its normals
            arriving = paths.irradiance[:, None] * light[rows].to(normals)[paths.function]
            radiance[:, inside] += torch.zeros_like(normals).index_add_(0, paths.point, arriving).T
        else:
            radiance[:, inside] += irradiance(normals, light if part is basis else light[rows]) / math.pi
    radiance, coverage = (avg_pool2d(layer, _SAMPLES).flatten(1) for layer in (radiance, inside[None].double()))
    return tonemap(radiance, coverage, background=torch.ones(1, 1), encoding="srgb").unflatten(1, (size, size)).float()
