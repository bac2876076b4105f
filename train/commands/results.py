"""Results of earlier commands, which no command replaces unless its setting `overwrite` says so."""

from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path

from augment.attacks import adversary
from augment.attacks.attack_files import LINES
from renderer.errors import InputError
from train.data import photographs
from train.evaluation.scores.predictions import PREDICTIONS
from train.evaluation.scores.scoring import CONTACT_SHEET, SUMMARY
from train.evaluation.scores.sheet import ROC_FIGURE, ROC_TABLE
from train.report.report_page import PAGE
from train.report.summary import is_finished
from train.runs import checkpoint
from train.runs.run_config import CONFIG, read_config
from train.runs.run_log import METRICS
from train.runs.saved_networks import PUBLISHED, WEIGHTS

# By command, the files that show its results in a folder: patterns of `Path.glob`, the most telling first.
OF_AUDIT = ("*/recognized.json",)
OF_RUN = (checkpoint.LAST, checkpoint.PREVIOUS, checkpoint.BEST, METRICS, WEIGHTS)
OF_ATTACK = (f"*/{LINES}", LINES, adversary.DESCRIPTION, "sweep.csv", "sweep.png")
OF_SCORES = (SUMMARY, PREDICTIONS, CONTACT_SHEET, ROC_TABLE, ROC_FIGURE)
OF_LABORATORY = (photographs.DESCRIPTION, photographs.TABLE)
OF_FIT = ("light.json", "background.png", "comparison.png")
SHARED = (CONFIG, PAGE)  # of several commands
RESULTS = (*OF_RUN, *OF_ATTACK, *OF_AUDIT, *OF_SCORES, *OF_LABORATORY, PUBLISHED, *OF_FIT, *SHARED)


def require_replaceable(path: Path, key: str, overwrite: bool, own: Collection[str] = ()) -> None:
    """Refuse to write where results lie that would be lost.

    Args:
        path: The file or the folder that a command would write. It may be missing.
        key: The setting that names it.
        overwrite: Whether the user allows that results are replaced.
        own: Patterns among RESULTS that do not count, since the command goes on with these files.

    Raises:
        InputError: The file exists, or the folder holds results of any command, and `overwrite` is false.
    """
    if overwrite or not path.exists():
        return
    if not path.is_dir():
        raise InputError(f"{key}={path} exists: choose another file, or set overwrite=true to replace it")
    for pattern in RESULTS:
        found = None if pattern in own else next(path.glob(pattern), None)
        if found:
            held = f"{key}={path} holds results of an earlier command ({found.relative_to(path)})"
            raise InputError(f"{held}: choose another folder, or set overwrite=true to write over them")


def require_new_run(folder: Path, key: str, overwrite: bool, resume: bool) -> None:
    """Refuse a training in a folder with other results than a checkpoint, which `train.training.run.prepare` looks at.

    A run that ended before its first checkpoint has no results yet, and is started anew by the same command.

    Args:
        folder: The folder of a run. It may be missing.
        key: The setting that names it.
        overwrite: Whether the user allows that results are replaced.
        resume: Whether the run is to go on with what is there.

    Raises:
        InputError: As of `require_replaceable`.
    """
    if checkpoint.exists(folder):
        return
    own: tuple[str, ...] = ()
    if _is_of_training(folder) and not is_finished(folder):
        own = (CONFIG, METRICS, *((checkpoint.BEST,) if resume else ()))
    require_replaceable(folder, key, overwrite, own)


def _is_of_training(folder: Path) -> bool:
    """Say whether the configuration in a folder is one of pnb-train."""
    with suppress(InputError):
        return isinstance(read_config(folder / CONFIG).get("train"), Mapping)
    return False
