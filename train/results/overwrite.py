"""Protect or remove results of earlier commands. Only `overwrite=true` lets a command do so."""

from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path

from augment.attack_settings import LINES
from renderer.errors import InputError
from renderer.io.files import remove
from train import run_folder
from train.data import photo
from train.results import predictions
from train.results.page import PAGE
from train.results.predictions import RELIT, SUMMARY, SWEEP_FIGURE, SWEEP_TABLE, TRANSFERS
from train.results.store import is_finished
from train.run_config import CONFIG, read_config
from train.run_folder import BEFORE, METRICS, ORIGINAL, writable_folder
from train.settings import KEPT_ASIDE, PHOTOGRAPHS_FIRST

# Files of an audit, as patterns of `Path.glob`.
OF_AUDIT = ("*/recognized.json", f"*/*/{RELIT}")
# Files of a training run. `remove_run` removes them in this order.
OF_RUN = (METRICS, run_folder.LAST, run_folder.PREVIOUS, run_folder.BEST, run_folder.WEIGHTS)
# Files that commands write to their output folders. A command refuses a folder with one of them.
RESULTS = (
    *OF_RUN,
    *OF_AUDIT,
    *(RELIT, f"*/{LINES}", LINES, "adversary.json", SWEEP_TABLE, SWEEP_FIGURE),
    *(SUMMARY, predictions.PREDICTIONS, predictions.CONTACT_SHEET),
    *(predictions.ROC_TABLE, predictions.ROC_FIGURE),
    *("light.json", "background.png", "comparison.png"),
    *(photo.DESCRIPTION, photo.TABLE, run_folder.PUBLISHED, CONFIG, PAGE),
)


def require_replaceable(path: Path, key: str, overwrite: bool, own: Collection[str] = ()) -> None:
    """Check that a command would not replace results of an earlier command.

    `own` has patterns in RESULTS of files that may be there, because the command continues with
    them.
    """
    if overwrite or not path.exists():
        return
    if not path.is_dir():
        raise InputError(f"{key}={path} exists: choose another file, or set overwrite=true")
    for pattern in (one for one in RESULTS if one not in own):
        for found in path.glob(pattern):
            fault = f"{key}={path} holds results of an earlier command ({found.relative_to(path)})"
            raise InputError(f"{fault}: choose another folder, or set overwrite=true")


def output_folder(folder: str | Path, overwrite: bool, own: Collection[str] = ()) -> Path:
    """Check that a command can write to a folder, and would not replace results of another one."""
    path = writable_folder(folder, "out")
    require_replaceable(path, "out", overwrite, own)
    return path


def require_new_run(folder: Path, key: str, overwrite: bool, resume: bool) -> None:
    """Check that a training run would not replace results of an earlier command.

    A folder with a checkpoint is accepted here, because the class `Run` checks
    such a folder. The files of a run that ended before its first checkpoint may
    be replaced, because they are not results.
    """
    if any((folder / name).exists() for name in (run_folder.LAST, run_folder.PREVIOUS)):
        return
    # Names of the files that an unfinished run without a checkpoint has written.
    own: tuple[str, ...] = ()
    with suppress(InputError):
        is_of_training = isinstance(read_config(folder / CONFIG).get("train"), Mapping)
        if is_of_training and not is_finished(folder):
            own = (CONFIG, METRICS, run_folder.BEST) if resume else (CONFIG, METRICS)
    require_replaceable(folder, key, overwrite, own)


def remove_run(folder: Path, *, with_others: bool = True) -> None:
    """Remove the results of a training run, and those of its first training and baselines.

    The metrics go first, without which no run counts as finished, and config.yaml goes last. If the
    removal is stopped, what is left belongs to the run that config.yaml describes. The log stays.
    `with_others=False` keeps the first training and the baselines, which may be resumed.
    """
    names = (*OF_RUN, run_folder.FAILURE, PAGE, run_folder.RENDERS, BEFORE, KEPT_ASIDE)
    logs = [*folder.glob("events.out.tfevents.*"), *folder.glob(f"*/{SUMMARY}")]
    remove(*(folder / name for name in names), *logs)
    with suppress(InputError):  # config.yaml may be missing.
        for name in (PHOTOGRAPHS_FIRST, *read_config(folder / CONFIG).get("compare", ())):
            if with_others and (folder / name / CONFIG).is_file():
                remove_run(folder / name)
                remove(folder / name / ORIGINAL)
    (folder / CONFIG).unlink(missing_ok=True)


def remove_attack(out: Path) -> None:
    """Remove the results of an earlier pnb-attack, so that no report shows them with new ones."""
    remove(*(out / name for name in (PAGE, CONFIG, RELIT, SWEEP_TABLE, SWEEP_FIGURE)))
    for lines in out.glob(f"*/{LINES}"):
        remove(*lines.parent.glob("example_*"), lines.with_name(TRANSFERS), lines)
