import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre, gamma, sph_harm_y, spherical_in

from renderer.harmonics import (
    MAX_DEGREE,
    basis,
    irradiance_basis,
    lambertian_factors,
    live_coefficients,
    project,
    quadrature,
    rotate,
)

EPS = np.finfo(np.float64).eps
POLES = [[0.0, 0.0, 1.0], [-0.0, 0.0, 1.0], [0.0, -0.0, -1.0], [-0.0, -0.0, -1.0]]


def random_directions(count: int, seed: int = 0) -> torch.Tensor:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return torch.from_numpy(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def random_rotation(seed: int) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(rng=np.random.default_rng(seed)).as_matrix())


def random_coefficients(degree: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=((degree + 1) ** 2, 3)))


def bands(degree: int) -> torch.Tensor:
    return torch.tensor([l for l in range(degree + 1) for _ in range(2 * l + 1)])


def scipy_basis(directions: torch.Tensor, degree: int) -> np.ndarray:
    """The real combinations of scipy's complex harmonics, whose sign (-1)^m is taken out."""
    x, y, z = directions.double().numpy().T
    polar, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            value = sph_harm_y(l, abs(m), polar, azimuth)
            part = value.real if m >= 0 else value.imag
            columns.append(part if m == 0 else math.sqrt(2) * (-1) ** m * part)
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("degree", [0, 1, 2, 6, 13, MAX_DEGREE])
def test_the_basis_is_scipys_without_the_condon_shortley_sign(degree):
    directions = torch.cat([random_directions(200), torch.tensor(POLES, dtype=torch.float64)])
    np.testing.assert_allclose(basis(directions, degree).numpy(), scipy_basis(directions, degree), rtol=0, atol=1e-13)


@pytest.mark.parametrize("degree", [2, 6, MAX_DEGREE])
def test_float32_loses_a_few_ulps(degree):
    """A rounding half an eps large at one degree grows linearly with those that follow, and there is one at each."""
    directions = torch.cat([random_directions(2000).float(), torch.tensor(POLES)])
    single, double = basis(directions, degree), basis(directions.double(), degree)
    assert single.dtype == torch.float32
    assert (single - double).abs().max() < degree**2 / 4 * torch.finfo(torch.float32).eps


def test_band_one_is_y_z_x():
    directions = random_directions(50)
    expected = math.sqrt(3 / (4 * math.pi)) * directions[:, [1, 2, 0]]
    torch.testing.assert_close(basis(directions, 1)[:, 1:], expected, rtol=4 * EPS, atol=0)


def test_leading_dimensions_are_kept():
    directions = random_directions(6)
    torch.testing.assert_close(basis(directions.view(2, 3, 3), 4), basis(directions, 4).view(2, 3, 25), rtol=0, atol=0)


def test_at_the_poles_only_m_0_is_left():
    values = basis(torch.tensor(POLES, dtype=torch.float64), MAX_DEGREE)
    degrees = np.arange(MAX_DEGREE + 1)
    expected = np.zeros((4, (MAX_DEGREE + 1) ** 2))
    expected[:, degrees**2 + degrees] = np.sqrt((2 * degrees + 1) / (4 * np.pi))
    expected[2:, degrees**2 + degrees] *= (-1.0) ** degrees
    np.testing.assert_allclose(values.numpy(), expected, rtol=0, atol=MAX_DEGREE**2 / 4 * EPS)  # as in float32, above


def test_gradients_are_right_at_and_beside_the_poles():
    """Where the derivatives in polar angles are not finite."""
    directions = torch.cat([torch.tensor([*POLES, [1e-4, 0, 1]], dtype=torch.float64), random_directions(4)])
    assert torch.autograd.gradcheck(lambda d: basis(d, 6), directions.requires_grad_(True))


@pytest.mark.parametrize("degree", [0, 1, 6, MAX_DEGREE])
def test_the_basis_is_orthonormal_under_quadrature(degree):
    directions, weights = quadrature(2 * degree)
    values = basis(directions, degree)
    gram = values.T @ (weights[:, None] * values)
    # A sum over 861 directions or fewer of products up to 3, whose weights add up to 4π.
    torch.testing.assert_close(gram, torch.eye(len(gram), dtype=torch.float64), rtol=0, atol=1e-13)


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
    np.testing.assert_allclose(lambertian_factors(MAX_DEGREE), expected, rtol=0, atol=1e-12)  # quad's own bound


def test_lambertian_factors_have_their_published_values():
    published = [math.pi, 2 * math.pi / 3, math.pi / 4, 0, -math.pi / 24, 0, math.pi / 64]
    np.testing.assert_allclose(lambertian_factors(6), published, rtol=2 * EPS, atol=0)
    assert lambertian_factors(0).tolist() == [math.pi]


def test_31_of_49_coefficients_are_live_and_the_others_are_bands_3_and_5():
    live = live_coefficients(6)
    assert len(live) == 31
    np.testing.assert_array_equal(live, np.flatnonzero(~np.isin(bands(6), [3, 5])))


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
        np.testing.assert_allclose(values, integrals[live_coefficients(6)], rtol=0, atol=1e-14)
        np.testing.assert_allclose(np.delete(integrals, live_coefficients(6)), 0, atol=1e-14)


def test_projection_after_evaluation_is_the_identity():
    coefficients = random_coefficients(6)
    projected = project(lambda directions: basis(directions, 6) @ coefficients, 6)
    # 8,385 directions; pairwise sums of values up to 10 keep well below 100 roundings of those.
    torch.testing.assert_close(projected, coefficients, rtol=0, atol=1000 * EPS)


def test_projection_of_an_exponential_has_its_closed_form():
    """exp(z) = Σ (2l + 1) i_l(1) P_l(z), with the modified spherical Bessel functions."""
    projected = project(lambda directions: directions[:, 2:].exp(), MAX_DEGREE)[:, 0].numpy()
    l = np.arange(MAX_DEGREE + 1)
    expected = np.zeros_like(projected)
    expected[l * l + l] = np.sqrt(4 * np.pi * (2 * l + 1)) * spherical_in(l, 1.0)
    np.testing.assert_allclose(projected, expected, rtol=0, atol=1000 * EPS)


@pytest.mark.parametrize("degree", [0, 2, 6])
@pytest.mark.parametrize("seed", range(3))
def test_rotated_light_at_a_turned_direction_is_the_light_at_the_direction(degree, seed):
    coefficients, rotation, directions = random_coefficients(degree), random_rotation(seed), random_directions(20)
    turned = basis(directions @ rotation.T, degree) @ rotate(coefficients, rotation)
    torch.testing.assert_close(turned, basis(directions, degree) @ coefficients, rtol=0, atol=1e-13)


def test_rotations_compose():
    coefficients, first, second = random_coefficients(6), random_rotation(1), random_rotation(2)
    in_turn, at_once = rotate(rotate(coefficients, first), second), rotate(coefficients, second @ first)
    torch.testing.assert_close(in_turn, at_once, rtol=0, atol=1e-13)


def test_rotation_keeps_the_norm_of_each_band_and_the_precision_of_its_input():
    coefficients = random_coefficients(6)
    turned = rotate(coefficients, random_rotation(3))
    for l in range(7):
        before, after = coefficients[bands(6) == l].norm(dim=0), turned[bands(6) == l].norm(dim=0)
        torch.testing.assert_close(after, before, rtol=1e-13, atol=0)
    assert rotate(coefficients.float(), random_rotation(3)).dtype == torch.float32


@pytest.mark.parametrize("degree", [-1, MAX_DEGREE + 1])
def test_degrees_out_of_range_are_refused(degree):
    for function in (lambda: basis(random_directions(1), degree), lambda: lambertian_factors(degree)):
        with pytest.raises(ValueError, match=f"degree {degree}"):
            function()
