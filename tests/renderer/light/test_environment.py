"""Environment maps: quadrature on them, and files of each format."""

import math
import os
import sys
from pathlib import Path

import numpy as np
import OpenImageIO
import pytest
import torch
from oracles import draw

from renderer.errors import InputError
from renderer.light.environment import negative_fraction, read_map, read_panorama, to_map, write_map
from renderer.light.files import load_light
from renderer.light.harmonics import project

EPS = torch.finfo(torch.float64).eps
# Rounding error of a .hdr file relative to the largest channel of a texel.
# Mantissas are at least 128, and values are rounded to half a unit.
RGBE_ERROR = 2.0**-8
HDR_HEADER = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 3\n"


def random_map(height: int = 16, width: int = 32) -> torch.Tensor:
    """Draw radiance over six orders of magnitude, in which some channels are zero."""
    draws = torch.Generator().manual_seed(1)
    magnitude = torch.rand(height, width, 1, generator=draws) * 6 - 3
    channels = 0.5 * torch.randn(height, width, 3, generator=draws)
    is_lit = torch.rand(height, width, 3, generator=draws) > 0.1
    return 10 ** (magnitude + channels) * is_lit


@pytest.mark.parametrize(("degree", "height"), [(0, 32), (2, 64), (6, 32), (6, 128)])
def test_a_light_comes_back_from_its_map_within_the_quadrature_error(degree, height):
    """The documented error is that of the midpoint rule along z, Σ Δz³ f'' / 24."""
    light = draw((degree + 1) ** 2, 3)
    radiance = to_map(light, height)
    assert radiance.shape == (height, 2 * height, 3)
    assert radiance.dtype == torch.float64
    error = (project(radiance, degree) - light).norm(dim=0)
    rounding = 2 * height**2 * EPS
    assert (error / light.norm(dim=0) <= 22.25 / height**2 + rounding).all()


@pytest.mark.parametrize(
    ("above", "below", "fraction"),
    [(3.0, -1.0, 0.25), (1.0, 0.5, 0.0), (-1.0, -1.0, 1.0), (0.0, 0.0, 0.0)],
)
def test_the_negative_fraction_is_a_share_of_the_magnitude_over_the_sphere(above, below, fraction):
    radiance = torch.full((10, 7, 3), below)
    radiance[:5] = above
    assert negative_fraction(radiance) == pytest.approx(fraction, abs=210 * EPS)


def test_the_negative_fraction_counts_solid_angles():
    """A cap around the pole with a radius of 45° has the share (1 - cos 45°) / 2 of the sphere."""
    radiance = torch.ones(128, 4, 3)
    radiance[:32] = -1
    assert negative_fraction(radiance) == pytest.approx((1 - math.sqrt(0.5)) / 2, rel=1e-12)


def test_slightly_negative_radiance_of_a_panorama_becomes_0(tmp_path):
    radiance = torch.ones(8, 16, 3)
    radiance[2, 3] = -1e-5
    write_map(tmp_path / "map.npy", radiance)
    assert torch.equal(read_panorama(tmp_path / "map.npy"), radiance.clamp(min=0))


@pytest.mark.parametrize("suffix", [".npy", ".exr", ".NPY", ".EXR"])
def test_arrays_and_exr_files_keep_float32_and_its_sign_to_the_bit(tmp_path, suffix):
    radiance = random_map() - 0.1
    path = tmp_path / f"map{suffix}"
    write_map(path, radiance)
    read = read_map(path)
    assert read.dtype == torch.float32
    assert torch.equal(read, radiance)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
def test_a_map_is_written_to_a_folder_whose_name_is_not_utf_8(tmp_path, suffix):
    path = tmp_path / os.fsdecode(b"m\xfcller") / f"map{suffix}"
    write_map(path, radiance := random_map())
    read = read_map(path.rename(tmp_path / path.name))
    torch.testing.assert_close(read, radiance, rtol=0, atol=RGBE_ERROR * radiance.max().item())


def test_the_error_of_a_hdr_file_is_half_a_unit_without_bias(tmp_path):
    radiance = random_map(64, 128)
    path = tmp_path / "map.HDR"
    write_map(path, radiance)
    largest_channels = radiance.amax(dim=-1, keepdim=True).clamp(min=1e-6)
    read = read_map(path)
    assert (read[radiance == 0] == 0).all()
    error = (read - radiance) / largest_channels
    assert RGBE_ERROR / 2 < error.abs().max() <= RGBE_ERROR
    # The limit is five standard errors of the mean. Truncated values would be off by much more.
    assert error.mean().abs() < 5 * RGBE_ERROR / math.sqrt(3 * error.numel())


def test_a_hdr_file_that_was_written_byte_by_byte_is_read(tmp_path):
    """The radiance is mantissa · 2^(exponent - 136), and black if the exponent is 0."""
    texels = np.array(
        [
            [[128, 64, 32, 129], [200, 0, 1, 128], [0, 0, 0, 0]],
            [[255, 255, 128, 136], [130, 7, 9, 118], [1, 2, 192, 140]],
        ]
    )
    path = tmp_path / "map.hdr"
    path.write_bytes(HDR_HEADER + texels.astype(np.uint8).tobytes())
    mantissas = texels[..., :3]
    exponents = texels[..., 3:]
    np.testing.assert_array_equal(read_map(path), mantissas * 2.0 ** (exponents - 136))


def write_exr(path: Path, texels: np.ndarray, names: tuple[str, ...], **attributes) -> None:
    height, width, channels = texels.shape
    spec = OpenImageIO.ImageSpec(width, height, channels, "half")
    spec.channelnames = names
    for name, value in attributes.items():
        if name == "chromaticities":
            spec.attribute(name, "float[8]", value)
        elif hasattr(spec, name):
            setattr(spec, name, value)
        else:
            spec.attribute(name, value)
    file = OpenImageIO.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(np.ascontiguousarray(texels, np.float32))
    assert file.close()


def numbered_texels(channels: int) -> np.ndarray:
    """Return different half floats, shape (2, 4, C). Those of channel c are in [c, c + 1)."""
    return np.arange(channels) + np.arange(8).reshape(2, 4, 1) / 8


@pytest.mark.parametrize(
    ("names", "expected_channels"),
    [
        ("A B G R", [3, 2, 1]),
        ("r g b a", [0, 1, 2]),
        ("Red Green Blue", [0, 1, 2]),
        ("Y", [0, 0, 0]),
        ("sky.R sky.G sky.B sky.A", [0, 1, 2]),
        ("spec.R spec.G spec.B R G B", [3, 4, 5]),
        ("View.Depth.Z View.Combined.R View.Combined.G View.Combined.B", [1, 2, 3]),
        ("V.AO.R V.AO.G V.AO.B V.Combined.R V.Combined.G V.Combined.B", [3, 4, 5]),
    ],
)
def test_the_color_channels_of_an_exr_file_are_found_by_name(tmp_path, names, expected_channels):
    channel_names = tuple(names.split())
    texels = numbered_texels(len(channel_names))
    write_exr(tmp_path / "map.exr", texels, channel_names)
    found = read_map(tmp_path / "map.exr")
    np.testing.assert_array_equal(found, texels[..., expected_channels])


# ACEScg: chromaticities, and the matrices of SMPTE ST 2065-1 and IEC 61966-2-1 to and
# from XYZ. Their product keeps the chromaticity of each light.
ACESCG = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
ACESCG_TO_XYZ = np.array(
    [
        [0.6624542, 0.1340042, 0.1561877],
        [0.2722287, 0.6740818, 0.0536895],
        [-0.0055746, 0.0040607, 1.0103391],
    ]
)
XYZ_TO_REC_709 = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)
ACESCG_TO_REC_709 = XYZ_TO_REC_709 @ ACESCG_TO_XYZ
LIGHT = np.array([1, 0.5, 0.1])


def write_hdr(path: Path, header: str, rgb: np.ndarray) -> Path:
    exponent = math.ceil(math.log2(rgb.max())) + 1
    texel = bytes([*np.round(rgb * 2.0 ** (8 - exponent)).astype(int), exponent + 128])
    path.write_bytes(HDR_HEADER.replace(b"\n\n", f"\n{header}\n\n".encode(), 1) + 6 * texel)
    return path


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_a_map_of_acescg_becomes_rec_709(tmp_path, suffix):
    texel = np.linalg.solve(ACESCG_TO_REC_709, LIGHT)
    path = tmp_path / f"map.{suffix}"
    if suffix == "exr":
        texels = np.broadcast_to(texel, (2, 3, 3))
        write_exr(path, texels, ("R", "G", "B"), chromaticities=ACESCG)
    else:
        write_hdr(path, "PRIMARIES= " + " ".join(map(str, ACESCG)), texel)
    torch.testing.assert_close(
        read_map(path), torch.tensor(LIGHT).float().expand(2, 3, 3), rtol=0, atol=0.008
    )


def test_colors_beyond_rec_709_have_no_negative_radiance_and_a_warning(tmp_path):
    green = np.broadcast_to([0.0, 1.0, 0.0], (2, 3, 3))
    write_exr(tmp_path / "map.exr", green, ("R", "G", "B"), chromaticities=ACESCG)
    with pytest.warns(UserWarning, match=r"beyond Rec\. 709"):
        radiance = read_map(tmp_path / "map.exr")
    expected = torch.from_numpy(ACESCG_TO_REC_709[:, 1]).float().clamp(min=0)
    torch.testing.assert_close(radiance, expected.expand(2, 3, 3), rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("header", "factors"),
    [
        ("EXPOSURE=2", 2),
        ("EXPOSURE= 2.0\nEXPOSURE=4", 8),
        ("COLORCORR=1 2 4", [1, 2, 4]),
        ("EXPOSURE=.5\nCOLORCORR= 1 2 4\nCOLORCORR=2 2 2", [1, 2, 4]),
        ("\tEXPOSURE=2", 1),
        ("GAMMA=1", 1),
        ("PRIMARIES=.64 .33 .3 .6 .15 .06 .3127 .329", 1),
        ("PRIMARIES=0 0 0 0 0 0 0 0", 1),
    ],
)
def test_radiance_of_a_hdr_file_is_divided_by_all_factors_of_its_header(tmp_path, header, factors):
    """The factors are cumulative. Indented lines belong to other pictures."""
    radiance = read_map(write_hdr(tmp_path / "map.hdr", header, np.array([1, 0.5, 0.25])))
    expected = np.array([1, 0.5, 0.25]) / factors
    np.testing.assert_array_equal(radiance, np.broadcast_to(expected, (2, 3, 3)))


@pytest.mark.parametrize(
    "header",
    ["GAMMA=2.2", "EXPOSURE=0", "EXPOSURE=nan", "COLORCORR=1 2", "PRIMARIES=0 0 0 0 0 0 .3 .3"],
)
def test_a_hdr_file_with_a_header_that_gives_no_radiance_is_refused(tmp_path, header):
    with pytest.raises(InputError, match=r"map\.hdr cannot be read"):
        read_map(write_hdr(tmp_path / "map.hdr", header, np.array([1, 0.5, 0.25])))


def test_a_deep_image_is_refused(tmp_path):
    """OpenImageIO ends the process if its pixels are read."""
    spec = OpenImageIO.ImageSpec(2, 1, 3, OpenImageIO.FLOAT)
    spec.deep = True
    data = OpenImageIO.DeepData()
    data.init(2, 3, [OpenImageIO.FLOAT] * 3, ["R", "G", "B"])
    output = OpenImageIO.ImageOutput.create("a.exr")
    assert output.open(str(tmp_path / "a.exr"), spec) and output.write_deep_image(data)
    output.close()
    with pytest.raises(InputError, match="deep image"):
        read_map(tmp_path / "a.exr")


@pytest.mark.parametrize(
    "values",
    [np.array([None], dtype=object), np.full((4, 8, 3), 1e300), np.ones((49, 3))],
    ids=["pickled", "beyond float32", "coefficients"],
)
def test_an_array_that_is_not_a_map_is_refused(tmp_path, values):
    np.save(tmp_path / "map.npy", values)
    with pytest.raises(InputError, match=r"map\.npy"):
        read_map(tmp_path / "map.npy")


PERCENT = tuple(100 * value for value in ACESCG)


@pytest.mark.parametrize(
    ("names", "attributes", "message"),
    [
        ("Z", {}, "or one gray channel"),
        ("View.Depth.V", {}, "or one gray channel"),
        ("id", {}, "or one gray channel"),
        ("AO.R AO.G AO.B Sky.R Sky.G Sky.B", {}, "ao, sky have colors"),
        ("R G B", {"chromaticities": PERCENT}, "span no colors"),
        ("R G B", {"x": 1, "full_width": 8}, "cropped"),
        ("R G B", {"Orientation": 4}, "rotated"),
    ],
    ids=["depth", "depth of a view", "numbers", "layers", "percent", "cropped", "turned"],
)
def test_an_exr_file_without_light_or_of_a_part_is_refused(tmp_path, names, attributes, message):
    channels = tuple(names.split())
    write_exr(tmp_path / "map.exr", numbered_texels(len(channels)), channels, **attributes)
    with pytest.raises(InputError, match=message):
        read_map(tmp_path / "map.exr")


@pytest.mark.parametrize("images", [("RGB", "Y"), ("Y", "RGB"), ("RGB", "BGR")])
def test_of_several_images_in_an_exr_file_the_first_is_read_if_it_alone_has_colors(
    tmp_path, images
):
    path = str(tmp_path / "map.exr")
    specs = []
    for channels in images:
        spec = OpenImageIO.ImageSpec(16, 8, len(channels), "float")
        spec.channelnames = tuple(channels)
        spec.attribute("oiio:subimagename", channels)
        specs.append(spec)
    output = OpenImageIO.ImageOutput.create(path)
    output.open(path, tuple(specs))
    for index, spec in enumerate(specs):
        if index:
            output.open(path, spec, "AppendSubimage")
        output.write_image(np.full((8, 16, spec.nchannels), 2.0, np.float32))
    output.close()
    if images[1] == "Y":
        assert (read_map(tmp_path / "map.exr") == 2).all()
    else:
        with pytest.raises(InputError, match="several images"):
            read_map(tmp_path / "map.exr")


def test_a_hdr_file_with_its_bottom_row_first_is_refused(tmp_path):
    (tmp_path / "map.hdr").write_bytes(HDR_HEADER.replace(b"-Y", b"+Y") + bytes(24))
    with pytest.raises(InputError, match=r"map\.hdr"):
        read_map(tmp_path / "map.hdr")


@pytest.mark.parametrize("size", [(4, 8), (48, 64), (96, 179), (96, 205)])
def test_a_map_with_few_texels_or_another_aspect_ratio_is_refused(tmp_path, size):
    """With few rows, even radiance would get a direction. A mirror ball's map is square."""
    np.save(tmp_path / "map.npy", np.ones((*size, 3)))
    with pytest.raises(InputError, match=r"map\.npy"):
        load_light(str(tmp_path / "map.npy"))


@pytest.mark.parametrize("width", [180, 204])
def test_a_map_whose_width_differs_by_a_sixteenth_is_read(tmp_path, width):
    np.save(tmp_path / "map.npy", np.ones((96, width, 3)))
    light = load_light(str(tmp_path / "map.npy"))
    assert light[0].min() > 0.1
    assert light[1:].abs().max() < 1e-3
