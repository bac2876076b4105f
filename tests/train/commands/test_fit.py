import math
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

import renderer
from augment.scene.objects import load_object
from augment.settings import ObjectSettings
from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.image import decode, encode, to_bytes
from renderer.io.images import read_image
from renderer.io.meshes import export_mesh
from renderer.light.environment import to_map, write_map
from renderer.light.files import load_light
from renderer.light.harmonics import equirectangular, project
from renderer.mesh import Mesh
from renderer.mitsuba_scene import SCENE, render_mitsuba_scene, write_mitsuba_scene
from renderer.settings import ImageSettings
from scripts.attack import main as attack_command

MARGIN = 1.6  # Side of the square around the object, in widths of the object.
SIZE = 192  # Photographs have so many pixels per side.
WHOLE = 0.98  # Coverage from which a pixel shows the object alone.
ROUNDING = 0.0005  # Rounding error of a printed percentage with one decimal.


def textured(name: str) -> Mesh:
    mesh = renderer.solid(name)
    azimuth = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0])[mesh.faces] / (2 * np.pi)
    azimuth = np.where(np.ptp(azimuth, axis=1, keepdims=True) > 0.5, azimuth % 1, azimuth)
    height = mesh.vertices[:, 2][mesh.faces] / 2 + 0.5
    noise = np.random.default_rng(0).integers(60, 250, (6, 10, 3), dtype=np.uint8)
    texture = np.array(Image.fromarray(noise).resize((160, 96), Image.Resampling.BICUBIC))
    return replace(
        Mesh.plain(mesh.vertices, mesh.faces),
        corner_uvs=np.stack([azimuth, height], axis=-1).astype(np.float32),
        texture_ids=np.zeros(len(mesh.faces), dtype=np.int32),
        textures=(texture,),
    )


def generated_map() -> Tensor:
    """Make a map (64, 128, 3) of a blue sky, a brown ground and a warm, much brighter lamp."""
    directions, _ = equirectangular(64, 128)
    up = directions[..., 2:]
    sky = torch.tensor([0.5, 0.7, 1.0]).double() * (0.6 + 0.4 * up)
    ground = torch.tensor([0.3, 0.25, 0.2]).double()
    toward = torch.tensor([0.6, -0.3, 0.74]).double()
    lamp = (directions @ (toward / toward.norm()) > 0.97)[..., None]
    return torch.where(up > 0, sky, ground) + 60 * lamp * torch.tensor([1.0, 0.9, 0.7]).double()


def unclipped(radiance: Tensor) -> Tensor:
    """Scale a map so that a white surface is nowhere brighter than 1."""
    light = project(radiance.double(), 20)
    directions = torch.from_numpy(renderer.normalize(renderer.solid("orange")).vertices)
    directions = directions / directions.norm(dim=1, keepdim=True)
    harmonics = renderer.light.basis.Harmonics(20)
    brightest = (harmonics.irradiance(directions) @ light[harmonics.nonzero]).max()
    return radiance * (0.95 / brightest)


def photograph(folder: Path, mesh: Mesh, camera: Camera, radiance: Tensor, encoding: str) -> float:
    """Path-trace photo.png and mask.png, and return the width of the object in image widths."""
    write_map(folder / "light.exr", radiance)
    settings = ImageSettings(SIZE, bounces=3, encoding=encoding)
    write_mitsuba_scene(folder, mesh, 1.0, [camera], settings, "light.exr")
    traced = render_mitsuba_scene(folder / SCENE, 1, (SIZE, SIZE))[0].double()
    share = traced[3].clamp(0, 1)
    image = encode((traced[:3] + 0.3 * (1 - share)).clamp(0, 1), encoding)
    for name, values in (("photo.png", image), ("mask.png", share.expand(3, -1, -1))):
        Image.fromarray(to_bytes(values.permute(1, 2, 0)).numpy()).save(folder / name)
    rows, columns = ((share > 0.5).any(axis).nonzero() for axis in (1, 0))
    return float(max(rows.max() - rows.min(), columns.max() - columns.min())) / SIZE


def irradiance(mesh: Mesh, camera: Camera, light: Tensor) -> Tensor:
    """Compute the irradiance of the visible surface without shadows, shape (3, pixels)."""
    white = Mesh.plain(mesh.vertices, mesh.faces)
    dim = 1e-3  # Values are so small that none is clamped.
    return renderer.render(white, camera, dim * light.double(), 96, 0.0).flatten(1) / dim


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["srgb", "linear"])
def test_camera_and_light_of_a_path_traced_textured_solid_are_found(
    call, tmp_path, capsys, encoding
):
    pytest.importorskip("mitsuba")
    name = str(tmp_path / "pear.glb")
    export_mesh(renderer.normalize(textured("pear")), name)
    camera = PerspectiveCamera(68.8, 40.1, 3.0, 0.2, -0.1, distance=5.0)
    radiance = unclipped(generated_map())
    mesh = load_object(ObjectSettings(name, label="orange")).mesh
    side = MARGIN * photograph(tmp_path, mesh, camera, radiance, encoding)
    angle = 2 * math.degrees(math.atan(math.tan(math.radians(camera.angle) / 2) * side))
    files = f"mesh={name}", "photograph=photo.png", "mask=mask.png", "out=fitted", "label=orange"
    capsys.readouterr()
    assert call("fit", *files, f"encoding={encoding}", f"fov={angle}") == 0
    output = capsys.readouterr().out
    printed = float(re.search(r"the object's pixels differ by ([0-9.]+)%", output)[1]) / 100
    command = shlex.split(output.splitlines()[-1])
    quick = "attack.force=true", "attack.max_steps=1", "attack.checks=false", "out=a"
    assert call("attack", *command[1:], *quick) == 0
    [file] = (tmp_path / "a").glob("**/before.npy")
    shown = torch.from_numpy(np.load(file))[0].double()
    background = read_image(tmp_path / "fitted" / "background.png", shown.shape[-1]).double()
    inside = read_image(tmp_path / "fitted" / "mask.png", shown.shape[-1])[0] > WHOLE
    expected = decode(background, encoding)[:, inside]
    real = float((decode(shown, encoding)[:, inside] - expected).norm() / expected.norm())
    assert printed == pytest.approx(real, abs=1.01 * ROUNDING)
    assert real < 0.05
    light = load_light(str(tmp_path / "fitted" / "light.json"), None)
    assert float(to_map(light, 256).min()) >= 0
    found = irradiance(mesh, camera, light)
    true = irradiance(mesh, camera, project(radiance.double(), 20))
    assert float(((found - true).norm(dim=1) / true.norm(dim=1)).max()) < 0.07
    scene = attack_command.read(command[1:]).scene
    toward = torch.from_numpy(camera.eye()[:3])
    seen = OrthographicCamera(scene.polar, scene.azimuth, scene.width)
    cosine = seen.axes()[2] @ (toward / toward.norm()).numpy()
    assert cosine > math.cos(math.radians(1.5))
