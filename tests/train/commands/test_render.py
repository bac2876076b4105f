import json
import math
import re
import shutil
import tarfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yaml
from PIL import Image
from torchvision.datasets import ImageFolder

import norm_balls as nb
from augment import dataset
from augment.dataset import describe_camera, render_dataset
from augment.scene.scene import Scene
from renderer.camera import PerspectiveCamera
from renderer.errors import InputError
from scripts.render import main, name_light
from train.command_settings import RenderSettings
from train.commands.render import run
from train.data.annotations import DATA_SET

COUNT = 11
MAPS = ["mask", "depth", "normals"]


@pytest.fixture(autouse=True, scope="module")
def small_blocks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "BLOCK", 4)
        yield


@pytest.fixture(scope="module")
def meshes(tmp_path_factory) -> list[dict[str, str]]:
    folder = tmp_path_factory.mktemp("meshes")
    trimesh.creation.box().export(folder / "box.ply")
    trimesh.creation.icosphere(2).export(folder / "ball.ply")
    return [{"mesh": str(folder / f"{name}.ply"), "label": name} for name in ("box", "ball")]


def write(meshes, out: Path, **options) -> Path:
    chosen = {"size": 12, "count": COUNT, "splits": {"train": 2, "val": 1}} | options
    run(RenderSettings(meshes=meshes, out=str(out), device="cpu", **chosen))
    return out


@pytest.fixture(scope="module")
def written(meshes, tmp_path_factory) -> Path:
    """Write a folder with all maps."""
    return write(meshes, tmp_path_factory.mktemp("written") / "out", maps=MAPS)


def pictures(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.rglob("[0-9]*.png"))}


def details(folder: Path, index: int) -> dict:
    return json.loads((folder / "details" / f"{index:06d}.json").read_text())


def test_parts_without_a_render_of_a_class_number_the_classes_alike(meshes, tmp_path):
    out = write(meshes, tmp_path / "out", count=3, maps=[])
    parts = [ImageFolder(str(out / part), allow_empty=True) for part in ("train", "val")]
    assert parts[0].class_to_idx == parts[1].class_to_idx == {"ball": 0, "box": 1}


def test_an_object_that_is_drawn_without_a_label_is_named(meshes, tmp_path, caplog):
    box, ball = meshes
    write([box | {"others": [{"mesh": ball["mesh"]}, ball]}], tmp_path / "out", count=1, maps=[])
    assert caplog.text.count(ball["mesh"]) == 1


def test_torchvision_reads_the_classes_of_folders(written):
    for part, count in {"train": 7, "val": 4}.items():
        found = ImageFolder(str(written / part))
        assert len(found) == count and found.classes == ["ball", "box"]
        for path, label in found.samples:
            of_render = details(written, int(Path(path).stem))
            assert of_render["objects"][0]["class"] == found.classes[label]
            assert of_render["split"] == part


def test_boxes_and_run_lengths_of_coco_are_those_of_the_mask(meshes, tmp_path):
    folder = write(meshes, tmp_path / "out", format="coco")
    found = json.loads((folder / "annotations/instances_val.json").read_text())
    assert len(found["images"]) == len(found["annotations"]) == 4
    for image, item in zip(found["images"], found["annotations"], strict=True):
        assert item["image_id"] == image["id"]
        assert (folder / "val" / image["file_name"]).exists()
        mask = np.array(Image.open(folder / "details" / f"{image['id'] - 1:06d}_mask.png"))
        counts, size = (item["segmentation"][key] for key in ("counts", "size"))
        decoded = np.repeat(np.arange(len(counts)) % 2, counts).reshape(size[::-1]).T
        assert (decoded == (mask == 1)).all()
        left, top, width, height = item["bbox"]
        box = left, top, left + width, top + height
        assert box == Image.fromarray(mask).getbbox()
        assert item["area"] == (mask == 1).sum()


def test_lines_of_yolo_are_centers_and_sizes_as_fractions(meshes, tmp_path):
    folder = write(meshes, tmp_path / "out", format="yolo", size=[8, 16])
    names = yaml.safe_load((folder / "data.yaml").read_text())["names"]
    for path in (folder / "labels").rglob("*.txt"):
        [line] = path.read_text().splitlines()
        label, x, y, width, height = map(float, line.split())
        [item] = details(folder, int(path.stem))["objects"]
        left, top, right, bottom = item["box"]
        assert names[int(label)] == item["class"]
        found = [16 * (x - width / 2), 8 * (y - height / 2), 16 * width, 8 * height]
        assert found == pytest.approx([left, top, right - left, bottom - top], abs=1e-4)


def test_an_object_too_thin_for_a_box_has_an_image_and_no_annotation(tmp_path):
    trimesh.creation.box((2, 0.02, 0.02)).export(tmp_path / "wire.ply")
    wires = [{"mesh": str(tmp_path / "wire.ply"), "label": "wire"}]
    options = {"count": 2, "splits": {"train": 1}, "maps": []}
    coco = write(wires, tmp_path / "coco", format="coco", **options)
    found = json.loads((coco / "annotations/instances_train.json").read_text())
    assert len(found["images"]) == 2 and not found["annotations"]
    yolo = write(wires, tmp_path / "yolo", format="yolo", **options)
    assert [path.read_text() for path in (yolo / "labels/train").iterdir()] == ["", ""]


def test_without_maps_the_pictures_are_the_same(meshes, written, tmp_path):
    folder = write(meshes, tmp_path / "out", maps=[])
    assert pictures(written).items() >= pictures(folder).items()
    assert len(pictures(folder)) == COUNT
    assert "depth_scale" not in details(folder, 0)


def test_views_of_one_light_each_are_shaded_as_operators_shade_them(meshes):
    # Two views in a block of four renders are shaded directly, and one view has an operator.
    ball = [(meshes[1]["mesh"], "ball")]
    [direct], [operator] = (
        render_dataset(ball, 24, 1, views=views, fov=30.0, seed=1) for views in (2, 1)
    )
    assert (direct.image.int() - operator.image.int()).abs().max() <= 1
    assert torch.equal(direct.masks, operator.masks)


def test_every_tenth_of_a_data_set_shows_all_sides_of_the_objects(meshes):
    """Twelve views in front of five backgrounds: each tenth has six pairs of them."""
    ball = [(meshes[1]["mesh"], "ball")]
    backgrounds = [0.1, 0.3, 0.5, 0.7, 0.9]
    of_scene = {"views": 12, "backgrounds": backgrounds, "exposure": 1.0}
    renders = list(render_dataset(ball, 8, 60, maps=False, **of_scene))
    # Direction from the object to the camera.
    backs = [tuple(np.round(np.array(render.camera["pose"])[:3, 2], 6)) for render in renders]
    assert Counter(Counter(backs).values()) == {5: 12}
    tenths = [{*backs[start : start + 6]} for start in range(0, 60, 6)]
    assert min(map(len, tenths)) >= 3
    assert max(np.linalg.norm(np.mean(list(tenth), axis=0)[:2]) for tenth in tenths) < 0.6


def test_masks_are_found_for_all_renders_of_a_block_together(meshes, monkeypatch):
    counts = []
    find = Scene.truth

    def counted(scene, index_of, *chosen):
        if len(chosen) == 2:  # with conditions, as building a scene gives none
            counts.append(len(chosen[0]))
        return find(scene, index_of, *chosen)

    monkeypatch.setattr(Scene, "truth", counted)
    # One view in a block of four renders has an operator.
    ball = [(meshes[1]["mesh"], "ball")]
    assert len(list(render_dataset(ball, 12, COUNT, views=1))) == COUNT
    assert counts == [4, 4, 3]


def test_maps_of_renders_do_not_need_the_default_type_of_torch(meshes):
    try:
        torch.set_default_dtype(torch.float64)
        [render] = render_dataset([(meshes[1]["mesh"], "ball")], 12, 1)
    finally:
        torch.set_default_dtype(torch.float32)
    lengths = render.normals.norm(dim=0)[render.masks[0]]
    torch.testing.assert_close(lengths, torch.ones_like(lengths, dtype=torch.float32))


@pytest.mark.parametrize("format", ["webdataset", "coco"])
def test_the_disk_space_that_is_announced_is_not_exceeded(meshes, tmp_path, capsys, format):
    augment = RenderSettings(out="unused").augment
    augment.vary.camera.noise = 1.0  # Noise cannot be compressed.
    options = {"count": 4, "size": 160, "format": format, "maps": MAPS, "augment": augment}
    out = write(meshes, tmp_path / "out", **options)
    written = sum(path.stat().st_size for path in out.rglob("*.*"))
    announced = 1e6 * int(re.search(r"at most (\d+) MB", capsys.readouterr().out)[1])
    assert announced / 4 < written <= announced


def test_a_tar_file_has_the_same_pictures_as_a_folder(meshes, written, tmp_path):
    expected = pictures(written)
    folder = write(meshes, tmp_path / "tar", format="webdataset", maps=MAPS)
    found = {}
    for path in folder.glob("*.tar"):
        with tarfile.open(path) as tar:
            for member in tar:
                stem, *parts = member.name.split(".")
                name = "_".join([stem, *parts[:-1]]) + "." + parts[-1]
                found[name] = tar.extractfile(member).read()
    assert {name: found[name] for name in expected} == expected
    assert {found[name] for name in found if name.endswith(".cls")} == {b"0", b"1"}


def test_shards_and_stopped_commands_give_the_same_pictures(meshes, written, tmp_path):
    expected = pictures(written)
    folder = tmp_path / "shards"
    for shard in (1, 0):
        write(meshes, folder, maps=MAPS, shards=2, shard=shard)
    assert pictures(folder) == expected
    kept = folder / "details/000000.json"
    before = kept.stat().st_mtime_ns
    for index in (4, COUNT - 1):
        (folder / f"details/{index:06d}.json").unlink()
    write(meshes, folder, maps=MAPS)
    assert pictures(folder) == expected and kept.stat().st_mtime_ns == before


@pytest.mark.parametrize("changed", [{"seed": 1}, {"format": "coco"}])
def test_a_data_set_of_other_settings_is_not_continued(meshes, written, changed):
    with pytest.raises(InputError, match=next(iter(changed))):
        write(meshes, written, maps=MAPS, **changed)


def test_a_data_set_of_a_mesh_that_changed_is_not_continued(tmp_path):
    mesh = tmp_path / "mesh.ply"
    trimesh.creation.box().export(mesh)
    one = [{"mesh": str(mesh), "label": "one"}]
    folder = write(one, tmp_path / "out", count=1, maps=[])
    # Earlier versions wrote no fingerprints.
    path = folder / "data_set.json"
    described = json.loads(path.read_text())
    assert described.pop("inputs").keys() == {str(mesh)}
    trimesh.creation.icosphere(1).export(mesh)
    with pytest.raises(InputError, match=f"{mesh} has changed since"):
        write(one, folder, count=1, maps=[])
    path.write_text(json.dumps(described))
    write(one, folder, count=1, maps=[])


def test_a_command_that_failed_before_its_first_render_can_be_corrected(meshes, tmp_path):
    with pytest.raises(InputError, match="absent"):
        write(["absent.ply"], tmp_path / "out")
    assert len(pictures(write(meshes[:1], tmp_path / "out", count=1, maps=[]))) == 1


def test_processes_that_begin_at_once_do_not_refuse_the_folder(meshes, tmp_path, monkeypatch):
    out, listed = tmp_path / "out", Path.iterdir
    first = write(meshes[:1], tmp_path / "first", count=1, maps=[])

    def begun(folder):
        """List the folder while another process writes its description."""
        if folder == out:
            (out / ".pnb-1.tmp").touch()
        yield from listed(folder)
        if folder == out:
            shutil.copy(first / DATA_SET, out)

    monkeypatch.setattr(Path, "iterdir", begun)
    assert len(pictures(write(meshes[:1], out, count=1, maps=[]))) == 1


@pytest.mark.parametrize("key", ["backgrounds", "slides"])
def test_renders_are_not_written_among_the_images_that_they_show(meshes, tmp_path, key):
    augment = nb.AugmentationSettings(mode="random")
    owner = augment.vary if key == "backgrounds" else augment.vary.camera
    setattr(owner, key, str(tmp_path))
    with pytest.raises(InputError, match="lies inside"):
        write(meshes, tmp_path / "renders", augment=augment)


def test_a_folder_of_other_files_is_refused(meshes, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        write(meshes, tmp_path)


def test_depth_and_normals_of_a_ball_are_those_of_a_sphere(tmp_path):
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(5).export(path)
    camera = PerspectiveCamera(polar=70.0, azimuth=30.0, width=2.5, distance=4.0)
    [render] = render_dataset([(path, "ball")], 32, 1, cameras=[camera])
    column, row = torch.meshgrid(torch.arange(32), torch.arange(32), indexing="xy")
    # A ray from the camera, in its axes right, up and back, per unit of depth.
    facts = render.camera
    x = (column + 0.5 - facts["cx"]) / facts["fx"]
    y = (facts["cy"] - row - 0.5) / facts["fy"]
    # The ray t (x, y, -1) meets the unit sphere around (0, 0, -4).
    a, b, c = x**2 + y**2 + 1, -2 * 4.0, 4.0**2 - 1
    inside = (b**2 - 4 * a * c) > 2
    depth = (-b - (b**2 - 4 * a * c).clamp(min=0).sqrt()) / (2 * a)
    # The nearest of four samples in a pixel, whose centers are a quarter of a pixel away.
    assert (render.depth - depth)[inside].abs().max() < 0.05
    normals = torch.stack([x * depth, y * depth, 4 - depth])
    assert (render.normals - normals)[:, inside].abs().max() < 0.05
    assert (render.normals[:, inside].norm(dim=0) - 1).abs().max() < 1e-5
    # Both maps show the object where the mask does.
    assert torch.equal(render.depth != 0, render.masks[0])
    assert torch.equal((render.normals != 0).any(0), render.masks[0])


def test_pixels_of_the_described_camera_are_those_of_its_projection():
    camera = PerspectiveCamera(60.0, 25.0, width=2.2, right=0.3, up=-0.2, distance=5.0)
    facts = describe_camera(camera, (40, 60))
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    to_camera = np.linalg.inv(np.array(facts["pose"]))
    x, y, z, _ = to_camera @ np.column_stack([points, np.ones(5)]).T
    found = [facts["cx"] - facts["fx"] * x / z, facts["cy"] + facts["fy"] * y / z]
    right, up, _ = camera.project(points).T
    assert np.allclose(found, [30 + 30 * right, 20 - 30 * up])


def test_the_first_meshes_get_the_renders_that_do_not_divide(meshes):
    pairs = [(item["mesh"], item["label"]) for item in meshes]
    labels = [render.labels[0] for render in render_dataset(pairs, 8, 5, backgrounds=[0.2, 0.8])]
    assert labels == ["box", "ball", "box", "ball", "box"]


# What other libraries read. Two objects stand on one ground, and a cup alone.
@pytest.fixture(scope="module")
def groups(meshes) -> list:
    box, ball = meshes
    return [[box, ball | {"label": "a ball: 2"}], ball | {"label": 7}]


@pytest.mark.ecosystem
@pytest.mark.filterwarnings("ignore")
def test_pycocotools_and_torchvision_read_boxes_and_masks(groups, tmp_path):
    pytest.importorskip("pycocotools")
    from torchvision.datasets import CocoDetection, wrap_dataset_for_transforms_v2

    folder = write(groups, tmp_path / "out", format="coco", size=[20, 32])
    found = CocoDetection(str(folder / "train"), str(folder / "annotations/instances_train.json"))
    wrapped = wrap_dataset_for_transforms_v2(found, target_keys="all")
    assert len(found) == 7
    found.coco.info()
    assert found.coco.getCatIds(supNms=["box"]) == [1]
    for (image, annotations), (_, target) in zip(found, wrapped, strict=True):
        index = annotations[0]["image_id"] - 1
        assert image.size == (32, 20)
        number = np.array(Image.open(folder / "details" / f"{index:06d}_mask.png"))
        objects = details(folder, index)["objects"]
        names = [found.coco.cats[item["category_id"]]["name"] for item in annotations]
        assert names == [item["class"] for item in objects]
        assert target["boxes"].tolist() == [item["box"] for item in objects]
        for order, item in enumerate(annotations):
            mask = found.coco.annToMask(item) == 1
            assert (mask == (number == order + 1)).all()
            assert (target["masks"][order].bool().numpy() == mask).all()


def test_the_parts_of_the_command_line_replace_those_of_the_default():
    assert main.read(["out=out", "splits={train: 1}"]).splits == {"train": 1}


def test_parts_may_be_numbered():
    assert main.read(["out=out", "splits={0: 1, 1: 2}"]).splits == {"0": 1, "1": 2}


@pytest.mark.parametrize("name", ["../photos", "a/b", ".."])
def test_a_part_cannot_be_in_another_folder(name):
    with pytest.raises(InputError, match="splits"):
        RenderSettings(out="out", splits={name: 1})


@pytest.mark.ecosystem
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("splits", [{"train": 2, "val": 1}, {"train": 1}])
def test_ultralytics_reads_boxes_and_classes(groups, tmp_path, splits):
    pytest.importorskip("ultralytics")
    from ultralytics.data.dataset import YOLODataset
    from ultralytics.data.utils import check_det_dataset

    folder = write(groups, tmp_path / "out", format="yolo", size=[20, 32], splits=splits)
    data = check_det_dataset(str(folder / "data.yaml"))
    assert [*data["names"].values()] == ["box", "a ball: 2", "7"]
    for found in YOLODataset(img_path=data["train"], data=data).labels:
        objects = details(folder, int(Path(found["im_file"]).stem))["objects"]
        assert found["shape"] == (20, 32)
        assert [data["names"][int(i)] for i in found["cls"][:, 0]] == [i["class"] for i in objects]
        x, y, width, height = found["bboxes"].T
        corners = [x - width / 2, y - height / 2, x + width / 2, y + height / 2]
        expected = [item["box"] for item in objects]
        assert np.allclose(np.stack(corners, 1) * [32, 20, 32, 20], expected, atol=1e-3)


@pytest.mark.parametrize(("size", "fov"), [([24, 40], 30.0), ([40, 24], 30.0), ([40, 24], 60.0)])
def test_all_objects_of_an_entry_are_in_the_image_at_the_given_field_of_view(meshes, size, fov):
    box, ball = ((item["mesh"], item["label"]) for item in meshes)
    entries = [[box, ball], [ball, box, box], ball]
    for render in render_dataset(entries, size, 6, fov=fov, views=2, width=3.2):
        left, top, right, bottom = render.boxes.T
        height, width = size
        half_angle = math.atan(width / 2 / render.camera["fx"])
        assert 2 * math.degrees(half_angle) == pytest.approx(fov)
        assert min(left.min(), top.min()) > 0
        assert right.max() < width and bottom.max() < height
        # Their center is that of the image.
        assert abs(left.min() + right.max() - width) <= 2
        assert abs(top.min() + bottom.max() - height) <= 2
        assert max(right.max() - left.min(), bottom.max() - top.min()) > 12


@pytest.mark.parametrize("label", ["", -1])
def test_an_object_without_a_class_is_not_labeled(meshes, label):
    items = [[meshes[0]["mesh"], "box"], [meshes[1]["mesh"], label]]
    [render] = render_dataset([[tuple(item) for item in items]], 24, 1)
    assert render.labels == ["box"] and len(render.boxes) == len(render.masks) == 1


def test_a_light_that_is_named_replaces_those_that_are_drawn():
    drawn = "augment.vary.environments="
    for name in ("light", "scene.light"):
        words = [f"{name}=uniform", "seed=3"]
        assert name_light(words) == ["scene.light=uniform", "seed=3", f"{drawn}[]"]
        words.append(f"{drawn}[grace]")
        assert name_light(words) == ["scene.light=uniform", *words[1:]]
    assert name_light(["seed=3"]) == ["seed=3"]


def test_parts_without_renders_are_left_out(meshes, tmp_path):
    folder = write(meshes, tmp_path / "out", format="yolo", count=1, splits={"train": 9, "test": 1})
    paths = yaml.safe_load((folder / "data.yaml").read_text())
    assert {key: paths[key] for key in paths if key not in ("nc", "names")} == {
        "train": "images/train",
        "val": "images/train",
    }


def test_each_index_is_in_one_tar_file_however_often_a_shard_was_stopped(meshes, tmp_path):
    folder = write(meshes, tmp_path / "out", format="webdataset", shards=2, shard=0)
    # A killed process leaves this file.
    unfinished = folder / ".pnb-x.tmp"
    unfinished.touch()
    with pytest.raises(InputError, match="shards"):
        write(meshes, folder, format="webdataset")
    write(meshes, folder, format="webdataset", shards=2, shard=1)
    assert not unfinished.exists()
    found = []
    for path in folder.glob("*.tar"):
        with tarfile.open(path) as tar:
            found += [int(name[:6]) for name in tar.getnames() if name.endswith(".cls")]
    assert sorted(found) == [*range(COUNT)]


@pytest.mark.parametrize("name", ["a/b", "..", "/tmp"])
def test_a_class_that_cannot_be_a_folder_is_refused(meshes, tmp_path, name):
    with pytest.raises(InputError, match="no name of a folder"):
        write([meshes[0] | {"label": name}], tmp_path / "out")
    write([meshes[0] | {"label": name}], tmp_path / "coco", format="coco", count=1)


@pytest.mark.slow
def test_a_network_is_wrong_on_the_files_that_are_rendered_against_it(tmp_path):
    network = nb.load_classifier("efficientnet_lite0")
    orange = [{"mesh": "solid:orange", "label": "orange"}]
    folder = write(orange, tmp_path, size=None, count=2, maps=[], network="efficientnet_lite0")
    for index in range(2):
        image = np.array(Image.open(folder / details(folder, index)["image"]))
        pixels = torch.from_numpy(image).permute(2, 0, 1)[None] / 255
        assert pixels.shape[2:] == (224, 224)
        assert network.classes[int(network(pixels).argmax())] != "orange"
