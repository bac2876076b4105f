"""Environment light of the daylight sky of Preetham, Shirley and Smits.

The source is "A Practical Analytic Model for Daylight" (1999). The sky has three
parameters: the zenith angle and the azimuth of the sun in degrees, in world axes,
and the turbidity (haziness) of the air. The disc of the sun is not part of the
sky.

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

# Smallest and largest zenith angle of the sun in degrees: from overhead to the horizon.
ZENITH = (0.0, 90.0)

# Degree l and order m of each of the 49 SH coefficients.
_BANDS_AND_ORDERS = [(l, m) for l in range(HARMONICS.degree + 1) for m in range(-l, l + 1)]
# Order m of each coefficient, shape (49,).
_ORDERS = torch.tensor([m for _, m in _BANDS_AND_ORDERS])
# For each coefficient of degree l and order m, the index of the coefficient of order -m.
_MIRRORED = torch.tensor([l * l + l - m for l, m in _BANDS_AND_ORDERS])
# For each coefficient, the index of its polynomial in the fit. The orders m and -m share
# a polynomial.
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
    """SH coefficients of the sky, with their derivatives by the three parameters.

    Polynomials give the coefficients Ũ of a sky with the sun at azimuth 0. For the
    azimuth φ, the coefficients are U_lm = Ũ_lm cos(mφ) and U_l,-m = Ũ_lm sin(mφ)
    for m ≥ 0. The paper prints the rotation by -φ, and ∂U/∂θ without the power of
    turbidity in its second sum.
    """

    @staticmethod
    def forward(
        ctx: Any, zenith: Tensor, azimuth: Tensor, turbidity: Tensor, fit: Tensor
    ) -> Tensor:
        """Compute the coefficients and their derivatives.

        Args:
            ctx: Context of autograd.
            zenith: Zenith angle of the sun in radians, shape (...).
            azimuth: Azimuth of the sun in radians, same shape.
            turbidity: Turbidity, same shape.
            fit: Polynomials, see `_library_fit`.

        Returns:
            SH coefficients, shape (..., 49, 3).
        """
        # Chebyshev polynomials of two variables in [-1, 1], and their derivatives.
        zenith_values, zenith_slopes = _chebyshev(4 / math.pi * zenith - 1, 4 / math.pi, len(fit))
        turbidity_values, turbidity_slopes = _chebyshev(
            5 / turbidity - 1.5, -5 / turbidity**2, fit.shape[1]
        )
        # The first axis is the value, its derivative by the zenith angle, and its
        # derivative by the turbidity, shape (3, ..., polynomials).
        zenith_factors = torch.stack([zenith_values, zenith_slopes, zenith_values])
        turbidity_factors = torch.stack([turbidity_values, turbidity_values, turbidity_slopes])
        products = zenith_factors[..., :, None] * turbidity_factors[..., None, :]
        polynomials = fit.to(products).flatten(2).flatten(0, 1)
        # Coefficients of the 28 harmonics with m ≥ 0, and their two derivatives, for a sun at
        # the azimuth 0, shape (3, ..., 28, 3 colors).
        at_azimuth_zero = (products.flatten(-2) @ polynomials).unflatten(-1, (-1, 3))
        # cos(mφ) for m ≥ 0, and sin(|m| φ) for m < 0, shape (..., 49, 1).
        orders = _ORDERS.to(azimuth)
        angles = azimuth[..., None] * orders.abs()
        rotation = torch.where(orders < 0, angles.sin(), angles.cos())[..., None]
        value, by_zenith, by_turbidity = at_azimuth_zero[..., _ROW_IN_FIT, :] * rotation
        by_azimuth = -orders[:, None] * value[..., _MIRRORED, :]
        ctx.save_for_backward(by_zenith, by_azimuth, by_turbidity)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the gradients by the zenith angle, the azimuth and the turbidity.

        Args:
            ctx: Context of autograd.
            upstream: Gradient by the coefficients, shape (..., 49, 3).

        Returns:
            Gradients by the three parameters, shape (...) each, and None for the
            polynomials.
        """
        by_zenith, by_azimuth, by_turbidity = (
            (upstream * partial).sum((-2, -1)) for partial in ctx.saved_tensors
        )
        return by_zenith, by_azimuth, by_turbidity, None


@cache
def _library_fit() -> Tensor:
    """Load the polynomials of the sky that come with the library.

    Returns:
        Coefficients of the products of Chebyshev polynomials in the zenith angle
        (axis 0) and in 1 / turbidity (axis 1), for the 28 SH coefficients with
        order m ≥ 0 (axis 2) and three colors (axis 3).
    """
    return load_file(Path(__file__).with_name("skylight_fit.safetensors"))["fit"]


def _as_parameters(
    zenith: Tensor | float, azimuth: Tensor | float, turbidity: Tensor | float
) -> list[Tensor]:
    """Check the parameters of a sky, and convert them to tensors.

    The tensors get the dtype and the device of the first floating-point tensor
    among turbidity, zenith and azimuth. Without such a tensor, they are float64.
    Angles are converted to radians before they are rounded to this dtype.

    Args:
        zenith: Zenith angle of the sun in degrees.
        azimuth: Azimuth of the sun in degrees.
        turbidity: Turbidity.

    Returns:
        Zenith angle and azimuth in radians, and turbidity, in the shapes of the
        arguments.

    Raises:
        InputError: If a value is no number or tensor, not finite, or out of
            range.
    """
    value_by_name = {"zenith": zenith, "azimuth": azimuth, "turbidity": turbidity}
    for name, value in value_by_name.items():
        if not is_number(value):
            # `as_tensor` raises InputError if the value is no tensor.
            as_tensor(name, value)
    floating = [value for value in (turbidity, zenith, azimuth) if _is_floating(value)]
    like = floating[0] if floating else torch.zeros((), dtype=torch.float64)
    turbidity_tensor = torch.as_tensor(turbidity, dtype=like.dtype, device=like.device)
    degrees = []
    for angle in (zenith, azimuth):
        dtype = angle.dtype if _is_floating(angle) else torch.float64
        degrees.append(torch.as_tensor(angle, dtype=dtype, device=like.device))
    zenith_degrees, azimuth_degrees = degrees
    require_finite(azimuth=azimuth_degrees)
    expected = "0 to 90 degrees, with the sun above the horizon"
    _require_in_domain("zenith", zenith_degrees.to(like.dtype), ZENITH, expected)
    _require_in_domain("turbidity", turbidity_tensor, TURBIDITY, "2 to 10")
    radians = [torch.deg2rad(angle).to(like.dtype) for angle in degrees]
    return [*radians, turbidity_tensor]


def _is_floating(value: object) -> TypeGuard[Tensor]:
    """Tell whether a value is a tensor of floating-point numbers."""
    return isinstance(value, Tensor) and value.is_floating_point()


def _require_in_domain(
    name: str, value: Tensor, limits: tuple[float, float], description: str
) -> None:
    """Check that all entries of a parameter are within limits, up to rounding.

    Args:
        name: Name of the parameter, for the error.
        value: Values of the parameter, any shape.
        limits: Smallest and largest value.
        description: Description of the range, for the error.

    Raises:
        InputError: If an entry is outside of the limits, or NaN.
    """
    low, high = limits
    rounding = 4 * torch.finfo(value.dtype).eps
    # Both comparisons are False for NaN, so NaN counts as outside.
    is_outside = ~((value >= low * (1 - rounding)) & (value <= high * (1 + rounding)))
    if is_outside.any():
        first = value[is_outside][0].item()
        raise InputError(
            f"{name}={first:.9g} is outside of the range of the sky model: give {description}"
        )


def _chebyshev(x: Tensor, slope: Tensor | float, count: int) -> tuple[Tensor, Tensor]:
    """Evaluate Chebyshev polynomials of a variable, and their derivatives by a parameter.

    Args:
        x: Variable, in [-1, 1], shape (...).
        slope: Derivative of the variable by the parameter, shape (...) or a
            number.
        count: Number of polynomials.

    Returns:
        Values and derivatives of the polynomials T_0 to T_(count - 1),
        shape (..., count) each.
    """
    # The recurrence is T_(k + 1) = 2 x T_k - T_(k - 1). Its derivative follows from the
    # product rule.
    values = [torch.ones_like(x), x]
    derivatives = [torch.zeros_like(x), torch.ones_like(x) * slope]
    for _ in range(2, count):
        derivatives.append(2 * (slope * values[-1] + x * derivatives[-1]) - derivatives[-2])
        values.append(2 * x * values[-1] - values[-2])
    return torch.stack(values[:count], dim=-1), torch.stack(derivatives[:count], dim=-1)
