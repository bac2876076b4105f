"""The commands' settings and outputs."""

import json
import math
import re
import shlex
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import renderer
from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from renderer.image import decode
from renderer.io.images import read_image
from renderer.light.environment import read_panorama, to_map
from renderer.light.harmonics import equirectangular
from renderer.light.light_files import save_light
from renderer.light.presets import load_light
from scripts.attack import main as attack_command
from train import console
from train.commands.experiment import logged_to
from train.commands.fit import grab_cut
from train.networks import WideResNet, describe
from train.runs.checkpoint import BEST, save
from train.runs.run_lock import LOCK, sole_writer
from train.runs.saved_networks import load_run

USER_ERROR = 2
CLASSES = ["fig", "lime", "orange"]


@pytest.fixture
def here(tmp_path) -> Path:
    """A folder with a network for images of 64 pixels in 1.10, and photographs in 2024."""
    torch.manual_seed(0)
    network = WideResNet(len(CLASSES), 10, 1, 0.0)
    described = describe(network, CLASSES, size=64, encoding="linear", depth=10, width=1, dropout=0.0)
    (tmp_path / "1.10").mkdir()
    save(tmp_path / "1.10" / BEST, {"model": network.state_dict(), "architecture": described})
    rng = np.random.default_rng(0)
    for name in ("2024/orange", "2024/other_\udcff"):
        (tmp_path / name).mkdir(parents=True)
        pixels = rng.integers(0, 256, (64, 64, 3)).astype(np.uint8)
        Image.fromarray(pixels).save(tmp_path / name / "a.png")
    (tmp_path / "file").touch()
    return tmp_path


EVALUATE = ["evaluate", "run=1.10", "photos=2024", "device=cpu", "precision=float32"]
EXPORT = ["light", "light=grace", "height=4"]


def test_a_network_is_scored_on_photographs_in_folders_named_by_numbers_or_not_in_utf_8(call, here, capsys):
    assert call(*EVALUATE, "out=1e3") == 0
    assert "1 images of orange, 1 of other things" in capsys.readouterr().out
    assert {path.name for path in (here / "1e3").iterdir()} == {
        *("predictions.csv", "summary.json", "contact_sheet.png", "roc.csv", "roc.png", LOCK)
    }
    assert json.loads((here / "1e3" / "summary.json").read_text())["size"] == 64
    header, *rows = (here / "1e3" / "predictions.csv").read_text(encoding="utf-8").splitlines()
    assert any(row.startswith(r"other_\udcff/a.png,") for row in rows)
    (first,) = (row.split(",") for row in rows if row.startswith("orange/a.png,"))
    image = np.asarray(Image.open(here / "2024" / "orange" / "a.png")).transpose(2, 0, 1).copy()
    with torch.no_grad():
        logits = load_run(here / "1.10")(torch.from_numpy(image)[None] / 255)[0]
    log_odds = float(logits[2] - logits[:2].logsumexp(0))
    assert float(first[header.split(",").index("orange_log_odds")]) == pytest.approx(log_odds, abs=1e-4)
    assert call(*EVALUATE, "run=null", "classifier=run:1.10", "out=classifier") == 0  # as any other network
    tables = [(here / out / "predictions.csv").read_bytes() for out in ("1e3", "classifier")]
    assert tables[0] == tables[1]


@pytest.mark.parametrize("suffix", [".npy", ".exr", ".hdr"])
def test_a_light_that_is_negative_in_places_is_exported_as_a_map_that_can_be_read(call, here, capsys, suffix):
    """Light of radiance 1 + 2 z has the irradiance π (1 + 4/3 z), whose mean square is π² (1 + 16/27)."""
    light = torch.zeros(49, 3)
    light[0], light[2] = math.sqrt(4 * math.pi), 2 * math.sqrt(4 * math.pi / 3)
    save_light(here / "light.json", light)
    assert call("light", "light=light.json", f"out=map{suffix}", "height=64") == 0
    printed = float(re.search("irradiance is off by ([0-9.]+)%", capsys.readouterr().out)[1])

    radiance = read_panorama(here / f"map{suffix}")[..., 0].double()
    directions, solid_angles = equirectangular(*radiance.shape)
    assert radiance.min() >= 0
    assert float((radiance * solid_angles).sum()) == pytest.approx(4 * math.pi, rel=0.01)
    height = torch.linspace(-1, 1, 201, dtype=torch.float64)
    normals = torch.stack([(1 - height**2).sqrt(), 0 * height, height], dim=1)
    cosines = (normals @ directions.flatten(0, 1).T).clamp(min=0)
    irradiance = cosines @ (radiance * solid_angles).flatten()
    error = (irradiance - math.pi * (1 + 4 / 3 * height)).square().mean().sqrt()
    assert printed == pytest.approx(100 * float(error) / (math.pi * math.sqrt(1 + 16 / 27)), abs=0.5)


WRONG = [
    ([*EVALUATE, "skip_unreadable=maybe"], "skip_unreadable=maybe must be true or false"),
    ([*EVALUATE, "label=pear"], "label: classifier run:1.10: 'pear' is not a class of the model"),
    ([*EVALUATE, "label=[]"], "label=[] must name a class, or several, each once"),
    ([*EVALUATE, "label=[fig,pear]"], "label: classifier run:1.10: 'pear' is not a class of the model"),
    ([*EVALUATE, "classifier=python:own:build"], "give one network"),
    ([*EVALUATE, "run=null", "classifier=python:own:build", "model=python:a:b"], "model=python:a:b is for"),
    ([*EVALUATE, "run=null", "classifier=python:nowhere:build"], "classifier=python:nowhere:build"),
    ([*EVALUATE, "weights=b"], "weights=b is not for run:1.10"),
    ([*EVALUATE, "out=file"], "out=file cannot be written to (Not a directory): choose another folder"),
    (["compare"], "runs is not set: give runs=..."),
    (["compare", "runs=[a,b,./a]"], "runs names a twice"),
    (["compare", "runs=[2024]"], "2024 holds no finished run"),
    (["compare", "--multirun"], "--multirun is not an option"),
    ([*EXPORT, "out=a.jpg"], "out: "),
    (["publish", "run=1.10", "out=file/out"], "out=file/out cannot be written to"),
    ([*EXPORT, "out=file/a.npy"], "out: environment map file/a.npy cannot be written: "),
    (["lab", "out=file/out"], "out=file/out cannot be written to"),
]


@pytest.mark.parametrize(("command", "message"), WRONG, ids=[" ".join([c[0], *c[-2:]]) for c, _ in WRONG])
def test_a_mistake_is_one_line_and_status_2_before_the_work(call, here, capsys, command, message):
    before = sorted(here.rglob("*"))
    assert call(*command) == USER_ERROR
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith(f"error: {message}") and printed.err.count("\n") == 1
    assert sorted(here.rglob("*")) == before


@pytest.mark.parametrize("command", [EVALUATE, ["attack", "classifier=run:1.10"], ["lab"]], ids=lambda given: given[0])
def test_two_commands_do_not_write_in_one_folder(call, here, capsys, command):
    with sole_writer("out", here / "out"):
        assert call(*command, "out=out") == USER_ERROR
    assert "error: out=out is being written by another process" in capsys.readouterr().err
    assert not (here / "out").exists()


def test_a_light_is_not_written_over_itself(call, here, capsys):
    assert call("light", "light=grace", "height=8", "out=a.npy") == 0
    (here / "b.npy").symlink_to("a.npy")
    whole = (here / "a.npy").read_bytes()
    assert call("light", "light=a.npy", "height=8", "out=b.npy") == USER_ERROR
    assert capsys.readouterr().err.startswith("error: out=b.npy is the light itself, which would be lost")
    assert (here / "a.npy").read_bytes() == whole


def test_grab_cut_finds_the_outline_of_a_solid_in_a_box_around_it():
    [camera], light = renderer.orbit_cameras(1, 4.0), renderer.load_light("uniform")
    shown = renderer.solid("orange"), camera, light, 96
    behind = 0.2 + 0.1 * torch.rand(3, 96, 96, generator=torch.Generator().manual_seed(0))
    image = renderer.render(*shown, behind, encoding="srgb")[0]
    mask = grab_cut((255 * image.permute(1, 2, 0)).byte().numpy(), [10, 10, 86, 86]) > 0
    exact = (renderer.render(*shown, 0.0)[0].amax(0) > 0).numpy()
    assert (mask & exact).sum() > 0.95 * (mask | exact).sum()
    for box in ([10, 10, 10, 86], [0, 0, 97, 96], [1, 2, 3]):
        with pytest.raises(InputError, match=r"is not \[left, top, right, bottom\] within 96 × 96 pixels"):
            grab_cut(np.zeros((96, 96, 3), np.uint8), box)


@pytest.mark.slow
def test_a_scene_is_found_in_a_photograph_and_attacks_begin_there(call, here, capsys):
    """A cup in front of noise, at another place than the image's middle: rendered and scored as photographed."""
    camera, light = OrthographicCamera(57.3, 28.6, 4.0, 0.6, -0.3), 0.2 * load_light("grace").double()
    light[0] += 0.2  # no negative radiance
    mesh, size = renderer.normalize(renderer.solid("cup")), 192
    behind = torch.rand(3, size, size, generator=torch.Generator().manual_seed(0)).double()
    image = renderer.render(mesh, camera, light, size, behind, samples=4, encoding="srgb")[0]
    share = 1 - renderer.render(mesh, camera, 0 * light, size, 1.0, samples=4)[0, 0]
    for name, values in (("photo.png", image), ("mask.png", share.expand(3, -1, -1))):
        Image.fromarray((255 * values.permute(1, 2, 0)).round().byte().numpy()).save(here / name)
    fit = ["fit", "photograph=photo.png", "mesh=solid:cup", "out=fitted", "size=48", "bounces=0"]
    Image.new("L", (9, 9), 255).save(here / "small.png")
    Image.new("L", (size, size)).save(here / "black.png")
    for arguments, message in (
        (["mask=small.png"], "mask=small.png has 9 × 9 pixels: give one of the photograph's size, 192 × 192"),
        (["mask=black.png"], "no object is found"),
        (["mask=none.png"], "none.png cannot be read"),
        ([], "give mask=FILE or box=[left,top,right,bottom], one of them"),
    ):
        assert call(*fit, *arguments) == USER_ERROR
        assert message in capsys.readouterr().err and not (here / "fitted").exists()
    assert call(*fit, "mask=mask.png") == 0
    output = capsys.readouterr().out
    command = shlex.split(output.splitlines()[-1])
    settings = attack_command.read(command[1:])
    assert not settings.renderer.shadows and settings.label == "orange"  # as it was fitted
    scene, angles = settings.scene, (settings.scene.polar, settings.scene.azimuth)
    [found], background = renderer.orbit_cameras(1, scene.width, *angles), read_image(scene.backgrounds[0], 64)
    shown = renderer.render(mesh, found, load_light(scene.light), 64, background, samples=4, encoding="srgb")[0]
    differ = (shown - background).abs().amax(0)
    assert (differ > 0).double().mean() > 0.2 and float(differ[differ > 0].mean()) < 0.06  # all else is photographed
    background = read_image(scene.backgrounds[0], 224).double()  # of the pixels of the default classifier
    light = load_light(scene.light).double()
    shown = renderer.render(mesh, found, light, 224, background, samples=2, encoding="srgb")[0]
    inside = read_image(here / "fitted" / "mask.png", 224)[0] > 0.98
    shown, background = (decode(image[:, inside], "srgb") for image in (shown, background))
    real = float((shown - background).norm() / background.norm())
    printed = float(re.search("the object's pixels differ by ([0-9.]+)%", output)[1]) / 100
    assert printed == pytest.approx(real, abs=0.00051) and real < 0.15
    assert to_map(light, 128).min() >= 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_log_on_a_full_disk_prints_no_traceback(capsys):
    with suppress(OSError), logged_to(Path("/dev/full")):
        console.info("a line")
    printed = capsys.readouterr()
    assert printed.out == "a line\n"
    assert printed.err == ""
