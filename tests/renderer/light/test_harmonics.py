import itertools
import math

import numpy as np
import pytest
import torch
from oracles import draw, random_directions, real_harmonics, scipy_basis
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre, gamma, sph_harm_y_all, spherical_in

from renderer.light.harmonics import (
    MAX_DEGREE,
    basis,
    irradiance_basis,
    lambertian_factors,
    nonzero_coefficients,
    project,
    quadrature,
    rotate,
)
from renderer.shading import irradiance

EPS = np.finfo(np.float64).eps
every_degree = pytest.mark.parametrize("degree", [0, 1, 2, 6, 13, MAX_DEGREE])
EQUATOR = [[1.0, 0.0, 0.0], [-1.0, 0.0, -0.0], [-0.0, 1.0, 0.0], [0.0, -1.0, -0.0], [-0.6, 0.8, 0.0], [-1.0, -0.0, 0.0]]
POLES = [[0.0, 0.0, 1.0], [-0.0, 0.0, 1.0], [0.0, -0.0, -1.0], [-0.0, -0.0, -1.0]]


def gradient_of_basis(directions: torch.Tensor, degree: int) -> np.ndarray:
    """(N, K, 3) by autograd, with a copy of the directions for each harmonic."""
    copies = directions.expand((degree + 1) ** 2, -1, -1).clone().requires_grad_()
    (gradient,) = torch.autograd.grad(basis(copies, degree).diagonal(dim1=0, dim2=2).sum(), copies)
    return gradient.transpose(0, 1).numpy()


def scipy_gradient(directions: torch.Tensor, degree: int) -> np.ndarray:
    """(N, K, 3) scipy's derivatives by the polar angles times the angles' by the vector (the paper's appendix D), away
    from the poles."""
    x, y, z = directions.numpy().T
    rho = np.hypot(x, y)
    by_angle = sph_harm_y_all(degree, degree, np.arctan2(rho, z), np.arctan2(y, x), diff_n=1)[1]
    polar = np.stack([x * z, y * z, -(rho**2)]) / (rho * (rho**2 + z**2))
    azimuth = np.stack([-y, x, 0 * x]) / rho**2
    slopes = by_angle[..., 0, None] * polar.T + by_angle[..., 1, None] * azimuth.T
    return real_harmonics(slopes).swapaxes(0, 1)


def steepest(degree: int) -> np.ndarray:
    """The largest derivative in the band of each coefficient: that of m = ±1 at the poles; 26 in band 20."""
    l = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    return np.sqrt(l * (l + 1) * (2 * l + 1) / (8 * np.pi))


@every_degree
def test_the_basis_is_scipys_without_the_condon_shortley_sign(degree):
    directions = torch.cat([random_directions(200), torch.tensor(POLES + EQUATOR, dtype=torch.float64)])
    np.testing.assert_allclose(basis(directions, degree).numpy(), scipy_basis(directions, degree), rtol=0, atol=1e-13)


@pytest.mark.parametrize("degree", [1, 2, 6, MAX_DEGREE])
def test_the_gradient_is_scipys_through_the_polar_angles(degree):
    """To 1e-13 of the band's steepest; the angles themselves lose 1 / sin θ of that towards the poles."""
    directions = torch.cat([random_directions(20), torch.tensor(EQUATOR, dtype=torch.float64)])
    error = gradient_of_basis(directions, degree) - scipy_gradient(directions, degree)
    sine = np.hypot(*directions.numpy().T[:2])[:, None, None]
    assert (np.abs(error) * sine <= 1e-13 * steepest(degree)[:, None]).all()


def test_at_the_poles_only_m_1_has_a_gradient():
    """sin θ e^(imφ) is x + iy for m = 1 and of higher order for others; P_l¹ / sin θ is l (l + 1) / 2 at the pole."""
    gradient = gradient_of_basis(torch.tensor(POLES, dtype=torch.float64), MAX_DEGREE)
    degrees = np.arange(1, MAX_DEGREE + 1)
    expected = np.zeros_like(gradient)
    for m, axis in ((1, 0), (-1, 1)):
        expected[:, degrees**2 + degrees + m, axis] = steepest(MAX_DEGREE)[degrees**2]
        expected[2:, degrees**2 + degrees + m, axis] *= (-1.0) ** (degrees + 1)
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-13 * steepest(MAX_DEGREE)[-1])


@every_degree
def test_autograd_is_right_at_and_beside_the_poles_on_the_equator_and_off_the_sphere(degree):
    """Where the derivatives in polar angles are not finite, too."""
    special = torch.tensor([*POLES, [1e-4, 0, 1], *EQUATOR[:2], [3e-2, -5e-2, 4e-2]], dtype=torch.float64)
    directions = torch.cat([special, 7 * random_directions(2)]).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda d: basis(d, degree), directions, fast_mode=degree > 1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 6, 11])
def test_quadrature_integrates_every_monomial_of_its_degree(degree):
    directions, weights = quadrature(degree)
    x, y, z = directions.numpy().T
    for a, b, c in itertools.product(range(degree + 1), repeat=3):
        if a + b + c > degree:
            continue
        exact = 0.0
        if not (a % 2 or b % 2 or c % 2):
            exact = 2 * gamma((a + 1) / 2) * gamma((b + 1) / 2) * gamma((c + 1) / 2) / gamma((a + b + c + 3) / 2)
        # Weights that add up to 4π, and monomials of at most 1 with a few roundings each.
        assert weights.numpy() @ (x**a * y**b * z**c) == pytest.approx(exact, rel=0, abs=4 * np.pi * 8 * EPS)


def test_lambertian_factors_are_the_legendre_coefficients_of_the_clamped_cosine():
    expected = [
        2 * math.pi * quad(lambda u, l=l: u * eval_legendre(l, u), 0, 1, epsabs=1e-13)[0] for l in range(MAX_DEGREE + 1)
    ]
    by_coefficient = np.repeat(expected, 2 * np.arange(MAX_DEGREE + 1) + 1)
    np.testing.assert_allclose(lambertian_factors(MAX_DEGREE), by_coefficient, rtol=0, atol=1e-12)  # quad's own bound


def test_bands_3_and_5_reach_no_diffuse_surface():
    assert nonzero_coefficients(6).tolist() == [*range(9), *range(16, 25), *range(36, 49)]


def test_constants_first_computed_in_inference_mode_serve_training_later():
    """They are cached, and autograd refuses to save tensors made in that mode."""
    with torch.inference_mode():
        irradiance(draw(2, 3), draw(64, 3))
        basis(draw(2, 3), 7)
    inputs = [draw(2, 3).requires_grad_(), draw(64, 3).requires_grad_()]
    (irradiance(*inputs).sum() + basis(inputs[0], 7).sum()).backward()
    assert all(tensor.grad.isfinite().all() for tensor in inputs)


def test_the_irradiance_basis_integrates_the_harmonics_over_the_hemisphere():
    """Against Gauss-Legendre quadrature in the cosine to the normal, exact for these polynomials."""
    normals = torch.cat([random_directions(5), torch.tensor(POLES, dtype=torch.float64)])
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    cosine, azimuth = (nodes + 1) / 2, 2 * np.pi * np.arange(16) / 16
    sine = np.sqrt(1 - cosine**2)[:, None]
    local = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.repeat(cosine[:, None], 16, axis=1)], axis=-1)
    weights = np.repeat(node_weights / 2 * cosine * 2 * np.pi / 16, 16)
    for normal, values in zip(normals.numpy(), irradiance_basis(normals, 6).numpy(), strict=True):
        tangents = np.linalg.svd(normal[None])[2][1:]
        directions = local.reshape(-1, 3) @ np.stack([*tangents, normal])
        integrals = weights @ basis(torch.from_numpy(directions), 6).numpy()
        np.testing.assert_allclose(values, integrals[nonzero_coefficients(6)], rtol=0, atol=1e-14)
        np.testing.assert_allclose(np.delete(integrals, nonzero_coefficients(6)), 0, atol=1e-14)


def test_projection_of_an_exponential_has_its_closed_form():
    """exp(z) = Σ (2l + 1) i_l(1) P_l(z), with the modified spherical Bessel functions."""
    projected = project(lambda directions: directions[:, 2:].exp(), MAX_DEGREE)[:, 0].numpy()
    l = np.arange(MAX_DEGREE + 1)
    expected = np.zeros_like(projected)
    expected[l * l + l] = np.sqrt(4 * np.pi * (2 * l + 1)) * spherical_in(l, 1.0)
    np.testing.assert_allclose(projected, expected, rtol=0, atol=1000 * EPS)


@every_degree
def test_rotated_light_in_a_rotated_direction_is_the_light_in_the_direction(degree):
    """Errors are of the light's norm, 21 × √3 at most on average."""
    light, directions = draw((degree + 1) ** 2, 3), random_directions(20)
    rotation = torch.from_numpy(Rotation.random(rng=np.random.default_rng(degree)).as_matrix())
    rotated, turned = rotate(light, rotation), directions @ rotation.T
    torch.testing.assert_close(
        basis(turned, degree) @ rotated, basis(directions, degree) @ light, rtol=0, atol=1e-13 * (degree + 1)
    )


@pytest.mark.parametrize("degree", [-1, MAX_DEGREE + 1])
def test_degrees_out_of_range_are_refused(degree):
    with pytest.raises(ValueError, match=f"degree={degree}"):
        basis(random_directions(1), degree)
