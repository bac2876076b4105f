"""The nearest light that something could emit: harmonics whose radiance is nowhere negative.

A quadratic program with a constraint for every direction, solved by exchange: radiance is held non-negative in a
finite set of directions, and where the nearest such light still dips below zero, directions are added until it dips
nowhere (Hettich and Kortanek 1993, "Semi-infinite programming: theory, methods, and applications", section 7).
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from renderer.light.convex import Ball
from renderer.light.radiance_dips import Array, dips

TOLERANCE = 1e-4  # of a light's largest radiance, that it may dip below zero
_FOUND = TOLERANCE / 10  # dips that are looked for: in a flat valley, a deeper one may lie between two that are found
_ROUNDS = 50  # seven are usual
_ON_SPHERE = 1e-7  # of the radius
_STEPS = 10  # to come as near to a sphere; two are usual
_TINY = 1e-300


def project_nonnegative(lights: Tensor, within: Ball | None = None) -> Tensor:
    """The lights (..., (degree + 1)², C) of nowhere negative radiance that are nearest in coefficients.

    within: for lights (A, (degree + 1)², C), a ball to lie in, whose centers are such lights. The radiance of each
    channel is nowhere below -`TOLERANCE` of its largest; channels that were in order stay to the bit. Computed in
    float64, without a graph.
    """
    programs = _programs(lights, within)
    _exchange(programs)
    nearest = np.concatenate([program.nearest for program in programs])
    return torch.from_numpy(nearest).view(lights.mT.shape).to(lights).mT


def _programs(lights: Tensor, within: Ball | None) -> "Sequence[_Programme]":
    """One of each light, if a sphere holds its channels together, and else one of each channel."""
    wanted = _by_channel(lights)
    if within is None:
        return [_Programme(light) for light in wanted]
    if within.norm == "linf":
        return [_Programme(*each) for each in zip(wanted, *map(_by_channel, within.ends), strict=True)]
    shape = len(lights), lights.shape[2], lights.shape[1]
    of_lights = zip(wanted.reshape(shape), _by_channel(within.center).reshape(shape), strict=True)
    return [_InSphere(light, center, within.radius) for light, center in of_lights]


def _by_channel(lights: Tensor) -> Array:
    """(channels, 1, K) of lights (..., K, C)."""
    return lights.detach().mT.flatten(0, -2)[:, None].cpu().double().numpy()


class _Programme:
    """The lights (C, K) nearest to those wanted, between ends, and non-negative in the directions that are held."""

    def __init__(self, wanted: Array, low: Array | float = -np.inf, high: Array | float = np.inf):
        self.wanted, self.nearest = wanted, wanted.clip(low, high)
        self.low, self.high = np.broadcast_to(low, wanted.shape), np.broadcast_to(high, wanted.shape)
        self._held = [wanted[:0]] * len(wanted)  # harmonics (M, K) in the directions, of each light

    def hold(self, rows: Sequence[Array]) -> None:
        """Solve it with further directions (M, K) of each light; those that turn out to hold nothing are let go."""
        self._held = [np.concatenate(pair) for pair in zip(self._held, rows, strict=True)]
        self.nearest, self._held = self._solved()

    def _solved(self) -> tuple[Array, list[Array]]:
        return self._nearest_to(self.wanted)

    def _nearest_to(self, lights: Array) -> tuple[Array, list[Array]]:
        each = zip(lights, self._held, self.low, self.high, strict=True)
        nearest, held = zip(*(_nearest_held(*light) if len(light[1]) else light[:2] for light in each), strict=True)
        return np.stack(nearest), list(held)


class _InSphere(_Programme):
    """The same, of lights that together lie within an L2 distance of a center.

    With a multiplier λ for the sphere, what is nearest to lights v is nearest, without it, to c + (v - c) / (1 + λ). As
    long as the same directions hold, that is straight in the share 1 / (1 + λ) of the way: hence Newton's steps.
    """

    def __init__(self, wanted: Array, center: Array, radius: float):
        super().__init__(wanted)
        self._center, self._radius, self._offset = center, radius, wanted - center
        self._least = self._share = min(radius / max(float(np.linalg.norm(self._offset)), _TINY), 1.0)
        self.nearest = self._place()

    def _place(self) -> Array:
        return self.wanted if self._share == 1 else self._center + self._share * self._offset

    def _solved(self) -> tuple[Array, list[Array]]:
        for _ in range(_STEPS):
            place = self._place()
            nearest, held = self._nearest_to(place)
            gone = nearest - self._center
            distance = float(np.linalg.norm(gone))
            left = self._radius - distance
            if abs(left) <= _ON_SPHERE * self._radius or (self._share == 1 and left > 0):
                break
            courses, forces, changes = zip(*map(_course, self._offset, nearest - place, held), strict=True)
            along = np.stack(courses)
            speed, slope = float((along * along).sum()), float((along * gone).sum())
            root = math.sqrt(max(slope**2 + speed * left * (self._radius + distance), 0))
            step = min(max((root - slope) / max(speed, _TINY), self._least - self._share), 1 - self._share)
            self._share += step
            if np.all(np.concatenate(forces) + step * np.concatenate(changes) >= 0):  # the same directions hold there
                gone = gone + step * along
                break
        return self._center + gone * min(1, self._radius / max(float(np.linalg.norm(gone)), _TINY)), held


def _course(offset: Array, added: Array, rows: Array) -> tuple[Array, Array, Array]:
    """Where the nearest light (K,) goes as what is wanted goes along an offset (K,), as long as the same directions
    (M, K) hold it; and with which multipliers (M,), whose sum with the rows is added, it is held, and their change."""
    change, forces = np.linalg.lstsq(rows.T, np.stack([-offset, added], axis=1))[0].T
    return offset + rows.T @ change, forces, change


def _exchange(programs: Sequence[_Programme]) -> None:
    """Hold them where they dip, until they dip nowhere."""
    for _ in range(_ROUNDS):
        lights = np.concatenate([program.nearest for program in programs])
        wanted = np.concatenate([program.wanted for program in programs])
        dim = 1e-6 * np.linalg.norm(wanted, axis=1)  # radiance of which a share is but the rounding of what is given
        owner, rows = dips(lights, dim, _FOUND)
        channels = len(lights) // len(programs)
        dipping = np.unique(owner // channels)
        for index in dipping:
            own = range(index * channels, (index + 1) * channels)
            programs[index].hold([rows[owner == light] for light in own])
        programs = [programs[index] for index in dipping]
        if not programs:
            break


def _nearest_held(wanted: Array, rows: Array, low: Array, high: Array) -> tuple[Array, Array]:
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
