import math
import re
from pathlib import Path

import numpy as np
import OpenImageIO
import pytest
import torch
from oracles import draw

from renderer.errors import InputError
from renderer.light.environment import negative_fraction, read_map, to_map, write_map
from renderer.light.harmonics import project
from renderer.light.presets import load_light

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
RGBE = 2.0**-8  # of a texel's largest channel, which is at least 128 units of its exponent: half a unit


def draws(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_map(height: int = 16, width: int = 32) -> torch.Tensor:
    """Radiance over six orders of magnitude, half a magnitude between the channels of a texel, some channels zero."""
    magnitude = torch.rand(height, width, 1, generator=draws(1)) * 6 - 3
    radiance = 10 ** (magnitude + 0.5 * torch.randn(height, width, 3, generator=draws(2)))
    return radiance * (torch.rand(height, width, 3, generator=draws(3)) > 0.1)


@pytest.mark.parametrize(("degree", "height"), [(0, 32), (2, 64), (6, 32), (6, 128)])
def test_a_light_comes_back_from_its_map_within_the_quadrature_error(degree, height):
    light = draw((degree + 1) ** 2, 3)
    radiance = to_map(light, height)
    assert radiance.shape == (height, 2 * height, 3) and radiance.dtype == torch.float64
    error = (project(radiance, degree) - light).norm(dim=0) / light.norm(dim=0)
    # Documented: the midpoint rule along z, off by Σ Δz³ f'' / 24, of which zonal harmonics of degree 6 have the most.
    assert (error <= 22.25 / height**2 + 2 * height**2 * EPS).all()


@pytest.mark.parametrize(
    ("above", "below", "fraction"), [(3.0, -1.0, 0.25), (1.0, 0.5, 0.0), (-1.0, -1.0, 1.0), (0.0, 0.0, 0.0)]
)
def test_the_negative_fraction_is_of_the_magnitude_over_the_sphere(above, below, fraction):
    radiance = torch.full((10, 7, 3), below)
    radiance[:5] = above
    assert negative_fraction(radiance) == pytest.approx(fraction, abs=210 * EPS)


@pytest.mark.parametrize("suffix", [".npy", ".exr", ".NPY", ".EXR"])
def test_arrays_and_exr_keep_float32_to_the_bit_and_its_sign(tmp_path, suffix):
    radiance = random_map() - 0.1
    path = tmp_path / f"map{suffix}"
    write_map(path, radiance)
    read = read_map(path)
    assert read.dtype == torch.float32 and [file.name for file in tmp_path.iterdir()] == [path.name]
    torch.testing.assert_close(read, radiance, rtol=0, atol=0)


def test_hdr_keeps_2_to_the_minus_8_of_the_largest_channel_without_bias(tmp_path):
    path, radiance = tmp_path / "map.HDR", random_map(64, 128)
    write_map(path, radiance)
    error = (read_map(path) - radiance) / radiance.amax(dim=-1, keepdim=True).clamp(min=1e-6)
    assert error.abs().max() <= RGBE
    assert error.abs().max() > RGBE / 2  # the bound is reached
    assert (read_map(path)[radiance == 0] == 0).all()
    # Five standard errors of the mean of errors uniform in half a unit; truncation would be off by RGBE / 2 or so.
    assert error.mean().abs() < 5 * RGBE / math.sqrt(3 * error.numel())


HDR_HEADER = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 3\n"


def test_a_radiance_file_written_byte_by_byte_is_read(tmp_path):
    """Radiance = mantissa · 2^(exponent - 136), and black where the exponent is 0."""
    first = [[128, 64, 32, 129], [200, 0, 1, 128], [0, 0, 0, 0]]
    texels = np.array([first, [[255, 255, 128, 136], [130, 7, 9, 118], [1, 2, 192, 140]]])
    (tmp_path / "map.hdr").write_bytes(HDR_HEADER + texels.astype(np.uint8).tobytes())
    expected = texels[..., :3] * 2.0 ** (texels[..., 3:] - 136)
    np.testing.assert_array_equal(read_map(tmp_path / "map.hdr"), expected)


def write_exr(path: Path, texels: np.ndarray, names: tuple[str, ...], **attributes) -> None:
    height, width, channels = texels.shape
    spec = OpenImageIO.ImageSpec(width, height, channels, "half")
    spec.channelnames = names
    for name, value in attributes.items():
        if hasattr(spec, name):
            setattr(spec, name, value)
        else:
            spec.attribute(name, value)
    file = OpenImageIO.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_image(texels.astype(np.float32)) and file.close()


def numbered(channels: int) -> np.ndarray:
    """(2, 4, C), all values different, exact as half floats; channel c in [c, c + 1)."""
    return np.arange(channels) + np.arange(8).reshape(2, 4, 1) / 8


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("A", "B", "G", "R"), [3, 2, 1]),
        (("r", "g", "b", "a"), [0, 1, 2]),
        (("Red", "Green", "Blue"), [0, 1, 2]),
        (("Y",), [0, 0, 0]),
        (("sky.R", "sky.G", "sky.B", "sky.A"), [0, 1, 2]),
        (("spec.R", "spec.G", "spec.B", "R", "G", "B"), [3, 4, 5]),
        (("View.Depth.Z", "View.Combined.R", "View.Combined.G", "View.Combined.B"), [1, 2, 3]),
    ],
    ids=lambda values: "-".join(map(str, values)),
)
def test_the_color_channels_of_an_exr_file_are_found_by_name(tmp_path, names, expected):
    texels, path = numbered(len(names)), tmp_path / "map.exr"
    write_exr(path, texels, names)
    np.testing.assert_array_equal(read_map(path), texels[..., expected])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.array([None, "pickled"], dtype=object), "cannot be read: "),
        (np.full((4, 8, 3), 1e300), "holds NaN, infinity or radiance beyond 1e+12"),
        (np.ones((49, 3)), "its shape is (49, 3), give (height, width, channels)"),
        (np.ones((4, 8, 2)), "its shape is (4, 8, 2), give"),
    ],
    ids=["pickled", "beyond float32", "coefficients", "two channels"],
)
def test_an_array_that_is_not_a_map_is_refused(tmp_path, values, message):
    np.save(tmp_path / "map.npy", values)
    with pytest.raises(InputError, match=re.escape(message)):
        read_map(tmp_path / "map.npy")


@pytest.mark.parametrize("attributes", [{"x": 1, "full_width": 8}, {"Orientation": 4}, None])
def test_a_file_that_is_not_the_whole_upright_image_is_refused(tmp_path, attributes):
    """A cropped or rotated .exr file, or a .hdr file with its bottom row first."""
    path = tmp_path / ("map.exr" if attributes else "map.hdr")
    if attributes:
        write_exr(path, numbered(3), ("R", "G", "B"), **attributes)
    else:
        path.write_bytes(HDR_HEADER.replace(b"-Y", b"+Y") + bytes(24))
    with pytest.raises(InputError, match="stored cropped or turned, save it whole, its top row first"):
        read_map(path)


@pytest.mark.parametrize("size", [(4, 8), (48, 64)])
def test_a_map_with_few_texels_or_another_aspect_ratio_is_refused(tmp_path, size):
    """Of few rows, even radiance from everywhere would be light with a direction; a mirror ball's map is square."""
    np.save(tmp_path / "map.npy", np.ones((*size, 3)))
    with pytest.raises(InputError, match=rf"map\.npy has {size[1]} × {size[0]} texels: give an equirectangular one"):
        load_light(str(tmp_path / "map.npy"))


def test_an_exr_file_whose_header_breaks_off_is_read_or_refused_without_ending_the_process(tmp_path):
    write_map(tmp_path / "map.exr", torch.ones(4, 8, 3))
    content = (tmp_path / "map.exr").read_bytes()
    before, name, after = content.partition(b"screenWindowWidth\0float\0")
    (tmp_path / "map.exr").write_bytes(before + name + b"\0" + after[1:])  # the attribute's size is 0, not 4
    try:
        radiance = read_map(tmp_path / "map.exr")
    except InputError as error:
        assert "map.exr" in str(error)
    else:  # older releases of OpenImageIO overlook it
        assert torch.equal(radiance, torch.ones(4, 8, 3))
