"""The daylight sky of Preetham, Shirley and Smits 1999 ("A Practical Analytic Model for Daylight") as distant light.

Three scalars: the sun's zenith angle and azimuth, in radians and world axes, and the turbidity of the air. The sun's
disc itself is not part of the sky. Radiance is linear Rec. 709 RGB in kcd/m²: (1, 1, 1) is white of 1000 cd/m². The
mean luminance over the sphere of a clear day's sky is about 5, where that of the probes in `presets` is about 0.1.

`coefficients_by_quadrature` is the reference and `coefficients` the fast path: polynomials, made by
scripts/fit_skylight.py and turned to the sun's azimuth (the paper's appendix "Differentiating Skylight Parameters",
after Habel et al. 2008).
"""

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.polynomial.chebyshev import chebpts1, chebvander2d
from safetensors.torch import load_file
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import InputError, require_finite
from renderer.light.harmonics import basis
from renderer.transfer import DEGREE

ZENITH = (0.0, math.pi / 2)  # from overhead to the horizon, both included
TURBIDITY = (2.0, 10.0)  # from clear to hazy; 1 would be pure air

# Preetham et al., appendix A.2: A to E of Perez's formula for Y, x and y, as slope and offset in turbidity.
_PEREZ = torch.tensor(
    [
        [(0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)],
        [(-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)],
        [(-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)],
    ],
    dtype=torch.float64,
)
# x and y overhead: a row for each of T², T, 1 and a column for each of θ³, θ², θ, 1.
_ZENITH_CHROMATICITY = torch.tensor(
    [
        [
            (0.00166, -0.00375, 0.00209, 0),
            (-0.02903, 0.06377, -0.03202, 0.00394),
            (0.11693, -0.21196, 0.06052, 0.25886),
        ],
        [
            (0.00275, -0.00610, 0.00317, 0),
            (-0.04214, 0.08970, -0.04153, 0.00516),
            (0.15346, -0.26756, 0.06670, 0.26688),
        ],
    ],
    dtype=torch.float64,
)
# IEC 61966-2-1, to its four digits.
_RGB_TO_XYZ = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
_XYZ_TO_RGB = torch.linalg.inv(torch.tensor(_RGB_TO_XYZ, dtype=torch.float64))

_BANDS_AND_ORDERS = [(l, m) for l in range(DEGREE + 1) for m in range(-l, l + 1)]
_ORDERS = torch.tensor([m for _, m in _BANDS_AND_ORDERS])
_MIRRORED = torch.tensor([l * l + l - m for l, m in _BANDS_AND_ORDERS])
_UPRIGHT = torch.tensor([l * l + l + m for l, m in _BANDS_AND_ORDERS if m >= 0])  # the 28 that are fitted
_FITTED = torch.tensor([l * (l + 1) // 2 + abs(m) for l, m in _BANDS_AND_ORDERS])  # where they are in the fit


def radiance(directions: Tensor, zenith: Tensor | float, azimuth: Tensor | float, turbidity: Tensor | float) -> Tensor:
    """Sky radiance (N, 3) float64, linear RGB in kcd/m², from unit directions (N, 3); zero below the horizon.

    zenith, azimuth, turbidity: scalars. Saturated skies leave the gamut and are not clamped: around a clear sunset blue
    falls to -2.6 % of the largest value. Differentiable; at the sun itself, where Perez's term has a cusp, the angle to
    it counts as constant, which gives the mean of the gradients around it. InputError: outside the domain.
    """
    parameters = (value.double() for value in _checked(zenith, azimuth, turbidity))
    return _radiance(directions.double(), *parameters)


def coefficients_by_quadrature(
    zenith: Tensor | float, azimuth: Tensor | float, turbidity: Tensor | float, degree: int = DEGREE, nodes: int = 48
) -> Tensor:
    """Coefficients ((degree + 1)², 3) float64 of the sky, by Gauss-Legendre quadrature over the upper hemisphere.

    zenith, azimuth, turbidity: scalars. At degree 6, 48 nodes leave an error of up to 2e-8 of the coefficients' norm
    (in the clearest air with the sun overhead; mostly 1e-9) and 24 of up to 1e-5. Differentiable: the directions stay
    while the sun moves, which leaves the derivatives off by up to 1e-5 (mostly 1e-8). InputError: outside the domain.
    """
    zenith, azimuth, turbidity = (value.double() for value in _checked(zenith, azimuth, turbidity))
    directions, solid_angles = _quadrature_around_sun(zenith.detach(), azimuth.detach(), nodes)
    sky = _radiance(directions, zenith, azimuth, turbidity)
    return basis(directions, degree).T @ (solid_angles[:, None] * sky)


def coefficients(
    zenith: Tensor | float, azimuth: Tensor | float, turbidity: Tensor | float, fit: Tensor | None = None
) -> Tensor:
    """Coefficients (..., 49, 3) of the sky, linear RGB in kcd/m², from parameters whose shapes broadcast to (...).

    Float32 or float64, as the parameters, with analytic first derivatives. Off by up to 7e-5 of the coefficients' norm
    (4e-4 where they are smallest: in haze, with the sun on the horizon). The derivatives are off by up to 0.1 % in
    zenith and azimuth and 0.5 % in turbidity, two to three times that at the domain's ends. InputError: outside it.
    fit: another one than the committed, as `fit_polynomials` returns it.

    >>> noon, evening = coefficients(0.5, 0.0, 3.0), coefficients(1.4, 0.0, 3.0)
    >>> noon.shape, bool(noon[0].sum() > evening[0].sum())  # index 0: the mean radiance
    (torch.Size([49, 3]), True)
    """
    parameters = torch.broadcast_tensors(*_checked(zenith, azimuth, turbidity))
    return _FittedSky.apply(*parameters, _committed_fit() if fit is None else fit)


def fit_polynomials(zenith_degree: int, turbidity_degree: int, nodes: int = 32) -> Tensor:
    """What `coefficients` evaluates: (zenith_degree + 1, turbidity_degree + 1, 28, 3) float64.

    Chebyshev coefficients, in the zenith and in 1/turbidity, of the sky's coefficients with m = 0..l where the sun is
    at azimuth 0; those with m < 0 vanish by symmetry. Least squares over quadratures of so many nodes at twice as many
    Chebyshev points. The model has a pole at a turbidity of 1.65: polynomials in turbidity itself, of the paper's
    degrees 13 and 7, are off by up to 4 %, those in its inverse by 0.15 %. Monomials would lose float32's digits.
    """
    degrees = zenith_degree, turbidity_degree
    x, y = (each.ravel() for each in np.meshgrid(*(chebpts1(2 * (degree + 1)) for degree in degrees)))
    positions = zip(math.pi / 4 * (x + 1), 5 / (y + 1.5), strict=True)  # undone by `_FittedSky`
    skies = [
        coefficients_by_quadrature(zenith, 0.0, turbidity, nodes=nodes)[_UPRIGHT] for zenith, turbidity in positions
    ]
    fit = np.linalg.lstsq(chebvander2d(x, y, degrees), torch.stack(skies).flatten(1).numpy())[0]
    return torch.from_numpy(fit).view(zenith_degree + 1, turbidity_degree + 1, *skies[0].shape)


def fit_error(fit: Tensor, skies: int, generator: torch.Generator) -> float:
    """The largest error of a fit on random skies, relative to the L2 norm of each one's coefficients by quadrature."""
    parameters = torch.rand(3, skies, generator=generator, dtype=torch.float64)
    zeniths, azimuths = ZENITH[1] * parameters[0], 2 * math.pi * parameters[1]
    turbidities = TURBIDITY[0] + (TURBIDITY[1] - TURBIDITY[0]) * parameters[2]
    exact = torch.stack([coefficients_by_quadrature(*sky) for sky in zip(zeniths, azimuths, turbidities, strict=True)])
    errors = coefficients(zeniths, azimuths, turbidities, fit) - exact
    return float((errors.flatten(1).norm(dim=1) / exact.flatten(1).norm(dim=1)).max())


class _FittedSky(torch.autograd.Function):
    """Polynomials turned about z by the azimuth φ: U_lm = Ũ_lm cos(mφ), U_l,-m = Ũ_lm sin(mφ) for m ≥ 0.

    The paper prints the rotation by -φ, and ∂U/∂θ without the power of turbidity in its second sum.
    """

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


def _radiance(directions: Tensor, zenith: Tensor, azimuth: Tensor, turbidity: Tensor) -> Tensor:
    height, angle = directions[:, 2], _angle(directions, _polar(zenith, azimuth))
    scale = _zenith_values(zenith, turbidity) / _perez(torch.ones_like(zenith), zenith, turbidity)
    # 1/cos overflows at the horizon; from a cosine of 1e-3 on, its exponential is below 1e-57.
    luminance, x, y = scale[:, None] * _perez(height.clamp(min=1e-3), angle, turbidity)
    xyz = torch.stack([x, y, 1 - x - y], dim=-1) * (luminance / y)[:, None]
    return torch.where(height[:, None] >= 0, xyz @ _XYZ_TO_RGB.T.to(xyz), 0.0)


def _polar(zenith: Tensor, azimuth: Tensor) -> Tensor:
    """The unit vector (3,) at a polar angle off +z and an azimuth off +x."""
    return torch.stack([zenith.sin() * azimuth.cos(), zenith.sin() * azimuth.sin(), zenith.cos()])


def _angle(a: Tensor, b: Tensor) -> Tensor:
    """The angle between unit vectors, accurate and with finite derivatives at 0 and π too, unlike the arccosine."""
    return 2 * torch.atan2((a - b).norm(dim=-1), (a + b).norm(dim=-1))


def _perez(cosine: Tensor, angle: Tensor, turbidity: Tensor) -> Tensor:
    """Perez's distribution of Y, x, y (3, ...), up to a factor, from the zenith angle's cosine and the angle to the
    sun, each (...)."""
    slope, offset = _PEREZ.to(turbidity).unbind(-1)
    a, b, c, d, e = (slope * turbidity + offset).T.reshape(5, 3, *[1] * angle.ndim)
    return (1 + a * (b / cosine).exp()) * (1 + c * (d * angle).exp() + e * angle.cos() ** 2)


def _zenith_values(zenith: Tensor, turbidity: Tensor) -> Tensor:
    """Y in kcd/m², x and y (3,) of the sky overhead."""
    chi = (4 / 9 - turbidity / 120) * (math.pi - 2 * zenith)
    luminance = (4.0453 * turbidity - 4.9710) * chi.tan() - 0.2155 * turbidity + 2.4192
    turbidity_powers = torch.stack([turbidity**2, turbidity, torch.ones_like(turbidity)])
    zenith_powers = torch.stack([zenith**3, zenith**2, zenith, torch.ones_like(zenith)])
    return torch.cat([luminance[None], turbidity_powers @ _ZENITH_CHROMATICITY.to(zenith) @ zenith_powers])


def _quadrature_around_sun(zenith: Tensor, azimuth: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """Directions (4 nodes², 3) above the horizon and their solid angles (4 nodes²,).

    In polar coordinates around the sun, so that the cusp there is an end of the integration: whole circles until they
    touch the horizon, and from there arcs above it, at angles π/2 - zenith cos t, in which their length is smooth.
    """
    zenith = zenith.clamp(min=1e-8)  # overhead there are no arcs, and the ratio of the tangents is 0/0
    u, weights = _gauss_legendre(nodes, zenith)
    t, nearest = math.pi * u, math.pi / 2 - zenith
    angles = torch.cat([nearest * u, math.pi / 2 - zenith * t.cos()])
    steps = torch.cat([nearest * weights, zenith * t.sin() * math.pi * weights])
    half_arcs = torch.cat([torch.full_like(t, math.pi), (-(zenith * t.cos()).tan() / zenith.tan()).acos()])

    u, weights = _gauss_legendre(2 * nodes, zenith)
    bearings = half_arcs[:, None] * (2 * u - 1)  # 0 is up
    solid_angles = (angles.sin() * steps * 2 * half_arcs)[:, None] * weights

    sun, up = _polar(zenith, azimuth), _polar(zenith - math.pi / 2, azimuth)
    around = bearings.cos()[..., None] * up + bearings.sin()[..., None] * torch.linalg.cross(sun, up)
    directions = angles.cos()[:, None, None] * sun + angles.sin()[:, None, None] * around
    return directions.flatten(0, 1), solid_angles.flatten()


def _gauss_legendre(nodes: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes and weights (nodes,) on [0, 1]."""
    node, weight = (torch.from_numpy(array).to(like) for array in np.polynomial.legendre.leggauss(nodes))
    return (node + 1) / 2, weight / 2


def _chebyshev(x: Tensor, slope: Tensor | float, count: int) -> tuple[Tensor, Tensor]:
    """Chebyshev polynomials (..., count) at x (...), and their derivatives by what x has this slope in."""
    values, derivatives = [torch.ones_like(x), x], [torch.zeros_like(x), torch.ones_like(x) * slope]
    for _ in range(2, count):
        derivatives.append(2 * (slope * values[-1] + x * derivatives[-1]) - derivatives[-2])
        values.append(2 * x * values[-1] - values[-2])
    return torch.stack(values[:count], dim=-1), torch.stack(derivatives[:count], dim=-1)
