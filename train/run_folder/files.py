"""A run's folder: who may write in it, and what its files hold, read as data that anyone may have written."""

import json
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf
from omegaconf._utils import get_yaml_loader

from renderer.errors import InputError, in_one_line

CONFIG, LOCK, FAILURE = "config.yaml", ".lock", "failed.txt"
LARGEST_CONFIG, LARGEST_FILE = 2**20, 2**28  # bytes; a run has written 300 for each of its epochs


@contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Whether nobody else holds the folder, on any machine that shares it; nobody else gets it then."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()


@contextmanager
def sole_writer(key: str, *folders: Path) -> Iterator[None]:
    """InputError naming the key where another process writes in one of the folders; none may until they are left.

    A folder in which nothing was written is not left behind.
    """
    with ExitStack() as stack:
        for folder in folders:
            if not stack.enter_context(locked(folder)):
                raise InputError(
                    f"{key}={folder} is being written by another process: let it end, or choose another folder with "
                    f"{key}="
                )
        try:
            yield
        finally:
            for folder in folders:
                if [path.name for path in folder.iterdir()] == [LOCK]:
                    (folder / LOCK).unlink()
                    folder.rmdir()


def state(folder: Path) -> str:
    """What became of a run that is not finished."""
    if not folder.exists():
        return "not begun"
    with locked(folder) as ours:
        if not ours:
            return "in training"
    failure = folder / FAILURE
    return (
        f"failed: {failure.read_text(encoding='utf-8', errors='replace').strip()}"
        if failure.exists()
        else "interrupted"
    )


def write_whole(path: Path, content: bytes | memoryview, previous: Path | None = None) -> None:
    """Write a file so that it is, at any moment, also after a loss of power, either the old one or the new one.

    previous: where the old one is kept. OSError that names the path where the disk does not take it; the old one stays.
    """
    temporary = path.with_suffix(".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if previous and path.exists():
            os.replace(path, previous)
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error


def _sync_folder(folder: Path) -> None:
    """Make the renaming last, where folders can be synchronized."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_config(path: Path) -> DictConfig:
    """A run's config.yaml, in which nothing is resolved: `${...}` is text. InputError naming a file that is none."""
    try:
        plain = yaml.load(_read(path, LARGEST_CONFIG), _PlainLoader)
        if not isinstance(plain, dict):
            raise ValueError("it holds no keys")
        config = OmegaConf.create(_escaped(plain))
        if unset := OmegaConf.missing_keys(config):
            raise ValueError(f"{min(unset)} is not set")
        return config
    except Exception as error:  # YAML and OmegaConf raise many kinds for what is no configuration
        raise _damaged(path, error) from error


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file that holds an object; InputError naming one that does not."""
    try:
        return _object(_read(path))
    except (ValueError, RecursionError, OSError) as error:
        raise _damaged(path, error) from error


def read_numbers(path: Path) -> list[dict[str, float]]:
    """A file of JSON lines, an object of numbers each; a last line that a crash cut short is passed over.

    InputError naming a file that is none.
    """
    try:
        lines = [_object(line) for line in _read(path).split("\n")[:-1]]
        if any(not isinstance(value, int | float) for line in lines for value in line.values()):
            raise ValueError("a value is no number")
    except (ValueError, RecursionError, OSError) as error:
        raise _damaged(path, error) from error
    return lines


class _PlainLoader(get_yaml_loader()):  # type: ignore[misc]  # OmegaConf makes its class in a function
    """Without aliases, which no run writes, and by which a short file stands for one beyond memory."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise ValueError("it holds an alias")
        return super().compose_node(parent, index)


def _read(path: Path, largest: int = LARGEST_FILE) -> str:
    if not path.is_file():
        raise ValueError("there is no such file")
    if path.stat().st_size > largest:
        raise ValueError(f"it is larger than {largest} bytes")
    return path.read_text(encoding="utf-8")


def _object(text: str) -> dict[str, Any]:
    found = json.loads(text)
    if not isinstance(found, dict) or not found:
        raise ValueError("it holds no object of keys and values")
    return found


def _escaped(value: Any) -> Any:
    """With `${` as OmegaConf writes it where it means no interpolation."""
    if isinstance(value, dict):
        return {key: _escaped(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_escaped(item) for item in value]
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", value) if isinstance(value, str) else value


def _damaged(path: Path, error: Exception) -> InputError:
    said = in_one_line(error)
    return InputError(f"{path} is damaged or no file that `python -m train` wrote ({said}): use another run")
