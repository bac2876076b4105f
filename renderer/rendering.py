"""Meshes to images in one call: `render`, differentiable, and `precompute_transfer` for images under many lights."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial, reduce
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.albedo import face_albedo, surface_albedo
from renderer.camera import Camera, OrthographicCamera
from renderer.errors import FACTOR, InputError, require_bounded, require_choice, require_range
from renderer.fragments import Fragments, build_fragments
from renderer.gloss import Gloss, SampleGloss, sample_gloss
from renderer.image import SAMPLES, ImageSettings, as_background, composite, decode, samples_per_side
from renderer.light.basis import HARMONICS, Basis, Harmonics, LocalBasis, SumBasis, parts_of
from renderer.light.harmonics import degree_of
from renderer.mesh import Mesh, require_mesh
from renderer.rasterizer import NAMES, choose
from renderer.shading import glossy_radiance, normals_in_sight, radiance
from renderer.shapes import sphere
from renderer.silhouettes import moving_outlines
from renderer.transfer import build_operators
from renderer.transport.local import LocalLightView
from renderer.transport.precomputed import build_transport
from renderer.transport.rays import Rays, Surface
from renderer.validation import as_list, as_tensor, describe, require_kind, require_number
from renderer.views import TransferOperators

if TYPE_CHECKING:
    from jaxtyping import Float

LocalLight = LocalBasis | tuple[LocalBasis, Tensor]  # lamps or a projector, and coefficients (size, 3)
WHITE = 1 + 1e-4  # the largest albedo, and what rounding adds to it
_LOCAL_LIGHTS = "a list of lamps and projectors, alone or in pairs (basis, coefficients)"
_OBLIQUE = OrthographicCamera(math.pi / 3, 0.0, 2.0)  # the first of `orbit_cameras`
_choose = cache(choose)  # "opengl" checks the driver, which takes longer than an image
_white_ball = cache(lambda: Mesh.plain(*sphere(5)))


def render(
    mesh: Mesh,
    cameras: Camera | Sequence[Camera],
    light: Float[Tensor, "coefficients 3"] | None,
    size: int = 224,
    background: float | Float[Tensor, "*views channels size size"] | Float[Tensor, " 3"] = 0.5,
    *,
    lights: Sequence[LocalLight] = (),
    vertices: Float[Tensor, "N 3"] | None = None,
    albedo: Float[Tensor, "F 3"] | Float[Tensor, "height width 3"] | None = None,
    albedo_scale: float = 1.0,
    gloss: Gloss | None = None,
    samples: int | None = None,
    encoding: str = "linear",
    normals: str = "smooth",
    shadows: bool = False,
    bounces: int = 0,
    silhouettes: bool = False,
    rasterizer: str = "auto",
) -> Float[Tensor, "V 3 size size"]:
    """Images in [0, 1] of a mesh from V cameras; differentiable in light, vertices, albedo and gloss.

    NumPy arrays and lists are taken in place of tensors.

    light: (degree + 1)² coefficients (`load_light`), in whose dtype and on whose device the images are computed; None
    for no environment light. lights: lamps and projectors, alone for full white power, or with coefficients (size, 3);
    they cast shadows and do not bounce. background: see `renderer.image.as_background`; one for all views, or an image
    for each. vertices: in place of the mesh's. albedo: linear in [0, 1], in place of the mesh's colors per face, or
    of its only texture. albedo_scale multiplies the albedo, also beyond 1. gloss: in place of the mesh's. samples:
    per pixel side; None is 2, or 8 with silhouettes. encoding: linear or srgb. normals: flat or smooth. shadows: that
    the mesh casts on itself. bounces: of light between its surfaces, shadows included. rasterizer: auto, opengl,
    numba or numpy. Gradients by vertices hold visibility constant; those by vertices, albedo and gloss also hold
    shadows and bounces of environment light constant. silhouettes: gradients by vertices, and by fields of the
    cameras that are tensors of one number, also see how outlines and surfaces move in the image.
    InputError: NaN, shapes that do not fit, unknown choices, arguments of other types, albedo beyond [0, 1].

    >>> light = renderer.load_light("grace").requires_grad_()
    >>> image = renderer.render(renderer.solid("apple"), renderer.orbit_cameras(2, 2.2), light, size=16)
    >>> image.shape, torch.autograd.grad(image.mean(), light)[0].shape
    (torch.Size([2, 3, 16, 16]), torch.Size([49, 3]))
    """
    require_mesh("mesh", mesh)
    per_side = samples_per_side(samples, silhouettes)
    settings = ImageSettings(size, per_side, encoding, normals, shadows, bounces, silhouettes)
    cameras = _listed(cameras)
    _require_scale(albedo_scale)
    _require_gloss(gloss)
    require_choice("rasterizer", rasterizer, NAMES)
    light = None if light is None else _as_light(light)
    albedo = None if albedo is None else _as_albedo(albedo)
    vertices = None if vertices is None else as_tensor("vertices", vertices)
    if vertices is not None and vertices.shape != mesh.vertices.shape:
        raise InputError(f"vertices of shape {tuple(vertices.shape)} does not fit the mesh: give {mesh.vertices.shape}")
    local = [_with_coefficients(local) for local in as_list("lights", lights, LocalBasis | tuple, _LOCAL_LIGHTS)]
    like = next((values for _, values in [(None, light), *local] if values is not None), torch.zeros(0))
    vertices = (torch.from_numpy(mesh.vertices) if vertices is None else vertices).to(like)
    positions = vertices.detach().cpu().double().numpy()
    fixed = [camera.fixed() for camera in cameras]
    views = build_fragments(positions, mesh.faces, fixed, settings, _choose(rasterizer), closed=mesh.closed)
    backgrounds = as_background(background, size, like).expand(len(views), -1, -1, -1)
    smooth, faces = normals == "smooth" and light is not None, torch.from_numpy(mesh.faces).to(like.device)
    moved = replace(mesh, vertices=positions)
    emitters: list[tuple[Harmonics | LocalBasis, Tensor]] = [(basis, values.to(like)) for basis, values in local]
    if light is not None:
        emitters.insert(0, (Harmonics(degree_of(light)), light))
    basis = SumBasis(tuple(basis for basis, _ in emitters))
    transport = build_transport(moved, settings, albedo_scale, basis) if emitters else None
    rays = transport.rays if transport else Rays(moved)
    images = []
    for camera, view, behind in zip(cameras, views, backgrounds, strict=True):
        fragments = view.to(like.device)
        colors = _albedo(mesh, fragments, albedo, encoding).to(like) * albedo_scale
        surface = Surface(moved, view, settings, given_gloss=gloss)
        indirect = partial(transport.radiance, surface) if transport else None
        in_local_light = cache(partial(LocalLightView, rays, mesh, view, settings, vertices, gloss))
        of_vertices = normals_in_sight(fragments, vertices, faces) if smooth else None
        shine = sample_gloss(mesh, fragments, gloss)
        shading = Shading(vertices, colors, emitters, of_vertices, in_local_light, indirect, gloss=shine)
        if silhouettes:
            linear = decode(behind.flatten(1), encoding)
            pixels, coverage, shade = view_with_outlines(camera, fragments, faces, linear, shading)
        else:
            pixels, coverage = fragments.pixels, fragments.coverage.to(like)
            shade = view_radiance(fragments, shading)
        images.append(composite(shade, coverage, pixels, behind, encoding))
    return torch.stack(images)


class Shading(NamedTuple):
    """What the samples of one view are shaded with.

    albedo: (S, 3), at the samples. lights: bases with coefficients (size, 3). normals: as for `radiance`. indirect: of
    albedo and coefficients of environment light, the radiance that shadows and bounces add to it. positions: of lamps
    that moved, (L, 3). gloss: in environment light.
    """

    vertices: Tensor
    albedo: Tensor
    lights: Sequence[tuple[Harmonics | LocalBasis, Tensor]]
    normals: Tensor | None
    in_local_light: Callable[[], LocalLightView]
    indirect: Callable[[Tensor, Tensor], Tensor] | None = None
    positions: Tensor | None = None
    gloss: SampleGloss | None = None


def view_radiance(fragments: Fragments, shading: Shading) -> Tensor:
    """(3, P) radiance of one view: shaded environment light, what shadows and bounces change of it, local lights."""
    albedo, gloss = shading.albedo, shading.gloss
    radiances = [torch.zeros(3, len(fragments.pixels)).to(albedo)] if not shading.lights else []
    for basis, light in shading.lights:
        if isinstance(basis, LocalBasis):
            radiances.append(shading.in_local_light().radiance(basis, albedo, light, shading.positions, fragments))
            continue
        shaded = fragments, shading.vertices, light, albedo, shading.normals
        radiances.append(radiance(*shaded) if gloss is None else glossy_radiance(*shaded, gloss))
        if shading.indirect is not None:
            radiances.append(shading.indirect(albedo, light))
    return reduce(torch.add, radiances)


def view_with_outlines(
    camera: Camera, fragments: Fragments, faces: Tensor, background: Tensor, shading: Shading
) -> tuple[Tensor, Tensor, Tensor]:
    """(pixels (P + E,), coverage (P + E,), radiance (3, P + E)) of one view, of which E pixels are not covered; the
    radiance, that of `view_radiance`, is differentiable in outlines, too (`renderer.silhouettes`).

    background: linear, (3, size²). What shadows and bounces of environment light add to a pixel is divided among its
    samples by albedo, where outlines move.
    """
    albedo, indirect, pixel = shading.albedo, shading.indirect, fragments.pixel
    at_samples = view_radiance(fragments.by_sample(), shading._replace(indirect=None))
    summed = at_samples.new_zeros(3, len(fragments.pixels)).index_add(1, pixel, at_samples) / fragments.samples**2
    values = at_samples.detach()
    if indirect is not None:
        added = [indirect(albedo, light) for basis, light in shading.lights if not isinstance(basis, LocalBasis)]
        summed = reduce(torch.add, added, summed)
        total = values.new_zeros(summed.shape).index_add(1, pixel, albedo.detach().T.to(values))
        per_albedo = torch.stack(added).sum(0).detach() * fragments.samples**2 / total.masked_fill(total == 0, 1)
        values = values + per_albedo[:, pixel] * albedo.detach().T
    pixels, zeros = moving_outlines(fragments, camera, shading.vertices, faces, values, background)
    coverage = F.pad(fragments.coverage.to(summed), (0, len(pixels)))
    return torch.cat([fragments.pixels, pixels]), coverage, F.pad(summed, (0, len(pixels))) + zeros


def _with_coefficients(light: LocalLight) -> tuple[LocalBasis, Tensor]:
    """A local light with its coefficients (size, 3); without them it shines white, at its full power."""
    pair = (light, None) if isinstance(light, LocalBasis) else light
    if len(pair) != 2 or not isinstance(pair[0], LocalBasis):
        raise InputError(f"lights holds {describe(pair)}: give {_LOCAL_LIGHTS}")
    basis, given = pair
    if given is None:
        return basis, torch.full((basis.size, 3), basis.power)
    values = as_tensor("lights: coefficients", given)
    if values.shape != (basis.size, 3):
        raise InputError(f"lights: {basis} has coefficients of shape {tuple(values.shape)}, give {(basis.size, 3)}")
    require_bounded(lights=values)
    return basis, values


def precompute_transfer(
    mesh: Mesh,
    cameras: Camera | Sequence[Camera],
    size: int = 224,
    *,
    albedo_scale: float = 1.0,
    gloss: Gloss | None = None,
    samples: int = SAMPLES,
    encoding: str = "linear",
    normals: str = "smooth",
    shadows: bool = False,
    bounces: int = 0,
    rasterizer: str = "auto",
) -> TransferOperators:
    """One operator per camera: images and gradients under any number of lights, without rasterizing again.

    `operator.image(light, background)` equals the image of `render`, to rounding. Keywords as there. The operators are
    a sequence whose own method `image` renders all views in one call.

    >>> operators = renderer.precompute_transfer(renderer.solid("pear"), renderer.orbit_cameras(2, 2.2), size=16)
    >>> lights = torch.stack([renderer.load_light("grace"), renderer.load_light("st_peters")])
    >>> operators[0].image(lights).shape, operators.image(lights).shape
    (torch.Size([2, 3, 16, 16]), torch.Size([2, 2, 3, 16, 16]))
    """
    require_mesh("mesh", mesh)
    settings = ImageSettings(size, samples, encoding, normals, shadows, bounces)
    _require_scale(albedo_scale)
    _require_gloss(gloss)
    require_choice("rasterizer", rasterizer, NAMES)
    operators = build_operators(mesh, _listed(cameras), settings, _choose(rasterizer), albedo_scale, gloss=gloss)
    return TransferOperators(operators)


def light_sphere(light: Tensor, size: int, camera: Camera = _OBLIQUE, basis: Basis = HARMONICS) -> Tensor:
    """A light (basis.size, 3) as an image: (3, size, size) float32, sRGB-encoded, of a diffuse white ball on white.

    The ball is that of radius 1 about the origin, which says how far lights in the scene are, and fills the image as
    the camera sees it from afar. Even light of radiance 1 is white. A mirror would show the series ringing and the
    coefficients that reach no surface. InputError: NaN.
    """
    parts = [(part, light[rows].detach().cpu().float()) for rows, part in parts_of(basis)]
    local = [(part, values) for part, values in parts if isinstance(part, LocalBasis)]
    sky = next((values / math.pi for part, values in parts if isinstance(part, Harmonics)), None)
    camera = OrthographicCamera(camera.polar, camera.azimuth, 2.0)
    return render(_white_ball(), camera, sky, size, 1.0, lights=local, encoding="srgb", rasterizer="numpy")[0]


def _listed(cameras: Camera | Sequence[Camera]) -> list[Camera]:
    """Return one camera or several as a list."""
    advice = "a camera or a list of cameras, such as renderer.orbit_cameras(10, width=2.0)"
    listed = as_list("cameras", [cameras] if isinstance(cameras, Camera) else cameras, Camera, advice)
    if not listed:
        raise InputError("cameras is empty: give one camera or several")
    return listed


def _require_scale(albedo_scale: float) -> None:
    """Check the factor of the albedo."""
    require_number("albedo_scale", albedo_scale)
    require_range("albedo_scale", albedo_scale, 0, FACTOR)


def _require_gloss(gloss: Gloss | None) -> None:
    """Check that gloss is a record of its three values, not one of these."""
    require_kind("gloss", gloss, Gloss | None, "renderer.Gloss(roughness, metallic, strength) or None")


def _as_light(light: object) -> Tensor:
    """Convert the coefficients of environment light."""
    if isinstance(light, str):
        raise InputError(f"light is {light!r}: give coefficients, such as renderer.load_light({light!r})")
    coefficients = as_tensor("light", light)
    degree_of(coefficients)
    return coefficients


def _as_albedo(albedo: object) -> Tensor:
    """Convert linear albedo, of which nothing is negative or reflects more than it gets."""
    values = as_tensor("albedo", albedo)
    require_bounded(albedo=values)
    if values.numel() and not (values.min() >= 0 and values.max() <= WHITE):
        extremes = f"{values.min().item():g} to {values.max().item():g}"
        raise InputError(f"albedo holds values from {extremes}: give 0 to 1, and albedo_scale for brighter surfaces")
    return values


def _albedo(mesh: Mesh, view: Fragments, albedo: Tensor | None, encoding: str) -> Tensor:
    """(S, 3) linear albedo at a view's samples."""
    if albedo is None:
        return surface_albedo(mesh, view, encoding)
    if albedo.shape == mesh.faces.shape:
        return face_albedo(albedo, view)
    if albedo.ndim == 3 and albedo.shape[2] == 3 and len(mesh.textures) == 1:
        return surface_albedo(mesh, view, encoding, [albedo])
    advice = f"give {tuple(mesh.faces.shape)}, a color per face, or (H, W, 3) for a mesh that has one texture"
    raise InputError(f"albedo of shape {tuple(albedo.shape)} does not fit the mesh: {advice}")
