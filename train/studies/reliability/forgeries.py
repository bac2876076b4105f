"""Well-formed files of every format that say what cannot be meant, by the end of the file's name."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from train.studies.reliability.edits import (
    CODE_RAN,
    Edit,
    array,
    arrays,
    content,
    image,
    in_checkpoint,
    in_json,
    nan_weights,
    npy_header,
    pickled_code,
    ply,
    png_header,
    replaced,
    safetensors,
    swapped,
    zip_bomb,
)

GRAY = np.full((4, 8, 3), 0.5, dtype=np.float32)
BOMB = "a: &a [1, 1, 1]\n" + "".join(
    f"{next_}: &{next_} [{', '.join(9 * [f'*{name}'])}]\n" for name, next_ in zip("abcdefgh", "bcdefghi", strict=True)
)
DEEP = {"depth": 10**9, "width": 1, "dropout": 0, "classes": ["a"]}


def _rows(value: object) -> str:
    return json.dumps([[value] * 3] * 49)


def _sized(channels: int, height: int, width: int) -> Edit:
    return arrays(train_images=np.zeros((60, channels, height, width), np.uint8))


REFUSED: dict[str, dict[str, Edit]] = {
    ".npy": {
        "complex": array(GRAY.astype(complex)),
        "text": array(np.array([["a"]])),
        "objects": array(np.array([[{}]], dtype=object)),
        "no texel": array(GRAY[:0]),
        "two channels": array(GRAY[..., :2]),
        "no height": array(GRAY[0]),
        "NaN": array(GRAY * np.nan),
        "infinity": array(np.full_like(GRAY, np.inf)),
        "1e300": array(np.full((4, 8, 3), 1e300)),
        "black": array(GRAY * 0),
        "negative": array(-GRAY),
        "10 TB": npy_header("(1000000, 1000000, 3)"),
        "negative shape": npy_header("(-1, 8, 3)"),
        "code for a shape": npy_header("__import__('os').getcwd()"),
    },
    ".hdr": {"10⁹ wide": content("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1000000000 +X 1000000000\n")},
    ".exr": {"a PNG": image("RGB", (4, 4))},
    "light.json": {
        "a number": content("1"),
        "one row": content("[[1, 2, 3]]"),
        "NaN": content(_rows(float("nan"))),
        "1e300": content(_rows(1e300)),
        "words": content(_rows("a")),
        "10⁴⁰⁰": content(_rows(10**400)),
        "nested deep": content("[" * 10**5),
        "another basis": in_json("basis", value="projector"),
    },
    ".npz": {
        "real images": arrays(train_images=np.zeros((60, 3, 16, 16))),
        "channels last": arrays(train_images=np.zeros((60, 16, 16, 3), np.uint8)),
        "oblong": _sized(3, 16, 12),
        "another size than the test's": _sized(3, 8, 8),
        "no images": arrays(train_images=np.zeros((0, 3, 16, 16), np.uint8), train_labels=np.zeros(0, int)),
        "labels beyond classes": arrays(train_labels=np.full(60, 7)),
        "negative labels": arrays(train_labels=np.full(60, -1)),
        "labels of 2⁶³": arrays(train_labels=np.full(60, 2**63 + 1, np.uint64)),
        "real labels": arrays(train_labels=np.zeros(60)),
        "too few labels": arrays(train_labels=np.zeros(5, int)),
        "no labels": arrays(train_labels=None),
        "classes of bytes": arrays(classes=np.array([b"a", b"orange", b"c"])),
        "a class twice": arrays(classes=np.array(["orange", "orange", "a"])),
        "classes without the label": arrays(classes=np.array(["a", "b", "c"])),
        "objects": arrays(classes=np.array([{}], dtype=object)),
        "10 TB": zip_bomb,
    },
    ".png": {"10¹⁰ pixels": png_header(100_000, 100_000), "2³¹ wide": png_header(2**31 - 1, 1)},
    ".obj": {
        "no faces": content("v 0 0 0\n"),
        "zero area": content("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n"),
        "NaN": swapped("v ", "v nan 0 0\nv "),
        "infinity": swapped("v ", "v inf 0 0\nv "),
        "1e200": content("v 1e200 0 0\nv 0 1e200 0\nv 0 0 1e200\nf 1 2 3\n"),
        "1e-300": content("v 1e-300 0 0\nv 0 1e-300 0\nv 0 0 1e-300\nf 1 2 3\n"),
        "a vertex that is not there": content("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        "vertex 10¹²": content("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1000000000000\n"),
        "words": content("v a b c\nf 1 2 3\n"),
        "no such library": swapped("mesh.mtl", "gone.mtl"),
        "a pipe for a library": swapped("mesh.mtl", "pipe.mtl", pipe="pipe.mtl"),
        "no such material": swapped("usemtl peel", "usemtl gone"),
    },
    ".mtl": {
        "no such texture": swapped("peel.png", "gone.png"),
        "a folder for a texture": swapped("peel.png", "photographs"),
        "a color of NaN": swapped("Kd 1 0.5 0", "Kd nan nan nan"),
    },
    ".gltf": {
        "a list": content("[]"),
        "no meshes": in_json("meshes", value=[]),
        "no such buffer": in_json("buffers", 0, "uri", value="gone.bin"),
        "an accessor of 10¹²": in_json("accessors", 0, "count", value=10**12),
        "a negative accessor": in_json("accessors", 0, "count", value=-1),
        "a node of zeros": in_json("nodes", -1, "matrix", value=[0] * 16),
        "a node at NaN": in_json("nodes", -1, "matrix", value=[float("nan")] * 16),
    },
    ".ply": {"10¹² vertices": ply(10**12, "0 0 0"), "a negative vertex": ply(3, "0 0 0\n1 0 0\n0 1 0\n3 0 1 -2\n")},
    ".stl": {"2³² faces": content(bytes(80) + b"\xff\xff\xff\xff" + bytes(50))},
    ".off": {
        "10¹² vertices": content("OFF\n1000000000000 1 0\n0 0 0\n"),
        "a vertex that is not there": content("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n"),
    },
    ".pt": {
        "code": pickled_code,
        "depth 6·10⁶ + 4": in_checkpoint("architecture", "depth", value=6 * 10**6 + 4),
        "width 10⁶": in_checkpoint("architecture", "width", value=10**6),
        "width in words": in_checkpoint("architecture", "width", value="wide"),
        "depth NaN": in_checkpoint("architecture", "depth", value=float("nan")),
        "no classes": in_checkpoint("architecture", "classes", value=[]),
        "other classes": in_checkpoint("architecture", "classes", value=["a", "b", "c"]),
        "later version": in_checkpoint("architecture", "version", value=99),
        "size 10⁹": in_checkpoint("architecture", "size", value=10**9),
        "no weights": in_checkpoint("model", value=[]),
        "weights of NaN": nan_weights,
    },
    "last.pt": {
        "history in words": in_checkpoint("history", value="x"),
        "epoch -1": in_checkpoint("epoch", value=-1),
        "no optimizer": in_checkpoint("optimizer", value={}),
        "no such precision": in_checkpoint("precision", value="int3"),
    },
    ".safetensors": {
        "a header of 10¹²": content((10**12).to_bytes(8, "little")),
        "10 TB": safetensors(a={"dtype": "F32", "shape": [10**13], "data_offsets": [0, 4 * 10**13]}),
        "no description": safetensors(),
        "a list for a description": safetensors(__metadata__={"architecture": "[]"}),
        "depth 10⁹": safetensors(__metadata__={"architecture": json.dumps(DEEP)}),
    },
    "config.yaml": {
        "a bomb": content(BOMB),
        "a list": content("[1, 2]"),
        "nested deep": content("a: " + "[" * 10**4),
        "code": content(f"a: !!python/object/apply:os.system ['touch {CODE_RAN}']\n"),
        "numbers for all": content("seed: 1\naugment: 3\ndata: 5\ntrain: x\nmodel: 1\nscene: 1\n"),
    },
    "metrics.jsonl": {
        "words": content('{"epoch": "x"}\n'),
        "a number": content("1\n"),
        "lists": content('{"epoch": [1]}\n'),
        "nested deep": content("[" * 10**5 + "\n"),
    },
    "summary.json": {
        "a list": content("[]"),
        "a number for a figure": content('{"recall": 3}'),
        "words for a value": content('{"recall": {"value": "x", "n": 1}}'),
    },
    "photos.csv": {
        "no header": content("a,b\n"),
        "no such photograph": content("path,source_tag\nnowhere.png,web\n"),
        "no such hard negatives": content("path,source_tag,hard_negatives\norange/0.png,web,nowhere\n"),
        "Latin-1": content(b"path,source_tag\norange/0.png,\xe4\n"),
    },
}


def _sixteen_bits(path: Path) -> None:
    Image.fromarray(np.full((9, 9), 40_000, np.uint16)).save(path, format="PNG")


EITHER: dict[str, dict[str, Edit]] = {  # odd, but what is meant may be clear
    ".npy": {"one texel": array(GRAY[:1, :1])},
    ".npz": {"labels of one class": arrays(train_labels=np.zeros(60, int))},
    "0.png": {
        "one pixel": image("RGB", (1, 1)),
        "one column": image("RGB", (1, 5000)),
        "alpha": image("RGBA", (9, 9)),
        "CMYK": image("CMYK", (9, 9), "JPEG"),
        "16 bits": _sixteen_bits,
    },
    ".obj": {
        "Latin-1": replaced(lambda whole: b"# \xe4\n" + whole),
        "UTF-16": replaced(lambda whole: whole.decode().encode("utf-16")),
    },
    ".mtl": {
        "a color in words": swapped("Kd 1 0.5 0", "Kd red"),
        "a color of 1e30": swapped("Kd 1 0.5 0", "Kd 1e30 0 0"),
        "a negative color": swapped("Kd 1 0.5 0", "Kd -1 0 0"),
    },
    ".gltf": {"a node in itself": in_json("nodes", 0, "children", value=[0])},
    ".pt": {"an unknown key": in_checkpoint("architecture", "unknown", value="x")},
    "config.yaml": {"an interpolation": swapped("label: orange", "label: ${oc.env:HOME}")},
    "metrics.jsonl": {"NaN": content('{"epoch": NaN, "test/accuracy": NaN}\n')},
    "photos.csv": {
        "NUL": content(b"path,source_tag\norange/0.png,\0\n"),
        "a long cell": content("path,source_tag\norange/0.png," + "x" * 200_000 + "\n"),
        "a formula": content('path,source_tag\norange/0.png,"=1+1"\n'),
    },
}
