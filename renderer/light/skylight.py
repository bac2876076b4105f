"""The daylight sky of Preetham, Shirley and Smits as distant light.

The source is their "A Practical Analytic Model for Daylight" (1999). The sky
has three scalar parameters: the zenith angle and the azimuth of the sun in
degrees, in world axes, and the turbidity (haziness) of the air. The disc of the
sun is not part of the sky.

Radiance is linear Rec. 709 RGB in kcd/m²: (1, 1, 1) is white of 1000 cd/m². The
mean luminance of a clear day's sky over the sphere is about 5. That of the
probes in `presets` is about 0.1.

The SH coefficients of a sky with the sun at azimuth 0 are polynomials in the
zenith angle and in 1 / turbidity, which were fitted once by
tests/renderer/fit_skylight.py. This module evaluates them and rotates them to
the azimuth of the sun. See the paper's appendix "Differentiating Skylight
Parameters", after Habel et al. 2008.
"""

import math
from functools import cache
from pathlib import Path
from typing import Any, TypeGuard

import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import InputError, is_number, require_finite
from renderer.light.basis import HARMONICS
from renderer.settings import TURBIDITY
from renderer.validation import as_tensor

# The sun's zenith angle in degrees, from overhead to the horizon, inclusive.
ZENITH = (0.0, 90.0)

_BANDS_AND_ORDERS = [(l, m) for l in range(HARMONICS.degree + 1) for m in range(-l, l + 1)]
# The order m of each coefficient.
_ORDERS = torch.tensor([m for _, m in _BANDS_AND_ORDERS])
# The index of the coefficient of order -m, for the coefficient of order m.
_MIRRORED = torch.tensor([l * l + l - m for l, m in _BANDS_AND_ORDERS])
# The row of each coefficient in the fit, which has the orders m ≥ 0 only.
_ROW_IN_FIT = torch.tensor([l * (l + 1) // 2 + abs(m) for l, m in _BANDS_AND_ORDERS])


def coefficients(
    zenith: Tensor | float,
    azimuth: Tensor | float,
    turbidity: Tensor | float,
    fit: Tensor | None = None,
) -> Tensor:
    """Compute the light of a daylight sky.

    The result has analytic first derivatives by the parameters. Those by the
    angles are per degree. The error of the result is at most 7e-5 of the norm of
    the coefficients (4e-4 in haze with the sun on the horizon, where the
    coefficients are smallest). The error of the derivatives
    is at most 0.1 % by zenith and azimuth and 0.5 % by turbidity, and two to
    three times as large at the ends of the domain.

    Args:
        zenith: Zenith angle of the sun in degrees, in `ZENITH`. The shapes of
            the three parameters broadcast to (...).
        azimuth: Azimuth of the sun in degrees.
        turbidity: Haziness of the air, in `TURBIDITY`.
        fit: Polynomials to evaluate, as tests/renderer/fit_skylight.py writes
            them. None for the fit that comes with the library.

    Returns:
        SH coefficients of degree 6, shape (..., 49, 3), linear RGB in kcd/m²,
        in the dtype of the turbidity. If that is a number, the dtype is that of
        the angles, and float64 if all are numbers.

    Raises:
        InputError: If a parameter is outside of its range, NaN or infinite.

    Example:
        >>> import norm_balls as nb
        >>> noon = nb.skylight.coefficients(30.0, 0.0, 3.0)
        >>> evening = nb.skylight.coefficients(80.0, 0.0, 3.0)
        >>> noon.shape, bool(noon[0].sum() > evening[0].sum())  # index 0: the mean
        (torch.Size([49, 3]), True)
    """
    parameters = torch.broadcast_tensors(*_as_parameters(zenith, azimuth, turbidity))
    return _FittedSky.apply(*parameters, _library_fit() if fit is None else fit)


class _FittedSky(torch.autograd.Function):
    """Evaluate the polynomials and rotate them about z by the azimuth φ, in radians.

    With the coefficients Ũ of the sky at azimuth 0, the rotated ones are
    U_lm = Ũ_lm cos(mφ) and U_l,-m = Ũ_lm sin(mφ) for m ≥ 0. The paper prints
    the rotation by -φ, and ∂U/∂θ without the power of turbidity in its second
    sum.
    """

    @staticmethod
    def forward(
        ctx: Any, zenith: Tensor, azimuth: Tensor, turbidity: Tensor, fit: Tensor
    ) -> Tensor:
        # Chebyshev polynomials in variables that range over [-1, 1].
        in_zenith, by_zenith = _chebyshev(4 / math.pi * zenith - 1, 4 / math.pi, len(fit))
        in_turbidity, by_turbidity = _chebyshev(
            5 / turbidity - 1.5, -5 / turbidity**2, fit.shape[1]
        )
        # Row 0 is the value, row 1 its derivative by zenith, row 2 by turbidity.
        zenith_factors = torch.stack([in_zenith, by_zenith, in_zenith])
        turbidity_factors = torch.stack([in_turbidity, in_turbidity, by_turbidity])
        products = zenith_factors[..., :, None] * turbidity_factors[..., None, :]
        polynomials = fit.to(products).flatten(2).flatten(0, 1)
        at_azimuth_zero = (products.flatten(-2) @ polynomials).unflatten(-1, (-1, 3))
        orders = _ORDERS.to(azimuth)
        turn = azimuth[..., None] * orders.abs()
        turn = torch.where(orders < 0, turn.sin(), turn.cos())[..., None]
        value, by_zenith, by_turbidity = at_azimuth_zero[..., _ROW_IN_FIT, :] * turn
        by_azimuth = -orders[:, None] * value[..., _MIRRORED, :]
        ctx.save_for_backward(by_zenith, by_azimuth, by_turbidity)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        by_zenith, by_azimuth, by_turbidity = (
            (upstream * partial).sum((-2, -1)) for partial in ctx.saved_tensors
        )
        return by_zenith, by_azimuth, by_turbidity, None


@cache
def _library_fit() -> Tensor:
    """Load the polynomials, shape (zenith powers, turbidity powers, 28 orders m ≥ 0, 3)."""
    return load_file(Path(__file__).with_name("skylight_fit.safetensors"))["fit"]


def _as_parameters(
    zenith: Tensor | float, azimuth: Tensor | float, turbidity: Tensor | float
) -> list[Tensor]:
    """Return the angles in radians and the turbidity as tensors.

    They have the dtype and the device of the first floating tensor among
    turbidity, zenith and azimuth. If all are numbers, they are float64. Angles in
    float64 are rounded to this dtype only after the conversion. Values outside of
    the domain raise `InputError`.
    """
    named = {"zenith": zenith, "azimuth": azimuth, "turbidity": turbidity}
    for name, value in named.items():
        if not is_number(value):
            as_tensor(name, value)  # This raises InputError for anything but a tensor.
    floating = [value for value in (turbidity, zenith, azimuth) if _is_floating(value)]
    like = floating[0] if floating else torch.zeros((), dtype=torch.float64)
    turbidities = torch.as_tensor(turbidity, dtype=like.dtype, device=like.device)
    degrees = []
    for angle in (zenith, azimuth):
        dtype = angle.dtype if _is_floating(angle) else torch.float64
        degrees.append(torch.as_tensor(angle, dtype=dtype, device=like.device))
    zeniths, azimuths = degrees
    require_finite(azimuth=azimuths)
    expected = "0 to 90 degrees, with the sun above the horizon"
    _require_in_domain("zenith", zeniths.to(like.dtype), ZENITH, expected)
    _require_in_domain("turbidity", turbidities, TURBIDITY, "2 to 10")
    radians = [torch.deg2rad(angles).to(like.dtype) for angles in degrees]
    return [*radians, turbidities]


def _is_floating(value: object) -> TypeGuard[Tensor]:
    """Return whether a value is a tensor of floating-point numbers."""
    return isinstance(value, Tensor) and value.is_floating_point()


def _require_in_domain(
    name: str, value: Tensor, limits: tuple[float, float], description: str
) -> None:
    """Raise `InputError` if an entry of a parameter is outside of its limits or NaN.

    An entry may exceed a limit by rounding.
    """
    low, high = limits
    rounding = 4 * torch.finfo(value.dtype).eps
    # NaN fails both comparisons, so it counts as outside.
    is_outside = ~((value >= low * (1 - rounding)) & (value <= high * (1 + rounding)))
    if is_outside.any():
        first = value[is_outside][0].item()
        raise InputError(
            f"{name}={first:.9g} is outside the sky model's domain: give {description}"
        )


def _chebyshev(x: Tensor, slope: Tensor | float, count: int) -> tuple[Tensor, Tensor]:
    """Return the first Chebyshev polynomials at x (...) and their derivatives by a parameter.

    `slope` is the derivative of x by this parameter. Both results have the
    shape (..., count).
    """
    values = [torch.ones_like(x), x]
    derivatives = [torch.zeros_like(x), torch.ones_like(x) * slope]
    for _ in range(2, count):
        derivatives.append(2 * (slope * values[-1] + x * derivatives[-1]) - derivatives[-2])
        values.append(2 * x * values[-1] - values[-2])
    return torch.stack(values[:count], dim=-1), torch.stack(derivatives[:count], dim=-1)
