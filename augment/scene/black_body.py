"""Color of the light of black bodies."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Matrix from XYZ to linear sRGB (IEC 61966-2-1).
XYZ_TO_RGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)


def planckian_locus(kelvin: Tensor) -> tuple[Tensor, Tensor]:
    """Return CIE 1960 u and v of a black body at 1,000 to 15,000 K, within 1e-4 (Krystek 1985)."""
    u = (0.860117757 + 1.54118254e-4 * kelvin + 1.28641212e-7 * kelvin**2) / (
        1 + 8.42420235e-4 * kelvin + 7.08145163e-7 * kelvin**2
    )
    v = (0.317398726 + 4.22806245e-5 * kelvin + 4.20481691e-8 * kelvin**2) / (
        1 - 2.89741816e-5 * kelvin + 1.61456053e-7 * kelvin**2
    )
    return u, v


def planckian_rgb(kelvin: Tensor, offset: Tensor | float = 0.0) -> Float[Tensor, "... 3 1 1"]:
    """Return the linear RGB, with Y = 1, of a color at a distance (Duv) above a black body."""
    of_body = torch.stack(planckian_locus(torch.stack([kelvin, 1.01 * kelvin])))
    # A hotter body has less u and v. The normal of the locus points to green.
    (u, v), (along_u, along_v) = of_body[:, 0], of_body[:, 1] - of_body[:, 0]
    shift = offset / torch.hypot(along_u, along_v)
    u, v = u + shift * along_v, v - shift * along_u
    # CIE 1960 (u, v) to X and Z at Y = 1: X / Y = 3u / 2v and Z / Y = (4 − u − 10v) / 2v.
    xyz = torch.cat([3 * u, 2 * v, 4 - u - 10 * v], -3) / (2 * v)
    to_rgb = xyz.new_tensor(XYZ_TO_RGB)
    return (to_rgb @ xyz[..., 0, 0, None])[..., None].clamp(min=1e-3)
