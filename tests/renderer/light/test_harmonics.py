import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre, gamma, sph_harm_y, sph_harm_y_all, spherical_in

from renderer.light import harmonics
from renderer.light.harmonics import (
    MAX_DEGREE,
    basis,
    basis_gradient,
    gradient_matrices,
    homogeneous_gradients,
    irradiance_basis,
    lambertian_factors,
    monomial_coefficients,
    monomials,
    nonzero_coefficients,
    project,
    quadrature,
    rotate,
)

EPS = np.finfo(np.float64).eps
EQUATOR = [[1.0, 0.0, 0.0], [-1.0, 0.0, -0.0], [-0.0, 1.0, 0.0], [0.0, -1.0, -0.0], [-0.6, 0.8, 0.0], [-1.0, -0.0, 0.0]]
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


def scipy_gradient(directions: torch.Tensor, degree: int) -> np.ndarray:
    """scipy's derivatives by the polar angles times the angles' by the vector (the paper's appendix D): no poles."""
    x, y, z = directions.double().numpy().T
    rho = np.hypot(x, y)
    by_angle = sph_harm_y_all(degree, degree, np.arctan2(rho, z), np.arctan2(y, x), diff_n=1)[1]
    polar = np.stack([x * z, y * z, -(rho**2)]) / (rho * (rho**2 + z**2))
    azimuth = np.stack([-y, x, 0 * x]) / rho**2
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            slope = by_angle[l, abs(m), :, 0] * polar + by_angle[l, abs(m), :, 1] * azimuth
            part = slope.real if m >= 0 else slope.imag
            columns.append(part if m == 0 else math.sqrt(2) * (-1) ** m * part)
    return np.stack(columns).transpose(2, 0, 1)


def steepest(degree: int) -> np.ndarray:
    """The largest derivative in the band of each coefficient: that of m = ±1 at the poles; 26 in band 20."""
    l = bands(degree).numpy()
    return np.sqrt(l * (l + 1) * (2 * l + 1) / (8 * np.pi))


@pytest.mark.parametrize("degree", [0, 1, 2, 6, 13, MAX_DEGREE])
def test_the_basis_is_scipys_without_the_condon_shortley_sign(degree):
    directions = torch.cat([random_directions(200), torch.tensor(POLES + EQUATOR, dtype=torch.float64)])
    np.testing.assert_allclose(basis(directions, degree).numpy(), scipy_basis(directions, degree), rtol=0, atol=1e-13)


@pytest.mark.parametrize("length", [1.0, 1e-3, 1e9])
@pytest.mark.parametrize("degree", [0, 1, 2, 6, 13, MAX_DEGREE])
def test_the_gradient_is_scipys_through_the_polar_angles(degree, length):
    """To 1e-13 of the band's steepest; the angles themselves lose 1 / sin θ of that towards the poles."""
    directions = torch.cat([random_directions(200), torch.tensor(EQUATOR, dtype=torch.float64)]) * length
    error = basis_gradient(directions, degree).numpy() - scipy_gradient(directions, degree)
    sine = np.hypot(*directions.numpy().T[:2]) / length
    assert (np.abs(error) * length * sine[:, None, None] <= 1e-13 * steepest(degree)[:, None]).all()


def test_at_the_poles_only_m_1_has_a_gradient():
    """sin θ e^(imφ) is x + iy for m = 1 and of higher order for others; P_l¹ / sin θ is l (l + 1) / 2 at the pole."""
    gradient = basis_gradient(torch.tensor(POLES, dtype=torch.float64), MAX_DEGREE).numpy()
    degrees = np.arange(1, MAX_DEGREE + 1)
    expected = np.zeros_like(gradient)
    for m, axis in ((1, 0), (-1, 1)):
        expected[:, degrees**2 + degrees + m, axis] = steepest(MAX_DEGREE)[degrees**2]
        expected[2:, degrees**2 + degrees + m, axis] *= (-1.0) ** (degrees + 1)
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-13 * steepest(MAX_DEGREE)[-1])


@pytest.mark.parametrize("degree", [0, 1, 2, 6, 13, MAX_DEGREE])
def test_in_float32_basis_and_gradient_are_scipys_to_half_an_ulp(degree):
    """And 1e-13 more, where a rounding falls the other way."""
    directions = torch.cat([random_directions(200), torch.tensor(EQUATOR).double()]).float()
    for ours, theirs, scale in (
        (basis, scipy_basis, 1),
        (basis_gradient, scipy_gradient, steepest(degree)[:, None] / directions[:, :2].norm(dim=1).numpy().min()),
    ):
        expected = theirs(directions, degree)
        error = np.abs(ours(directions, degree).numpy() - expected)
        assert (error <= np.spacing(np.abs(expected).astype(np.float32)) / 2 + 1e-13 * scale).all()


@pytest.mark.parametrize(
    ("dtype", "smallest"), [(torch.float64, -1074), (torch.float32, -149), (torch.float16, -24), (torch.bfloat16, -133)]
)
def test_only_the_direction_of_a_vector_counts_down_to_denormal_ones(dtype, smallest):
    vectors = torch.tensor([[1, 2, -2], [0, 0, 1], [-3, 4, 0], [1, 0, 0]], dtype=torch.float64)
    for exponent in (smallest, smallest + 1, -3, 4):
        scaled = (vectors * 2.0**exponent).to(dtype)
        assert torch.equal(basis(scaled, 6), basis(vectors.to(dtype), 6))
    halved = basis_gradient(2 * vectors.to(dtype), 6)
    assert torch.equal(halved, (basis_gradient(vectors, 6) / 2).to(dtype))


def test_a_zero_vector_has_finite_values_and_a_gradient_of_zero():
    zero = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    values = basis(zero, MAX_DEGREE)
    (gradient,) = torch.autograd.grad(values.sum(), zero)
    assert values.isfinite().all()
    assert not gradient.any() and not basis_gradient(zero, MAX_DEGREE).any()


@pytest.mark.parametrize("degree", [0, 1, 6, MAX_DEGREE])
def test_autograd_sees_the_gradient_at_and_beside_the_poles_on_the_equator_and_off_the_sphere(degree):
    """Where the derivatives in polar angles are not finite, too."""
    special = torch.tensor([*POLES, [1e-4, 0, 1], *EQUATOR[:2], [3e-2, -5e-2, 4e-2]], dtype=torch.float64)
    directions = torch.cat([special, 7 * random_directions(2)]).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda d: basis(d, degree), directions, fast_mode=degree > 1)


def test_second_derivatives_are_right():
    directions = 2 * random_directions(3).requires_grad_(True)
    assert torch.autograd.gradgradcheck(lambda d: basis(d, 3), directions)


@pytest.mark.parametrize("degree", [0, 1, 6, MAX_DEGREE])
def test_the_gradient_matrices_are_the_derivatives_of_the_solid_harmonics(degree):
    """By quadrature against scipy: ∂(r^l Y) at r = 1 is ∇Y + l Y n, and a harmonic polynomial of band l - 1."""
    directions, weights = quadrature(2 * degree)
    values = scipy_basis(directions, degree)
    radial = (bands(degree).numpy() * values)[..., None] * directions.numpy()[:, None]
    slopes = scipy_gradient(directions, degree) + radial
    expected = [(weights.numpy()[:, None] * values).T @ slopes[..., axis] for axis in range(3)]
    # Sums over 861 directions or fewer of products up to 3 × 30, whose weights add up to 4π.
    np.testing.assert_allclose(gradient_matrices(degree), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 5, 6])
def test_homogeneous_harmonics_have_the_gradients_of_central_differences(degree):
    """r^degree Y at points off the sphere, for the bands of the degree's parity, with Y by scipy."""
    points, step = torch.tensor([0.7, 1.2])[:, None] * random_directions(2), 1e-5
    chosen = (bands(degree) % 2 == degree % 2).numpy()

    def homogeneous(at: torch.Tensor, power: int) -> np.ndarray:
        return at.norm(dim=1, keepdim=True).numpy() ** power * scipy_basis(at, degree)

    for axis, matrix in enumerate(homogeneous_gradients(degree).numpy()):
        offset = step * torch.eye(3, dtype=torch.float64)[axis]
        expected = (homogeneous(points + offset, degree) - homogeneous(points - offset, degree)) / (2 * step)
        # The difference's error is that of its third derivative, of the order of degree³ × step², and EPS / step.
        np.testing.assert_allclose(
            homogeneous(points, degree - 1) @ matrix[:, chosen], expected[:, chosen], rtol=0, atol=1e-7
        )


@pytest.mark.parametrize("degree", [0, 1, 2, 5, 6, 12])
def test_harmonics_are_polynomials_in_monomials_of_the_degrees_parity(degree):
    points = torch.cat([random_directions(20), torch.tensor(POLES + EQUATOR, dtype=torch.float64)])
    chosen = (bands(degree) % 2 == degree % 2).numpy()
    values = monomials(points.T, degree).T @ monomial_coefficients(degree)
    # Measured against EPS: coefficients of either sign cancel, by a factor of 50 or less at degree 12.
    np.testing.assert_allclose(values[:, chosen], scipy_basis(points, degree)[:, chosen], rtol=0, atol=200 * EPS)


@pytest.mark.parametrize(
    "function",
    [
        harmonics.gradient_matrices,
        harmonics.homogeneous_gradients,
        harmonics.monomial_coefficients,
        harmonics.bands,
        harmonics.lambertian_factors,
        nonzero_coefficients,
    ],
)
def test_constants_first_asked_for_in_inference_mode_serve_training_later(function):
    """They are kept, and autograd refuses to save tensors made in that mode."""
    function.cache_clear()
    with torch.inference_mode():
        function(5)
    assert not function(5).is_inference()


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


def test_31_of_49_coefficients_are_live_and_the_others_are_bands_3_and_5():
    nonzero = nonzero_coefficients(6)
    assert len(nonzero) == 31
    np.testing.assert_array_equal(nonzero, np.flatnonzero(~np.isin(bands(6), [3, 5])))


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


@pytest.mark.parametrize("degree", [0, 2, 6, MAX_DEGREE])
@pytest.mark.parametrize("seed", range(2))
def test_rotated_light_at_a_turned_direction_is_the_light_at_the_direction(degree, seed):
    """And its gradient is turned. Errors are of the light's norm, 21 × √3 at most on average, and of band l's slope."""
    coefficients, rotation, directions = random_coefficients(degree, seed), random_rotation(seed), random_directions(20)
    rotated, turned = rotate(coefficients, rotation), directions @ rotation.T
    values = basis(turned, degree) @ rotated
    torch.testing.assert_close(values, basis(directions, degree) @ coefficients, rtol=0, atol=1e-13 * (degree + 1))
    slopes = torch.einsum("nkd,kc->ncd", basis_gradient(turned, degree), rotated)
    expected = torch.einsum("nkd,kc->ncd", basis_gradient(directions, degree), coefficients) @ rotation.T
    torch.testing.assert_close(slopes, expected, rtol=0, atol=1e-13 * (degree + 1) * (1 + steepest(degree)[-1]))


@pytest.mark.parametrize("degree", [-1, MAX_DEGREE + 1])
def test_degrees_out_of_range_are_refused(degree):
    for refused in (
        lambda: basis(random_directions(1), degree),
        lambda: basis_gradient(random_directions(1), degree),
        lambda: lambertian_factors(degree),
    ):
        with pytest.raises(ValueError, match=f"degree {degree}"):
            refused()
