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

# Files that each command writes to its output folder, as patterns of `Path.glob`.
# A command refuses a folder with one of these files.
OF_AUDIT = ("*/recognized.json", f"*/*/{RELIT}")
OF_RUN = (checkpoint.LAST, checkpoint.PREVIOUS, checkpoint.BEST, METRICS, WEIGHTS)
OF_ATTACK = (RELIT, f"*/{LINES}", LINES, adversary.DESCRIPTION, "sweep.csv", "sweep.png")
OF_SCORES = (SUMMARY, PREDICTIONS, CONTACT_SHEET, ROC_TABLE, ROC_FIGURE)
OF_LABORATORY = (photographs.DESCRIPTION, photographs.TABLE)
OF_FIT = ("light.json", "background.png", "comparison.png")
# Files that most commands write: the configuration and the report.
SHARED = (CONFIG, PAGE)
# All of these files.
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
    """Check that a command would not replace results of an earlier command.

    Args:
        path: File or folder that the command will write. It may be missing.
        key: Setting that has the path, for the error message.
        overwrite: Whether the user allows the command to replace results.
        own: Patterns in RESULTS of files that may be there, because the command
            continues with them.

    Raises:
        InputError: If the file exists, or if the folder holds results, and
            `overwrite` is False.
    """
    if overwrite or not path.exists():
        return
    if not path.is_dir():
        raise InputError(
            f"{key}={path} exists: choose another file, or set overwrite=true to replace it",
        )
    for pattern in RESULTS:
        if pattern in own:
            continue
        # The first file that matches the pattern.
        found = next(path.glob(pattern), None)
        if found:
            name = found.relative_to(path)
            raise InputError(
                f"{key}={path} holds results of an earlier command ({name}): "
                "choose another folder, or set overwrite=true to write over them",
            )


def require_new_run(folder: Path, key: str, overwrite: bool, resume: bool) -> None:
    """Check that a training run would not replace results of an earlier command.

    A folder with a checkpoint is accepted here, because the class `Run` checks
    such a folder. The files of a run that ended before its first checkpoint may
    be replaced, because they are not results.

    Args:
        folder: Folder of the run. It may be missing.
        key: Setting that has the folder, for the error message.
        overwrite: Whether the user allows the command to replace results.
        resume: Whether the run continues an earlier run in the folder.

    Raises:
        InputError: If the folder holds other results, and `overwrite` is False.
    """
    if checkpoint.exists(folder):
        return
    # Names of the files that an unfinished run without a checkpoint has written.
    own: tuple[str, ...] = ()
    if _is_of_training(folder) and not is_finished(folder):
        own = (CONFIG, METRICS)
        if resume:
            own += (checkpoint.BEST,)
    require_replaceable(folder, key, overwrite, own)


def _is_of_training(folder: Path) -> bool:
    """Return whether the config.yaml in a folder is the configuration of a training run."""
    with suppress(InputError):
        return isinstance(read_config(folder / CONFIG).get("train"), Mapping)
    return False
