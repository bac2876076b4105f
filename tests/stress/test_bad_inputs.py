"""Damaged and forged files are used with finite results, or refused in one sentence.

No reader raises another exception, hangs, or runs code from a file. By default,
the tests try a small fixed sample. `-m slow` tries many more.
"""

import io
import json
import os
import re
import resource
import shutil
import signal
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from renderer import InputError, load_light, load_mesh
from renderer.io.images import gray_or_image
from train.cli import USER_ERROR
from train.data.sets import load_folder, load_npz

from .conftest import MAX_SECONDS, RENDERER, TRAINING, run_here

# A reader that runs code from its input creates this file in the working folder.
CODE_RAN = "code_ran"
# Limit for a reader in seconds. A command has `MAX_SECONDS`.
READER_SECONDS = 60
# Additional bytes of address space. A reader that asks for more fails, and not the machine.
MEMORY = 12 * 2**30

LIGHTS = ("light.npy", "light.hdr", "light.exr", "light.json")
MESHES = ("mesh.obj", "mesh.glb", "mesh.ply", "mesh.stl", "mesh.off")


# Functions of the library by the files that they read.
READERS: dict[str, Callable[[Path], Any]] = {
    **dict.fromkeys(MESHES, load_mesh),
    **dict.fromkeys(("mesh.mtl", "peel.png"), lambda path: load_mesh(path.with_name("mesh.obj"))),
    **dict.fromkeys(LIGHTS, lambda path: load_light(str(path))),
    "background.png": lambda path: gray_or_image("background", str(path), 16),
    "data.npz": lambda path: load_npz(str(path)),
    "images/apple/0.png": lambda path: load_folder(str(path.parents[1]), 16, 0.3),
}
EVALUATE = ("evaluate", "photos=photographs", "out=out", "device=cpu", "precision=float32")
EVALUATE_RUN = (*EVALUATE, "run=finished")
EVALUATE_PUBLISHED = (*EVALUATE, "run=published")
ATTACK = (
    *("attack", "network=run:finished", "meshes=[mesh.obj]", "out=out", "device=cpu"),
    *("attack.max_steps=1", "attack.force=true", "attack.checks=false"),
    *RENDERER,
)
LAMPS = "scene.lamps={positions: [[2, 2, 2], [-2, 2, 2]], start: lamps.json}"
PROJECTOR = "scene.projector={pixels: 4, pattern: pattern.png}"
RESUME = ("train", "out=finished", *TRAINING, "train.epochs=3", "train.resume=true")
COMPARE = ("compare", "runs=[finished]")
# Commands by the files that they read.
COMMANDS: dict[str, tuple[str, ...]] = {
    "finished/best.pt": EVALUATE_RUN,
    "published/model.safetensors": EVALUATE_PUBLISHED,
    "finished/last.pt": RESUME,
    "finished/config.yaml": RESUME,
    "finished/metrics.jsonl": COMPARE,
    "finished/photographs/summary.json": COMPARE,
    "finished/photographs/predictions.csv": COMPARE,
    "photographs/orange/0.png": EVALUATE_RUN,
    "photographs/photos.csv": EVALUATE_RUN,
    "lamps.json": (*ATTACK, "attack=lamps", LAMPS),
    "pattern.png": (*ATTACK, "attack=projector", PROJECTOR),
}
UNLIMITED = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}
# Numbers of examples. A command takes longer, and tries a fifth of them.
QUICK = 5
MANY = 100
# These commands train.
SLOW_COMMANDS = [file for file in COMMANDS if COMMANDS[file] == RESUME]


NUMBER = re.compile(rb"[-+]?\d[\d.]*(?:e[-+]?\d+)?")
WORDS = b"nan inf -1 0 1e300 1e-300 word [] null"
TOKENS = (*WORDS.split(), b"9" * 19, b"9" * 400, b"")
NOISE = np.random.default_rng(0).bytes(1000)
OTHER = (b"", NOISE, b"<html>404</html>\n", b"[" * 10**5, b"1", b"[]", b"{}")
VALUES = (-1, 0, 10**9, 10**30, float("nan"), float("inf"), "word", None, [], {}, [1, "a"])
ARRAY_EDITS: tuple[Callable[[np.ndarray], np.ndarray], ...] = (
    lambda values: values[: len(values) // 2],
    lambda values: values[..., None],
    lambda values: values.T,
    lambda values: np.full(values.shape, np.nan),
    lambda values: np.full(values.shape, -1),
    lambda values: np.full(values.shape, 2**63 + 1),
    lambda values: np.full(values.shape, "word"),
    lambda values: np.full(values.shape, 1j),
    lambda values: np.full(values.shape, {}, dtype=object),
)
TENSOR_EDITS: tuple[Callable[[torch.Tensor], Any], ...] = (
    lambda values: values.float() * torch.nan,
    lambda values: values[..., None],
    lambda values: values.double(),
    lambda values: values.reshape(-1)[:0],
    lambda values: "word",
)


@st.composite
def bytes_changed(draw: st.DrawFn, good: bytes) -> bytes:
    """Cut a file, flip bytes, replace one number, or replace the whole file."""
    numbers = [found.span() for found in NUMBER.finditer(good)]
    kind = draw(st.sampled_from(["cut", "flip", "other", *(["number"] * 3 if numbers else [])]))
    if kind == "cut":
        return good[: draw(st.integers(0, len(good) - 1))]
    if kind == "other":
        return draw(st.sampled_from(OTHER))
    if kind == "number":
        begin, end = numbers[draw(st.integers(0, len(numbers) - 1))]
        token = draw(st.sampled_from(TOKENS))
        # Headers of binary files keep their length.
        padded = token.ljust(end - begin)
        return good[:begin] + padded + good[end:]
    changed = bytearray(good)
    for place in draw(st.lists(st.integers(0, len(good) - 1), min_size=1, max_size=8)):
        changed[place] ^= draw(st.integers(1, 255))
    return bytes(changed)


@st.composite
def arrays_changed(draw: st.DrawFn, good: bytes) -> bytes:
    arrays = dict(np.load(io.BytesIO(good)))
    name = draw(st.sampled_from(sorted(arrays)))
    edit = draw(st.sampled_from(ARRAY_EDITS))
    content = io.BytesIO()
    np.savez(content, **arrays | {name: edit(arrays[name])})
    return content.getvalue()


@st.composite
def checkpoint_changed(draw: st.DrawFn, good: bytes) -> bytes:
    state = torch.load(io.BytesIO(good), weights_only=True)
    node = state
    key = draw(st.sampled_from(sorted(state)))
    while isinstance(node[key], Mapping) and node[key] and draw(st.integers(0, 3)):
        node = node[key]
        key = draw(st.sampled_from(list(node)))
    if isinstance(node[key], torch.Tensor):
        edit = draw(st.sampled_from(TENSOR_EDITS))
        node[key] = edit(node[key])
    else:
        node[key] = draw(st.sampled_from(VALUES))
    content = io.BytesIO()
    torch.save(state, content)
    return content.getvalue()


def damages(file: str, good: bytes) -> st.SearchStrategy[bytes]:
    by_suffix = {".npz": arrays_changed, ".pt": checkpoint_changed}
    return bytes_changed(good) | by_suffix.get(Path(file).suffix, bytes_changed)(good)


@pytest.fixture(autouse=True)
def memory_limit() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def by_library(file: str, folder: Path) -> str | None:
    """Read a file, and return the sentence of a refusal, or None for a finite result."""
    try:
        require_finite(READERS[file](folder / file))
    except InputError as error:
        return str(error)
    return None


def by_command(file: str, folder: Path, capfd) -> str | None:
    """Run the command that reads a file, and return its error, or None if it succeeds."""
    capfd.readouterr()
    name, *arguments = COMMANDS[file]
    status = run_here(name, *arguments, folder=folder)
    errors = capfd.readouterr().err
    assert status in (0, USER_ERROR), errors
    if status == 0:
        return None
    assert errors.startswith("error: "), errors
    assert errors.count("\n") == 1, errors
    return errors.removeprefix("error: ").rstrip("\n")


def time_out(*_) -> None:
    pytest.fail("a file was read for minutes")


@pytest.fixture
def outcome(corpus, tmp_path, capfd) -> Callable[[str, Callable[[Path], object]], str | None]:
    """Return a function that edits and reads a file of a copy, and returns the refusal or None."""
    folder = tmp_path / "copy"

    def read(file: str, edit: Callable[[Path], object]) -> str | None:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(corpus, folder)
        edit(folder / file)
        is_library = file in READERS
        signal.signal(signal.SIGALRM, time_out)
        signal.alarm(READER_SECONDS if is_library else MAX_SECONDS)
        try:
            sentence = by_library(file, folder) if is_library else by_command(file, folder, capfd)
        finally:
            signal.alarm(0)
        assert not list(folder.glob(f"**/{CODE_RAN}")), "code ran"
        if sentence is not None:
            # Training reports a NaN of these.
            names = (*Path(file).parts, "mesh.obj", "checkpoint")
            assert "\n" not in sentence, sentence
            assert any(name in sentence for name in names), sentence
        return sentence

    return read


def require_finite(result: Any) -> None:
    if isinstance(result, torch.Tensor | np.ndarray):
        values = torch.as_tensor(result)
        assert not values.is_floating_point() or values.isfinite().all()
    parts = []
    if isinstance(result, list | tuple):
        parts = result
    elif hasattr(result, "__dict__"):
        parts = vars(result).values()
    for part in parts:
        require_finite(part)


@pytest.mark.filterwarnings("ignore")  # libraries warn of what they then refuse or read
@pytest.mark.parametrize(
    "file, examples",
    [
        *((file, QUICK) for file in READERS),
        *(pytest.param(file, MANY, marks=pytest.mark.slow) for file in READERS),
        *(pytest.param(file, MANY // 5, marks=pytest.mark.slow) for file in COMMANDS),
    ],
)
def test_a_damaged_file_is_used_or_refused_in_a_sentence_naming_it(corpus, outcome, file, examples):
    good = (corpus / file).read_bytes()

    @settings(max_examples=examples, derandomize=examples == QUICK, **UNLIMITED)
    @given(content=damages(file, good))
    def used_or_refused(content: bytes) -> None:
        outcome(file, partial(Path.write_bytes, data=content))

    used_or_refused()


def npy_header(shape: str) -> bytes:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


def zip_bomb(path: Path) -> None:
    """Write a small file whose headers announce arrays of 10 TB."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "|u1", "fortran_order": False, "shape": (10**13,)}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("train_images", "train_labels", "test_images", "test_labels", "classes"):
            archive.writestr(f"{name}.npy", header.getvalue() + bytes(10**6))


def name_not_text(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"\0string\0", b"\0string\x80"))


def huge_png() -> bytes:
    """Make a small file whose header announces 10¹⁰ pixels."""

    def chunk(name: bytes, body: bytes) -> bytes:
        length = struct.pack(">I", len(body))
        checksum = struct.pack(">I", zlib.crc32(name + body))
        return length + name + body + checksum

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 10**5, 10**5, 8, 2, 0, 0, 0))
    pixels = chunk(b"IDAT", zlib.compress(bytes(10**6)))
    return b"\x89PNG\r\n\x1a\n" + head + pixels + chunk(b"IEND", b"")


def safetensors(**header: object) -> bytes:
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text


LARGE = {"dtype": "F32", "shape": [10**13], "data_offsets": [0, 4]}
DEEP = {"depth": 10**9, "width": 1, "dropout": 0, "classes": ["a"]}
FORGED: list[tuple[str, str, str | bytes | Callable[[Path], object]]] = [
    ("mesh.obj", "vertex 10¹²", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1000000000000\n"),
    ("mesh.stl", "2³² faces", bytes(80) + b"\xff\xff\xff\xff" + bytes(50)),
    ("light.npy", "10 TB", npy_header("(1000000, 1000000, 3)")),
    ("light.npy", "code for a shape", npy_header("__import__('os').getcwd()")),
    (
        "light.hdr",
        "10⁹ wide",
        "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1000000000 +X 1000000000\n",
    ),
    ("light.exr", "a name that is not UTF-8", name_not_text),
    ("background.png", "10¹⁰ pixels", huge_png()),
    ("data.npz", "10 TB", zip_bomb),
    ("published/model.safetensors", "10 TB", safetensors(a=LARGE)),
    (
        "published/model.safetensors",
        "depth 10⁹",
        safetensors(__metadata__={"architecture": json.dumps(DEEP)}),
    ),
    ("finished/config.yaml", "code", f"a: !!python/object/apply:os.system ['touch {CODE_RAN}']\n"),
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "file, fault, content",
    [pytest.param(*one, marks=[pytest.mark.slow] * (one[0] in SLOW_COMMANDS)) for one in FORGED],
)
def test_a_forged_file_is_refused(outcome, file, fault, content):
    content = content.encode() if isinstance(content, str) else content
    edit = content if callable(content) else partial(Path.write_bytes, data=content)
    assert outcome(file, edit) is not None


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "file", ["mesh.obj", "light.npy", "light.json", "background.png", "data.npz"]
)
def test_what_is_no_file_is_refused(outcome, file):
    for instead in (Path.mkdir, os.mkfifo, lambda path: path.symlink_to(path.name)):
        assert outcome(file, lambda path, put=instead: (path.unlink(), put(path))) is not None
