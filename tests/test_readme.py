"""Each block of Python in the README, the guide and pretrained/ runs, and the first command."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import trimesh
from PIL import Image
from torch import nn
from torch.utils.data import ConcatDataset
from torchvision import models, tv_tensors

import norm_balls
import renderer
from augment import lighting
from renderer.image import to_bytes
from tests.helpers import save_plain
from train.command_settings import RenderSettings
from train.commands.render import run as write_renders

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/guide.md", "pretrained/README.md")
BLOCKS = {
    heading: "".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    for page in PAGES
    for heading, text in re.findall(
        r"^#{2,4} (.*?)\n(.*?)(?=^#{2,4} |\Z)", (ROOT / page).read_text(), re.M | re.DOTALL
    )
    if "```python" in text
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    trimesh.creation.icosphere(2).export(tmp_path / "orange.glb")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def run(heading: str, **names) -> dict[str, object]:
    """Run the block under a heading with given names, and return the names that it defines."""
    exec(BLOCKS[heading], names)
    return names


def test_every_block_of_python_is_run_here():
    assert BLOCKS.keys() == {*re.findall(r'[ (]run\("(.+?)"', Path(__file__).read_text())}


def test_random_light_block_relights_a_batch_and_a_clip():
    names = run("Random light on your own images")
    assert names["images"].dtype == torch.uint8 and names["images"].shape == (8, 3, 64, 96)
    assert len(names["frames"]) == 8


def linear_network() -> tuple[nn.Sequential, torch.Tensor]:
    """Return a network, and a copy of its weights."""
    network = nn.Sequential(nn.Flatten(), nn.Linear(3 * 32**2, 100))
    return network, network[1].weight.detach().clone()


@pytest.fixture
def relit(monkeypatch) -> list[object]:
    """The types of the images that random light has changed."""
    types, apply = [], norm_balls.RandomLighting.apply

    def applied(self, image, params, depth=None):
        types.append(type(image))
        return apply(self, image, params, depth)

    monkeypatch.setattr(norm_balls.RandomLighting, "apply", applied)
    return types


def write_data_set(name: str) -> None:
    meshes = [{"mesh": f"solid:{name}"} for name in ("orange", "cup")]
    write_renders(RenderSettings(meshes=meshes, out=name, format=name, count=4, size=[64, 64]))


@pytest.mark.slow
def test_torchvision_classifier_block_trains_on_relit_photographs(folder, monkeypatch):
    for index, name in enumerate(("orange", "cup") * 2):
        path = folder / "photographs" / "train" / name / f"{index}.png"
        save_plain(path, (90, 60 * index, 30), (64, 48))
    build = models.mobilenet_v3_small
    monkeypatch.setattr(models, "mobilenet_v3_small", lambda weights: build())
    names = run("In torchvision, for a classifier")
    assert names["images"].shape == (4, 3, 224, 224) and names["labels"].sum() == 2
    assert names["model"].classifier[-1].weight.grad.any()


@pytest.mark.ecosystem
@pytest.mark.filterwarnings("default")
def test_torchvision_detector_block_trains_on_relit_images_with_boxes(monkeypatch, relit):
    pytest.importorskip("pycocotools")
    write_data_set("coco")
    build = models.detection.fasterrcnn_mobilenet_v3_large_320_fpn
    monkeypatch.setattr(
        models.detection, build.__name__, lambda weights: build(weights_backbone=None)
    )
    names = run("In torchvision, for a detector")
    assert relit == [tv_tensors.Image] * 3
    assert all(value.isfinite() and value > 0 for value in names["losses"].values())
    assert names["detector"].roi_heads.box_predictor.bbox_pred.weight.grad.any()


@pytest.mark.ecosystem
@pytest.mark.filterwarnings("ignore")
def test_ultralytics_block_trains_on_relit_images(folder, monkeypatch):
    pytest.importorskip("ultralytics")
    pytest.importorskip("albumentations")
    write_data_set("yolo")
    # In one process, so that the test sees what is relit. All images, since p is drawn anew.
    monkeypatch.setattr("ultralytics.cfg.DEFAULT_CFG.workers", 0)
    relit, apply = [], lighting._apply_to_tensor
    counted = lambda *given: (relit.append(given), apply(*given))[1]  # noqa: E731
    monkeypatch.setattr(lighting, "_apply_to_tensor", counted)
    names = run("In Ultralytics")
    assert "Lighting" in str(names["detector"].trainer.args.augmentations)
    assert relit and names["detector"].trainer.last.exists()


@pytest.mark.ecosystem
@pytest.mark.filterwarnings("default")
def test_lightning_module_block_trains_on_relit_images(relit):
    pytest.importorskip("lightning")
    network, before = linear_network()
    run("In a Lightning module", network=network, data=PHOTOGRAPHS)
    assert relit == [torch.Tensor]
    assert not torch.equal(network[1].weight, before)


def test_plain_loop_block_trains_on_relit_and_worst_images(relit):
    network, before = linear_network()
    optimizer = torch.optim.SGD(network.parameters(), lr=0.01)
    data = [(torch.full((3, 32, 32), 0.5), 1)] * 40
    run("In a plain loop", network=network, data=data, optimizer=optimizer)
    # The second batch is seen in two lights, and shown in the worse one.
    assert len(relit) == 4
    assert not torch.equal(network[1].weight, before)


def test_detector_block_hides_an_orange_from_the_published_detector(folder, monkeypatch):
    fast = BLOCKS["A detector"].replace('encoding="srgb"', 'encoding="srgb", shadows=False')
    monkeypatch.setitem(BLOCKS, "A detector", fast)
    assert run("A detector")["result"].success.all()
    assert (folder / "detector.png").exists()


def test_render_block_has_a_gradient_by_light(monkeypatch):
    monkeypatch.setitem(BLOCKS, "Render", BLOCKS["Render"].replace("224", "56"))
    names = run("Render")
    assert names["images"].shape == (10, 3, 56, 56)
    assert names["light"].grad.any()


def test_many_meshes_block_has_gradients_by_all_lights():
    names = run("Many meshes")
    names["images"].mean().backward()
    assert names["lights"].grad.flatten(1).any(1).all()


def test_many_views_block_renders_each_view_and_light():
    names = run("Many lights and views")
    assert names["images"].shape == (100, 2, 3, 32, 32)
    assert names["own_images"].shape == (100, 3, 32, 32)
    assert names["lights"].grad.any()
    assert names["gradient"].any()


def test_cameras_block_renders_and_builds_a_scene_of_the_camera_in_the_files(folder):
    trimesh.creation.icosphere(2).export(folder / "orange.ply")
    (folder / "sparse").mkdir()
    (folder / "sparse" / "cameras.txt").write_text("1 SIMPLE_PINHOLE 224 224 300 112 112\n")
    # A camera without rotation looks along +z. The sphere is 4 units in front of it.
    (folder / "sparse" / "images.txt").write_text("1 1 0 0 0 0 0 4 1 view.png\n\n")
    names = run("Your own cameras")
    assert names["images"].shape == (1, 3, 224, 224)
    assert names["images"][0, :, 112, 112].min() > 0
    assert len(names["scene"]) == 1


def test_load_block_recognizes_an_orange(folder):
    shown = renderer.solid("orange", 0), renderer.orbit_cameras(1, width=2.4)
    image = renderer.render(*shown, renderer.load_light("grace"), 96)
    Image.fromarray(to_bytes(image[0]).permute(1, 2, 0).numpy()).save(folder / "orange.jpg")
    assert run("Load")["predicted"] == "orange"


def test_photographs_block_publishes_a_network_with_its_threshold(folder):
    for name, color in (("orange", (230, 120, 40)), ("cup", (90, 90, 200))):
        for index in range(20):
            path = folder / "lab" / name / f"{index}.png"
            save_plain(path, tuple(value - 3 * index for value in color), (32, 32))
    run("Photographs", nb=norm_balls)
    (point,) = norm_balls.load_run("published/best").operating_points
    assert point.label == "orange"


def test_attack_block_fools_the_installed_network_in_three_views(folder):
    names = run("Attack a network")
    result = names["result"]
    orange = names["network"].classes.index("orange")
    assert result.logits_in_views_before.argmax(-1).eq(orange).all()
    assert result.logits_in_views.argmax(-1).ne(orange).all()
    assert result.success.all()
    assert (folder / "attack.png").is_file()


@pytest.mark.slow
def test_block_without_gradients_finds_an_adversary_with_few_queries():
    result = run("Networks without gradients")["result"]
    assert result.success.all()
    # Three more queries count the success with the noise of a sensor.
    assert (result.queries <= 203).all()
    assert not result.backward_passes.any()


# Gray images whose labels are numbers, as torchvision's are, in a data set.
GRAYS = [(torch.full((3, 32, 32), label / 8), label) for label in range(8)]
PHOTOGRAPHS = ConcatDataset([GRAYS])


def test_training_loop_block_trains_on_data_and_renders():
    torch.manual_seed(0)
    network, before = linear_network()
    optimizer = torch.optim.SGD(network.parameters(), lr=0.01)
    given = {"torch": torch, "network": network, "data": PHOTOGRAPHS, "optimizer": optimizer}
    names = run("Your own training loop", **given)
    assert len(names["renders"]) == 10
    assert names["renders"].labels.eq(53).all()
    assert names["renders"].images.shape == (10, 3, 32, 32)
    assert not torch.equal(network[1].weight, before)


@pytest.mark.ecosystem
@pytest.mark.filterwarnings("default")
def test_lightning_block_trains_the_module_of_the_guide_on_data_and_renders():
    pytest.importorskip("lightning")
    guide = run("In a Lightning module", network=linear_network()[0], data=PHOTOGRAPHS)
    network, before = linear_network()
    module = guide["Classifier"](network)
    names = run("PyTorch Lightning, and loggers", module=module, data=PHOTOGRAPHS)
    assert len(names["callback"].renders.current) == 10
    assert not torch.equal(network[1].weight, before)


def test_data_set_block_shows_the_class_of_each_render(capsys):
    names = run("Labeled renders on disk")
    assert names["render"].labels == ["orange"]
    assert names["render"].masks.any()
    assert len(capsys.readouterr().out.splitlines()) == 10


def read_auc(folder: Path) -> float:
    return json.loads((folder / "laboratory" / "summary.json").read_text())["auc"]["value"]


@pytest.mark.slow
def test_the_demonstration_ends_with_a_table_of_the_effect_and_a_report(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)}
    options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-m", "train"], check=True, **options)
    lines = done.stdout.splitlines()
    # The result fits on a screen.
    assert len(lines) <= 20
    page = Path(lines[-1].removeprefix("report: "))
    folder = page.parent
    before = read_auc(folder / "before")
    after = read_auc(folder)
    assert after > before + 0.05
    header, _, *rows = [line.split("|") for line in lines if line.startswith("|")]
    column = [cell.strip() for cell in header].index("AUC")
    printed = [row[column].strip() for row in rows]
    assert printed == [f"{before:.3f}", f"{after:.3f}"]
    assert "Examples of renders" in page.read_text()
