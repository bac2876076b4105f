"""pnb-fit finds camera and light of a photograph, and prints the command that attacks it."""

import math
import re
import shlex

import numpy as np
import pytest
import torch
from PIL import Image

import renderer
from augment.scene.objects import load_object
from augment.settings import ObjectSettings
from renderer.camera import OrthographicCamera, PerspectiveCamera
from renderer.image import decode, to_bytes
from renderer.io.images import read_image
from renderer.light.environment import to_map
from renderer.light.files import load_light
from scripts.attack import main as attack_command

MARGIN = 1.6  # Side of the square around the object, in widths of the object.
SIZE = 128  # Photographs have so many pixels per side.
WHOLE = 0.98  # Coverage from which a pixel shows the object alone.
ROUNDING = 0.0005  # Rounding error of a printed percentage with one decimal.


@pytest.mark.slow
def test_camera_and_light_are_found_and_attacked_by_the_printed_command(call, tmp_path, capsys):
    mesh = load_object(ObjectSettings("solid:mushroom", label="orange")).mesh
    camera = PerspectiveCamera(63.0, 57.3, 3.0, 0.2, -0.1, distance=6.0)
    light = 0.2 * load_light("grace")
    image = renderer.render(mesh, camera, light, SIZE, 0.1, encoding="srgb", samples=8)
    share = 1 - renderer.render(mesh, camera, 0 * light, SIZE, 1.0, samples=8)
    for name, values in (("photo.png", image), ("mask.png", share)):
        Image.fromarray(to_bytes(values.permute(1, 2, 0)).numpy()).save(tmp_path / name)
    rows, columns = ((share[0] > 0.5).any(axis).nonzero() for axis in (1, 0))
    width = float(max(rows.max() - rows.min(), columns.max() - columns.min())) / SIZE
    tangent = MARGIN * width * math.tan(math.radians(camera.angle) / 2)
    files = "mesh=solid:mushroom", "photograph=photo.png", "mask=mask.png", "out=fitted ü"
    capsys.readouterr()
    words = "label=orange", "encoding=srgb", f"fov={2 * math.degrees(math.atan(tangent))}"
    assert call("fit", *files, *words) == 0
    output = capsys.readouterr().out
    printed = float(re.search(r"the object's pixels differ by ([0-9.]+)%", output)[1]) / 100
    command = shlex.split(output.splitlines()[-1])
    quick = "attack.force=true", "attack.max_steps=1", "attack.checks=false", "out=a"
    assert call("attack", *command[1:], *quick) == 0
    [file] = (tmp_path / "a").glob("**/before.npy")
    shown = torch.from_numpy(np.load(file))[0].double()
    background = read_image(tmp_path / "fitted ü" / "background.png", shown.shape[-1]).double()
    inside = read_image(tmp_path / "fitted ü" / "mask.png", shown.shape[-1])[0] > WHOLE
    expected = decode(background, "srgb")[:, inside]
    real = float((decode(shown, "srgb")[:, inside] - expected).norm() / expected.norm())
    assert printed == pytest.approx(real, abs=1.01 * ROUNDING)
    assert real < 0.05
    found = load_light(str(tmp_path / "fitted ü" / "light.json"), None)
    assert float(to_map(found, 256).min()) >= 0
    scene = attack_command.read(command[1:]).scene
    toward = torch.from_numpy(camera.eye()[:3])
    seen = OrthographicCamera(scene.polar, scene.azimuth, scene.width)
    cosine = seen.axes()[2] @ (toward / toward.norm()).numpy()
    assert cosine > math.cos(math.radians(1.5))
