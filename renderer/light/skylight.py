"""Environment light of the daylight sky of Preetham, Shirley and Smits.

The source is "A Practical Analytic Model for Daylight" (1999). The sky has three
parameters: the zenith angle and the azimuth of the sun in degrees, in world axes,
and the turbidity (haziness) of the air. The disc of the sun is not part of the
sky.

Radiance is linear Rec. 709 RGB in kcd/m²: (1, 1, 1) is white of 1000 cd/m². The
mean luminance of a clear day's sky over the sphere is about 5. That of the
probes of `load_light` is about 0.1.

The SH coefficients of a sky with the sun at azimuth 0 are polynomials in the
zenith angle and in 1 / turbidity, which were fitted once by
tests/renderer/fit_skylight.py. This module evaluates them and rotates them to
the azimuth of the sun. See the paper's appendix "Differentiating Skylight
Parameters", after Habel et al. 2008.
"""

import math
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor

from renderer.errors import InputError, as_tensor, require, require_finite
from renderer.light.basis import HARMONICS
from renderer.light.harmonics import rows_and_orders
from renderer.modes import once_differentiable, without_autocast
from renderer.settings import TURBIDITY

# Smallest and largest zenith angle of the sun in degrees: from overhead to the horizon.
ZENITH = (0.0, 90.0)

# Index of the polynomial of each of the 49 SH coefficients in the fitted sky, and their orders m.
# The orders m and -m have the same polynomial.
_ROW_IN_FIT, _ORDERS = rows_and_orders(HARMONICS.degree)
# Index of the coefficient of order -m, for each coefficient of order m.
_OPPOSITE_ORDER = torch.arange(len(_ORDERS)) - 2 * _ORDERS


@without_autocast
def coefficients(
    zenith: Tensor | float,
    azimuth: Tensor | float,
    turbidity: Tensor | float,
    fit: Tensor | None = None,
) -> Tensor:
    """Compute the SH coefficients of a daylight sky (Preetham et al. 1999).

    The coefficients are polynomials that were fitted to the sky model. Their
    error is at most 7e-5 of their norm. It is at most 4e-4 if the sun is on the
    horizon and the air is hazy, where the coefficients are smallest.

    The result is differentiable once with respect to the three parameters. The
    error of the derivatives is at most 0.1 % for the angles and 0.5 % for the
    turbidity, and two to three times as large at the limits of a parameter.

    Args:
        zenith: Zenith angle of the sun in degrees, from 0 to 90. The shapes of
            the three parameters broadcast to (...).
        azimuth: Azimuth of the sun in degrees, measured from +x toward +y.
        turbidity: Haziness of the air, from 2 (clear) to 10 (haze).
        fit: Coefficients of the polynomials, as tests/renderer/fit_skylight.py
            writes them. None for the coefficients that come with the library.

    Returns:
        SH coefficients of degree 6, shape (..., 49, 3), linear RGB in kcd/m². The
        dtype is the one of the turbidity. If the turbidity is a number, it is the
        dtype of the angles, or float64 if these are numbers, too.

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
    """SH coefficients of the sky, differentiable with respect to the three parameters.

    Polynomials give the coefficients Ũ of a sky with the sun at azimuth 0. For the
    azimuth φ, the coefficients are U_lm = Ũ_lm cos(mφ) and U_l,-m = Ũ_lm sin(mφ)
    for m ≥ 0. (Liu et al. 2019 print the rotation by -φ instead of φ, and leave
    out a power of the turbidity in the second sum of ∂U/∂θ.)
    """

    @staticmethod
    def forward(
        ctx: Any, zenith: Float[Tensor, " ..."], azimuth: Tensor, turbidity: Tensor, fit: Tensor
    ) -> Float[Tensor, "... 49 3"]:
        """Compute the SH coefficients of the sky, and save their derivatives in `ctx`.

        Angles are in radians. `fit` has the polynomials of the zenith angle (axis 0) and of
        1 / turbidity (axis 1).
        """
        # The zenith angle from 0 to π/2 is mapped to the domain [-1, 1] of the polynomials.
        zenith_values, zenith_slopes = _chebyshev(4 / math.pi * zenith - 1, 4 / math.pi, len(fit))
        # 1 / turbidity from 1/10 to 1/2 is mapped to the domain [-1, 1], too.
        haze_values, haze_slopes = _chebyshev(5 / turbidity - 1.5, -5 / turbidity**2, fit.shape[1])
        # Factors of the sky, of its derivative with respect to the zenith angle, and of
        # its derivative with respect to the turbidity, along the first axis.
        zenith_factors = torch.stack([zenith_values, zenith_slopes, zenith_values])
        turbidity_factors = torch.stack([haze_values, haze_values, haze_slopes])
        # Each product of two polynomials, with the axes: sky and its two derivatives, shape of the
        # parameters, polynomial of the zenith angle, polynomial of 1 / turbidity.
        products = zenith_factors[..., :, None] * turbidity_factors[..., None, :]
        polynomials = fit.to(products, non_blocking=True).flatten(2).flatten(0, 1)
        # Coefficients with m ≥ 0 for a sun at azimuth 0, with the axes: sky and its two
        # derivatives, shape of the parameters, 28 coefficients, 3 colors.
        at_azimuth_zero = (products.flatten(-2) @ polynomials).unflatten(-1, (-1, 3))
        indices = _ROW_IN_FIT, _ORDERS, _OPPOSITE_ORDER
        rows, orders, opposite = (ids.to(azimuth.device, non_blocking=True) for ids in indices)
        angles = azimuth[..., None] * orders.abs()
        # cos(mφ) for m ≥ 0, and sin(|m| φ) for m < 0, shape (..., 49, 1).
        rotation = torch.where(orders < 0, angles.sin(), angles.cos())[..., None]
        value, by_zenith, by_turbidity = at_azimuth_zero[..., rows, :] * rotation
        # The derivative of cos mφ is -m sin mφ, which belongs to the harmonic of order -m.
        by_azimuth = -orders[:, None] * value[..., opposite, :]
        ctx.save_for_backward(by_zenith, by_azimuth, by_turbidity)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Float[Tensor, "... 49 3"]) -> tuple[Tensor | None, ...]:
        """Compute the gradients with respect to the three parameters of the sky."""
        gradients = [(upstream * partial).sum((-2, -1)) for partial in ctx.saved_tensors]
        return *gradients, None


@cache
def _library_fit() -> Tensor:
    """Load the polynomials of the sky that come with the library.

    Each SH coefficient of a sky with the sun at azimuth 0 is a sum of products of two Chebyshev
    polynomials, one of the zenith angle and one of 1 / turbidity. The axes are: polynomial of the
    zenith angle, polynomial of 1 / turbidity, 28 SH coefficients with order m ≥ 0, color.
    """
    return load_file(Path(__file__).with_name("skylight_fit.safetensors"))["fit"]


def _as_parameters(
    zenith: Tensor | float, azimuth: Tensor | float, turbidity: Tensor | float
) -> list[Tensor]:
    """Convert the parameters of a sky to tensors, and degrees to radians before rounding.

    The dtype and the device are those of the first floating-point tensor among turbidity, zenith
    and azimuth, or else float64.
    """
    parameters = {"turbidity": turbidity, "zenith": zenith, "azimuth": azimuth}
    floating = [v for v in parameters.values() if isinstance(v, Tensor) and v.is_floating_point()]
    # Tensor that gives the dtype and the device of the results.
    like = floating[0] if floating else torch.zeros((), dtype=torch.float64)
    tensors = {}
    for name, value in parameters.items():
        # `as_tensor` raises InputError if the value is no tensor, but rounds Python numbers.
        as_tensor(name, value)
        dtype = None if any(value is tensor for tensor in floating) else torch.float64
        tensors[name] = torch.as_tensor(value, dtype=dtype, device=like.device)
    require_finite(azimuth=tensors["azimuth"])
    ranges = {
        "zenith": (*ZENITH, "0 to 90 degrees, with the sun above the horizon"),
        "turbidity": (*TURBIDITY, "2 to 10"),
    }
    # A value at a limit may lie outside of it after rounding, and still counts as inside.
    rounding = 4 * torch.finfo(like.dtype).eps
    for name, (low, high, expected) in ranges.items():
        value = tensors[name].to(like.dtype)
        # Both comparisons are False for NaN, so NaN counts as outside.
        is_inside = (value >= low * (1 - rounding)) & (value <= high * (1 + rounding))
        require(is_inside.all(), partial(_range_error, name, expected, value, is_inside))
    angles = (torch.deg2rad(tensors[name]).to(like.dtype) for name in ("zenith", "azimuth"))
    return [*angles, tensors["turbidity"].to(like.dtype)]


def _range_error(name: str, expected: str, value: Tensor, is_inside: Tensor) -> InputError:
    """Return the error that names the first value that is not inside the range."""
    first = value[~is_inside][0].item()
    return InputError(f"{name}={first:.9g} is out of the sky model's range: give {expected}")


def _chebyshev(x: Tensor, slope: Tensor | float, count: int) -> tuple[Tensor, Tensor]:
    """Evaluate Chebyshev polynomials of x(p), and their derivatives with respect to p.

    `slope` is the derivative of x with respect to p. Axis -1 of the results is for T_0 to
    T_(count - 1).
    """
    # The recurrence is T_(k + 1) = 2 x T_k - T_(k - 1). Its derivative follows from the
    # product rule.
    values = [torch.ones_like(x), x]
    derivatives = [torch.zeros_like(x), torch.ones_like(x) * slope]
    for _ in range(2, count):
        derivatives.append(2 * (slope * values[-1] + x * derivatives[-1]) - derivatives[-2])
        values.append(2 * x * values[-1] - values[-2])
    return torch.stack(values[:count], dim=-1), torch.stack(derivatives[:count], dim=-1)
