import multiprocessing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from renderer.errors import InputError
from tests.helpers import save_plain
from train.data.batches import Round, training_batches
from train.data.photographs import find_unlabeled, load_photographs
from train.data.sets import ImageFiles, Split, load_folder, load_unlabeled
from train.device import SignalHandler

SIZE = 72


def load_files(folder: Path, skip: bool = False) -> ImageFiles:
    paths = tuple(item.path for item in find_unlabeled(folder))
    return ImageFiles(folder, paths, SIZE, workers=0, skip=skip)


def ramp(width: int, height: int) -> Image.Image:
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return Image.fromarray(np.stack([x, y, np.full_like(x, 128)], axis=-1).astype(np.uint8))


@pytest.fixture
def files(tmp_path) -> ImageFiles:
    image = ramp(90, 120)
    turned = Image.Exif()
    turned[0x0112] = 6
    image.save(tmp_path / "a.png")
    image.save(tmp_path / "b.jpg", exif=turned)
    image.convert("CMYK").save(tmp_path / "c.jpg")
    image.convert("LA").save(tmp_path / "d.png")
    Image.fromarray(np.full((80, 100), 40_000, np.uint16)).save(tmp_path / "e.png")
    image.save(tmp_path / "f.gif", save_all=True, append_images=[ramp(90, 120).rotate(90)])
    ramp(1500, 1200).save(tmp_path / "g.jpg")
    return load_files(tmp_path)


def test_center_squares_are_those_of_images_in_memory_whatever_their_mode(files):
    _, expected, _ = load_photographs(files.folder, find_unlabeled(files.folder), SIZE, False)
    squares = torch.cat(list(files.squares(torch.arange(len(files)).split(3))))
    assert squares.shape == files.shape
    torch.testing.assert_close(squares[:-1], expected[:-1], rtol=0, atol=0)
    # The last image is so large that it is decoded at a fraction of its size.
    assert (squares[-1].int() - expected[-1].int()).abs().max() <= 3


def test_crops_are_parts_of_the_image_by_their_seeds_whatever_the_number_of_processes(files):
    rows = torch.zeros(200, dtype=torch.int64)
    seeds = torch.arange(200)
    (crops,) = files.crops([(rows, seeds)])
    halves = ImageFiles(files.folder, files.paths, SIZE, workers=2, skip=False).crops(
        zip(rows.split(100), seeds.split(100), strict=True)
    )
    assert torch.equal(crops, torch.cat(list(halves)))
    places = crops[:, :2].float() / 255
    spans = [places[:, 0, 36, -1] - places[:, 0, 36, 0], places[:, 1, -1, 36] - places[:, 1, 0, 36]]
    areas = (spans[0] * spans[1]).abs()
    assert 0.31 < areas.min() < 0.45  # The smallest crops have 35 % of the area.
    assert 0.9 < areas.max() <= 1
    assert (torch.stack(spans) > 0).all()  # No crop is mirrored or upside down.


def test_a_signal_that_all_processes_of_a_job_get_does_not_end_those_that_read_images(files):
    reading = replace(files, workers=1).squares(torch.zeros(40, 1, dtype=torch.int64))
    with SignalHandler():
        images = [next(reading)]
        for process in multiprocessing.active_children():
            process.terminate()
        assert len([*images, *reading]) == 40


def test_reading_images_draws_nothing_from_the_global_generator(files):
    before = torch.get_rng_state()
    list(files.squares([torch.arange(2)]))
    assert torch.equal(torch.get_rng_state(), before)


def test_a_broken_file_is_named_or_another_of_its_folder_stands_in(tmp_path, caplog):
    for name, color in (("lemon", "yellow"), ("orange", "red")):
        for file in ("a.png", "b.png"):
            save_plain(tmp_path / name / file, color, (80, 80))
    whole = (tmp_path / "lemon" / "b.png").read_bytes()
    (tmp_path / "lemon" / "b.png").write_bytes(whole[:100])
    rows = [torch.arange(4)]
    with pytest.raises(InputError, match=r"lemon/b\.png cannot be read .*skip_unreadable"):
        list(load_files(tmp_path).squares(rows))
    (images,) = load_files(tmp_path, skip=True).squares(rows)
    assert images[:, 1, 0, 0].tolist() == [255, 255, 0, 0]
    assert "1 images cannot be read" in caplog.text


def test_batches_from_disk_have_labeled_images_and_renders_and_go_on_where_they_stopped(tmp_path):
    for name, color in {"a": (10, 0, 0), "b": (20, 0, 0), "c": (30, 0, 0)}.items():
        for number in range(4):
            save_plain(tmp_path / name / f"{number}.png", color, (90, 80))
    data = load_folder(str(tmp_path), SIZE, 0.25)
    assert isinstance(data.train.images, ImageFiles)
    assert data.size == SIZE
    renders = Split(torch.full((3, 3, SIZE, SIZE), 200, dtype=torch.uint8), torch.full((3,), -2))
    images = data.train[1:9], renders
    every = Round(number=3, epoch=3, rows=torch.arange(11))
    batches = list(training_batches(*images, 4, 0, every))
    assert len(batches) == 3
    for pixels, labels, rendered in batches:
        value = pixels[:, 0, 40, 40].long()
        assert torch.equal(labels, torch.where(rendered, -2, value // 10 - 1))
        assert torch.equal(rendered, value == 200)
    rest = list(training_batches(*images, 4, 0, every, first=1))
    for batch, expected in zip(rest, batches[1:], strict=True):
        for part, expected_part in zip(batch, expected, strict=True):
            assert torch.equal(part, expected_part)


def test_no_file_of_a_folder_is_read_before_it_is_shown_and_few_are_held_out(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(b"no image")
    for number in range(9):
        (tmp_path / f"{number}.png").symlink_to("a.png")
    data = load_unlabeled(str(tmp_path), 224, 0.2, False, 0)
    assert (len(data.train), len(data.test), data.size) == (8, 2, 224)
    monkeypatch.setattr("train.data.sets.HELD_OUT", 1)
    data = load_unlabeled(str(tmp_path), 224, 0.2, False, 0)
    assert (len(data.train), len(data.test)) == (9, 1)
