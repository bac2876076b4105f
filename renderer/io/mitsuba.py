"""Views of a mesh as a Mitsuba 3 scene in files: scene.xml, .ply parts with their normals, and their textures.

Light from an environment map, with shadows always and with the bounces of `ImageSettings`: without shadows,
what a concave mesh throws on itself is dark there, and lit here. Mitsuba's diffuse surfaces reflect albedo / π of the
irradiance, ours all of it: the map's scale makes up for that, and for the albedo's gain, which only a bounce would have
more than once. Its radiance is premultiplied with alpha, as ours with the coverage.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jinja2 import StrictUndefined, Template
from PIL import Image

from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError
from renderer.image import ImageSettings, decode
from renderer.io.export import corner_normals
from renderer.io.texture_bake import with_added_albedo
from renderer.light.basis import EnvironmentBasis, LocalBasis
from renderer.light.environment import light_radiance, write_map
from renderer.light.harmonics import equirectangular
from renderer.light.local import Lamps, Projector
from renderer.mesh import Mesh

SCENE, PATTERN = "scene.xml", "pattern.exr"
TEMPLATE = Path(__file__).with_name("mitsuba.xml.jinja")
SAMPLES = 256  # per pixel, spread evenly: the noise in a smooth light is then below 1/255
VARIANT = "scalar_rgb"  # needs no LLVM, and renders the same bits on any number of threads
DIFFERENTIABLE = "llvm_ad_rgb"
TO_Z_UP = ((0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1))  # its maps have y up and +z in the middle


def write_mitsuba_scene(
    folder: Path,
    mesh: Mesh,
    albedo_scale: float,
    cameras: Sequence[Camera],
    settings: ImageSettings,
    light: str,
    placed: Sequence[tuple[EnvironmentBasis | LocalBasis, torch.Tensor]] = (),
) -> None:
    """Write a folder whose scene.xml shows a mesh to each camera, a sensor each. light: the map's file, as seen from
    there. placed: projectors and lamps, with their coefficients. Where a texture is on corners of other colors it is
    painted anew, since Mitsuba has no product of the two.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if (mesh.corner_colors[mesh.texture_ids >= 0] != 1).any():
        mesh, _ = with_added_albedo(mesh, np.zeros((len(mesh.faces), 3)), settings.encoding)
    template = Template(
        TEMPLATE.read_text("utf-8"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    scene = template.render(
        bounces=settings.bounces,
        light=light,
        scale=math.pi * albedo_scale,
        to_z_up=" ".join(str(entry) for row in TO_Z_UP for entry in row),
        placed=[emitter for lit in placed for emitter in _emitters(folder, *lit, albedo_scale)],
        sensors=[_sensor(camera) for camera in cameras],
        size=settings.size,
        samples=SAMPLES,
        parts=list(_write_parts(folder, mesh, settings)),
        encoding=settings.encoding,
    )
    (folder / SCENE).write_text(scene, encoding="utf-8")


def mitsuba_map(coefficients: torch.Tensor, height: int) -> torch.Tensor:
    """Radiance (height, 2 · height, 3) float64 of a light's coefficients at the texels as Mitsuba's `envmap` places
    them: its outermost rows are the poles. At 256 rows those of `to_map` would be taken for light 0.2 % dimmer."""
    around, _ = equirectangular(1, 2 * height)  # z is 0, the mean
    polar = torch.linspace(0, math.pi, height, dtype=torch.float64)[:, None, None]
    return light_radiance(coefficients, polar.sin() * around + polar.cos() * torch.tensor([0.0, 0.0, 1.0]))


def render_mitsuba_scene(path: Path, views: int) -> torch.Tensor:
    """(views, 4, size, size) float32 linear radiance and coverage of a scene's .xml file, a sensor each.

    InputError: Mitsuba is not installed, or refuses the file.
    """
    with mitsuba() as mi:
        try:
            scene = mi.load_file(str(path))
            images = [np.array(mi.render(scene, sensor=view)) for view in range(views)]
        except RuntimeError as error:
            raise InputError(f"{path} is not rendered by Mitsuba: {str(error).splitlines()[0]}") from error
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)


@contextmanager
def mitsuba(variant: str = VARIANT) -> Iterator[Any]:
    """The module under a variant; that of before, if any, comes back. InputError: it, or its LLVM, is not installed."""
    try:
        import drjit
        import mitsuba as module
    except ImportError as error:
        raise InputError("Mitsuba is not installed: pip install '.[lab]'") from error
    before = module.variant()
    try:
        module.set_variant(variant)
    except ImportError as error:
        raise InputError(f"Mitsuba finds no LLVM: install libllvm19, or set DRJIT_LIBLLVM_PATH ({error})") from error
    drjit.set_thread_count(max(2, drjit.thread_count()))  # with one, of one core, its reader of .exr waits forever
    try:
        yield module
    finally:
        if before:
            module.set_variant(before)


def _emitters(
    folder: Path, basis: EnvironmentBasis | LocalBasis, coefficients: torch.Tensor, albedo_scale: float
) -> Iterator[dict[str, Any]]:
    """The scales make up for what `write_mitsuba_scene` says of the sky's; a projector's radiance is over π already.

    Mitsuba's disks have radius 1 and shine along +z; their radiance is that of a far point's intensity on the area.
    """
    if isinstance(basis, Lamps):
        for (x, y, z), color in zip(basis.positions, math.pi * albedo_scale * coefficients, strict=True):
            if not basis.radius:
                yield {"type": "point", "place": (x, y, z), "color": color.tolist()}
                continue
            polar, distance = math.atan2(math.hypot(x, y), z), math.hypot(x, y, z)
            camera = PerspectiveCamera(polar, math.atan2(y, x), 1.0, distance=distance)
            area = math.pi * basis.radius**2
            color = [channel / area for channel in color.tolist()]
            yield {"type": "disk", "pose": _pose(camera, basis.radius), "color": color}
    elif isinstance(basis, Projector):
        write_map(folder / PATTERN, coefficients.view(basis.pixels, basis.pixels, 3))
        camera = PerspectiveCamera(basis.polar, basis.azimuth, 1.0, distance=basis.distance)
        scale, degrees = albedo_scale * basis.distance**2, math.degrees(basis.fov)
        yield {"type": "projector", "file": PATTERN, "degrees": degrees, "scale": scale, "pose": _pose(camera, 1.0)}


def _pose(camera: Camera, scale: float) -> str:
    """Mitsuba's cameras and projectors look along +z and have x to the left."""
    pose = camera.pose()
    pose[:3] *= [-scale, scale, -1, 1]
    return " ".join(f"{value:.17g}" for value in pose.ravel())


def _sensor(camera: Camera) -> dict[str, Any]:
    """Mitsuba's orthographic camera sees [-1, 1] in x and y."""
    if isinstance(camera, PerspectiveCamera):
        return {"degrees": math.degrees(camera.angle), "pose": _pose(camera, 1.0)}
    return {"degrees": None, "pose": _pose(camera, camera.width / 2)}


def _write_parts(folder: Path, mesh: Mesh, settings: ImageSettings) -> Iterator[dict[str, str | None]]:
    """A shape for each texture, and one for the faces without: part_0.ply and so on, with its texture_0.png."""
    normals = corner_normals(mesh, settings.normals)
    for number, index in enumerate(np.unique(mesh.texture_ids)):
        here, file, texture = mesh.texture_ids == index, f"part_{number}.ply", f"texture_{number}.png"
        colors = decode(torch.from_numpy(mesh.corner_colors[here]), settings.encoding).numpy()
        corners = [mesh.vertices[mesh.faces[here]], normals[here], mesh.corner_uvs[here], colors]
        _write_ply(folder / file, np.concatenate(corners, axis=-1).reshape(-1, 11))
        if index >= 0:
            Image.fromarray(mesh.textures[index]).save(folder / texture)
        yield {"file": file, "texture": texture if index >= 0 else None}


def _write_ply(path: Path, corners: np.ndarray) -> None:
    """Corners (3 F, 11) of faces, three after three, with a position, normal, uv and linear color each."""
    import trimesh

    attributes = dict(zip("uvrgb", corners[:, 6:].astype(np.float32).T, strict=True))
    faces = np.arange(len(corners)).reshape(-1, 3)
    part = trimesh.Trimesh(
        corners[:, :3], faces, vertex_normals=corners[:, 3:6], vertex_attributes=attributes, process=False
    )
    part.export(path, vertex_normal=True)
