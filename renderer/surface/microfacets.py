"""Glossy reflection by microfacets: GGX (Walter et al. 2007), Smith's masking and Fresnel's term.

With the half vector h between the directions to the light l and to the camera v, and α = roughness²,

    f = F D G / (4 (n·l)(n·v)),    D = α² / (π ((n·h)² (α² - 1) + 1)²),

and G is the product of 2 (n·x) / ((n·x) + √(α² + (1 - α²) (n·x)²)) over x = l and v, as in glTF 2.0 and Mitsuba. F of
a dielectric is Fresnel's of the refractive index 1.5; of a metal, Schlick's F0 + (F90 - F0) (1 - v·h)⁵. Both are linear
in few numbers of the surface, and so is all reflected light (the split sum of Karis 2013).

Of environment light a surface reflects ∫ L f (n·l) dl, linear in the light's coefficients U. Seen from v, the lobe
f (n·l) is symmetric about the plane of n and v. In harmonics about the axis v, where n has polar angle θ and azimuth φ,

    ∫ L f (n·l) dl = Σ_l Σ_m≥0 c_lm(cos θ, α) sin^m θ (U_lm cos mφ + U_l-m sin mφ).

The functions c are polynomials, found once by quadrature. So the harmonics of the lobe cost one small product of
matrices and K multiplications for each sample. Under perspective, v is not the same for all samples of a view: the
lobes are then turned to a common axis (`turned`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from renderer.light.environment import FEWEST_ROWS, to_map
from renderer.light.harmonics import bands, lambertian_factors, per_degree, rotate, select_rows
from renderer.light.window import best_window
from renderer.settings import MAX_DEGREE, MIN_ROUGHNESS
from renderer.vectors import unit

AMPLITUDE = 0.1  # of a highlight, that the band of a light's degree may have
NARROWER = 0.7  # times α, of the lobe whose highlights must not ring
IRRADIANCE = 10.0  # weight of irradiance beside that of highlights, in the choice of a window
SMALLEST = 1e-4  # amplitude of a band in `_spectrum`, which is divided by
NEGLIGIBLE = 1e-3  # amplitude of bands that tables leave out
INDEX = 1.5  # of refraction, as of varnish
SCHLICK, EDGE, DIELECTRIC = range(3)  # F0 = 1 and F90 = 0; F0 = 0 and F90 = 1; Fresnel's of INDEX
USUAL = 6  # degree: lower ones take the first functions of its table
NODES = 12  # Chebyshev's, in the roughness; in the cosine 2 degree + 4, since mirrors turn by twice the angle
AT_ONCE = 16  # cosines, in the quadrature of lobes: bounds the memory
QUADRATURE = (32, 24)  # half vectors: by their distribution, and by azimuth on one side of the plane


def reflectance(normals: Tensor, toward: Tensor, directions: Tensor, roughness: Tensor) -> Tensor:
    """π f (3, ...) with the terms SCHLICK, EDGE and DIELECTRIC: radiance per irradiance, as diffuse surfaces have
    albedo.

    normals, toward, directions: (..., 3) unit, the latter two to the camera and to the light. roughness: (...).
    Differentiable. Where a normal faces away from the camera, n·v counts as 0.
    """
    half = unit((toward + directions).movedim(-1, 0)).movedim(0, -1)
    squared, cosine = roughness**4, (half * normals).sum(-1)
    value = squared / (cosine**2 * (squared - 1) + 1) ** 2
    for direction in (toward, directions):
        along = (direction * normals).sum(-1).clamp(min=0)
        value = value / (along + (squared + (1 - squared) * along**2).sqrt())
    return torch.stack([value * term for term in fresnel((half * toward).sum(-1).clamp(0, 1))])


def fresnel(cosine: Tensor) -> Tensor:
    """F (3, ...): SCHLICK, EDGE and DIELECTRIC, by the cosine v·h (...)."""
    refracted = (INDEX**2 - 1 + cosine**2).sqrt()
    perpendicular = (refracted - cosine) / (refracted + cosine)
    parallel = perpendicular * (cosine * (refracted + cosine) - 1) / (cosine * (refracted - cosine) + 1)
    edge = (1 - cosine) ** 5
    return torch.stack([1 - edge, edge, (perpendicular**2 + parallel**2) / 2])


class ViewFrame(NamedTuple):
    """Axes of a view and of its S samples; the third of a sample's is the direction to the camera.

    normals: (3, S), along the axes of the sample. tilt: (4, S), sine and cosine of the angle about y and then of that
    about x that turn the view's axes into the sample's; None where all samples have the view's. axis: sine and cosine
    of polar angle and azimuth of the view's third axis in the world.
    """

    normals: Tensor
    tilt: Tensor | None
    axis: Tensor

    @staticmethod
    def of(normals: Tensor, toward: Tensor) -> ViewFrame:
        """Of unit normals (S, 3) and directions to the camera (S, 3), or (1, 3) of all. Differentiable in both."""
        x, y, z = unit(toward.detach().mean(0))
        across = torch.hypot(x, y)
        azimuth = torch.atan2(y, x)
        axis = torch.stack([across, z, azimuth.sin(), azimuth.cos()])
        inward = _in_view(normals, axis)
        if len(toward) == 1 and not toward.requires_grad:
            return ViewFrame(torch.stack(inward), None, axis)
        (x, y, z), (ahead_x, ahead_y, ahead_z) = inward, _in_view(toward, axis)
        cosine = (1 - ahead_x**2).sqrt()
        tilt = torch.stack([ahead_x, cosine, -ahead_y / cosine, ahead_z / cosine])
        y, z = _turned(y, z, -tilt[2], tilt[3])
        z, x = _turned(z, x, -tilt[0], tilt[1])
        return ViewFrame(torch.stack([x, y, z]), tilt, axis)

    @property
    def cosine(self) -> Tensor:
        """n·v (S,), taken for 0 below."""
        return self.normals[2].clamp(0, 1)

    def harmonics(self, lobes: Tensor) -> Tensor:
        """(K, S) coefficients of lobes (M, S), as of `lobe_functions`, for light in the view's axes (`to_world`)."""
        degree = (math.isqrt(8 * len(lobes) + 1) - 3) // 2
        function, m = (index.to(lobes.device) for index in _functions(degree))
        rows = lobes.index_select(0, function) * _circular(self.normals[0], self.normals[1], degree).index_select(
            0, degree + m
        )
        if self.tilt is None:
            return rows
        cycle, (sine_y, cosine_y, sine_x, cosine_x) = _cycle(degree), self.tilt
        rows = _about_z(_by_band(cycle, rows), sine_y, cosine_y)
        return _about_z(_by_band(cycle, rows), sine_x, cosine_x)

    def to_world(self, rows: Tensor) -> Tensor:
        """Turn coefficients (K, P) along the axes of `harmonics` into those along the world's axes."""
        cycle = _cycle(math.isqrt(len(rows)) - 1)
        if self.tilt is not None:
            rows = _by_band(cycle, rows)
        sine, cosine, *azimuth = self.axis[:, None].to(rows)
        rows = _about_z(_by_band(cycle, rows), sine, cosine)
        return _about_z(_by_band(cycle.T, rows), *azimuth)

    def from_world(self, rows: Tensor) -> Tensor:
        """Turn coefficients (K, P) along the world's axes into those along the axes of `harmonics`."""
        cycle = _cycle(math.isqrt(len(rows)) - 1)
        sine, cosine, sine_azimuth, cosine_azimuth = self.axis[:, None].to(rows)
        rows = _by_band(cycle, _about_z(rows, -sine_azimuth, cosine_azimuth))
        rows = _by_band(cycle.T, _about_z(rows, -sine, cosine))
        return rows if self.tilt is None else _by_band(cycle.T, rows)


def lobe_functions(cosine: Tensor, roughness: Tensor, degree: int, terms: Sequence[int]) -> Tensor:
    """π c (T, M, S) for each of T terms: of the functions c_lm with 0 ≤ m ≤ l, in ascending order of l and then m.

    cosine: n·v (S,). roughness: (S,) or (1,), at least MIN_ROUGHNESS. Differentiable.
    """
    functions = (degree + 1) * (degree + 2) // 2
    if degree > USUAL and len(roughness) == 1 and not roughness.requires_grad:
        of_roughness = _table_at(degree, float(roughness)).to(cosine)[list(terms)]
        return of_roughness @ _across(cosine, of_roughness.shape[-1])
    table = _table(max(degree, USUAL)).to(cosine)[list(terms), :functions]
    across = _across(cosine, table.shape[-1])
    of_roughness = along(roughness)
    if len(roughness) == 1:
        return torch.einsum("tmrc,r->tmc", table, of_roughness[:, 0]) @ across
    return table.flatten(2) @ (of_roughness[:, None] * across).flatten(0, 1)


def coat_albedo(cosine: Tensor, roughness: Tensor) -> Tensor:
    """Compute E(μ), the fraction of a beam that a dielectric coat reflects into all directions.

    The coat is reciprocal, so E is also the fraction of an even sky that a camera sees in the coat. Differentiable.

    Args:
        cosine: Cosine μ between normal and direction, in [0, 1], any shape.
        roughness: Roughness of the same shape, or (1,), at least `MIN_ROUGHNESS`.

    Returns:
        E, in [0, 1], of the shape of `cosine`.
    """
    table = _coat_table().to(cosine)
    across = _across(cosine.flatten(), table.shape[1])
    return ((table.T @ along(roughness.flatten())) * across).sum(0).view_as(cosine)


@per_degree
def coat_bands(degree: int) -> Tensor:
    """Return the zonal coefficients of E(μ) μ, the irradiance that a dielectric coat of strength 1 reflects.

    The coefficient of band l is B_l = 2π ∫ E(μ) μ P_l(μ) dμ over 0 ≤ μ ≤ 1, as π, 2π/3, π/4, ... are those of μ.
    Each B_l is a polynomial of the roughness. With U_lm of the light, the coat reflects Σ B_l U_lm Y_lm(n).

    Args:
        degree: Degree of the light.

    Returns:
        Coefficients in Chebyshev polynomials of the roughness (`along`), shape (degree + 1, NODES), float64.
    """
    node, weight = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(degree + 64))
    cosine = (node + 1) / 2
    table = _coat_table()
    reflected = table @ _across(cosine, table.shape[1]) * cosine  # (NODES, N)
    polynomials = torch.from_numpy(np.polynomial.legendre.legvander(cosine.numpy(), degree))  # (N, degree + 1)
    return math.pi * (polynomials.T * weight) @ reflected.T


def coat_mean(roughness: Tensor) -> Tensor:
    """Compute E_avg = 2 ∫ E(μ) μ dμ, which a dielectric coat reflects of an even sky on average. Differentiable.

    Args:
        roughness: Roughness, shape (S,), at least `MIN_ROUGHNESS`.

    Returns:
        E_avg, in [0, 1], shape (S,).
    """
    return (coat_bands(0).to(roughness) @ along(roughness))[0] / math.pi


def along(roughness: Tensor) -> Tensor:
    """Compute the Chebyshev polynomials of roughness (S,), shape (NODES, S). Differentiable."""
    return _chebyshev((2 * roughness - 1 - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS), NODES)


@cache
def degree_for(roughness: float, amplitude: float = AMPLITUDE) -> int:
    """Find the least degree above which no band has more than a fraction of a highlight's amplitude.

    Args:
        roughness: Roughness of the smoothest surface; less than `MIN_ROUGHNESS` is taken for it.
        amplitude: Fraction of the amplitude of the band 0, of a mirror's lobe seen head-on.

    Returns:
        The degree, at most `MAX_DEGREE`.
    """
    spectrum = _spectrum(max(roughness, MIN_ROUGHNESS), MAX_DEGREE)
    return int(np.count_nonzero(spectrum[1:] > amplitude))


def window_without_ringing(coefficients: Tensor, roughness: float) -> Tensor:
    """Find a window under which highlights of a map's light do not ring.

    A cut-off map rings where it is concentrated, so that its highlights have dark rings around them, or are negative.
    Of no window, the window for the surface's own lobe and the window for a lobe that is `NARROWER`, this is the first
    under which the narrower lobe shows nowhere negative radiance. Lobes are narrower at grazing angles.

    Args:
        coefficients: Those of the map, shape ((degree + 1)², C).
        roughness: Roughness of the smoothest surface; less than `MIN_ROUGHNESS` is taken for it.

    Returns:
        Factors of the coefficients, shape ((degree + 1)²,), float64, 1 for the first.
    """
    degree = math.isqrt(len(coefficients)) - 1
    lobe = torch.from_numpy(_spectrum(max(roughness, MIN_ROUGHNESS) * math.sqrt(NARROWER), degree))[bands(degree)]
    window = torch.ones(len(coefficients), dtype=torch.float64)
    rows = max(FEWEST_ROWS, 2 * degree)
    for width in (1.0, NARROWER):
        if (to_map(coefficients * (window * lobe)[:, None], rows) >= 0).all():
            break
        window = highlight_window(degree, roughness, width)
    return window


@cache
def highlight_window(degree: int, roughness: float, width: float) -> Tensor:
    """Find the best window under which a lobe is nowhere negative (`best_window`).

    The errors of highlights and of irradiance are weighed.

    Args:
        degree: Degree of the light.
        roughness: Roughness of the smoothest surface; less than `MIN_ROUGHNESS` is taken for it.
        width: Width of the lobe relative to that surface's, as a factor of α.

    Returns:
        Factors of the coefficients, shape ((degree + 1)²,), float64, 1 for the first.
    """
    spectrum = _spectrum(max(roughness, MIN_ROUGHNESS) * math.sqrt(width), degree)
    diffuse = lambertian_factors(degree)[torch.arange(degree + 1) ** 2].numpy() / math.pi
    weight = np.hypot(spectrum, IRRADIANCE * diffuse)
    return best_window(spectrum, np.sqrt(2 * np.arange(degree + 1) + 1) * weight)


@cache
def highlight_error(degree: int, roughness: float) -> float:
    """Compute how far the highlight of a point of light is off under `highlight_window`.

    Args:
        degree: Degree of the light.
        roughness: Roughness of the surface; less than `MIN_ROUGHNESS` is taken for it.

    Returns:
        The root mean square error over that of the highlight, of a mirror's lobe seen head-on.
    """
    spectrum = _spectrum(max(roughness, MIN_ROUGHNESS), 4 * MAX_DEGREE)
    kept = np.zeros_like(spectrum)
    kept[: degree + 1] = highlight_window(degree, roughness, NARROWER)[np.arange(degree + 1) ** 2].numpy()
    power = (2 * np.arange(len(spectrum)) + 1) * spectrum**2
    return math.sqrt(float(power @ (1 - kept) ** 2 / power.sum()))


def _spectrum(roughness: float, degree: int) -> np.ndarray:
    """Compute the amplitude of each band (degree + 1,), over that of band 0, in a mirror's lobe seen head-on."""
    up = torch.tensor([[0.0, 0, 1]], dtype=torch.float64)
    node, weight = np.polynomial.legendre.leggauss(2**9 + 4 * degree)
    cosine = torch.from_numpy((node + 1) / 2)
    light = torch.stack([(1 - cosine**2).sqrt(), 0 * cosine, cosine], 1)
    lobe = reflectance(up, up, light, torch.tensor(roughness, dtype=torch.float64))[SCHLICK] * cosine
    amplitudes = (weight * lobe.numpy()) @ np.polynomial.legendre.legvander(cosine.numpy(), degree)
    return np.maximum(amplitudes / amplitudes[0], SMALLEST)


def _in_view(vectors: Tensor, axis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The components (S,) of vectors (S, 3) along the view's axes."""
    x, y, z = vectors.T
    sine, cosine, sine_azimuth, cosine_azimuth = axis.unbind()
    x, y = _turned(x, y, -sine_azimuth, cosine_azimuth)
    z, x = _turned(z, x, -sine, cosine)
    return x, y, z


def _turned(x: Tensor, y: Tensor, sine: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
    return x * cosine - y * sine, x * sine + y * cosine


@per_degree
def _functions(degree: int) -> tuple[Tensor, Tensor]:
    """(K,) of each coefficient: which of the lobe functions is its, and its order m."""
    l = bands(degree)
    m = torch.arange(len(l)) - l * (l + 1)
    return l * (l + 1) // 2 + m.abs(), m


def _circular(x: Tensor, y: Tensor, degree: int) -> Tensor:
    """(2 degree + 1, ...): Im (x + iy)^degree, ..., Im (x + iy), 1, Re (x + iy), ..., Re (x + iy)^degree."""
    rows = [torch.ones_like(x)]
    real, imaginary = x, y
    for _ in range(degree):
        rows = [imaginary, *rows, real]
        real, imaginary = _turned(real, imaginary, y, x)
    return torch.stack(rows)


def _about_z(rows: Tensor, sine: Tensor, cosine: Tensor) -> Tensor:
    """Coefficients (K, S) turned about z by an angle for each (S,), or for all (1,)."""
    degree = math.isqrt(len(rows)) - 1
    m, powers = _functions(degree)[1].to(rows.device), _circular(cosine, sine, degree)
    signed = torch.cat([-powers[:degree], 0 * powers[:1], powers[:degree].flip(0)])
    partner = torch.arange(len(m), device=rows.device) - 2 * m
    turned = rows * powers.index_select(0, degree + m.abs())
    return turned - rows.index_select(0, partner) * signed.index_select(0, degree + m)


def _by_band(matrix: Tensor, rows: Tensor) -> Tensor:
    """The product of a rotation (K, K), which mixes no bands, and coefficients (K, S)."""
    ends = [l * l for l in range(math.isqrt(len(rows)) + 1)]
    blocks = (slice(*ends[l : l + 2]) for l in range(len(ends) - 1))
    return torch.cat([matrix[band, band].to(rows) @ rows[band] for band in blocks])


@per_degree
def _cycle(degree: int) -> Tensor:
    """(K, K) float64: what turns coefficients as the rotation of x to y, y to z and z to x does."""
    return rotate(torch.eye((degree + 1) ** 2, dtype=torch.float64), torch.eye(3, dtype=torch.float64).roll(1, 0))


def _chebyshev(x: Tensor, count: int) -> Tensor:
    """(count, S): the polynomials T_0, T_1, ... at x (S,)."""
    rows = [torch.ones_like(x), x]
    for _ in range(count - 2):
        rows.append(2 * x * rows[-1] - rows[-2])
    return torch.stack(rows)


def _across(cosine: Tensor, count: int) -> Tensor:
    """Compute Chebyshev polynomials of a cosine (S,), shape (count, S), whose nodes lie closer near 0."""
    return _chebyshev(4 * cosine / (cosine + 1) - 1, count)


def _coat_table() -> Tensor:
    """Return the coefficients of E in the products of `_table`, shape (NODES, 2 USUAL + 4), float64."""
    return _table(USUAL)[DIELECTRIC, 0] * (math.sqrt(4 * math.pi) / math.pi)


@per_degree
def _table(degree: int) -> Tensor:
    """(3 terms, M functions, NODES, 2 degree + 4) float64: coefficients of π c in products of Chebyshev polynomials of
    the roughness and, the faster index, the cosine."""
    angles = math.pi * (torch.arange(NODES, dtype=torch.float64) + 0.5) / NODES
    roughness = (angles.cos() * (1 - MIN_ROUGHNESS) + 1 + MIN_ROUGHNESS) / 2
    fits = torch.stack([_fit(degree, float(value)) for value in roughness])  # (NODES, 3, M, 2 degree + 4)
    return torch.einsum("kr,rtmc->tmkc", torch.linalg.inv(_chebyshev(angles.cos(), NODES).T), fits).contiguous()


@lru_cache(maxsize=8)
@torch.inference_mode(False)
def _table_at(degree: int, roughness: float) -> Tensor:
    """(3 terms, M functions, 2 degree + 4) float64: `_table` at one roughness, in less time."""
    return _fit(degree, roughness)


def _fit(degree: int, roughness: float) -> Tensor:
    """Fit π c at one roughness in Chebyshev polynomials of the cosine, shape (3 terms, M functions, 2 degree + 4).

    Bands without amplitude at this roughness are zero.
    """
    count, shown = 2 * degree + 4, max(min(degree, USUAL), min(degree, degree_for(roughness, NEGLIGIBLE)))
    angles = math.pi * (torch.arange(3 * count // 2, dtype=torch.float64) + 0.5) / (3 * count // 2)
    x = angles.cos()
    cosines = (x + 1) / (3 - x)
    orders = torch.tensor([m for l in range(shown + 1) for m in range(l + 1)])
    of_roughness = torch.tensor(roughness, dtype=torch.float64)
    lobes = torch.cat([_lobes(some, of_roughness, shown) for some in cosines.split(AT_ONCE)], dim=2).permute(1, 2, 0)
    # Least squares with the factor sin^m θ, since near 0 the functions are quotients of small numbers.
    factors = (1 - cosines[:, None] ** 2) ** (orders[:, None, None] / 2) * _chebyshev(x, count).T
    fits = torch.linalg.lstsq(factors, lobes, rcond=1e-9, driver="gelsd").solution.permute(2, 0, 1)  # (3, M, count)
    return torch.nn.functional.pad(fits, (0, 0, 0, (degree + 1) * (degree + 2) // 2 - len(orders)))


def _lobes(cosines: Tensor, roughness: Tensor, degree: int) -> Tensor:
    """Compute π c_lm sin^m θ at N cosines, shape (3 terms, M, N), by quadrature over half vectors.

    The half vectors on one side of the plane of n and v have azimuth φ and polar angle θ, tan θ = α tan ψ. Nodes are
    even in φ and Gauss-Legendre's in ψ, up to the angle at which the light comes from below the horizon.
    """
    node, weight = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(QUADRATURE[0]))
    azimuth = math.pi * (torch.arange(QUADRATURE[1], dtype=torch.float64) + 0.5) / QUADRATURE[1]
    alpha = roughness**2
    sines = (1 - cosines**2).sqrt()
    toward = torch.stack([-sines, 0 * sines, cosines], dim=1)  # (N, 3)
    steepest = (math.pi / 2 - torch.atan2(sines[:, None] * azimuth.cos(), cosines[:, None])) / 2  # (N, azimuths)
    last = (steepest.tan() / alpha).atan()[:, None]
    angle = last * (node[:, None] + 1) / 2  # ψ (N, nodes, azimuths)
    polar = (alpha * angle.tan()).atan()
    half = torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()], -1).flatten(1, 2)
    # The solid angle of a half vector is sin θ dθ dφ, and that of light is 4 (v·h) times it.
    per_angle = alpha * (polar.cos() / angle.cos()) ** 2
    measure = (last * weight[:, None] / 2 * per_angle * polar.sin()).flatten(1) * (2 * math.pi / QUADRATURE[1])
    facing = (toward[:, None] * half).sum(-1)
    light = 2 * facing[..., None] * half - toward[:, None]
    values = reflectance(half.new_tensor([[0.0, 0, 1]]), toward[:, None], light, roughness)
    values = values * light[..., 2].clamp(min=0) * measure * 4 * facing
    ahead = torch.stack([cosines, 0 * sines, sines], dim=1)  # normal to v, in its plane with n
    directions = torch.stack([(light * ahead[:, None]).sum(2), light[..., 1], (light * toward[:, None]).sum(2)])
    harmonics = torch.stack(select_rows(directions, [l * (l + 1) + m for l in range(degree + 1) for m in range(l + 1)]))
    return torch.einsum("tnq,mnq->tmn", values, harmonics)
