import numpy as np
from PIL import Image

from train.photographs.contact_sheet import CELL, FRAME, IMAGE, Section, Tile, draw_contact_sheet
from train.photographs.scoring import evaluate_photographs

FRAMES = {"hits": (46, 158, 91), "misses": (208, 59, 59), "false alarms": (232, 163, 23)}


def count_tiles(sheet: Image.Image) -> dict[str, int]:
    pixels = np.asarray(sheet)
    areas = {name: int((pixels == color).all(axis=2).sum()) for name, color in FRAMES.items()}
    counts = {name: divmod(area, CELL**2 - IMAGE**2) for name, area in areas.items()}
    assert all(rest == 0 for _, rest in counts.values())
    return {name: count for name, (count, _) in counts.items()}


def test_the_contact_sheet_frames_each_hit_miss_and_false_alarm(story, tmp_path):
    evaluate_photographs(*story, "orange", tmp_path)
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        assert count_tiles(sheet) == {"hits": 1, "misses": 4, "false alarms": 2}


def test_the_contact_sheet_stays_bounded_and_keeps_the_surest_and_the_least_sure(known_model, tmp_path):
    """Of 101 hits 40 are drawn, image 100 being the surest and image 0 the least."""
    names = [f"{index:03}.png" for index in range(101)]
    table = np.stack([np.arange(1, 102), np.zeros(101)], axis=1) / 20
    evaluate_photographs(*known_model(names, table, ["orange", "pear"]), "orange", tmp_path)
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        assert count_tiles(sheet) == {"hits": 40, "misses": 0, "false alarms": 0}
        red, green, blue = np.moveaxis(np.asarray(sheet).astype(int), 2, 0)
    areas = np.bincount(red[(green == 0) & (blue == 0)])
    shown = np.flatnonzero(areas >= IMAGE**2)
    assert len(shown) == 40 and shown[0] == 0 and shown[-1] == 100
    assert set(np.diff(shown)) == {2, 3}
    first_row = shown[::-1][:10]
    lines = np.where((green == 0) & (blue == 0), red, -1)
    assert any(list(dict.fromkeys(line[line >= 0])) == list(first_row) for line in lines)


def test_images_on_the_contact_sheet_keep_their_pixels():
    image = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    tiles = [Tile(image, ("a caption that is far too long to fit under its tile", "second line"))] * 11
    sheet = np.asarray(draw_contact_sheet([Section("empty", "red", []), Section("title", "#123456", tiles)]))
    enlarged = image.repeat(3, axis=0).repeat(3, axis=1)
    framed = (sheet == (0x12, 0x34, 0x56)).all(axis=2)
    corners = [
        (y, x)
        for y, x in np.argwhere(framed)
        if framed[y : y + CELL, x].sum() == CELL and framed[y, x : x + CELL].sum() == CELL
    ]
    assert len(corners) == 11 and len({y for y, _ in corners}) == 2
    for y, x in corners:
        inside = sheet[y + FRAME : y + FRAME + IMAGE, x + FRAME : x + FRAME + IMAGE]
        np.testing.assert_array_equal(inside, enlarged)
