import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from augment.backgrounds import load_background, load_backgrounds
from renderer.errors import InputError


@pytest.fixture
def wide(tmp_path) -> Path:
    """An image of 4 × 6 pixels."""
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "wide.png")
    return tmp_path / "wide.png"


def test_a_background_is_gray_or_an_images_center_square(wide):
    assert torch.equal(load_background(0.25, 4), torch.full((1, 4, 4), 0.25))
    assert torch.equal(load_background("0.25", 4), load_background(0.25, 4))
    with Image.open(wide) as image:
        square = torch.from_numpy(np.array(image)[:, 1:5]).permute(2, 0, 1) / 255
    for name in (wide, str(wide)):
        assert torch.equal(load_background(name, 4), square)


def test_grays_have_one_channel_unless_there_is_an_image(wide):
    assert load_backgrounds([0, 0.5], 4).shape == (2, 1, 4, 4)
    mixed = load_backgrounds([0.5, wide], 4)
    assert mixed.shape == (2, 3, 4, 4) and mixed[0].eq(0.5).all() and torch.equal(mixed[1], load_background(wide, 4))


@pytest.mark.parametrize("choice", [-0.1, 255, math.nan, None])
def test_gray_values_outside_0_to_1_and_other_types_are_refused(choice):
    with pytest.raises(InputError, match=r"backgrounds=.*give gray values in \[0, 1\] or image files"):
        load_backgrounds([0.5, choice], 4)


def test_an_unreadable_background_is_named(tmp_path):
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no image")
    faults = {broken: "cannot be read .*", tmp_path / "absent.png": "does not exist", tmp_path: "is not a regular file"}
    for path, fault in faults.items():
        with pytest.raises(InputError, match=f"backgrounds: {path} {fault}: give an image file or a gray value"):
            load_background(str(path), 4)
