"""Harmonics against SciPy, Lambertian factors against integrals, rotations against directions."""

import numpy as np
import pytest
import torch
from oracles import draw, random_directions, scipy_basis
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre, spherical_in

from renderer.light import harmonics
from renderer.settings import MAX_DEGREE
from renderer.surface.shading import irradiance

EPS = np.finfo(np.float64).eps
every_degree = pytest.mark.parametrize("degree", [0, 1, 2, 6, MAX_DEGREE])
# Directions with both signs of zero, for which polar angles are special.
POLES = [[0.0, 0.0, 1.0], [-0.0, 0.0, 1.0], [0.0, -0.0, -1.0], [-0.0, -0.0, -1.0]]
EQUATOR = [[1.0, 0.0, 0.0], [-1.0, 0.0, -0.0], [-0.0, 1.0, 0.0], [0.0, -1.0, -0.0]]
EQUATOR += [[-0.6, 0.8, 0.0], [-1.0, -0.0, 0.0]]


@every_degree
def test_the_basis_is_scipys_without_the_condon_shortley_sign(degree):
    special = torch.tensor(POLES + EQUATOR, dtype=torch.float64)
    directions = torch.cat([random_directions(200), special])
    expected = scipy_basis(directions, degree)
    np.testing.assert_allclose(harmonics.basis(directions, degree), expected, rtol=0, atol=1e-13)


def test_lambertian_factors_are_the_legendre_coefficients_of_the_clamped_cosine():
    l = np.arange(harmonics.DIFFUSE_DEGREE + 1)
    by_band, _ = quad_vec(lambda cosine: cosine * eval_legendre(l, cosine), 0, 1, epsabs=1e-13)
    expected = np.repeat(2 * np.pi * by_band, 2 * l + 1)
    factors = harmonics.lambertian_factors(MAX_DEGREE)
    np.testing.assert_allclose(factors[: len(expected)], expected, rtol=0, atol=1e-12)
    assert not factors[len(expected) :].any()


def test_nonzero_coefficients_are_those_of_the_bands_0_and_1_and_of_even_bands():
    found = harmonics.nonzero_coefficients(MAX_DEGREE).tolist()
    bands = [0, 1, *range(2, harmonics.DIFFUSE_DEGREE + 1, 2)]
    assert found == [index for l in bands for index in range(l * l, (l + 1) ** 2)]


def test_constants_that_are_first_computed_in_inference_mode_serve_training_later():
    """The constants are cached, and autograd cannot save tensors of that mode."""
    with torch.inference_mode():
        irradiance(draw(3, 2), draw(64, 3))
        harmonics.basis(draw(2, 3), 7)
    normals = draw(3, 2).requires_grad_()
    light = draw(64, 3).requires_grad_()
    total = irradiance(normals, light).sum() + harmonics.basis(normals.T, 7).sum()
    total.backward()
    assert normals.grad.isfinite().all()
    assert light.grad.isfinite().all()


def test_the_projection_of_an_exponential_has_its_closed_form():
    """exp(z) = Σ (2l + 1) i_l(1) P_l(z), with the modified spherical Bessel functions i_l."""
    projected = harmonics.project(lambda directions: directions[:, 2:].exp(), 20)[:, 0].numpy()
    l = np.arange(21)
    expected = np.zeros_like(projected)
    expected[l * l + l] = np.sqrt(4 * np.pi * (2 * l + 1)) * spherical_in(l, 1.0)
    np.testing.assert_allclose(projected, expected, rtol=0, atol=1000 * EPS)


@every_degree
def test_rotated_light_in_a_rotated_direction_is_the_light_in_the_direction(degree):
    """Errors are relative to the norm of the light, which is about 1.7 (degree + 1)."""
    light = draw((degree + 1) ** 2, 3)
    directions = random_directions(20)
    matrix = Rotation.random(rng=np.random.default_rng(degree)).as_matrix()
    rotation = torch.from_numpy(matrix)
    found = harmonics.basis(directions @ rotation.T, degree) @ harmonics.rotate(light, rotation)
    expected = harmonics.basis(directions, degree) @ light
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13 * (degree + 1))
