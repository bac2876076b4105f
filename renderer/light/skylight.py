"""The daylight sky of Preetham, Shirley and Smits 1999 ("A Practical Analytic Model for Daylight") as distant light.

Three scalars: the sun's zenith angle and azimuth, in radians and world axes, and the turbidity of the air. The sun's
disc itself is not part of the sky. Radiance is linear Rec. 709 RGB in kcd/m²: (1, 1, 1) is white of 1000 cd/m². The
mean luminance over the sphere of a clear day's sky is about 5, where that of the probes in `presets` is about 0.1.

The model and its quadrature are in tests/renderer/fit_skylight.py, which fits them with the polynomials that are
evaluated here, turned to the sun's azimuth (the paper's appendix "Differentiating Skylight Parameters", after Habel et
al. 2008).
"""

import math
from functools import cache
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import InputError, is_number, require_finite
from renderer.light.basis import HARMONICS
from renderer.settings import TURBIDITY
from renderer.validation import as_tensor

ZENITH = (0.0, math.pi / 2)  # from overhead to the horizon, both included

_BANDS_AND_ORDERS = [(l, m) for l in range(HARMONICS.degree + 1) for m in range(-l, l + 1)]
_ORDERS = torch.tensor([m for _, m in _BANDS_AND_ORDERS])
_MIRRORED = torch.tensor([l * l + l - m for l, m in _BANDS_AND_ORDERS])
_FITTED = torch.tensor([l * (l + 1) // 2 + abs(m) for l, m in _BANDS_AND_ORDERS])  # where they are in the fit


def coefficients(
    zenith: Tensor | float, azimuth: Tensor | float, turbidity: Tensor | float, fit: Tensor | None = None
) -> Tensor:
    """Coefficients (..., 49, 3) of the sky, linear RGB in kcd/m², from parameters whose shapes broadcast to (...).

    Float32 or float64, as the parameters, with analytic first derivatives. Off by up to 7e-5 of the coefficients' norm
    (4e-4 where they are smallest: in haze, with the sun on the horizon). The derivatives are off by up to 0.1 % in
    zenith and azimuth and 0.5 % in turbidity, two to three times that at the domain's ends. InputError: outside it.
    fit: another one than the committed, as tests/renderer/fit_skylight.py writes it.

    >>> noon, evening = coefficients(0.5, 0.0, 3.0), coefficients(1.4, 0.0, 3.0)
    >>> noon.shape, bool(noon[0].sum() > evening[0].sum())  # index 0: the mean radiance
    (torch.Size([49, 3]), True)
    """
    parameters = torch.broadcast_tensors(*_checked(zenith, azimuth, turbidity))
    return _FittedSky.apply(*parameters, _committed_fit() if fit is None else fit)


class _FittedSky(torch.autograd.Function):
    """Polynomials turned about z by the azimuth φ: U_lm = Ũ_lm cos(mφ), U_l,-m = Ũ_lm sin(mφ) for m ≥ 0.
    The paper prints the rotation by -φ, and ∂U/∂θ without the power of turbidity in its second sum."""

    @staticmethod
    def forward(ctx: Any, zenith: Tensor, azimuth: Tensor, turbidity: Tensor, fit: Tensor) -> Tensor:
        in_zenith, by_zenith = _chebyshev(4 / math.pi * zenith - 1, 4 / math.pi, len(fit))
        in_turbidity, by_turbidity = _chebyshev(5 / turbidity - 1.5, -5 / turbidity**2, fit.shape[1])
        left = torch.stack([in_zenith, by_zenith, in_zenith])
        right = torch.stack([in_turbidity, in_turbidity, by_turbidity])
        products = (left[..., :, None] * right[..., None, :]).flatten(-2)
        upright = (products @ fit.to(products).flatten(2).flatten(0, 1)).unflatten(-1, (-1, 3))
        orders = _ORDERS.to(azimuth)
        turn = azimuth[..., None] * orders.abs()
        turn = torch.where(orders < 0, turn.sin(), turn.cos())[..., None]
        value, by_zenith, by_turbidity = upright[..., _FITTED, :] * turn
        by_azimuth = -orders[:, None] * value[..., _MIRRORED, :]
        ctx.save_for_backward(by_zenith, by_azimuth, by_turbidity)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        return *((upstream * partial).sum((-2, -1)) for partial in ctx.saved_tensors), None


@cache
def _committed_fit() -> Tensor:
    return load_file(Path(__file__).with_name("skylight_fit.safetensors"))["fit"]


def _checked(zenith: Tensor | float, azimuth: Tensor | float, turbidity: Tensor | float) -> list[Tensor]:
    """The parameters as tensors of the dtype and on the device of the first floating one; numbers alone as float64."""
    for name, value in (("zenith", zenith), ("azimuth", azimuth), ("turbidity", turbidity)):
        if not is_number(value):
            as_tensor(name, value)  # or InputError
    values = (zenith, azimuth, turbidity)
    floating = (value for value in values if isinstance(value, Tensor) and value.is_floating_point())
    like = next(floating, torch.zeros((), dtype=torch.float64))
    zenith, azimuth, turbidity = (torch.as_tensor(value, dtype=like.dtype, device=like.device) for value in values)
    require_finite(azimuth=azimuth)
    for name, value, (least, most), domain in (
        ("zenith", zenith, ZENITH, "0 to π/2, with the sun above the horizon"),
        ("turbidity", turbidity, TURBIDITY, "2 to 10"),
    ):
        outside = ~((value >= least) & (value <= most))  # NaN is outside too
        if outside.any():
            raise InputError(f"{name}={value[outside][0].item():.9g} is outside the sky model's domain: give {domain}")
    return [zenith, azimuth, turbidity]


def _chebyshev(x: Tensor, slope: Tensor | float, count: int) -> tuple[Tensor, Tensor]:
    """Chebyshev polynomials (..., count) at x (...), and their derivatives by what x has this slope in."""
    values, derivatives = [torch.ones_like(x), x], [torch.zeros_like(x), torch.ones_like(x) * slope]
    for _ in range(2, count):
        derivatives.append(2 * (slope * values[-1] + x * derivatives[-1]) - derivatives[-2])
        values.append(2 * x * values[-1] - values[-2])
    return torch.stack(values[:count], dim=-1), torch.stack(derivatives[:count], dim=-1)
