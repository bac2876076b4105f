"""Diffuse shading of a view's fragments, differentiable in the vertices, the light and the albedo.

Visibility and texture coordinates are held fixed (the paper's Section 3 and appendices B.3 and D), so the derivative
sees how normals turn and not how outlines move. For the light alone, `renderer.transfer` is faster.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import InputError, require_bounded, require_finite
from renderer.fragments import Fragments
from renderer.harmonics import (
    bands,
    gradient_matrices,
    lambertian_factors,
    live_coefficients,
    per_degree,
    select_rows,
    unit_vectors,
)
from renderer.normals import face_normals, vertex_normals

BLOCK = 2**15  # normals at a time


def radiance(
    fragments: Fragments, vertices: Tensor, light: Tensor, albedo: Tensor, smooth_faces: Tensor | None = None
) -> Tensor:
    """Linear radiance (3, P) of the covered pixels, weighted with coverage, in the dtype of `vertices`.

    vertices: (V, 3). light: ((degree + 1)², 3) coefficients, any degree. albedo: (S, 3) linear, at the samples
    (`renderer.albedo`). smooth_faces: all faces (F, 3) of the mesh, to shade with interpolated vertex normals; without
    them each face has its own normal. InputError: NaN in any of them.
    """
    require_bounded(albedo=albedo)  # the normals and the irradiance check the rest
    wide = _computed_in(vertices.dtype)
    positions, albedo = vertices.to(wide), albedo.to(wide)
    if smooth_faces is None:
        pixel, face, weights = fragments.merge(albedo)
        normals = face_normals(positions, fragments.corners) * fragments.facing.to(positions)
        shade = irradiance(normals, light).index_select(1, face)
    else:
        pixel, weights = fragments.pixel, albedo / fragments.samples**2
        shade = irradiance(smooth_normals(fragments, positions, smooth_faces), light)
    seen = shade * weights.T
    if fragments.samples > 1:  # a sample is a pixel otherwise
        seen = seen.new_zeros(3, len(fragments.pixels)).index_add(1, pixel, seen)
    return seen.to(vertices.dtype)


def irradiance(normals: Tensor, light: Tensor) -> Tensor:
    """(3, N) irradiance on surfaces with normals (N, 3), of any length, under light ((degree + 1)², 3).

    Differentiable in both, in the dtype of `normals`; half precision is computed in float32. The coefficients of
    bands that cannot reach a diffuse surface have a gradient of exactly zero.
    InputError: NaN, or a light that is not of whole bands and three channels.
    Source: the paper's equation for R in appendix B.2; its derivative by n in appendix D, here a polynomial too.
    """
    require_finite(normals=normals)
    require_bounded(light=light)
    if light.ndim != 2 or light.shape[1] != 3 or math.isqrt(len(light)) ** 2 != len(light) or not len(light):
        raise InputError(f"light has shape {tuple(light.shape)}: give ((degree + 1)², 3) coefficients")
    wide = _computed_in(normals.dtype)
    return _Irradiance.apply(normals.to(wide), light.to(wide)).to(normals.dtype)


class _Irradiance(torch.autograd.Function):
    """Goes by blocks of normals and computes their harmonics again in the backward pass: what it keeps is the normals'
    size, not 31 times that."""

    @staticmethod
    def forward(ctx, normals: Tensor, light: Tensor) -> Tensor:
        unit, length = unit_vectors(normals.T.contiguous())
        bands = _bands(math.isqrt(len(light)) - 1)
        weights = light[list(bands.live)] * bands.factors.to(light)
        ctx.save_for_backward(unit, length, weights)
        ctx.bands, ctx.light = bands, light.shape
        blocks = [weights.T @ _rows(block, bands.live) for block in unit.split(BLOCK, dim=1)]
        return torch.cat(blocks, dim=1)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        unit, length, weights = ctx.saved_tensors
        bands, by_normal, by_light = ctx.bands, None, None
        blocks = list(zip(unit.split(BLOCK, dim=1), upstream.split(BLOCK, dim=1), strict=True))
        if ctx.needs_input_grad[0]:
            slopes = torch.einsum("djk,kc->dcj", bands.ladder.to(weights), weights)
            solid = torch.cat([_contract(slopes, _rows(block, bands.below), above) for block, above in blocks], dim=1)
            tangential = solid - unit * (unit * solid).sum(0)
            by_normal = (tangential / length.masked_fill(length == 0, torch.inf)).T
        if ctx.needs_input_grad[1]:
            by_weight = sum(_rows(block, bands.live) @ above.T for block, above in blocks)
            by_light = unit.new_zeros(ctx.light)
            by_light[list(bands.live)] = by_weight * bands.factors.to(unit)
        return by_normal, by_light


@dataclass(frozen=True)
class _Bands:
    """Of the harmonics to some degree: the K that reach a surface, with A_l (K, 1), and the J of which the gradients of
    those consist, with what they take of each (3 axes, J, K)."""

    live: tuple[int, ...]
    factors: Tensor
    below: tuple[int, ...]
    ladder: Tensor


@per_degree
def _bands(degree: int) -> _Bands:
    live = live_coefficients(degree)
    ladder = gradient_matrices(degree)[:, :, live]
    below = torch.nonzero(ladder.abs().sum((0, 2))).squeeze(1)
    factors = lambertian_factors(degree)[bands(degree)[live]]
    return _Bands(tuple(live.tolist()), factors[:, None], tuple(below.tolist()), ladder[:, below])


def _computed_in(dtype: torch.dtype) -> torch.dtype:
    """The dtype itself, or float32 for half precision."""
    return torch.promote_types(dtype, torch.float32)


def _rows(unit: Tensor, indices: tuple[int, ...]) -> Tensor:
    """Some harmonics (len(indices), N) of unit vectors (3, N)."""
    rows = select_rows(unit, indices)
    return torch.stack(rows) if rows else unit.new_zeros(0, unit.shape[1])


def _contract(slopes: Tensor, values: Tensor, upstream: Tensor) -> Tensor:
    """Σ over channels of upstream (3, N) × gradients: (3 axes, N)."""
    gradients = (slopes.flatten(0, 1) @ values).unflatten(0, (3, 3))
    return (gradients * upstream).sum(1)


def smooth_normals(fragments: Fragments, vertices: Tensor, faces: Tensor) -> Tensor:
    """(S, 3) vertex normals interpolated to the samples, on the side that the camera sees; not of unit length."""
    near = torch.zeros(len(vertices), dtype=torch.bool, device=faces.device)
    near[fragments.corners.flatten()] = True
    around = faces[near[faces].any(1)]  # the other faces touch no vertex that a sample sees
    normals = vertex_normals(vertices, around)[fragments.corners] * fragments.facing.to(vertices)[:, None]
    barycentric = fragments.barycentric().to(vertices)
    return torch.einsum("sc,scd->sd", barycentric, normals.index_select(0, fragments.face))
