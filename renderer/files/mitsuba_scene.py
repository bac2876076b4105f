"""Views of a mesh as a Mitsuba 3 scene in files: scene.xml, .ply parts with their normals, and their textures.

Light from an environment map, with shadows always and with the bounces of `ImageSettings.transport`: under "direct",
what a concave mesh throws on itself is dark there, and lit here. Mitsuba's diffuse surfaces reflect albedo / π of the
irradiance, ours all of it: the map's scale makes up for that, and for the albedo's gain, which only a bounce would have
more than once. Its radiance is premultiplied with alpha, as ours with the coverage.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import torch
from PIL import Image

from renderer.basis import Distant, Placed
from renderer.camera import Camera, PerspectiveCamera
from renderer.environment import write_map
from renderer.errors import InputError
from renderer.files.albedo_bake import with_added_albedo
from renderer.files.mesh_export import corner_normals
from renderer.harmonics import basis, equirectangular
from renderer.image import ImageSettings, bounces, decode
from renderer.lamps import Lamps
from renderer.mesh import Mesh
from renderer.projector import Projector

SCENE = "scene.xml"
SAMPLES = 256  # per pixel, spread evenly: the noise in a smooth light is then below 1/255
VARIANT = "scalar_rgb"  # needs no LLVM, and renders the same bits on any number of threads
DIFFERENTIABLE = "llvm_ad_rgb"
TO_Z_UP = ((0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1))  # its maps have y up and +z in the middle

_XML = """<scene version="3.0.0">
    {integrator}
    <emitter type="envmap">
        <string name="filename" value="{light}"/>
        <float name="scale" value="{scale}"/>
        <float name="sampling_weight" value="{sky_weight}"/>
        <transform name="to_world"><matrix value="{to_z_up}"/></transform>
    </emitter>
{placed}
{sensors}
{shapes}
</scene>
"""
_DIRECT = (
    '<integrator type="direct"><integer name="emitter_samples" value="{emitter_samples}"/>'
    '<integer name="bsdf_samples" value="1"/><boolean name="hide_emitters" value="true"/></integrator>'
)
_PATH = (
    '<integrator type="path"><integer name="max_depth" value="{depth}"/><integer name="rr_depth" value="{depth}"/>'
    '<boolean name="hide_emitters" value="true"/></integrator>'
)
_PROJECTOR = """    <emitter type="projector">
        <texture name="irradiance" type="bitmap">
            <string name="filename" value="{file}"/>
            <boolean name="raw" value="true"/>
            <string name="filter_type" value="nearest"/>
            <string name="wrap_mode" value="clamp"/>
        </texture>
        <float name="fov" value="{degrees}"/>
        <float name="scale" value="{scale}"/>
        <transform name="to_world"><matrix value="{pose}"/></transform>
    </emitter>"""
_LAMP = """    <emitter type="point">
        <point name="position" x="{}" y="{}" z="{}"/>
        <rgb name="intensity" value="{} {} {}"/>
    </emitter>"""
_DISC = """    <shape type="disk">
        <transform name="to_world"><matrix value="{pose}"/></transform>
        <emitter type="area"><rgb name="radiance" value="{red} {green} {blue}"/></emitter>
    </shape>"""
_SENSOR = """    <sensor type="{kind}">
        {angle}
        <transform name="to_world"><matrix value="{pose}"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="{size}"/>
            <integer name="height" value="{size}"/>
            <string name="pixel_format" value="rgba"/>
            <rfilter type="box"/>
        </film>
        <sampler type="multijitter"><integer name="sample_count" value="{samples}"/></sampler>
    </sensor>"""
_SHAPE = """    <shape type="ply">
        <string name="filename" value="{file}"/>
        <boolean name="flip_tex_coords" value="true"/>
        <bsdf type="twosided"><bsdf type="diffuse">{albedo}</bsdf></bsdf>
    </shape>"""
_VERTEX_COLOR = '<texture name="reflectance" type="mesh_attribute"><string name="name" value="vertex_color"/></texture>'
_BITMAP = (
    '<texture name="reflectance" type="bitmap"><string name="filename" value="{file}"/>'
    '<boolean name="raw" value="{raw}"/></texture>'
)


def write_mitsuba_scene(
    folder: Path,
    mesh: Mesh,
    gain: float,
    cameras: Sequence[Camera],
    settings: ImageSettings,
    light: str,
    placed: Sequence[tuple[Distant | Placed, torch.Tensor]] = (),
) -> None:
    """Write a folder whose scene.xml shows a mesh to each camera, a sensor each. light: the map's file, as seen from
    there. placed: projectors and lamps, with their coefficients. Where a texture is on corners of other colours it is
    painted anew, since Mitsuba has no product of the two.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if (mesh.corner_colors[mesh.texture_ids >= 0] != 1).any():
        mesh, _ = with_added_albedo(mesh, np.zeros((len(mesh.faces), 3)), settings.encoding)
    count = bounces(settings.transport)
    scene = _XML.format(
        integrator=_PATH.format(depth=count + 2) if count else _DIRECT.format(emitter_samples=1 if placed else 0),
        sky_weight=0 if placed else 1,  # surfaces find the sky by themselves, with less noise
        placed="\n".join(emitter for lit in placed for emitter in _emitters(folder, *lit, gain)),
        light=escape(light),
        scale=math.pi * gain,
        to_z_up=" ".join(str(entry) for row in TO_Z_UP for entry in row),
        sensors="\n".join(_sensor(camera, settings.size) for camera in cameras),
        shapes="\n".join(_write_parts(folder, mesh, settings)),
    )
    (folder / SCENE).write_text(scene, encoding="utf-8")


def mitsuba_map(coefficients: torch.Tensor, height: int) -> torch.Tensor:
    """Radiance (height, 2 · height, 3) float64 of a light's coefficients at the texels as Mitsuba's `envmap` places
    them: its outermost rows are the poles. At 256 rows those of `to_map` would be taken for light 0.2 % dimmer."""
    directions, _ = equirectangular(1, 2 * height)
    around, polar = directions[0, :, :2], torch.linspace(0, math.pi, height, dtype=torch.float64)  # z is 0, the mean
    rows = (torch.cat([at.sin() * around, at.cos().expand(len(around), 1)], dim=1) for at in polar)
    degree = math.isqrt(len(coefficients)) - 1
    return torch.stack([basis(row, degree) @ coefficients.to(row) for row in rows])


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


def _emitters(folder: Path, basis: Distant | Placed, coefficients: torch.Tensor, gain: float) -> Iterator[str]:
    """The scales make up for what `write_mitsuba_scene` says of the sky's; a projector's radiance is over π already."""
    if isinstance(basis, Lamps):
        for place, power in zip(basis.places, (math.pi * gain * coefficients).tolist(), strict=True):
            yield _LAMP.format(*place, *power) if not basis.radius else _disc(place, basis.radius, power)
    elif isinstance(basis, Projector):
        write_map(folder / "pattern.exr", coefficients.view(basis.pixels, basis.pixels, 3))
        camera = PerspectiveCamera(basis.polar, basis.azimuth, 1.0, distance=basis.distance)
        yield _PROJECTOR.format(
            file="pattern.exr",
            degrees=math.degrees(basis.field_of_view),
            scale=gain * basis.distance**2,
            pose=_pose(camera, 1.0),
        )


def _disc(place: Sequence[float], radius: float, power: Sequence[float]) -> str:
    """Mitsuba's disks have radius 1 and shine along +z. The radiance is that of a far point's intensity on the area."""
    x, y, z = place
    camera = PerspectiveCamera(math.atan2(math.hypot(x, y), z), math.atan2(y, x), 1.0, distance=math.hypot(x, y, z))
    red, green, blue = (channel / (math.pi * radius**2) for channel in power)
    return _DISC.format(pose=_pose(camera, radius), red=red, green=green, blue=blue)


def _pose(camera: Camera, scale: float) -> str:
    """Mitsuba's cameras and projectors look along +z and have x to the left."""
    right, up, back = camera.axes()
    pose = np.eye(4)
    pose[:3, :3] = np.stack([-scale * right, scale * up, -back], axis=1)
    pose[:3, 3] = camera.position()
    return " ".join(f"{value:.17g}" for value in pose.ravel())


def _sensor(camera: Camera, size: int) -> str:
    """Mitsuba's orthographic camera sees [-1, 1] in x and y."""
    kind, angle, scale = "orthographic", "", camera.field_of_view / 2
    if isinstance(camera, PerspectiveCamera):
        kind, angle, scale = "perspective", f'<float name="fov" value="{math.degrees(camera.angle)}"/>', 1.0
    return _SENSOR.format(kind=kind, angle=angle, pose=_pose(camera, scale), size=size, samples=SAMPLES)


def _write_parts(folder: Path, mesh: Mesh, settings: ImageSettings) -> Iterator[str]:
    """A shape for each texture, and one for the faces without: part_0.ply and so on, with its texture_0.png."""
    normals, raw = corner_normals(mesh, settings.normals), str(settings.encoding == "linear").lower()
    for number, index in enumerate(np.unique(mesh.texture_ids)):
        here = mesh.texture_ids == index
        colors = decode(torch.from_numpy(mesh.corner_colors[here]), settings.encoding).numpy()
        corners = [mesh.vertices[mesh.faces[here]], normals[here], mesh.corner_uvs[here], colors]
        (folder / f"part_{number}.ply").write_bytes(_ply(np.concatenate(corners, axis=-1).astype("<f4")))
        albedo = _VERTEX_COLOR
        if index >= 0:
            Image.fromarray(mesh.textures[index]).save(folder / f"texture_{number}.png")
            albedo = _BITMAP.format(file=f"texture_{number}.png", raw=raw)
        yield _SHAPE.format(file=f"part_{number}.ply", albedo=albedo)


def _ply(corners: np.ndarray) -> bytes:
    """Faces (F, 3, 11) whose corners have a position, normal, uv and linear colour each."""
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {3 * len(corners)}",
        *(f"property float {name}" for name in (*"xyz", "nx", "ny", "nz", *"uvrgb")),
        f"element face {len(corners)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    faces = np.empty(len(corners), dtype=[("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, np.arange(3 * len(corners)).reshape(-1, 3)
    return "\n".join(header).encode() + corners.tobytes() + faces.tobytes()
