"""A scene as a linear operator on its light: (mesh, camera) → T, rasterised once and multiplied ever after.

Before clamping, every pixel of a diffuse mesh is linear in the lighting coefficients U (the paper's appendix B.2):
radiance = Uᵀ T. The box filter, the texture and the albedo fold into T exactly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.albedo import surface_albedo
from renderer.camera import OrthographicCamera
from renderer.errors import InputError, require_bounded
from renderer.fragments import Fragments, build_fragments
from renderer.harmonics import irradiance_basis, live_coefficients, per_degree
from renderer.image import PictureSettings
from renderer.mesh import Mesh
from renderer.normals import face_normals
from renderer.visibility import Backend

DEGREE = 6
COEFFICIENTS = (DEGREE + 1) ** 2
BLOCK = 2**16  # pixels filtered at a time: bounds the memory


@dataclass(frozen=True)
class Operator:
    """What is kept of one (mesh, view): linear radiance per unit light, weighted with coverage. Of one dtype.

    transfer: (3, K, P), K = 31 live coefficients at degree 6 and P covered pixels; or (1, K, P), a third of the size
    and the time, where no pixel mixes albedos (one sample per pixel, or a mesh of one colour).
    albedo: (3, P), what the one channel is multiplied with; ones where there are three.
    coverage: (P,) in (0, 1], the share of a pixel's samples that the mesh covers.
    pixels: (P,) int64, row-major indices of the covered pixels; row 0 is the top of the picture.
    degree: of the lights.
    """

    transfer: Tensor
    albedo: Tensor
    coverage: Tensor
    pixels: Tensor
    degree: int = DEGREE

    def radiance(self, lights: Tensor) -> Tensor:
        """Linear radiance (..., 3, P) under lights (..., (degree + 1)², 3); differentiable, by `light_gradient`.

        Computed in the operator's dtype, returned in the lights'. InputError: NaN, or lights of another degree.
        """
        require_bounded(lights=lights)
        if lights.shape[-2:] != ((self.degree + 1) ** 2, 3):
            raise InputError(f"lights of shape {tuple(lights.shape)} are not of the operator's degree {self.degree}")
        if torch.is_grad_enabled() and lights.requires_grad:
            return _Radiance.apply(lights, self)
        return _radiance(self, lights)

    def light_gradient(self, radiance_gradient: Tensor) -> Tensor:
        """∂C/∂U (..., (degree + 1)², 3) = T ∂C/∂radiance (..., 3, P), without a graph.

        Exactly zero for the coefficients of bands that cannot reach a diffuse surface. InputError: NaN.
        """
        require_bounded(radiance_gradient=radiance_gradient)
        upstream = radiance_gradient.to(self.transfer.dtype)
        if len(self.transfer) == 1:
            product = (upstream * self.albedo) @ self.transfer[0].T
        else:
            product = torch.einsum("...cp,ckp->...ck", upstream, self.transfer)
        return (_spread(self.degree).to(product) @ product.mT).to(radiance_gradient.dtype)

    def to(self, device: torch.device | str) -> "Operator":
        """The same on another device."""
        return replace(self, **{name: part.to(device) for name, part in vars(self).items() if name != "degree"})


class _Radiance(torch.autograd.Function):
    @staticmethod
    def forward(ctx, lights: Tensor, operator: Operator) -> Tensor:
        ctx.operator = operator
        return _radiance(operator, lights)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor) -> tuple[Tensor, None]:
        return ctx.operator.light_gradient(upstream), None


def _radiance(operator: Operator, lights: Tensor) -> Tensor:
    live = live_coefficients(operator.degree).to(lights.device)
    kept = lights.index_select(-2, live).to(operator.transfer.dtype)
    if len(operator.transfer) == 1:
        product = kept.mT @ operator.transfer[0] * operator.albedo
    else:
        product = torch.einsum("...kc,ckp->...cp", kept, operator.transfer)
    return product.to(lights.dtype)


@per_degree
def _spread(degree: int) -> Tensor:
    """((degree + 1)², K) float32: puts the live coefficients in their places, with exact zeros in the others."""
    return torch.eye((degree + 1) ** 2)[:, live_coefficients(degree)]


def apply_transfer(lights: Tensor, transfer: Tensor, albedo: Tensor) -> Tensor:
    """Radiance (..., B, 3, P) of B lights (..., B, K, 3) under transfer (..., C, K, P), C = 3 or 1, and albedo
    (..., 3, P). The light comes first in the product: on a CPU that is several times faster."""
    if transfer.shape[-3] == 3:
        return (lights.movedim(-1, -3) @ transfer).movedim(-3, -2)
    product = lights.mT.flatten(-3, -2) @ transfer.squeeze(-3)
    return product.unflatten(-2, (-1, 3)) * albedo.unsqueeze(-3)


def build_operators(
    mesh: Mesh,
    cameras: Sequence[OrthographicCamera],
    settings: PictureSettings,
    backend: Backend,
    gain: float = 1.0,
    degree: int = DEGREE,
    dtype: torch.dtype = torch.float32,
) -> list[Operator]:
    """One operator per camera, for lights of one degree; computed in float64 and stored in `dtype`.

    gain multiplies the albedo, for meshes whose texture is darker than the thing. Surfaces shade on the side that the
    camera sees, with a normal per face.
    """
    views = build_fragments(mesh.vertices, mesh.faces, cameras, settings, backend, closed=mesh.closed)
    return [build_operator(mesh, view, settings, gain, degree, dtype) for view in views]


def build_operator(
    mesh: Mesh, fragments: Fragments, settings: PictureSettings, gain: float, degree: int, dtype: torch.dtype
) -> Operator:
    """The operator of one view that has been rasterised; see `build_operators`."""
    require_bounded(gain=torch.tensor(gain))
    albedo = surface_albedo(mesh, fragments, settings.encoding) * gain
    normals = face_normals(torch.from_numpy(mesh.vertices), fragments.corners) * fragments.facing
    shading = irradiance_basis(normals, degree)
    factor = _pixel_albedo(fragments, albedo, dtype)
    if factor is None:
        factor = torch.ones(len(fragments.pixels), 3)
    else:
        albedo = torch.ones(len(albedo), 1, dtype=torch.float64)
    return Operator(
        transfer=_box_filter(fragments, shading, albedo, dtype),
        albedo=factor.T.to(dtype).contiguous(),
        coverage=fragments.coverage.to(dtype),
        pixels=fragments.pixels,
        degree=degree,
    )


def _pixel_albedo(fragments: Fragments, albedo: Tensor, dtype: torch.dtype) -> Tensor | None:
    """(P, 3) the albedo of each pixel, if all of its samples have the same to the dtype's rounding."""
    by_pixel = albedo.new_zeros(len(fragments.pixels), 3).index_copy(0, fragments.pixel, albedo)
    spread = (albedo - by_pixel[fragments.pixel]).abs()
    return by_pixel if (spread <= torch.finfo(dtype).eps * albedo).all() else None


def _box_filter(fragments: Fragments, shading: Tensor, albedo: Tensor, dtype: torch.dtype) -> Tensor:
    """Sum over each pixel's samples of shading (G, K) × albedo (S, C): (C, K, P), by blocks of pixels in float64."""
    pixel, face, weights = fragments.merge(albedo)
    starts = torch.arange(0, len(fragments.pixels), BLOCK)
    ends = torch.searchsorted(pixel, starts + BLOCK).tolist()
    filtered = torch.empty(weights.shape[1], shading.shape[1], len(fragments.pixels), dtype=dtype)
    for first, begin, end in zip(starts.tolist(), [0, *ends], ends, strict=False):
        rows = shading.index_select(0, face[begin:end])
        block = filtered[..., first : first + BLOCK]
        for channel, weight in zip(block, weights[begin:end].T, strict=True):
            summed = shading.new_zeros(channel.shape[::-1])
            channel.copy_(summed.index_add_(0, pixel[begin:end] - first, rows * weight[:, None]).T)
    return filtered
