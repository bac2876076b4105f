"""Whether what is asked for can be written, tried before the work whose results it is to hold."""

import tempfile
from pathlib import Path

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from augment import utils
from renderer.errors import InputError
from train.command_line.entry_points import one_sentence_errors

TRIAL = bytes(2**16)
LOG = "train.log"


def writable_folder(folder: str | Path, key: str) -> Path:
    """The folder, which need not be there yet. InputError naming the key where no file can be written into it."""
    folder = Path(folder)
    try:
        _try_folder(folder)
    except (OSError, ValueError) as error:
        raise InputError(f"{key}={folder} cannot be written to ({_reason(error)}): choose another folder") from error
    return folder


def writable_file(file: str | Path, key: str) -> Path:
    """The file, which need not be there yet, nor its folder. InputError naming the key where it cannot be written."""
    file = Path(file)
    try:
        if file.exists() and not file.is_file():
            raise ValueError("it is no regular file")
        _try_folder(file.parent)
        if file.exists():
            file.open("ab").close()
    except (OSError, ValueError) as error:
        raise InputError(f"{key}={file} cannot be written ({_reason(error)}): choose another file") from error
    return file


def _try_folder(folder: Path) -> None:
    """Nothing is left behind: the folder is tried, or the nearest above it in which it would be made."""
    there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    with tempfile.TemporaryFile(dir=there) as file:
        file.write(TRIAL)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


class Folders(Callback):
    """Tries a run's or sweep's folder before Hydra makes it and its log, whose errors would be tracebacks."""

    @one_sentence_errors
    def on_run_start(self, config: DictConfig, **_: object) -> None:
        if utils.rank() == 0:
            _try_setting(config.hydra.run.dir, "run")
            writable_file(Path(config.hydra.run.dir) / LOG, "run")

    @one_sentence_errors
    def on_multirun_start(self, config: DictConfig, **_: object) -> None:
        _try_setting(config.hydra.sweep.dir, "sweep")


def _try_setting(folder: object, key: str) -> None:
    if not isinstance(folder, str | int | float):
        raise InputError(f"{key}={folder} is no folder's name: give one")
    writable_folder(str(folder), key)
