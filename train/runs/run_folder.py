"""A run's folder: its one writer, its configuration and input files, its metrics and logs."""

import hashlib
import json
import logging
import os
import platform
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, fields
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import yaml
from filelock import FileLock, Timeout
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from augment.service import AttackExamples
from renderer.errors import InputError, in_one_line
from renderer.image import to_bytes
from renderer.io.files import remove_unfinished, write_whole
from renderer.io.images import write_image
from renderer.io.tiles import draw_grid, tiles_of
from renderer.rendering import light_sphere
from train.command import program
from train.runs.checkpoint import BEST, LAST, PREVIOUS
from train.runs.saved_networks import selected_file
from train.settings import CIRCUMSTANCES, INPUTS, ExperimentSettings, dotted, mapped

CONFIG, METRICS, LOCK, FAILURE = "config.yaml", "metrics.jsonl", ".lock", "failed.txt"
RENDERS = "renders"  # sub-folder with the images of the epochs
BEFORE = "before"  # sub-folder with the scores of the network that the run began with
EXAMPLE = 128  # px: the least side of the examples of an attack
PHASES = ("attack", "training", "evaluation", "input_output")  # of an epoch; other phases are parts of these
logging.raiseExceptions = False  # on a full disk train.log lacks lines, and only the run's own error is shown


@contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Whether this process alone holds the folder, among all machines that share it, until the block ends."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK)
    with suppress(Timeout):
        lock.acquire(blocking=False)
    if lock.is_locked:
        remove_unfinished(folder)
    try:
        yield lock.is_locked
    finally:
        lock.release()


@contextmanager
def sole_writer(key: str, *folders: Path) -> Iterator[None]:
    """Hold the folders; InputError naming the key where another process writes to one. Empty folders are removed."""
    with ExitStack() as stack:
        for folder in folders:
            if not stack.enter_context(locked(folder)):
                raise InputError(f"{key}={folder} is being written by another process: wait, or choose another")
        try:
            yield
        finally:
            for folder in folders:
                if [path.name for path in folder.iterdir()] == [LOCK]:
                    (folder / LOCK).unlink()
                    folder.rmdir()


def state(folder: Path) -> str:
    """The state of a run that is not finished, in words."""
    if not folder.exists():
        return "not begun"
    with locked(folder) as ours:
        if not ours:
            return "in training"
    if (failure := folder / FAILURE).exists():
        return f"failed: {failure.read_text(encoding='utf-8', errors='replace').strip()}"
    return "interrupted"


@contextmanager
def _text_of(path: Path) -> Iterator[str]:
    """A file's text; InputError naming the file for whatever reading it, or using its text inside, raises."""
    try:
        if not path.is_file():
            raise ValueError("there is no such file")
        yield path.read_text(encoding="utf-8")
    except Exception as error:
        raise InputError(f"{path} is damaged or of another kind ({in_one_line(error)}): use another run") from error


def read_config(path: Path) -> DictConfig:
    """A config.yaml that a run or an attack wrote; InputError naming a file that is damaged, or has an alias, which can
    stand for more than memory holds, or an interpolation, which would show the reader's environment."""
    with _text_of(path) as text:
        if "${" in text or any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader)):
            raise ValueError("it holds an alias or an interpolation")
        plain = yaml.safe_load(text)
        if not isinstance(plain, dict):
            raise ValueError("it holds no keys")
        return OmegaConf.create(plain)


def write_config(folder: Path, settings: Any, **facts: object) -> None:
    """Write config.yaml: a command's settings, a dataclass; hashes of inputs; versions; facts found at the start, but
    none with an interpolation, which `read_config` refuses; with a command, the folder that it was first given in."""
    folder.mkdir(parents=True, exist_ok=True)
    packages = {name: version(name) for name in ("torchvision", "numpy")}
    versions = {"python": platform.python_version(), "torch": str(torch.__version__), **packages}
    if "command" in facts:
        facts["working_folder"] = os.getcwd()
        with suppress(InputError):  # of a run that goes on, perhaps from another folder
            before = read_config(folder / CONFIG)
            if str(facts["command"]).startswith(str(before.get("command"))):
                facts["working_folder"] = before.get("working_folder") or os.getcwd()
    facts = {name: fact for name, fact in facts.items() if "${" not in str(fact)}
    content = {**asdict(settings), **facts, "inputs": fingerprints(settings), "versions": versions}
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    write_whole(folder / CONFIG, text.encode(), durable=True)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file that holds an object; InputError naming a damaged file."""
    with _text_of(path) as text:
        return _object(text)


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """The lines of a run's metrics.jsonl, one per epoch, then the final scores, but none that a crash cut short; []
    without the file. InputError naming a damaged file."""
    path = folder / METRICS
    if not path.is_file():
        return []
    with _text_of(path) as text:
        lines = [_object(line) for line in text.split("\n")[:-1]]
        if any(not isinstance(value, int | float) for line in lines for value in line.values()):
            raise ValueError("a value is not a number")
        return lines


def _object(text: str) -> dict[str, Any]:
    parsed = json.loads(text)
    if not isinstance(parsed, dict) or not parsed:
        raise ValueError("it holds no object of keys and values")
    return parsed


def decisive_settings(settings: Any) -> dict[str, object]:
    """The settings that decide a run's result, by dotted key; paths inside the run's own folder begin with `<run>`."""
    plain: Any = OmegaConf.to_container(settings) if isinstance(settings, DictConfig) else asdict(settings)
    moved = _moved(plain, str(plain.get("run")), "<run>")
    circumstances = tuple(f"{key}." for key in CIRCUMSTANCES)
    return {key: value for key, value in dotted(moved) if not f"{key}.".startswith(circumstances)}


def _moved(value: Any, folder: str, to: str) -> Any:
    """A setting, or nested ones, whose paths in a folder lie in another one instead."""
    return mapped(value, lambda text: to + text.removeprefix(folder) if f"{text}/".startswith(f"{folder}/") else text)


def given_command(overrides: Sequence[str]) -> str:
    """Return the command line of a training run without the run's folder.

    Args:
        overrides: The overrides of the run.
    """
    words = [text for text in overrides if not text.startswith(("run=", "train.resume="))]
    return shlex.join([*program("train"), *words])


def resumed(config: DictConfig, overrides: Sequence[str]) -> tuple[DictConfig, str]:
    """The configuration of the run in the folder `config.run`, under a command's overrides, whose values `config` has;
    and the command that began it. InputError where the folder holds no training run."""
    folder = Path(config.run).absolute()
    saved: Any = OmegaConf.to_container(read_config(folder / CONFIG)) if (folder / CONFIG).is_file() else {}
    if not isinstance(saved.get("train"), dict) or not isinstance(saved.get("run"), str):
        raise InputError(f"run={config.run} holds no run to resume: give the folder of one, or leave train.resume out")
    settings = {item.name: saved[item.name] for item in fields(ExperimentSettings) if item.name in saved}
    if Path(saved["run"]) not in folder.parents:  # of an arm, whose settings name the folder of the whole run
        settings = _moved(settings, saved["run"], str(folder))
    merged = OmegaConf.create(settings)
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        if (key := override.key_or_group) != "run":
            OmegaConf.update(merged, key, OmegaConf.select(config, key), merge=False, force_add=True)
    added = [text for text in overrides if not text.startswith(("run=", "train.resume="))]
    return merged, shlex.join(dict.fromkeys([*shlex.split(str(saved.get("command", ""))), *added]))


def require_same_run(folder: Path, settings: ExperimentSettings, finished: bool = False) -> DictConfig:
    """`require_same` of a training run; one that is not finished may get more epochs and another evaluation."""

    def permitted(key: str, old: Any, new: Any) -> bool:
        longer = key == "train.epochs" and isinstance(old, int) and new > old
        return not finished and (longer or key.startswith("evaluate."))

    return require_same(folder, settings, "run= (sweep=)", permitted)


def require_same(folder: Path, settings: Any, elsewhere: str, permitted: Callable[[str, Any, Any], bool]) -> DictConfig:
    """The configuration that a command wrote into the folder; InputError where its decisive settings or input files
    are others. elsewhere: the keys that name the folder. permitted: whether a key, by its old and new value, may be."""
    config, elsewhere = read_config(folder / CONFIG), f"another folder with {elsewhere}"
    before = decisive_settings(OmegaConf.structured(type(settings))) | decisive_settings(config)
    asked = decisive_settings(settings)
    for key in sorted(before.keys() | asked.keys()):
        old, new = before.get(key), asked.get(key)
        if old != new and not permitted(key, old, new):
            raise InputError(f"{folder} was made with {key}={old}, not {new}: give its setting, or {elsewhere}")
    hashes = config.get("inputs") or {}
    for path, fingerprint in fingerprints(settings).items():
        if hashes.get(path, fingerprint) != fingerprint:
            raise InputError(f"{path} has changed since {folder} began: put it back, or start in {elsewhere}")
    return config


def fingerprints(settings: Any) -> dict[str, str]:
    """SHA-256 by path: of files that INPUTS name, of a run's network, and of the names and sizes in other folders."""
    by_key = dict(dotted(asdict(settings)))
    paths = _texts([by_key.get(key) for key in INPUTS])
    paths = {path.removeprefix("run:") for path in paths}
    return {path: _fingerprint(Path(path)) for path in sorted(paths) if os.path.exists(path)}


def _texts(value: Any) -> set[str]:
    """The texts in a setting that may be paths; of a mapping, its mesh and those of its props."""
    if isinstance(value, dict):
        value = [value.get("mesh"), value.get("props")]
    if isinstance(value, list):
        return set().union(*map(_texts, value))
    return {value} if isinstance(value, str) else set()


def _fingerprint(path: Path) -> str:
    path = selected_file(path) or path
    if path.is_dir():
        files = [file for file in path.rglob("*") if file.is_file()]
        sizes = sorted((str(file.relative_to(path)), file.stat().st_size) for file in files)
        return hashlib.sha256(repr(sizes).encode(errors="surrogateescape")).hexdigest()
    return _content_hash(path, path.stat().st_size, path.stat().st_mtime_ns)


@cache
def _content_hash(path: Path, size: int, modified: int) -> str:
    with open(path, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def remove_run(folder: Path) -> None:
    """Remove the results of a run that would stand among those of the next one in its folder.

    The scores on photographs, the log and the report have the same names in both, and are replaced in any case.
    """
    for name in (LAST, PREVIOUS, BEST, METRICS, FAILURE):
        (folder / name).unlink(missing_ok=True)
    for events in folder.glob("events.out.tfevents.*"):
        events.unlink()
    for name in (RENDERS, BEFORE):
        shutil.rmtree(folder / name, ignore_errors=True)


class RunLog:
    """Writes a run folder's metrics.jsonl, TensorBoard events, renders and attack examples; OSError on a full disk.

    history: the lines of the epochs before, in place of those of the files, since a resumed run repeats some.
    """

    def __init__(self, folder: Path, history: Sequence[Mapping[str, float]] = ()):
        from torch.utils.tensorboard import SummaryWriter  # half a second, which readers of metrics are spared

        self._metrics, self._renders, self._epochs = folder / METRICS, folder / RENDERS, len(history)
        write_whole(self._metrics, "".join(json.dumps(line) + "\n" for line in history))
        remove_unfinished(self._renders)
        self._board = SummaryWriter(str(folder), purge_step=self._epochs + 1)

    def scalars(self, values: Mapping[str, float], epoch: int | None = None) -> None:
        """Log plain numbers; `group/name` keys become TensorBoard's groups.

        epoch: None for the final scores, which end the log, in TensorBoard one step after the last epoch.
        """
        line = values if epoch is None else {"epoch": epoch, **values}
        with open(self._metrics, "a") as file:
            file.write(json.dumps(line) + "\n")
        self._epochs = self._epochs if epoch is None else epoch
        for name, value in values.items():
            self._board.add_scalar(name, value, epoch or self._epochs + 1)
        self._board.close() if epoch is None else self._board.flush()

    def renders(self, images: Tensor, epoch: int) -> None:
        """The epoch's renders (E, 3, H, W) in [0, 1] as a grid in TensorBoard and in renders/."""
        from torchvision.utils import make_grid

        grid = make_grid(to_bytes(images.cpu()), nrow=20, padding=1, pad_value=255)
        self._renders.mkdir(exist_ok=True)
        path = self._renders / f"epoch_{epoch:03d}.png"
        write_image(path, Image.fromarray(grid.permute(1, 2, 0).numpy()), compress_level=1)
        self._board.add_image("renders", grid, epoch)

    def attack_examples(self, attack_examples: AttackExamples, classes: Sequence[str], epoch: int) -> None:
        """A few successful attacks of the epoch in renders/: a row each, with the prediction before and after, over
        the right class, and a white ball in either light. Images larger than EXAMPLE are reduced to it."""
        columns, labels = {}, [classes[index] if index >= 0 else "other things" for index in attack_examples.labels]
        sides = attack_examples.images, attack_examples.lights, attack_examples.predictions
        for name, images, lights, probabilities in zip(("before", "after"), *sides, strict=True):
            best = zip(*(values.tolist() for values in probabilities.max(1)), labels, strict=True)
            captions = [(f"{value:.0%} {classes[index]}", label) for value, index, label in best]
            reduced = interpolate(images, min(EXAMPLE, images.shape[-1]), mode="area")
            columns[name] = tiles_of(reduced, captions, EXAMPLE)
            spheres = (light_sphere(light, EXAMPLE // 2, basis=attack_examples.basis) for light in lights)
            columns[f"light {name}"] = tiles_of(spheres)
        self._renders.mkdir(exist_ok=True)
        grid = draw_grid([*zip(*columns.values(), strict=True)], [*columns])
        write_image(self._renders / f"attacks_{epoch:03d}.png", grid)
