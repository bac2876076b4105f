"""The nearest light that something could emit: harmonics whose radiance is nowhere negative.

A quadratic programme with a constraint for every direction, solved by exchange: radiance is held non-negative in a
finite set of directions, and where the nearest such light still dips below zero, directions are added until it dips
nowhere (Hettich and Kortanek 1993, "Semi-infinite programming: theory, methods, and applications", section 7).
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from scipy.optimize import nnls
from torch import Tensor

from renderer.basis import Ends
from renderer.harmonics import gradient_matrices, per_degree, select_rows

TOLERANCE = 1e-4  # of a light's largest radiance, that it may dip below zero
_FOUND = TOLERANCE / 10  # dips that are looked for: in a flat valley, a deeper one may lie between two that are found
_ROUNDS = 50  # eight are usual
_NEWTON_STEPS = 4
_REACH = 0.1  # of a step, in radians; nodes are half as far apart
_NEARLY = 0.1, 1e-3  # of the largest radiance, above zero and above the neighbours: nodes that a dip may be near to


def nearest_nonnegative(lights: Tensor, ends: Ends | None = None) -> Tensor:
    """The lights (..., (degree + 1)², C) of nowhere negative radiance that are nearest in coefficients.

    ends: of the same shape each, between which some such light lies. The radiance of each channel is nowhere below
    -`TOLERANCE` of its largest; channels that were in order stay to the bit. Computed in float64, without a graph.
    """
    wanted = _by_channel(lights)
    low, high = map(_by_channel, ends) if ends else (np.full_like(wanted, -np.inf), np.full_like(wanted, np.inf))
    nearest = wanted.clip(low, high)
    held = [_nodes(math.isqrt(wanted.shape[1]) - 1, 2)[1].numpy()] * len(wanted)  # harmonics where each is held
    dim = 1e-6 * torch.from_numpy(wanted).norm(dim=1)  # radiance of which a share is but the rounding of what is given
    unsettled = np.arange(len(wanted))
    for _ in range(_ROUNDS):
        owner, rows = _dips(torch.from_numpy(nearest[unsettled]), dim[unsettled])
        dipping = np.unique(owner)
        for index in dipping:
            light = unsettled[index]
            constraints = np.concatenate([held[light], rows[owner == index]])
            nearest[light], held[light] = _nearest_held(wanted[light], constraints, low[light], high[light])
        unsettled = unsettled[dipping]
        if not len(unsettled):
            break
    return torch.from_numpy(nearest).view(lights.mT.shape).to(lights).mT


def _by_channel(lights: Tensor) -> np.ndarray:
    return lights.detach().mT.flatten(0, -2).cpu().double().numpy()


def _nearest_held(
    wanted: np.ndarray, rows: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The x (K,) nearest to `wanted` with rows · x ≥ 0 between the ends, and those of the rows that hold it.

    Least distance programming by non-negative least squares (Lawson and Hanson 1974, chapter 23), in units of `wanted`.
    """
    size, unit, ended = len(wanted), np.linalg.norm(wanted), np.isfinite(low)
    axes = np.eye(size)[ended]
    sides = np.concatenate([rows, axes, -axes])
    bounds = np.concatenate([-rows @ wanted, (low - wanted)[ended], (wanted - high)[ended]])
    dual = np.concatenate([sides.T, bounds[None] / unit])
    multipliers, _ = nnls(dual, np.eye(size + 1)[size])
    residual = dual @ multipliers
    residual[size] -= 1
    if residual[size] > -(_FOUND**2):  # the ends leave no more room than rounding
        return wanted.clip(low, high), rows
    nearest = wanted - residual[:size] / residual[size] * unit
    return nearest.clip(low, high), rows[multipliers[: len(rows)] > 0]


def _dips(lights: Tensor, dim: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """(which of lights (R, K) dips, the harmonics (K,) in a direction to hold it), for each of D directions: the
    bottoms of all dips and, since bottoms move, four places around each. dim: (R,) radiance that is taken for none."""
    directions, harmonics, around = _nodes(math.isqrt(lights.shape[1]) - 1, 4)
    radiance = harmonics @ lights.T
    largest = radiance.abs().amax(0)
    near_zero, near_lowest = _NEARLY[0] * largest, _NEARLY[1] * largest
    candidate = (radiance < near_zero) & (largest > dim)
    for neighbour in around:
        candidate &= radiance <= radiance.index_select(0, neighbour) + near_lowest
    node, owner = torch.nonzero(candidate, as_tuple=True)
    local = _Local(lights, owner)
    bottom = directions[node]
    for _ in range(_NEWTON_STEPS):
        _, slope, curvature, axes = local(bottom)
        steepest = torch.maximum(curvature.abs(), slope.norm(dim=1, keepdim=True) / _REACH)
        bottom = _moved(bottom, -slope / steepest.clamp(min=1e-300), axes)
    depth, _, curvature, axes = local(bottom)
    found = -depth > _FOUND * largest[owner]
    owner, bottom, depth, curvature, axes = (part[found] for part in (owner, bottom, -depth, curvature, axes))
    reach = 0.7 * (2 * depth[:, None] / curvature.clamp(min=1e-300)).sqrt().clamp(max=_REACH)
    ring = [_moved(bottom, reach * torch.tensor(side), axes) for side in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    places = torch.cat([bottom, *ring])
    return owner.repeat(5).numpy(), _harmonics(places, lights.shape[1]).numpy()


class _Local:
    """Lights (D, K) as parabolas around directions (D, 3)."""

    def __init__(self, lights: Tensor, owner: Tensor):
        matrices = gradient_matrices(math.isqrt(lights.shape[1]) - 1)
        first = torch.einsum("djk,nk->ndj", matrices, lights)
        second = torch.einsum("djk,nek->ndej", matrices, first).flatten(1, 2)
        self.expansion = torch.cat([lights[:, None], first, second], dim=1)[owner]  # (D, 1 + 3 + 9, K)

    def __call__(self, directions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(radiance (D,), slopes (D, 2) and curvatures (D, 2) along the principal axes, these (D, 2, 3))."""
        harmonics = _harmonics(directions, self.expansion.shape[2])
        radiance, gradient, hessian = (self.expansion @ harmonics[..., None]).squeeze(2).split([1, 3, 9], dim=1)
        tangents = _tangents(directions)
        radial = (gradient * directions).sum(1)[:, None, None] * torch.eye(2).to(gradient)
        curvature, turn = torch.linalg.eigh(tangents @ hessian.unflatten(1, (3, 3)) @ tangents.mT - radial)
        axes = turn.mT @ tangents
        return radiance.squeeze(1), (axes @ gradient[..., None]).squeeze(2), curvature, axes


def _moved(directions: Tensor, steps: Tensor, axes: Tensor) -> Tensor:
    return F.normalize(directions + (steps[:, None] @ axes).squeeze(1))


def _tangents(directions: Tensor) -> Tensor:
    """(D, 2, 3): two orthonormal tangents at directions (D, 3)."""
    axis = torch.eye(3).to(directions)[directions.abs().argmin(1)]
    first = F.normalize(torch.linalg.cross(directions, axis))
    return torch.stack([first, torch.linalg.cross(directions, first)], dim=1)


def _harmonics(directions: Tensor, size: int) -> Tensor:
    return torch.stack(select_rows(directions.T, range(size)), dim=1)


@per_degree
def _nodes(degree: int, subdivisions: int) -> tuple[Tensor, Tensor, Tensor]:
    """(directions (N, 3), harmonics (N, K), indices (6, N) of the neighbours) of an icosphere's vertices."""
    sphere = trimesh.creation.icosphere(subdivisions)
    around = [[*near, *near[:1]][:6] for near in sphere.vertex_neighbors]  # twelve vertices have five
    directions = torch.from_numpy(np.array(sphere.vertices))
    return directions, _harmonics(directions, (degree + 1) ** 2), torch.tensor(around).T.contiguous()
