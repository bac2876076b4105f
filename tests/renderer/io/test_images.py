"""Photographs become sRGB with 8 bits, whatever the file says about its colors."""

import os
import struct
import warnings
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import PIL
import pytest
from oracles import linear_of, srgb_of
from PIL import Image, ImageCms, features

from renderer.errors import InputError
from renderer.io.images import Tile, draw_grid, gray_factor, open_image, read_image, read_rgb

# CIE chromaticities of red, green, blue and white (SMPTE EG 432-1, Adobe RGB (1998),
# ISO 22028-2 and ITU-R BT.2020).
D65 = (0.3127, 0.329)
SRGB = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, *D65)
DISPLAY_P3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, *D65)
ADOBE = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *D65)
PRO_PHOTO = (0.734699, 0.265301, 0.159597, 0.840403, 0.036598, 0.000105, 0.34567, 0.3585)
REC_2020 = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, *D65)
# White of the connection space of ICC profiles, and Bradford's matrix.
D50 = np.array([0.9642, 1, 0.8249])
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
COLOR = (230, 120, 40)


def to_d50(primaries: tuple[float, ...]) -> np.ndarray:
    """Compute the matrix from linear RGB to XYZ of the connection space of ICC profiles."""
    x, y = np.reshape(primaries, (4, 2)).T
    xyz = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    matrix = xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])
    gains = (BRADFORD @ D50) / (BRADFORD @ xyz[:, 3])
    return np.linalg.inv(BRADFORD) @ np.diag(gains) @ BRADFORD @ matrix


def stored(primaries: tuple[float, ...], gamma: float | None, color=COLOR) -> np.ndarray:
    """Return the 8-bit values that stand for an sRGB color with a gamma, or sRGB's curve (None)."""
    there = np.linalg.solve(to_d50(primaries), to_d50(SRGB) @ linear_of(np.array(color) / 255))
    values = srgb_of(there) if gamma is None else there ** (1 / gamma)
    return np.round(values * 255).astype(np.uint8)


def fixed(*numbers: float) -> bytes:
    return struct.pack(f">{len(numbers)}i", *(round(number * 65536) for number in numbers))


def profile(space: bytes, curve: bytes, primaries: tuple[float, ...] = SRGB) -> bytes:
    """Write a matrix or a gray ICC profile of version 2 (ICC.1:2001-04)."""
    tags = {b"desc": b"desc" + bytes(4) + struct.pack(">I", 2) + b"a\0" + bytes(78)}
    tags |= {b"cprt": b"text" + bytes(4) + b"a\0\0\0", b"wtpt": b"XYZ " + bytes(4) + fixed(*D50)}
    if space == b"GRAY":
        tags[b"kTRC"] = curve
    else:
        for name, column in zip((b"r", b"g", b"b"), to_d50(primaries).T, strict=True):
            tags[name + b"XYZ"] = b"XYZ " + bytes(4) + fixed(*column)
            tags[name + b"TRC"] = curve
    offset = 128 + 4 + 12 * len(tags)
    table, data = struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        table += name + struct.pack(">2I", offset + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    header = struct.pack(
        ">I4sI4s4s4s", offset + len(data), bytes(4), 0x2100000, b"mntr", space, b"XYZ "
    )
    header += bytes(12) + b"acsp" + bytes(28) + fixed(*D50)
    return header.ljust(128, b"\0") + table + data


def gamma_curve(gamma: float) -> bytes:
    return b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)


def srgb_table() -> bytes:
    values = np.round(linear_of(np.linspace(0, 1, 1024)) * 65535).astype(">u2").tobytes()
    return b"curv" + bytes(4) + struct.pack(">I", 1024) + values


def png(size: tuple[int, int], depth: int, color_type: int, rows: bytes, **chunks: bytes) -> bytes:
    """Write a PNG file byte by byte. `rows` are the packed rows of pixels."""

    def chunk(name: str, data: bytes) -> bytes:
        checksum = zlib.crc32(name.encode() + data)
        return struct.pack(">I", len(data)) + name.encode() + data + struct.pack(">I", checksum)

    width, height = size
    stride = len(rows) // height
    lines = b"".join(b"\0" + rows[row * stride : (row + 1) * stride] for row in range(height))
    parts = [chunk("IHDR", struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0))]
    parts += [chunk(name, data) for name, data in chunks.items()]
    parts += [chunk("IDAT", zlib.compress(lines)), chunk("IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def read(path: Path) -> np.ndarray:
    return np.asarray(read_rgb(path, 8)).astype(int)


@pytest.mark.parametrize(
    ("suffix", "primaries", "gamma"),
    [("png", DISPLAY_P3, None), ("jpg", ADOBE, 2.19921875), ("tif", PRO_PHOTO, 1.8)],
)
def test_a_photograph_with_an_icc_profile_becomes_srgb(tmp_path, suffix, primaries, gamma):
    curve = srgb_table() if gamma is None else gamma_curve(gamma)
    image = Image.new("RGB", (16, 16), tuple(map(int, stored(primaries, gamma))))
    options = {"quality": 100} if suffix == "jpg" else {}
    path = tmp_path / f"a.{suffix}"
    image.save(path, icc_profile=profile(b"RGB ", curve, primaries), **options)
    assert np.abs(read(path) - COLOR).max() <= (3 if suffix == "jpg" else 2)


def test_a_photograph_is_turned_beside_exif_data_of_the_wrong_type(tmp_path):
    """The orientation is 6, and the resolution is a text instead of a fraction."""
    pixels = np.zeros((8, 16, 3), np.uint8)
    pixels[:, :8] = 255
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=100)
    start, rest = np.split(np.fromfile(tmp_path / "a.jpg", np.uint8), [2])
    tags = struct.pack("<HHHIIHHI", 2, 0x112, 3, 1, 6, 0x11A, 2, 4) + b"72\0\0" + bytes(4)
    exif = b"Exif\0\0II*\0\x08\0\0\0" + tags
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    (tmp_path / "a.jpg").write_bytes(start.tobytes() + segment + rest.tobytes())
    assert np.abs(read(tmp_path / "a.jpg") - np.rot90(pixels, -1)).max() < 5


def test_alpha_palettes_and_turned_images_keep_their_pixels_beside_a_profile(tmp_path):
    color = tuple(map(int, stored(DISPLAY_P3, None)))
    content = profile(b"RGB ", srgb_table(), DISPLAY_P3)
    image = Image.new("RGBA", (16, 8), (*color, 255))
    image.paste((*color, 0), (0, 0, 8, 8))
    exif = Image.Exif()
    exif[0x0112] = 6
    image.save(tmp_path / "a.png", icc_profile=content, exif=exif)
    pixels = read(tmp_path / "a.png")
    assert pixels.shape == (16, 8, 3)
    assert (pixels[:8] == 255).all()
    assert np.abs(pixels[8:] - COLOR).max() <= 2
    image.convert("RGB").quantize(4).save(tmp_path / "p.png", icc_profile=content)
    assert np.abs(read(tmp_path / "p.png") - COLOR).max() <= 2


@pytest.mark.parametrize("name", ["own", "little cms"])
def test_a_profile_of_srgb_changes_no_bit(tmp_path, name):
    content = profile(b"RGB ", srgb_table())
    if name == "little cms":
        content = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    pixels = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=content)
    np.testing.assert_array_equal(read(tmp_path / "a.png"), pixels)


def test_a_gray_photograph_has_the_curve_of_its_profile(tmp_path):
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    expected = np.round(255 * srgb_of((levels / 255) ** 1.8))
    for mode, space in (("L", b"GRAY"), ("LA", b"GRAY"), ("L", b"RGB ")):
        image = Image.fromarray(levels).convert(mode)
        image.save(tmp_path / "a.png", icc_profile=profile(space, gamma_curve(1.8)))
        assert np.abs(read(tmp_path / "a.png") - expected[..., None]).max() <= 1
    sixteen = Image.fromarray(levels.astype(np.uint16) * 257)
    sixteen.save(tmp_path / "a.png", icc_profile=profile(b"GRAY", gamma_curve(1.8)))
    assert np.abs(read(tmp_path / "a.png") - expected[..., None]).max() <= 1


def test_lab_pixels_become_srgb(tmp_path):
    """In the memory of Pillow, a and b are shifted by 128."""
    xyz = to_d50(SRGB) @ linear_of(np.array(COLOR) / 255) / D50
    root = np.cbrt(xyz)
    lab = [116 * root[1] - 16, 500 * (root[0] - root[1]), 200 * (root[1] - root[2])]
    pixel = (round(lab[0] * 2.55), round(lab[1]) + 128, round(lab[2]) + 128)
    Image.new("LAB", (8, 8), pixel).save(tmp_path / "a.tif")
    assert np.abs(read(tmp_path / "a.tif") - COLOR).max() <= 2


@pytest.mark.parametrize("kind", ["damaged", "of other channels"])
def test_an_image_whose_profile_cannot_be_used_is_srgb_with_one_warning(tmp_path, kind):
    content = kind.encode() if kind == "damaged" else profile(b"GRAY", gamma_curve(1.7))
    for name in "ab":
        Image.new("RGB", (8, 8), COLOR).save(tmp_path / f"{name}.png", icc_profile=content)
    with pytest.warns(UserWarning, match="color profile"):
        assert (read(tmp_path / "a.png") == COLOR).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (read(tmp_path / "b.png") == COLOR).all()


def png_numbers(*numbers: float) -> bytes:
    return struct.pack(f">{len(numbers)}I", *(round(number * 100_000) for number in numbers))


@pytest.mark.parametrize(
    ("primaries", "gamma", "chunks"),
    [
        (SRGB, 1.0, {"gAMA": png_numbers(1)}),
        (SRGB, 1.8, {"gAMA": png_numbers(1 / 1.8)}),
        (ADOBE, None, {"gAMA": png_numbers(0.45455), "cHRM": png_numbers(*D65, *ADOBE[:6])}),
        (SRGB, None, {"gAMA": png_numbers(0.45455), "cHRM": png_numbers(*D65, *SRGB[:6])}),
        (SRGB, None, {"sRGB": b"\0", "gAMA": png_numbers(1)}),
        (DISPLAY_P3, None, {"cICP": bytes([12, 13, 0, 1])}),
        (REC_2020, 1.0, {"cICP": bytes([9, 8, 0, 1]), "gAMA": png_numbers(0.45455)}),
        (SRGB, None, {"cICP": bytes([1, 13, 0, 1])}),
    ],
)
def test_the_color_chunks_of_a_png_file_count(tmp_path, primaries, gamma, chunks):
    rows = bytes(stored(primaries, gamma)) * 4
    (tmp_path / "a.png").write_bytes(png((2, 2), 8, 2, rows, **chunks))
    tolerance = 0 if primaries == SRGB and gamma is None else 2
    assert np.abs(read(tmp_path / "a.png") - COLOR).max() <= tolerance


@pytest.mark.parametrize("codes", [[9, 16, 0, 1], [1, 13, 0, 0]], ids=["HDR", "narrow range"])
def test_a_png_file_of_high_dynamic_range_or_a_narrow_range_is_refused(tmp_path, codes):
    path = tmp_path / "a.png"
    path.write_bytes(png((2, 2), 8, 2, bytes(12), cICP=bytes(codes)))
    with pytest.raises(InputError, match="cICP"):
        read_image(path, 2)


@pytest.mark.skipif("avif" not in features.modules, reason="old versions of Pillow")
@pytest.mark.parametrize(
    ("primaries", "codes"),
    [(DISPLAY_P3, (12, 13)), (SRGB, (1, 13)), (SRGB, (2, 2)), (SRGB, (1, 1)), (SRGB, (6, 6))],
)
def test_the_codes_of_an_avif_file_count(tmp_path, primaries, codes):
    color = tuple(map(int, stored(primaries, None)))
    path = tmp_path / "a.avif"
    Image.new("RGB", (8, 8), color).save(path, quality=100, subsampling="4:4:4")
    before, mark, after = path.read_bytes().partition(b"colrnclx")
    path.write_bytes(before + mark + struct.pack(">HH", *codes) + after[4:])
    assert np.abs(read(path) - COLOR).max() <= 4
    path.write_bytes(before + mark + struct.pack(">HH", 9, 16) + after[4:])
    with pytest.raises(InputError, match="nclx"):
        read_image(path, 2)


def test_the_profile_of_a_jpeg_2000_file_counts(tmp_path):
    """The box colr has the method 2, a precedence, an approximation and the profile."""
    color = tuple(map(int, stored(DISPLAY_P3, None)))
    path = tmp_path / "a.jp2"
    Image.new("RGB", (8, 8), color).save(path)
    content = path.read_bytes()
    start = content.index(b"colr") - 4
    length = int.from_bytes(content[start : start + 4], "big")
    box = b"colr" + bytes([2, 0, 0]) + profile(b"RGB ", srgb_table(), DISPLAY_P3)
    box = (len(box) + 4).to_bytes(4, "big") + box
    # The header jp2h has the box colr in it, so it grows by the same bytes.
    header = content.index(b"jp2h") - 4
    grown = int.from_bytes(content[header : header + 4], "big") + len(box) - length
    content = content[:header] + grown.to_bytes(4, "big") + content[header + 4 :]
    path.write_bytes(content[:start] + box + content[start + length :])
    assert np.abs(read(path) - COLOR).max() <= 2


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("gamma", [1.0, 1.8])
def test_linear_16_bits_are_refused_and_never_lose_dark_values(tmp_path, suffix, depth, gamma):
    """The upper 8 bits of 0.003 in linear light are 0, although its sRGB value is 10."""
    pixels = np.full((8, 8), round(0.003 * (2**depth - 1)), np.uint16 if depth == 16 else np.uint8)
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(pixels).save(path, icc_profile=profile(b"GRAY", gamma_curve(gamma)))
    if depth == 16 and gamma == 1:
        with pytest.raises(InputError, match="linear"):
            read_image(path, 8)
    else:
        stored_value = (pixels[0, 0] >> (depth - 8)) / 255
        expected = 255 * srgb_of(np.array(stored_value**gamma))
        assert np.abs(read(path) - expected).max() <= 2


def test_the_mark_of_adobe_rgb_in_exif_data_counts(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    image = Image.new("RGB", (16, 16), tuple(map(int, stored(ADOBE, 2.19921875))))
    image.save(tmp_path / "a.jpg", exif=exif, quality=100)
    assert np.abs(read(tmp_path / "a.jpg") - COLOR).max() <= 3


@pytest.mark.parametrize(
    ("depth", "pixels", "key", "expected"),
    [
        (1, "10101010", 1, [255, 0] * 4),
        (2, "00011011", 2, [0, 85, 255, 255]),
        (4, "00110100", 4, [51, 255]),
        (8, f"{100:08b}{7:08b}", 100, [255, 7]),
        (16, f"{0x6440:016b}{0x6441:016b}", 0x6440, [255, 0x64]),
    ],
)
def test_the_transparent_gray_of_a_png_file_is_transparent(tmp_path, depth, pixels, key, expected):
    row = int(pixels, 2).to_bytes(len(pixels) // 8, "big")
    content = png((len(expected), 2), depth, 0, 2 * row, tRNS=struct.pack(">H", key))
    (tmp_path / "a.png").write_bytes(content)
    np.testing.assert_array_equal(read(tmp_path / "a.png")[..., 1], [expected, expected])


@pytest.mark.parametrize("depth", [1, 2, 4, 8])
def test_the_numbers_that_a_gray_png_file_stores_are_found_again(tmp_path, depth):
    rows = np.arange(16).reshape(2, 8) % 2**depth
    content = b"".join(
        int("".join(f"{number:0{depth}b}" for number in row), 2).to_bytes(depth, "big")
        for row in rows.tolist()
    )
    (tmp_path / "a.png").write_bytes(png((8, 2), depth, 0, content))
    with open_image(tmp_path / "a.png") as image:
        factor = gray_factor(image)
        np.testing.assert_array_equal(np.array(image) // factor, rows)


def test_letters_outside_of_ascii_are_drawn():
    tile = np.zeros((1, 1, 3), np.uint8)
    drawn = [np.array(draw_grid([[Tile(tile, [text])]])) for text in ("ä", "ü", "ж", "×")]
    assert len({image.tobytes() for image in drawn}) == len(drawn)


def test_the_transparent_color_of_16_bits_is_transparent(tmp_path):
    row = struct.pack(">6H", 0x1000, 0x2000, 0x3000, 0x1100, 0x2000, 0x3000)
    (tmp_path / "a.png").write_bytes(png((2, 2), 16, 2, 2 * row, tRNS=row[:6]))
    assert read(tmp_path / "a.png")[0].tolist() == [[255] * 3, [0x11, 0x20, 0x30]]


@pytest.mark.parametrize(("opacities", "expected"), [((0, 0), (50, 50)), ((0, 255), (255, 50))])
def test_a_bmp_file_whose_opacity_is_0_everywhere_is_opaque(tmp_path, opacities, expected):
    """Header of version 4, two pixels, and masks of red, green, blue and opacity."""
    header = struct.pack("<IiiHHII16x", 108, 2, 1, 1, 32, 3, 8)
    header += struct.pack("<4I52x", 0xFF0000, 0xFF00, 0xFF, 0xFF000000)
    pixels = b"".join(bytes([50, 50, 50, opacity]) for opacity in opacities)
    start = struct.pack("<2sIII", b"BM", 130, 0, 122)
    (tmp_path / "a.bmp").write_bytes(start + header + pixels)
    assert read(tmp_path / "a.bmp")[0, :, 0].tolist() == [*expected]


def test_16_bit_tiff_files_are_turned_and_scaled(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 8
    pixels = np.arange(6, dtype=np.uint16).reshape(2, 3) * 9000
    Image.fromarray(pixels).save(tmp_path / "a.tif", exif=exif)
    np.testing.assert_array_equal(read(tmp_path / "a.tif")[..., 0], np.rot90(pixels // 256))


def tiff(content: bytes, bits: int, photometric: int, extra: int | None = None) -> bytes:
    """Write a TIFF file of 4 × 1 gray pixels (TIFF 6.0, section 2)."""
    samples = 1 if extra is None else 2
    tags = [(256, 4), (257, 1), (258, bits if samples == 1 else bits * 65537), (259, 1)]
    tags += [(262, photometric), (273, 8), (277, samples), (278, 1), (279, len(content))]
    tags += [] if extra is None else [(338, extra)]
    content += bytes(len(content) % 2)
    counts = {258: samples}
    entries = b"".join(struct.pack("<HHII", tag, 3, counts.get(tag, 1), code) for tag, code in tags)
    header = struct.pack("<2sHI", b"II", 42, 8 + len(content))
    return header + content + struct.pack("<H", len(tags)) + entries + bytes(4)


@pytest.mark.parametrize(
    ("content", "bits", "photometric", "extra", "expected"),
    [
        (struct.pack("<4H", 0, 0x4000, 0x8000, 0xFFFF), 16, 0, None, [255, 191, 127, 0]),
        (bytes.fromhex("000400800fff"), 12, 1, None, [0, 64, 128, 255]),
        pytest.param(
            *(bytes([0, 0, 64, 128, 128, 128, 255, 255]), 8, 1, 1, [255, 191, 255, 255]),
            marks=pytest.mark.skipif(
                int(PIL.__version__.split(".")[0]) < 13,
                reason="this release of Pillow refuses gray images with premultiplied alpha",
            ),
        ),
    ],
    ids=["white is 0", "12 bits", "premultiplied alpha"],
)
def test_gray_tiffs_are_read_by_their_tags(tmp_path, content, bits, photometric, extra, expected):
    (tmp_path / "a.tif").write_bytes(tiff(content, bits, photometric, extra))
    np.testing.assert_array_equal(read(tmp_path / "a.tif")[0, :, 1], expected)


def test_tiff_files_with_one_plane_of_16_bits_for_each_channel_are_refused(tmp_path):
    """Pillow would read noise. The file has 2 × 1 pixels (TIFF 6.0, PlanarConfiguration)."""
    tags = [(256, 3, 1, 2), (257, 3, 1, 1), (258, 3, 3, 8), (259, 3, 1, 1), (262, 3, 1, 2)]
    tags += [(273, 4, 3, 14), (277, 3, 1, 3), (278, 3, 1, 1), (279, 4, 3, 26), (284, 3, 1, 2)]
    content = struct.pack("<3H6I", *[16] * 3, 38, 42, 46, *[4] * 3) + bytes(range(12))
    header = struct.pack("<2sHI", b"II", 42, 8 + len(content))
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    file = header + content + struct.pack("<H", len(tags)) + entries + bytes(4)
    (tmp_path / "a.tif").write_bytes(file)
    with pytest.raises(InputError, match="stored apart"):
        read_image(tmp_path / "a.tif", 2)


@pytest.mark.parametrize("dtype", [np.int32, np.float32])
def test_tiff_files_whose_white_is_unknown_are_refused(tmp_path, dtype):
    Image.fromarray(np.full((4, 4), 200, dtype)).save(tmp_path / "a.tif")
    with pytest.raises(InputError, match="white is unknown"):
        read_image(tmp_path / "a.tif", 2)


def test_an_eps_file_with_another_name_reaches_no_program(tmp_path, monkeypatch):
    ran = tmp_path / "ran"
    program = tmp_path / "gs"
    program.write_text(f"#!/bin/sh\ntouch {ran}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr("PIL.EpsImagePlugin.gs_binary", None)
    content = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n"
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with Image.open(path) as image, suppress(Exception):
        image.load()
    assert ran.exists(), "Pillow runs no Ghostscript any more, so nothing is left to prevent"
    ran.unlink()
    with pytest.raises(InputError, match=r"a\.png cannot be read"):
        read_image(path, 2)
    assert not ran.exists()


@pytest.mark.parametrize("kind", ["device", "missing"])
def test_only_regular_files_are_opened(tmp_path, kind):
    path = tmp_path / "a.png"
    if kind == "device":
        path.symlink_to("/dev/zero")
    with pytest.raises(InputError, match=r"a\.png (is not a regular file|does not exist)"):
        read_image(path, 2)
