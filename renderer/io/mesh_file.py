"""A mesh file, the files that it refers to, and what a reader ignores of it."""

import io
import warnings
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np
import torch
from PIL import Image

from renderer.errors import MAX_MAGNITUDE
from renderer.geometry.mesh import Mesh
from renderer.image import decode, encode
from renderer.io.files import file_below
from renderer.io.images import eight_bits

# Largest difference from the range [0, 1] that counts as rounding of a color.
_TOLERANCE = 1e-3


class Part(NamedTuple):
    """Mesh of a file, with its normals and its place in the scene.

    Attributes:
        mesh: Mesh in its own coordinates.
        normals: Normals of the corners of the faces in the file, of any length,
            shape (F, 3, 3). Zero for corners without a normal. None if the file has
            no normals.
        matrix: Affine matrix that places the mesh in the scene, shape (4, 4).
    """

    mesh: Mesh
    normals: np.ndarray | None = None
    matrix: np.ndarray = np.eye(4)


class MeshFile:
    """Content of a mesh file, with the files beside it.

    Attributes:
        path: Path of the file.
        content: Content of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content = path.read_bytes()
        # Dictionaries without values, because sets have no order.
        self._ignored: dict[str, None] = {}
        self._assumptions: dict[str, None] = {}
        self._textures: dict[str, np.ndarray] = {}

    def read(self, name: str) -> bytes:
        """Read a file below the folder of the mesh file.

        The file is sought at the given path, and then by its name in the folder
        itself. The path may contain \\ instead of / and %20 instead of a blank.
        """
        written = name.strip('" \t').replace("\\", "/")
        errors = []
        for path in (written, unquote(written)):
            for candidate in (path, path.rpartition("/")[2]):
                try:
                    return file_below(self.path.parent, candidate).read_bytes()
                except ValueError as error:
                    errors.append(error)
        raise errors[0]

    def texture(self, name: str) -> np.ndarray:
        """Read an image file as a texture, uint8, shape (H, W, 3)."""
        if name not in self._textures:
            with Image.open(io.BytesIO(self.read(name))) as image:
                pixels = eight_bits(image)
            if (
                pixels.has_transparency_data
                and np.array(pixels.convert("RGBA"))[..., 3].min() < 255
            ):
                self.assume(f"the alpha of {name} is ignored")
            self._textures[name] = np.array(pixels.convert("RGB"))
        return self._textures[name]

    def ignore(self, feature: str) -> None:
        """Note that a feature is ignored, which changes neither the shape nor the base color."""
        self._ignored[feature] = None

    def assume(self, assumption: str) -> None:
        """Note what the reader assumes, in a clause such as "the colors are sRGB-encoded"."""
        self._assumptions[assumption] = None

    def warn(self, stacklevel: int) -> None:
        """Warn once of all that was ignored or assumed."""
        clauses = list(self._assumptions)
        if self._ignored:
            names = ", ".join(self._ignored)
            clauses.append(f"ignored, as they change neither shape nor color: {names}")
        if clauses:
            warnings.warn(f"{self.path}: {'; '.join(clauses)}", stacklevel=stacklevel + 1)


def as_utf8(text: bytes) -> bytes:
    """Convert text with a byte-order mark, and other text that may be Latin-1, to UTF-8."""
    if text.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = text.decode("utf-16").encode()
    text = text.removeprefix(b"\xef\xbb\xbf")
    if b"\0" in text:
        raise ValueError("the text has NUL bytes, so the file is damaged: export it again")
    try:
        text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1").encode()
    return text


def require_bounded(**values: np.ndarray) -> None:
    """Raise `ValueError` if numbers of a file are not finite or huge."""
    for name, numbers in values.items():
        # A comparison with NaN is False, so `not` also finds NaN.
        if not (np.abs(numbers) <= MAX_MAGNITUDE).all():
            raise ValueError(f"{name} are not finite or beyond {MAX_MAGNITUDE:g}")


def unit_colors(colors: np.ndarray, file: MeshFile) -> np.ndarray:
    """Convert colors to [0, 1]: unsigned integers by their maximum, and numbers from 0 to 255."""
    if colors.dtype.kind == "u":
        return colors / np.iinfo(colors.dtype).max
    colors = colors.astype(np.float64)
    highest = colors.max(initial=0)
    if highest > 1 + _TOLERANCE and highest <= 255 and (colors == np.round(colors)).all():
        file.assume("colors above 1 are taken as values from 0 to 255")
        colors = colors / 255
    # A comparison with NaN is False, so `not` also finds NaN.
    if not ((colors >= -_TOLERANCE) & (colors <= 1 + _TOLERANCE)).all():
        raise ValueError("colors are out of range: give values from 0 to 1 or bytes")
    return colors.clip(0, 1)


def product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Multiply the linear values of sRGB-encoded colors, and encode the product."""
    factors = [decode(torch.from_numpy(colors), "srgb") for colors in (first, second)]
    return encode(factors[0] * factors[1], "srgb").numpy()
