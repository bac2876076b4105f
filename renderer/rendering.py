"""Images of meshes in one call.

`render` returns differentiable images. `precompute_transfer` returns operators,
which give images under many lights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING, overload

import torch
from torch import Tensor

from renderer.camera import Camera, OrthographicCamera
from renderer.errors import (
    MAX_SCALE,
    InputError,
    describe,
    require_bounded,
    require_choice,
    require_range,
)
from renderer.geometry.mesh import Mesh, require_mesh
from renderer.geometry.shapes import sphere
from renderer.image import as_background, composite
from renderer.light.basis import HARMONICS, Basis, LocalBasis, SplitLight, split_light
from renderer.light.harmonics import degree_of
from renderer.settings import RASTERIZERS, ImageSettings, samples_per_side
from renderer.shaded_view import ShadedView
from renderer.shading.gloss import Gloss
from renderer.surface.albedo import face_albedo, surface_albedo
from renderer.transport.operator_stacks import TransferOperators
from renderer.transport.operators import TransferOperator, build_operators
from renderer.transport.precomputed import build_transport
from renderer.transport.rays import Rays, Surface
from renderer.validation import as_list, as_tensor, require_kind, require_number
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import choose

if TYPE_CHECKING:
    from jaxtyping import Float

# Type of an entry of the argument `lights` of `render`: lamps or a projector, alone or
# with their coefficients, shape (size, 3).
LocalLight = LocalBasis | tuple[LocalBasis, Tensor]
# Largest albedo that `render` accepts. It is 1, and a margin for rounding errors.
WHITE = 1 + 1e-4
# Description of the argument `lights` in errors.
_LOCAL_LIGHTS = "a list of lamps and projectors, alone or in pairs (basis, coefficients)"
# Default camera of `light_sphere`. It has the direction of the first camera of
# `orbit_cameras`.
_OBLIQUE = OrthographicCamera(60.0, 0.0, 2.0)
# Function `choose` with a cache. Choosing "opengl" tests the driver, which takes longer
# than rendering an image.
_choose = cache(choose)


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
) -> Float[Tensor, "*views 3 size size"]:
    """Render a mesh from V cameras, differentiable in light, vertices, albedo and gloss.

    A camera alone, outside a list, gives an image without a views dimension.

    NumPy arrays and lists are taken instead of tensors. The images have the
    dtype and the device of the light.

    Gradients by the vertices hold visibility constant. Gradients by vertices,
    albedo and gloss also hold shadows and bounces of environment light constant.

    Args:
        mesh: The mesh, of N vertices and F faces.
        cameras: One camera, or a list of V cameras.
        light: Coefficients of environment light, shape ((degree + 1)², 3), such
            as `nb.load_light` returns. None for no environment light.
        size: Pixels per side of the images.
        background: Gray value, color (3,) or images in [0, 1], see
            `renderer.image.as_background`. One for all views, or an image for each.

        lights: Local lights, such as `nb.Lamps`, alone for full
            white power or in pairs with coefficients (size, 3). They cast shadows
            and do not bounce.

        vertices: Positions in world units instead of the mesh's, shape (N, 3).
        albedo: Linear albedo in [0, 1] instead of the mesh's colors, shape (F, 3)
            for a color per face or (height, width, 3) for the only texture.
        albedo_scale: Factor of the albedo, also beyond 1.
        gloss: Gloss instead of the mesh's.

        samples: Samples per side of a pixel. None for 2, or 8 with silhouettes.
        encoding: Encoding of the image values, "linear" or "srgb".
        rasterizer: What finds the visible faces, "auto", "opengl", "numba" or
            "numpy".

        normals: "smooth" for interpolated normals, "flat" for a normal per face.
        shadows: Whether the mesh casts shadows of environment light on itself.
        bounces: Number of bounces of light between the surfaces of the mesh, which
            include shadows.
        silhouettes: Whether gradients by the vertices, and by fields of the
            cameras that are tensors of one number, also see how outlines and
            surfaces move in the image.

    Returns:
        Images in [0, 1], shape (V, 3, size, size), or (3, size, size) of one
        camera.

    Raises:
        InputError: If an argument holds NaN or has another type, shapes do not
            fit, a choice is unknown, or the albedo is not in [0, 1].

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> light = nb.load_light("grace").requires_grad_()
        >>> cameras = nb.orbit_cameras(2, 2.2)
        >>> image = nb.render(nb.solid("apple"), cameras, light, size=16)
        >>> image.shape, torch.autograd.grad(image.mean(), light)[0].shape
        (torch.Size([2, 3, 16, 16]), torch.Size([49, 3]))
    """
    require_mesh("mesh", mesh)
    per_side = samples_per_side(samples, silhouettes)
    settings = ImageSettings(size, per_side, encoding, normals, shadows, bounces, silhouettes)
    all_cameras = _listed(cameras)
    _require_scale(albedo_scale)
    _require_gloss(gloss)
    require_choice("rasterizer", rasterizer, RASTERIZERS)
    light = None if light is None else _as_light(light)
    albedo = None if albedo is None else _as_albedo(albedo)
    vertices = None if vertices is None else as_tensor("vertices", vertices)
    if vertices is not None and vertices.shape != mesh.vertices.shape:
        shape = tuple(vertices.shape)
        raise InputError(
            f"vertices of shape {shape} does not fit the mesh: give {mesh.vertices.shape}"
        )
    given_lights = as_list("lights", lights, LocalBasis | tuple, _LOCAL_LIGHTS)
    # Pairs of lamps or a projector with their coefficients.
    local_lights = [_with_coefficients(local_light) for local_light in given_lights]
    # The images have the dtype and the device of the first light.
    like = torch.zeros(0) if light is None else light
    if light is None and local_lights:
        like = local_lights[0][1]
    split = SplitLight(light, [(basis, values.to(like)) for basis, values in local_lights])

    vertices = (torch.from_numpy(mesh.vertices) if vertices is None else vertices).to(like)
    # Visible faces and blocked rays are found without gradients, so these steps take a mesh
    # and cameras with plain numbers.
    moved = replace(mesh, vertices=vertices.detach().cpu().double().numpy())
    fixed_cameras = [camera.fixed() for camera in all_cameras]
    views = build_fragments(
        moved.vertices,
        mesh.faces,
        fixed_cameras,
        settings,
        _choose(rasterizer),
        closed=mesh.closed,
    )
    backgrounds = as_background(background, size, like).expand(len(views), -1, -1, -1)
    # Shadows on environment light and bounces. None if neither is rendered.
    transport = build_transport(moved, settings, albedo_scale, split.basis)
    rays = transport.rays if transport else Rays(moved)
    images = []
    for camera, view, behind in zip(all_cameras, views, backgrounds, strict=True):
        fragments = view.to(like.device)
        # Function of the albedo and of the environment light that computes how shadows and
        # bounces change the radiance.
        indirect = None
        if transport:
            surface = Surface(moved, view, settings, given_gloss=gloss)
            indirect = partial(transport.radiance, surface)
        shown = ShadedView(
            mesh=mesh,
            fragments=fragments,
            settings=settings,
            vertices=vertices,
            albedo=_albedo(mesh, fragments, albedo, encoding).to(like) * albedo_scale,
            light=split,
            rays=rays,
            gloss=gloss,
            indirect=indirect,
        )
        seen = shown.pixel_radiance(camera, behind.flatten(1))
        images.append(composite(seen.radiance, seen.coverage, seen.pixels, behind, encoding))
    return images[0] if isinstance(cameras, Camera) else torch.stack(images)


@cache
def _white_ball() -> Mesh:
    """Create a white ball of radius 1."""
    return Mesh.plain(*sphere(5))


def _with_coefficients(light: LocalLight) -> tuple[LocalBasis, Tensor]:
    """Split an entry of the argument `lights` of `render` into basis and coefficients.

    Args:
        light: Lamps or a projector, alone or in a pair with coefficients.

    Returns:
        Basis, and its coefficients, shape (size, 3). They are white light at full
        power if none were given.

    Raises:
        InputError: If the entry has another type, or the coefficients have a wrong
            shape or NaN.
    """
    pair = light if isinstance(light, tuple) else (light, None)
    if len(pair) != 2:
        raise InputError(f"lights has the entry {describe(pair)}: give {_LOCAL_LIGHTS}")
    basis, given = pair
    require_kind("lights: a basis", basis, LocalBasis, _LOCAL_LIGHTS)
    if given is None:
        return basis, torch.full((basis.size, 3), basis.power)
    values = as_tensor("lights: coefficients", given)
    if values.shape != (basis.size, 3):
        shape = tuple(values.shape)
        expected = (basis.size, 3)
        raise InputError(
            f"lights: the coefficients of {basis} have shape {shape}: give the shape {expected}"
        )
    require_bounded(lights=values)
    return basis, values


@overload
def precompute_transfer(
    mesh: Mesh,
    cameras: Camera,
    size: int = ...,
    *,
    albedo_scale: float = ...,
    gloss: Gloss | None = ...,
    samples: int = ...,
    encoding: str = ...,
    normals: str = ...,
    shadows: bool = ...,
    bounces: int = ...,
    rasterizer: str = ...,
) -> TransferOperator: ...


@overload
def precompute_transfer(
    mesh: Mesh,
    cameras: Sequence[Camera],
    size: int = ...,
    *,
    albedo_scale: float = ...,
    gloss: Gloss | None = ...,
    samples: int = ...,
    encoding: str = ...,
    normals: str = ...,
    shadows: bool = ...,
    bounces: int = ...,
    rasterizer: str = ...,
) -> TransferOperators: ...


def precompute_transfer(
    mesh: Mesh,
    cameras: Camera | Sequence[Camera],
    size: int = 224,
    *,
    albedo_scale: float = 1.0,
    gloss: Gloss | None = None,
    samples: int = ImageSettings.samples,
    encoding: str = "linear",
    normals: str = "smooth",
    shadows: bool = False,
    bounces: int = 0,
    rasterizer: str = "auto",
) -> TransferOperator | TransferOperators:
    """Compute a transfer operator for each camera.

    An operator gives images, and their gradients by the light, without rasterizing
    again. `operator.image(light, background)` equals the image of `render` up to
    rounding.

    Args:
        mesh: The mesh.
        cameras: One camera, or a list of V cameras.
        size: Width and height of the images in pixels.
        albedo_scale: Factor of the albedo.
        gloss: Gloss instead of the mesh's.
        samples: Samples per side of a pixel.
        encoding: Encoding of the image values, "linear" or "srgb".
        normals: "smooth" for interpolated normals, "flat" for a normal per face.
        shadows: Whether the mesh casts shadows of environment light on itself.
        bounces: Number of bounces of light between the surfaces of the mesh, which
            include shadows.
        rasterizer: "auto", "opengl", "numba" or "numpy".

    Returns:
        The operator of one camera, or the sequence of operators of a list of
        cameras. The method `image` of the sequence renders all views in one call.

    Raises:
        InputError: If an argument is out of range, or if there is no camera.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> cameras = nb.orbit_cameras(2, 2.2)
        >>> operators = nb.precompute_transfer(nb.solid("pear"), cameras, size=16)
        >>> lights = torch.stack([nb.load_light("grace"), nb.load_light("st_peters")])
        >>> operators[0].image(lights).shape, operators.image(lights).shape
        (torch.Size([2, 3, 16, 16]), torch.Size([2, 2, 3, 16, 16]))
    """
    require_mesh("mesh", mesh)
    settings = ImageSettings(size, samples, encoding, normals, shadows, bounces)
    _require_scale(albedo_scale)
    _require_gloss(gloss)
    require_choice("rasterizer", rasterizer, RASTERIZERS)
    operators = build_operators(
        mesh, _listed(cameras), settings, _choose(rasterizer), albedo_scale, gloss=gloss
    )
    return operators[0] if isinstance(cameras, Camera) else TransferOperators(operators)


def light_sphere(
    light: Tensor, size: int, camera: Camera = _OBLIQUE, basis: Basis = HARMONICS
) -> Tensor:
    """Render a white diffuse ball in a light, to show the light as an image.

    The ball has radius 1 and lies at the origin, so that the image also shows
    how far lamps are from it. It fills the image, as seen from afar. Under even
    light of radiance 1, the ball is white. A ball that mirrors would instead
    show coefficients that no diffuse surface reflects.

    Args:
        light: Coefficients of the light, shape (basis.size, 3).
        size: Pixels per side.
        camera: Camera whose direction shows the ball.
        basis: Basis of the coefficients.

    Returns:
        Image before a white background, sRGB-encoded, shape (3, size, size),
        float32.

    Raises:
        InputError: If the light has values that are not finite.

    Example:
        >>> import norm_balls as nb
        >>> image = nb.light_sphere(nb.load_light("grace"), size=16)
        >>> image.shape
        torch.Size([3, 16, 16])
    """
    light = as_tensor("light", light)
    if light.ndim != 2 or light.shape[1] != 3:
        shape = tuple(light.shape)
        raise InputError(f"light has shape {shape}: give coefficients {(basis.size, 3)}")
    sky, local = split_light(basis, light.detach().cpu().float())
    sky = None if sky is None else sky / math.pi
    camera = OrthographicCamera(camera.polar, camera.azimuth, 2.0)
    return render(
        _white_ball(), camera, sky, size, 1.0, lights=local, encoding="srgb", rasterizer="numpy"
    )


def _listed(cameras: Camera | Sequence[Camera]) -> list[Camera]:
    """Convert one camera or a sequence of cameras to a list.

    Args:
        cameras: Camera, or sequence of cameras.

    Returns:
        List of one or more cameras.

    Raises:
        InputError: If the sequence is empty or has an entry of another type.
    """
    advice = "a camera or a list of cameras, such as nb.orbit_cameras(10, width=2.0)"
    listed = as_list(
        "cameras", [cameras] if isinstance(cameras, Camera) else cameras, Camera, advice
    )
    if not listed:
        raise InputError("cameras is empty: give at least one camera")
    return listed


def _require_scale(albedo_scale: float) -> None:
    """Raise `InputError` if `albedo_scale` is no number from 0 to `MAX_SCALE`."""
    require_number("albedo_scale", albedo_scale)
    require_range("albedo_scale", albedo_scale, 0, MAX_SCALE)


def _require_gloss(gloss: Gloss | None) -> None:
    """Raise `InputError` if `gloss` is neither a `Gloss` nor None."""
    require_kind(
        "gloss", gloss, Gloss | None, "nb.Gloss(roughness, metallic, specular_factor) or None"
    )


def _as_light(light: object) -> Tensor:
    """Convert the argument `light` to a tensor, and check its shape.

    Args:
        light: SH coefficients as a tensor, an array or a list.

    Returns:
        SH coefficients, shape ((degree + 1)², 3).

    Raises:
        InputError: If the argument is a string, or has a wrong shape.
    """
    if isinstance(light, str):
        raise InputError(f"light is {light!r}: give coefficients, such as nb.load_light({light!r})")
    coefficients = as_tensor("light", light)
    degree_of(coefficients)
    return coefficients


def _as_albedo(albedo: object) -> Tensor:
    """Convert the argument `albedo` to a tensor, and check that its values are in [0, 1].

    Args:
        albedo: Linear albedo as a tensor, an array or a list.

    Returns:
        Linear albedo.

    Raises:
        InputError: If a value is NaN or not in [0, 1].
    """
    values = as_tensor("albedo", albedo)
    require_bounded(albedo=values)
    if values.numel() and not (values.min() >= 0 and values.max() <= WHITE):
        extremes = f"{values.min().item():g} to {values.max().item():g}"
        raise InputError(
            f"albedo has values from {extremes}: give values from 0 to 1, and set albedo_scale "
            "for brighter surfaces"
        )
    return values


def _albedo(mesh: Mesh, view: Fragments, albedo: Tensor | None, encoding: str) -> Tensor:
    """Compute the linear albedo at the S covered samples of a view.

    Args:
        mesh: Mesh that the view shows, with F faces.
        view: Covered samples of the view.
        albedo: Albedo to use instead of the colors of the mesh, shape (F, 3) for
            one color per face, or (H, W, 3) for the only texture of the mesh.
            None uses the colors of the mesh.
        encoding: Encoding of the colors of the mesh, "linear" or "srgb".

    Returns:
        Linear albedo, shape (S, 3).

    Raises:
        InputError: If the albedo has a wrong shape.
    """
    if albedo is None:
        return surface_albedo(mesh, view, encoding)
    if albedo.shape == mesh.faces.shape:
        return face_albedo(albedo, view)
    if albedo.ndim == 3 and albedo.shape[2] == 3 and len(mesh.textures) == 1:
        return surface_albedo(mesh, view, encoding, [albedo])
    raise InputError(
        f"albedo has shape {tuple(albedo.shape)}, which does not fit the mesh: give one color per "
        f"face, {tuple(mesh.faces.shape)}, or a texture (H, W, 3) if the mesh has one texture"
    )
