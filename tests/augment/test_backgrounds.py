import math

import numpy as np
import pytest
import torch
from PIL import Image

from augment.backgrounds import load_background, load_backgrounds
from renderer.errors import InputError


def test_a_background_is_gray_or_an_images_center_square(tmp_path):
    wide = tmp_path / "wide.png"
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(wide)
    square = torch.from_numpy(pixels[:, 1:5]).permute(2, 0, 1) / 255
    assert torch.equal(load_background(wide, 4), square) and torch.equal(load_background(str(wide), 4), square)
    assert torch.equal(load_background("0.25", 4), torch.full((1, 4, 4), 0.25))
    assert load_backgrounds([0, 0.5], 4).shape == (2, 1, 4, 4)
    assert torch.equal(load_backgrounds([0.5, wide], 4), torch.stack([torch.full((3, 4, 4), 0.5), square]))


@pytest.mark.parametrize("choice", [-0.1, 255, math.nan, None, "absent.png"])
def test_other_gray_values_and_what_is_no_image_are_refused(choice):
    with pytest.raises(InputError, match=r"^backgrounds.*: give (gray values in|an image file)"):
        load_backgrounds([0.5, choice], 4)
