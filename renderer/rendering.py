"""Images of meshes in one call.

`render` returns differentiable images. `precompute_transfer` returns transfer
operators, which compute images under many lights without rasterizing again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from typing import TypedDict, Unpack, overload

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from renderer import errors
from renderer.camera import Camera, OrthographicCamera, showing
from renderer.errors import InputError
from renderer.image import as_background, composite, encode
from renderer.light.basis import HARMONICS, Basis, LitBasis, LocalBasis, SplitLight, split_light
from renderer.light.harmonics import degree_of
from renderer.mesh import NO_TEXTURE, Mesh, require_mesh
from renderer.modes import without_autocast
from renderer.operators.apply import TransferOperator
from renderer.operators.build import build_operators
from renderer.operators.rays import LocalLightView, Rays, Surface
from renderer.operators.shadows import build_transport
from renderer.operators.stack import TransferOperators
from renderer.pinhole import PinholeCamera
from renderer.settings import ImageSettings, Size, samples_per_side
from renderer.shaded_view import ShadedView
from renderer.solids import sphere
from renderer.surface.albedo import surface_albedo
from renderer.surface.gloss import Gloss
from renderer.visibility import choose
from renderer.visibility.fragments import build_fragments, views_at_once

# Type of a local light for `render`: a `Lamps` or a `Projector` object, alone or in a pair with its
# coefficients.
LocalLight = LocalBasis | LitBasis
# Largest albedo that `render` accepts: 1 and a margin for rounding errors.
MAX_ALBEDO = 1 + 1e-4
# Words with which errors ask for the argument `lights` of `render`.
_LOCAL_LIGHTS = "a list of lamps and projectors, alone or in pairs (basis, coefficients)"
# Default camera for pictures of lights. It looks from the same direction as the first camera of
# `orbit_cameras`.
_OBLIQUE = OrthographicCamera(60.0, 0.0, 2.0)
# Choosing the rasterizer "opengl" tests the graphics driver, which takes longer than rendering an
# image. The choice is therefore cached.
_choose = cache(choose)
# A white ball of radius 1 around the origin.
_white_ball = cache(lambda: Mesh.plain(*sphere(5)))


@without_autocast
def render(
    mesh: Mesh,
    cameras: Camera | Sequence[Camera],
    light: Float[Tensor, "coefficients 3"] | None,
    size: Size = 224,
    background: float | Float[Tensor, "*views channels height width"] | Float[Tensor, " 3"] = 0.5,
    *,
    lights: Sequence[LocalLight] = (),
    vertices: Float[Tensor, "N 3"] | None = None,
    albedo: Float[Tensor, "F 3"] | Float[Tensor, "rows columns 3"] | None = None,
    albedo_scale: float = 1.0,
    gloss: Gloss | None = None,
    samples: int | None = None,
    encoding: str = "linear",
    normals: str = "smooth",
    shadows: bool = False,
    bounces: int = 0,
    silhouettes: bool = False,
    rasterizer: str = "auto",
) -> Float[Tensor, "*views 3 height width"]:
    """Render a mesh, differentiable with respect to light, vertices, albedo and gloss.

    Arguments can be NumPy arrays or lists instead of tensors. The images have the
    dtype and the device of the light. They are computed in float32 or float64.

    Gradients with respect to the vertices do not include visibility changes,
    unless `silhouettes` is True. Without it, they also hold the barycentric
    coordinates of each sample fixed, as if its point moved with the face. Gradients
    with respect to vertices, albedo and gloss do not include changes of shadows and
    bounces of environment light.

    Args:
        mesh: Mesh with N vertices and F faces.
        cameras: One camera, or a list of V cameras.
        light: SH coefficients of environment light, such as `nb.load_light`
            returns, shape ((degree + 1)², 3). None for no environment light.
        size: Pixels per side of the images, or (height, width). The width of a
            camera is horizontal, and pixels are square.
        background: Background in [0, 1]: a gray value, a color of shape (3,), one
            image of shape (3, height, width), or an image for each camera.
        lights: Local lights, such as `nb.Lamps`. A light alone has full white
            power. A light can also be in a pair with its coefficients,
            shape (light.size, 3). Local lights cast shadows, but do not bounce, so
            `bounces` must be 0.
        vertices: Positions in world units, shape (N, 3). None uses the positions
            of the mesh.
        albedo: Linear albedo in [0, 1], shape (F, 3) for one color per face, or
            (rows, columns, 3) for the only texture. None uses the colors of the
            mesh.
        albedo_scale: Factor for the albedo. The product may exceed 1.
        gloss: Specular reflection. None uses the gloss of the mesh.
        samples: Number of samples along one side of a pixel. None for 2, or for 8
            if `silhouettes` is True.
        encoding: Encoding of the image values, "linear" or "srgb".
        normals: "smooth" interpolates the normals of the vertices, which differ
            between both sides of a sharp edge (see `Mesh.normal_ids`). "flat" uses
            one normal per face.
        shadows: True if the mesh casts shadows of environment light on itself.
        bounces: Number of bounces of light between the surfaces of the mesh. One
            or more includes shadows.
        silhouettes: True includes visibility changes at moving silhouettes in
            gradients with respect to the vertices, and with respect to fields of
            the cameras that are tensors.
        rasterizer: Program that finds the visible faces: "auto", "opengl", "numba",
            "numpy" or "torch".

    Returns:
        Images in [0, 1], shape (V, 3, height, width). For one camera that is not in a
        list, one image of shape (3, height, width).

    Raises:
        InputError: If an argument holds NaN or has a wrong type or shape, if a
            choice is unknown, or if the albedo is not in [0, 1].

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> light = nb.load_light("grace").requires_grad_()
        >>> cameras = nb.orbit_cameras(2, 2.2)
        >>> image = nb.render(nb.solid("apple"), cameras, light, size=16)
        >>> image.shape, torch.autograd.grad(image.mean(), light)[0].shape
        (torch.Size([2, 3, 16, 16]), torch.Size([49, 3]))
    """
    per_side = samples_per_side(samples, silhouettes)
    settings = ImageSettings(size, per_side, encoding, normals, shadows, bounces, silhouettes)
    all_cameras = _checked_cameras(mesh, cameras, albedo_scale, gloss)
    light = None if light is None else _as_light(light)
    albedo = None if albedo is None else _as_albedo(albedo, mesh)
    is_moved = vertices is not None
    vertices = errors.as_tensor("vertices", vertices if is_moved else mesh.vertices)
    errors.require_shape("vertices", vertices, *mesh.vertices.shape)
    given_lights = errors.as_list("lights", lights, LocalBasis | tuple, _LOCAL_LIGHTS)
    # Each local light becomes a pair of a basis and its coefficients.
    local_lights = [_with_coefficients(local_light) for local_light in given_lights]
    # The images have the dtype and the device of the first light.
    given = [light] if light is not None else [values for _, values in local_lights]
    like = given[0] if given else torch.zeros(0)
    image_dtype = like.dtype
    # Rounded to half precision, vertices would move by pixels.
    like = like.to(torch.promote_types(image_dtype, torch.float32))
    pinholes = [camera for camera in all_cameras if isinstance(camera, PinholeCamera)]
    is_movable = not local_lights and len(pinholes) == len(all_cameras)
    if mesh.origin.any() and not is_movable:
        # In coordinates of the earth, float32 would round vertices to meters.
        like = like.double()
    light = None if light is None else light.to(like)
    albedos = [] if albedo is None else [albedo.to(like.device)]
    split = SplitLight(light, [(basis, values.to(like)) for basis, values in local_lights])

    if mesh.origin.any() and is_movable:
        vertices = vertices.double() - torch.from_numpy(mesh.origin).to(vertices.device)
        all_cameras = [camera.translated(-mesh.origin) for camera in pinholes]
        mesh = replace(mesh, vertices=mesh.vertices - mesh.origin)
    vertices = vertices.to(like)
    # Rasterizing and ray tracing have no gradients, so they take a mesh and cameras with plain
    # numbers instead of tensors.
    moved_mesh = replace(mesh, vertices=vertices.detach().cpu().double().numpy())
    all_cameras = showing(all_cameras, moved_mesh.vertices, mesh.faces)
    backgrounds = as_background(background, size, like)
    view_count = len(all_cameras)
    if backgrounds.ndim > 3 and len(backgrounds) not in (1, view_count):
        raise InputError(f"there are {len(backgrounds)} backgrounds: give 1 or {view_count}")
    # Several views at once form a tall image. Rays and silhouettes need single views.
    is_single = bool(local_lights) or settings.global_illumination or silhouettes
    at_once = views_at_once(settings, like.device, is_single)
    is_closed = moved_mesh.closed if is_moved else mesh.closed
    fixed_cameras = [camera.fixed() for camera in all_cameras]
    shown = vertices, mesh.faces, fixed_cameras, settings, _choose(rasterizer), is_closed
    views = build_fragments(*shown, at_once)
    backgrounds_of_views = backgrounds.expand(view_count, -1, -1, -1).split(at_once)
    # Object that computes bounces and shadows of environment light. None without both.
    colored_mesh = moved_mesh
    if albedo is not None and bounces:
        colored_mesh = _recolored(moved_mesh, albedo, encoding)
    transport = build_transport(colored_mesh, settings, albedo_scale, split.basis)
    rays = transport.rays if transport else Rays(moved_mesh)
    images = []
    # Only silhouettes use the camera, and they have single views.
    cameras_of_views = all_cameras[::at_once]
    with errors.joint_checks():
        for camera, view, behind in zip(cameras_of_views, views, backgrounds_of_views, strict=True):
            fragments = view.to(like.device)
            indirect = None
            if transport:
                surface = Surface(moved_mesh, view.to("cpu"), settings, given_gloss=gloss)
                # Function of the albedo and the environment light. It returns the radiance that
                # shadows and bounces add to the pixels.
                indirect = partial(transport.radiance, surface)
            lamp_view = None
            if local_lights:
                on_cpu = fragments.to("cpu")
                lamp_view = LocalLightView(rays, Surface(mesh, on_cpu, settings, vertices, gloss))
            shaded_view = ShadedView(
                mesh=mesh,
                fragments=fragments,
                settings=settings,
                vertices=vertices,
                albedo=surface_albedo(mesh, fragments, encoding, albedos).to(like) * albedo_scale,
                light=split,
                lamp_view=lamp_view,
                gloss=gloss,
                indirect=indirect,
            )
            tall = behind.transpose(0, 1).flatten(1, 2)
            seen = shaded_view.pixel_radiance(camera, tall.flatten(1))
            image = composite(seen.radiance, seen.coverage, seen.pixels, tall, encoding)
            images.append(image.unflatten(1, (len(behind), -1)).transpose(0, 1).to(image_dtype))
    return images[0][0] if isinstance(cameras, Camera) else torch.cat(images)


def _with_coefficients(light: LocalLight) -> LitBasis:
    """Split a light into basis and coefficients, which are white at full power by default."""
    pair = light if isinstance(light, tuple) else (light, None)
    if len(pair) != 2:
        raise InputError(f"lights has the entry {errors.describe(pair)}: give {_LOCAL_LIGHTS}")
    basis, given = pair
    errors.require_kind("lights: a basis", basis, LocalBasis, _LOCAL_LIGHTS)
    if given is None:
        return basis, torch.full((basis.size, 3), basis.power)
    values = errors.as_tensor("lights: coefficients", given)
    errors.require_shape(f"lights: the coefficients of {basis}", values, basis.size, 3)
    errors.require_bounded(lights=values)
    return basis, values


class TransferOptions(TypedDict, total=False):
    """Types of the keyword arguments of `precompute_transfer`."""

    albedo_scale: float
    gloss: Gloss | None
    samples: int
    encoding: str
    normals: str
    shadows: bool
    bounces: int
    rasterizer: str
    device: torch.device | str


@overload
def precompute_transfer(
    mesh: Mesh, cameras: Camera, size: Size = ..., **options: Unpack[TransferOptions]
) -> TransferOperator: ...


@overload
def precompute_transfer(
    mesh: Mesh, cameras: Sequence[Camera], size: Size = ..., **options: Unpack[TransferOptions]
) -> TransferOperators: ...


def precompute_transfer(
    mesh: Mesh,
    cameras: Camera | Sequence[Camera],
    size: Size = 224,
    *,
    albedo_scale: float = 1.0,
    gloss: Gloss | None = None,
    samples: int = ImageSettings.samples,
    encoding: str = "linear",
    normals: str = "smooth",
    shadows: bool = False,
    bounces: int = 0,
    rasterizer: str = "auto",
    device: torch.device | str = "cpu",
) -> TransferOperator | TransferOperators:
    """Compute a transfer operator for each camera.

    A transfer operator computes images under any environment light, and their
    gradients with respect to the light, without rasterizing again. Except for
    rounding errors, `operator.image(light, background)` is the image of `render`.

    Args:
        mesh: Mesh to render.
        cameras: One camera, or a list of V cameras.
        size: Pixels per side of the images, or (height, width).
        albedo_scale: Factor for the albedo.
        gloss: Specular reflection. None uses the gloss of the mesh.
        samples: Number of samples along one side of a pixel.
        encoding: Encoding of the image values, "linear" or "srgb".
        normals: "smooth" interpolates the normals of the vertices, which differ
            between both sides of a sharp edge (see `Mesh.normal_ids`). "flat" uses
            one normal per face.
        shadows: True if the mesh casts shadows of environment light on itself.
        bounces: Number of bounces of light between the surfaces of the mesh. One
            or more includes shadows.
        rasterizer: Program that finds the visible faces: "auto", "opengl", "numba",
            "numpy" or "torch".
        device: Device of the operators, such as "cuda". A GPU computes those without
            shadows, bounces, projectors and lamps itself, many views at once.

    Returns:
        The operator for one camera, or the sequence of operators for a list of
        cameras. The method `image` of the sequence renders all views in one call.

    Raises:
        InputError: If an argument is out of range, or if there is no camera or device.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> cameras = nb.orbit_cameras(2, 2.2)
        >>> operators = nb.precompute_transfer(nb.solid("pear"), cameras, size=16)
        >>> lights = torch.stack([nb.load_light("grace"), nb.load_light("st_peters")])
        >>> operators[0].image(lights).shape, operators.image(lights).shape
        (torch.Size([2, 3, 16, 16]), torch.Size([2, 2, 3, 16, 16]))
    """
    settings = ImageSettings(size, samples, encoding, normals, shadows, bounces)
    fixed = [camera.fixed() for camera in _checked_cameras(mesh, cameras, albedo_scale, gloss)]
    all_cameras = showing(fixed, mesh.vertices, mesh.faces)
    shown = mesh, all_cameras, settings, _choose(rasterizer), albedo_scale
    operators = build_operators(*shown, gloss=gloss, device=errors.as_device(device))
    return operators[0] if isinstance(cameras, Camera) else TransferOperators(operators)


def light_sphere(
    light: Tensor, size: int, camera: Camera = _OBLIQUE, basis: Basis = HARMONICS
) -> Tensor:
    """Render a white diffuse ball under a light, to show the light as an image.

    The ball has radius 1, lies at the origin and fills the image. Under uniform
    light of radiance 1, the ball is white. (A mirror ball would also show
    coefficients that no diffuse surface reflects.)

    Args:
        light: Coefficients of the light, shape (basis.size, 3).
        size: Width and height of the image in pixels.
        camera: Camera that gives the viewing direction.
        basis: Basis of the coefficients. The default is spherical harmonics.

    Returns:
        sRGB-encoded image in front of a white background, float32,
        shape (3, height, width).

    Raises:
        InputError: If the light has values that are not finite.

    Example:
        >>> import norm_balls as nb
        >>> image = nb.light_sphere(nb.load_light("grace"), size=16)
        >>> image.shape
        torch.Size([3, 16, 16])
    """
    light = errors.as_tensor("light", light)
    errors.require_shape("light", light, basis.size, 3)
    # Uniform light of radiance 1 has the irradiance π.
    sky, local = split_light(basis, light.detach().cpu().float() / math.pi)
    camera = OrthographicCamera(camera.polar, camera.azimuth, 2.0)
    return render(
        _white_ball(), camera, sky, size, 1.0, lights=local, encoding="srgb", rasterizer="numpy"
    )


def _checked_cameras(
    mesh: Mesh, cameras: Camera | Sequence[Camera], albedo_scale: float, gloss: Gloss | None
) -> list[Camera]:
    """Check arguments of `render` and `precompute_transfer`, and return the cameras as a list."""
    require_mesh("mesh", mesh)
    errors.require_number("albedo_scale", albedo_scale, 0, errors.MAX_SCALE)
    expected = "nb.Gloss(roughness, metallic, specular_factor) or None"
    errors.require_kind("gloss", gloss, Gloss | None, expected)
    expected = "a camera or a list of cameras, such as nb.orbit_cameras(10, width=2.0)"
    given = [cameras] if isinstance(cameras, Camera) else cameras
    all_cameras = errors.as_list("cameras", given, Camera, expected)
    if not all_cameras:
        raise InputError(f"cameras is empty: give {expected}")
    return all_cameras


def _as_light(light: object) -> Tensor:
    """Convert the argument `light` to a tensor, and check its shape."""
    if isinstance(light, str):
        raise InputError(f"light is {light!r}: give coefficients, such as nb.load_light({light!r})")
    coefficients = errors.as_tensor("light", light)
    # `degree_of` raises an error if the shape is wrong.
    degree_of(coefficients)
    return coefficients


def _as_albedo(albedo: object, mesh: Mesh) -> Tensor:
    """Convert the argument `albedo` to a tensor, and check its shape and its values."""
    values = errors.as_tensor("albedo", albedo)
    errors.require_bounded(albedo=values)
    if values.numel() and not ((values.min() >= 0) & (values.max() <= MAX_ALBEDO)):
        fault = f"albedo has values from {values.min().item():g} to {values.max().item():g}"
        advice = "give values from 0 to 1, and set albedo_scale for brighter surfaces"
        raise InputError(f"{fault}: {advice}")
    # A texture of any resolution may replace the only texture of the mesh.
    is_texture = values.ndim == 3 and values.shape[2] == 3 and len(mesh.textures) == 1
    if values.shape != mesh.faces.shape and not is_texture:
        fault = f"albedo has shape {tuple(values.shape)}, which does not fit the mesh"
        colors = f"give one color per face, {tuple(mesh.faces.shape)}"
        raise InputError(f"{fault}: {colors}, or a texture (H, W, 3) if the mesh has one texture")
    return values


def _recolored(mesh: Mesh, albedo: Float[Tensor, " ..."], encoding: str) -> Mesh:
    """Return a matte mesh with a given albedo, off which light bounces.

    The linear albedo has one row per face, or is the only texture. A texture is rounded
    to 8 bits, which the mean over the patches of a surface evens out.
    """
    colors = encode(albedo.detach().cpu().double(), encoding).numpy()
    mesh = replace(mesh, gloss=None, gloss_textures=())
    if albedo.ndim == 3:
        return replace(mesh, textures=(np.rint(255 * colors).astype(np.uint8),))
    # All three corners of a face get its color, and no face keeps a texture.
    corner_colors = colors[:, None].repeat(3, axis=1).astype(np.float32)
    untextured = np.full_like(mesh.texture_ids, NO_TEXTURE)
    return replace(mesh, corner_colors=corner_colors, texture_ids=untextured, textures=())
