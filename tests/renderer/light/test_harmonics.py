import math

import numpy as np
import pytest
import torch
from oracles import draw, random_directions, scipy_basis
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre, spherical_in

from renderer.light.harmonics import DIFFUSE_DEGREE, basis, lambertian_factors, project, rotate
from renderer.settings import MAX_DEGREE
from renderer.surface.shading import irradiance

EPS = np.finfo(np.float64).eps
every_degree = pytest.mark.parametrize("degree", [0, 1, 2, 6, 13, MAX_DEGREE])
EQUATOR = [[1.0, 0.0, 0.0], [-1.0, 0.0, -0.0], [-0.0, 1.0, 0.0], [0.0, -1.0, -0.0], [-0.6, 0.8, 0.0], [-1.0, -0.0, 0.0]]
POLES = [[0.0, 0.0, 1.0], [-0.0, 0.0, 1.0], [0.0, -0.0, -1.0], [-0.0, -0.0, -1.0]]


@every_degree
def test_the_basis_is_scipys_without_the_condon_shortley_sign(degree):
    directions = torch.cat([random_directions(200), torch.tensor(POLES + EQUATOR, dtype=torch.float64)])
    np.testing.assert_allclose(basis(directions, degree).numpy(), scipy_basis(directions, degree), rtol=0, atol=1e-13)


@every_degree
def test_autograd_is_right_at_and_beside_the_poles_on_the_equator_and_off_the_sphere(degree):
    """Where the derivatives in polar angles are not finite, too."""
    special = torch.tensor([*POLES, [1e-4, 0, 1], *EQUATOR[:2], [3e-2, -5e-2, 4e-2]], dtype=torch.float64)
    directions = torch.cat([special, 7 * random_directions(2)]).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda d: basis(d, degree), directions, fast_mode=degree > 1)


def test_lambertian_factors_are_the_legendre_coefficients_of_the_clamped_cosine():
    expected = [
        2 * math.pi * quad(lambda u, l=l: u * eval_legendre(l, u), 0, 1, epsabs=1e-13)[0]
        for l in range(DIFFUSE_DEGREE + 1)
    ]
    by_coefficient = np.repeat(expected, 2 * np.arange(DIFFUSE_DEGREE + 1) + 1)
    factors = lambertian_factors(MAX_DEGREE)
    kept = factors[: len(by_coefficient)]
    np.testing.assert_allclose(kept, by_coefficient, rtol=0, atol=1e-12)  # quad's own bound
    assert not factors[len(by_coefficient) :].any()


def test_the_bands_that_diffuse_surfaces_are_not_shown_change_irradiance_by_no_more_than_a_sixtieth():
    """A beam lights a surface by Σ (2l + 1) / (4 π) A_l P_l(cos θ), whose true value is cos θ or 0."""
    cosines = np.linspace(-1, 1, 2001)
    factors = lambertian_factors(DIFFUSE_DEGREE)[np.arange(DIFFUSE_DEGREE + 1) ** 2].numpy()
    series = np.polynomial.legendre.legval(cosines, (2 * np.arange(DIFFUSE_DEGREE + 1) + 1) / (4 * math.pi) * factors)
    assert np.abs(series - cosines.clip(0)).max() < 1 / 60


def test_constants_first_computed_in_inference_mode_serve_training_later():
    """They are cached, and autograd refuses to save tensors made in that mode."""
    with torch.inference_mode():
        irradiance(draw(3, 2), draw(64, 3), torch.float64)
        basis(draw(2, 3), 7)
    inputs = [draw(3, 2).requires_grad_(), draw(64, 3).requires_grad_()]
    (irradiance(*inputs, torch.float64).sum() + basis(inputs[0].T, 7).sum()).backward()
    assert all(tensor.grad.isfinite().all() for tensor in inputs)


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
