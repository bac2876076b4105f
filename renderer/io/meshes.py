"""The files that a mesh is made of: text in any encoding, and the materials and images that it names.

trimesh leaves out, without a word, what it cannot find or decode; here that is an InputError before it reads.
"""

import codecs
import io
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from urllib.parse import unquote

from PIL import Image, UnidentifiedImageError
from trimesh.resolvers import Resolver

from renderer.errors import InputError
from renderer.io.gltf_images import gltf_images
from renderer.io.images import eight_bits

MATERIALS = "materials.mtl"  # the name under which trimesh is given all materials of an .obj file
LIBRARY, USED = (re.compile(rf"^[ \t]*{key}[ \t]+(.*?)[ \t\r]*$", re.MULTILINE) for key in ("mtllib", "usemtl"))
IMAGE = re.compile(r"^comment[ \t]+TextureFile[ \t]+(.*?)[ \t\r]*$", re.MULTILINE)


class Companions(Resolver):  # type: ignore[misc]  # trimesh counts as untyped, see pyproject.toml
    """What lies beside a mesh, by the names that its file has for it. Regular files alone: a pipe would never end."""

    def __init__(self, path: Path):
        self.materials = ""
        self.path = path
        self._folders = [path.parent]

    def add_materials(self, text: str) -> str:
        """Take the materials that an .obj's text names; the text that names all of them as one file, `MATERIALS`.

        A line names one file, in whose name there may be blanks, or several.
        """
        names = [name for line in LIBRARY.findall(text) for name in ([line] if self._find(line) else line.split())]
        for name in names:
            self.materials += decoded(self.read(name)) + "\n"
            self._folders.append(self._locate(name).parent)
        return f"mtllib {MATERIALS}\n{text}" if names else text

    def get(self, name: str) -> bytes | str:
        return self.materials if name == MATERIALS else self.read(name)

    def read(self, name: str) -> bytes:
        """A file's content. InputError where it is not there or cannot be read."""
        file = self._locate(name)
        try:
            return file.read_bytes()
        except OSError as error:
            raise InputError(f"{self.path} names {file}, which cannot be read: {error.strerror}") from error

    def _locate(self, name: str) -> Path:
        file = self._find(name)
        if file is None:
            named = name or "a file without a name"
            raise InputError(f"{self.path} names {named}, which is not there: put it beside, or take its name out")
        return file

    def _find(self, name: str) -> Path | None:
        """By a name that another system may have written: \\ for /, %20 for a blank, or in a folder of its own.

        Options, as in `map_Kd -s 1 1 1 peel.png`, come before the name.
        """
        plain = name.strip('" \t').replace("\\", "/")
        last = plain.split()[-1] if plain.startswith("-") else plain
        names = dict.fromkeys([plain, unquote(plain), last, plain.lstrip("/"), plain.rpartition("/")[2]])
        files = (folder / each for folder in self._folders for each in names if each and "\0" not in each)
        return next((file for file in files if file.is_file()), None)

    def keys(self) -> list[str]:
        return []

    def write(self, name: str, data: bytes) -> None:
        raise NotImplementedError("a mesh's companions are only read")

    def namespaced(self, namespace: str) -> "Companions":
        return self


def decoded(content: bytes) -> str:
    """Text in UTF-8, or in UTF-16 with its mark, or else in Latin-1, in which every byte is a character."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def open_mesh(path: Path) -> tuple[io.BytesIO, Companions]:
    """What trimesh reads: the file and what it names, all of it there and every image one that Pillow knows.

    InputError otherwise; KeyError, ValueError and the like for a damaged glTF file.
    """
    content, companions = path.read_bytes(), Companions(path)
    images: Iterable[tuple[str, bytes]] = ()
    match path.suffix.lower():
        case ".obj":
            text = companions.add_materials(decoded(content))
            content, images = text.encode(), _obj_images(text, companions)
        case ".ply":
            header, end, body = content.partition(b"end_header")
            text = decoded(header)
            content = text.encode() + end + body
            images = ((name, companions.read(name)) for name in IMAGE.findall(text))
        case ".gltf" | ".glb":
            images = gltf_images(content, companions.read)
        case ".off" | ".stl" if not _is_binary_stl(content):
            content = decoded(content).encode()
    for name, image in images:
        _require_image(path, name, image)
    return io.BytesIO(content), companions


def _is_binary_stl(content: bytes) -> bool:
    """Whether the length is that of as many faces as the bytes after the header say."""
    return len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")


def _require_image(path: Path, name: str, content: bytes) -> None:
    try:
        with Image.open(io.BytesIO(content)) as image:
            eight_bits(image)
    except Exception as error:  # Pillow's decoders raise almost anything at a broken file
        reason = "" if isinstance(error, UnidentifiedImageError) else f" ({error})"
        raise InputError(
            f"{path} names {name}, which is no image that can be read{reason}: save it as PNG or JPEG of 8 bits, and "
            "of fewer than 10⁸ pixels"
        ) from error


def _obj_images(text: str, companions: Companions) -> Iterator[tuple[str, bytes]]:
    """Of the materials that are used."""
    used, material = set(USED.findall(text)), None
    missing = set(used) if companions.materials else set()
    for line in companions.materials.splitlines():
        key, _, value = line.strip().replace("\t", " ").partition(" ")
        if key.lower() == "newmtl":
            material = value.strip()
            missing.discard(material)
        elif key.lower() == "map_kd" and material in used:
            yield value.strip(), companions.read(value)
        elif key.lower() == "kd" and material in used and not _is_color(value):
            raise ValueError(
                f"the material {material} has the color {value.strip()!r}, which is no red, green and blue"
            )
    if missing:
        raise InputError(f"{companions.path} uses the material {min(missing)}, which no file that it names has: add it")


def _is_color(value: str) -> bool:
    """Whether it is red, green and blue, or one number for all three."""
    try:
        return len([float(word) for word in value.split()]) in (1, 3)
    except ValueError:
        return False
