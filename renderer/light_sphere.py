"""A light as an image: a white ball in it."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from renderer.camera import OrthographicCamera
from renderer.image import develop
from renderer.shading import irradiance

_SAMPLES = 2  # per pixel side
_OBLIQUE = OrthographicCamera(math.pi / 3, 0.0, 2.0)  # the first of `renderer.camera.ring`


def light_sphere(light: Tensor, size: int, camera: OrthographicCamera = _OBLIQUE) -> Tensor:
    """A diffuse white ball in a light ((degree + 1)², 3), which fills a square image as the camera sees it, on white.

    Returns (3, size, size) float32, sRGB-encoded in [0, 1]. The pixel's value before encoding is irradiance / π, so
    that even light of radiance 1 is white; what is darker than black or brighter than white is clamped. A diffuse ball
    rather than a mirror, which would show the series ringing and the coefficients that reach no surface.
    InputError: NaN.
    """
    side = size * _SAMPLES
    across = (2 * torch.arange(side, dtype=torch.float64) + 1) / side - 1
    up, right = torch.meshgrid(-across, across, indexing="ij")
    back = 1 - right.square() - up.square()
    inside = back > 0
    normals = torch.stack([right, up, back.sqrt()], dim=-1)[inside] @ torch.from_numpy(camera.axes())
    radiance = torch.zeros(3, side, side, dtype=torch.float64)
    radiance[:, inside] = irradiance(normals, light.detach().cpu()) / math.pi
    radiance, coverage = (avg_pool2d(layer, _SAMPLES).flatten(1) for layer in (radiance, inside[None].double()))
    return develop(radiance, coverage, background=torch.ones(1, 1), encoding="srgb").unflatten(1, (size, size)).float()
