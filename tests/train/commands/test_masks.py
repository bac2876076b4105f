from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from renderer.errors import InputError
from train.commands.fit import read_mask

# The object is not symmetric, and neither is the image.
IS_OBJECT = np.zeros((12, 16), dtype=bool)
IS_OBJECT[2:7, 3:12] = True
WHITE_ON_BLACK = np.where(IS_OBJECT, 255, 0).astype(np.uint8)


def rgba(inside: tuple[int, ...], outside: tuple[int, ...]) -> Image.Image:
    pixels = np.where(IS_OBJECT[..., None], inside, outside).astype(np.uint8)
    return Image.fromarray(pixels)


def palette(*colors: tuple[int, int, int]) -> Image.Image:
    image = Image.fromarray(IS_OBJECT.astype(np.uint8)).convert("P")
    image.putpalette([value for color in colors for value in color])
    return image


MASKS = {
    "white on black": Image.fromarray(WHITE_ON_BLACK),
    "nearly white on nearly black": Image.fromarray(np.where(IS_OBJECT, 251, 4).astype(np.uint8)),
    "one bit": Image.fromarray(WHITE_ON_BLACK).convert("1"),
    "zero and one": Image.fromarray(IS_OBJECT.astype(np.uint8)),
    "16 bits": Image.fromarray(WHITE_ON_BLACK.astype(np.uint16) * 257),
    "16 bits, zero and one": Image.fromarray(IS_OBJECT.astype(np.uint16)),
    "palette": palette((0, 0, 0), (128, 0, 0)),
    "palette, white first": palette((0, 0, 0), (255, 255, 255)),
    "color": rgba((0, 0, 200), (0, 0, 0)),
    "cut-out": rgba((210, 180, 80, 255), (50, 40, 30, 0)),
    "translucent cut-out": rgba((210, 180, 80, 128), (50, 40, 30, 0)),
    "black cut-out": rgba((0, 0, 0, 255), (255, 255, 255, 0)),
    "white with transparency": rgba((255, 255, 255, 255), (0, 0, 0, 0)),
    "gray cut-out": rgba((90, 90, 90, 255), (200, 200, 200, 0)).convert("LA"),
    "opaque with alpha": Image.fromarray(WHITE_ON_BLACK).convert("RGBA"),
    "float, zero and one": Image.fromarray(IS_OBJECT.astype(np.float32)),
}
TURNED = Image.Exif()
TURNED[0x0112] = 3
# Images with options with which they are saved. A transparent color is outside of the object.
SAVED = {name: (image, {}) for name, image in MASKS.items()} | {
    "transparent color": (palette((255, 255, 255), (90, 10, 10)), {"transparency": 0}),
    "transparent palette": (palette((255, 255, 255), (90, 10, 10)), {"transparency": b"\0\xff"}),
    "turned": (Image.fromarray(WHITE_ON_BLACK[::-1, ::-1].copy()), {"exif": TURNED}),
}


def save(folder: Path, image: Image.Image, **options: object) -> str:
    path = folder / ("mask.tif" if image.mode == "F" else "mask.png")
    image.save(path, **options)
    return str(path)


@pytest.mark.parametrize("name", SAVED)
def test_masks_of_every_kind_mark_the_object(tmp_path, name):
    image, options = SAVED[name]
    mask = read_mask(save(tmp_path, image, **options), 12, 16)
    assert mask.dtype == np.uint8
    np.testing.assert_array_equal(mask, WHITE_ON_BLACK)


def test_soft_edges_keep_their_coverage(tmp_path):
    soft = WHITE_ON_BLACK.copy()
    soft[2] //= 2
    cut_out = np.dstack([np.full((12, 16, 3), 90, np.uint8), soft])
    for pixels in (soft, soft.astype(np.uint16) * 257, cut_out):
        mask = read_mask(save(tmp_path, Image.fromarray(pixels)), 12, 16)
        np.testing.assert_array_equal(mask, soft)


def three_colors() -> Image.Image:
    pixels = np.zeros((12, 16, 3), dtype=np.uint8)
    pixels[:4] = (128, 0, 0)
    pixels[8:] = (0, 128, 0)
    return Image.fromarray(pixels)


def black_and_white_with_alpha() -> Image.Image:
    image = Image.fromarray(WHITE_ON_BLACK).convert("RGBA")
    image.putpixel((0, 0), (0, 0, 0, 0))
    return image


NO_MASKS = {
    "three colors": three_colors(),
    "no black": palette((0, 0, 200), (200, 0, 0)),
    "labels 0, 1, 2": Image.fromarray(np.arange(192, dtype=np.uint8).reshape(12, 16) // 64),
    "white": Image.new("L", (16, 12), 255),
    "black": Image.new("L", (16, 12), 0),
    "two masks": black_and_white_with_alpha(),
    "size": Image.fromarray(WHITE_ON_BLACK).resize((17, 12)),
    "gray area": Image.fromarray(np.where(np.arange(16) > 10, np.uint8(128), WHITE_ON_BLACK)),
}


@pytest.mark.parametrize("name", NO_MASKS)
def test_a_mask_that_does_not_tell_where_the_object_is_is_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"mask=.*mask\.png"):
        read_mask(save(tmp_path, NO_MASKS[name]), 12, 16)
