"""Where light of spherical harmonics is negative: the bottoms of its dips, from a grid and by Newton's steps."""

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from renderer.light.harmonics import bands, gradient_matrices, monomial_coefficients, per_degree

Array = NDArray[Any]

_SUBDIVISIONS = 4  # of the grid: nodes are 0.07 radians apart
_NEARLY = 0.04, 1e-3  # of the largest radiance, above zero and above the neighbors: nodes that a dip may be near to
_REACH = 0.1  # of a step, in radians
_NEWTON_STEPS = 2


def dips(lights: Array, dim: Array, share: float) -> tuple[Array, Array]:
    """(which of lights (R, K) dips, the harmonics (K,) in the direction of the bottom) for each of D dips.

    share: of a light's largest radiance, that dips are deeper than; dim: (R,) largest radiance that is taken for none.
    """
    degree = math.isqrt(lights.shape[1]) - 1
    directions, harmonics, neighbors = _grid(degree)
    radiance = lights @ harmonics
    largest = np.abs(radiance).max(1)
    near_zero, near_lowest = (each * largest for each in _NEARLY)
    owner, node = np.nonzero(radiance < np.where(largest > dim, near_zero, -np.inf)[:, None])
    for neighbor in neighbors:
        lower = radiance[owner, node] <= radiance[owner, neighbor[node]] + near_lowest[owner]
        owner, node = owner[lower], node[lower]
    expansion = (lights @ _derivatives(degree)).reshape(len(lights), 3 + 9, -1)[owner]
    bottom = directions[node]
    for _ in range(_NEWTON_STEPS):
        bottom = _lower(bottom, expansion)
    rows = _harmonics(bottom, degree)
    deep = (rows * lights[owner]).sum(1) < -share * largest[owner]
    return owner[deep], rows[deep]


def _lower(directions: Array, expansion: Array) -> Array:
    """A Newton step down from directions (D, 3), on each light's own; along either principal axis of its curvature.

    expansion: (D, 3 + 9, K), coefficients of the lights' first and second derivatives.
    """
    derivatives = expansion @ _harmonics(directions, math.isqrt(expansion.shape[2]) - 1)[..., None]
    gradient, hessian = derivatives[:, :3], derivatives[:, 3:].reshape(-1, 3, 3)
    tangents = _tangents(directions)
    radial = directions[:, None] @ gradient
    curvature, turn = np.linalg.eigh(tangents @ hessian @ tangents.mT - radial * np.eye(2))
    axes = turn.mT @ tangents
    slope = (axes @ gradient)[..., 0]
    steepness = np.maximum(np.abs(curvature), np.linalg.norm(slope, axis=1, keepdims=True) / _REACH)
    moved = directions - ((slope / np.maximum(steepness, 1e-300))[:, None] @ axes)[:, 0]
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def _tangents(directions: Array) -> Array:
    """(D, 2, 3): two orthonormal tangents. Source: Duff et al. 2017, "Building an orthonormal basis, revisited"."""
    x, y, z = directions.T
    sign = np.copysign(1, z)
    a = -1 / (sign + z)
    b = x * y * a
    return np.array([[1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]]).transpose(2, 0, 1)


def _harmonics(directions: Array, degree: int) -> Array:
    """(D, K): on the sphere, polynomials homogeneous of the degree and of the one below; `select_rows` of a few."""
    powers, coefficients = _polynomials(degree)
    rising = np.ones((degree + 1, *directions.T.shape))
    for power in range(degree):
        rising[power + 1] = rising[power] * directions.T
    x, y, z = rising.transpose(1, 0, 2)
    return (x[powers[0]] * y[powers[1]] * z[powers[2]]).T @ coefficients


@per_degree
def _polynomials(degree: int) -> tuple[Array, Array]:
    """(powers (3, J) of x, y and z in each monomial, the harmonics' coefficients (J, K))."""
    totals = range(degree, max(degree - 2, -1), -1)
    powers = [(a, b, total - a - b) for total in totals for a in range(total, -1, -1) for b in range(total - a, -1, -1)]
    own = [monomial_coefficients(total) * ((bands(total) - total) % 2 == 0) for total in totals]
    coefficients = [F.pad(each, (0, (degree + 1) ** 2 - each.shape[1])) for each in own]
    return np.array(powers).T, torch.cat(coefficients).numpy()


@per_degree
def _derivatives(degree: int) -> Array:
    """(K, (3 + 9) K): what makes of a light's coefficients those of its derivatives by x, y and z."""
    first = gradient_matrices(degree)
    second = (first[:, None] @ first).flatten(0, 1)
    return torch.cat([first, second]).flatten(0, 1).T.contiguous().numpy()


@per_degree
def _grid(degree: int) -> tuple[Array, Array, Array]:
    """(directions (N, 3), harmonics (K, N), indices (6, N) of the neighbors) of an icosphere's vertices."""
    from trimesh.creation import icosphere  # trimesh takes half a second

    sphere = icosphere(_SUBDIVISIONS)
    around = [[*near, *near[:1]][:6] for near in sphere.vertex_neighbors]  # twelve vertices have five
    directions = np.array(sphere.vertices)
    return directions, np.ascontiguousarray(_harmonics(directions, degree).T), np.array(around).T
