"""Protect the results of earlier commands. Only `overwrite=true` lets a command replace them."""

from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path

from augment.attacks import adversary
from augment.attacks.attack_files import LINES
from renderer.errors import InputError
from train.data import photographs
from train.evaluation.relit import RELIT
from train.evaluation.scores.predictions import PREDICTIONS
from train.evaluation.scores.scoring import CONTACT_SHEET, SUMMARY
from train.evaluation.scores.sheet import ROC_FIGURE, ROC_TABLE
from train.report.report_page import PAGE
from train.report.summary import is_finished
from train.runs import checkpoint
from train.runs.run_config import CONFIG, read_config
from train.runs.run_log import METRICS
from train.runs.saved_networks import PUBLISHED, WEIGHTS

# Files that each command writes to a folder, as patterns of `Path.glob`.
# `require_replaceable` looks for all of them, and names the first that it finds.
OF_AUDIT = ("*/recognized.json", f"*/*/{RELIT}")
OF_RUN = (checkpoint.LAST, checkpoint.PREVIOUS, checkpoint.BEST, METRICS, WEIGHTS)
OF_ATTACK = (RELIT, f"*/{LINES}", LINES, adversary.DESCRIPTION, "sweep.csv", "sweep.png")
OF_SCORES = (SUMMARY, PREDICTIONS, CONTACT_SHEET, ROC_TABLE, ROC_FIGURE)
OF_LABORATORY = (photographs.DESCRIPTION, photographs.TABLE)
OF_FIT = ("light.json", "background.png", "comparison.png")
# Files that several commands write.
SHARED = (CONFIG, PAGE)
RESULTS = (
    *OF_RUN,
    *OF_ATTACK,
    *OF_AUDIT,
    *OF_SCORES,
    *OF_LABORATORY,
    PUBLISHED,
    *OF_FIT,
    *SHARED,
)


def require_replaceable(path: Path, key: str, overwrite: bool, own: Collection[str] = ()) -> None:
    """Check that a command would not replace earlier results.

    Args:
        path: File or folder that the command will write. It may be missing.
        key: Setting that names it, for the error message.
        overwrite: Whether the user allows the command to replace results.
        own: Patterns in RESULTS that the check ignores, because the command
            continues with the files of these patterns.

    Raises:
        InputError: If `overwrite` is false, and the file exists or the folder
            holds results of a command.
    """
    if overwrite or not path.exists():
        return
    if not path.is_dir():
        raise InputError(
            f"{key}={path} exists: choose another file, or set overwrite=true to replace it",
        )
    for pattern in RESULTS:
        found = None if pattern in own else next(path.glob(pattern), None)
        if found:
            name = found.relative_to(path)
            raise InputError(
                f"{key}={path} holds results of an earlier command ({name}): "
                "choose another folder, or set overwrite=true to write over them",
            )


def require_new_run(folder: Path, key: str, overwrite: bool, resume: bool) -> None:
    """Check that a training run would not replace earlier results.

    A folder with a checkpoint passes, because the run itself checks it. A run
    that ended before its first checkpoint has no results. The same command
    starts it again.

    Args:
        folder: Folder of the run. It may be missing.
        key: Setting that names it, for the error message.
        overwrite: Whether the user allows the command to replace results.
        resume: Whether the run continues an earlier one.

    Raises:
        InputError: See `require_replaceable`.
    """
    if checkpoint.exists(folder):
        return
    # Files of a run that ended before its first checkpoint.
    own: tuple[str, ...] = ()
    if _is_of_training(folder) and not is_finished(folder):
        own = (CONFIG, METRICS)
        if resume:
            own += (checkpoint.BEST,)
    require_replaceable(folder, key, overwrite, own)


def _is_of_training(folder: Path) -> bool:
    """Return whether pnb-train wrote the configuration in a folder."""
    with suppress(InputError):
        return isinstance(read_config(folder / CONFIG).get("train"), Mapping)
    return False
