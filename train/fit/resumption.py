"""Going on with a run from its folder's newest whole checkpoint, which is held against what the run expects."""

from collections.abc import Mapping
from typing import Any

from renderer.errors import InputError, in_one_line
from train.device import PRECISIONS
from train.fit.trainer import Trainer
from train.run_folder.checkpoint import LAST, load_newest
from train.run_folder.logs import console


def resume(trainer: Trainer) -> None:
    """Restore what the trainer's folder holds; InputError where that is from another architecture, or no run's."""
    folder = trainer.folder
    state, problem = load_newest(folder)
    if missing := trainer.state_dict().keys() - state.keys():
        raise InputError(
            f"the checkpoint in {folder} has a network and no run to go on with ({min(missing)} is missing): "
            f"restore {LAST}, or start in another folder with run="
        )
    stored = state["architecture"]
    if any(stored.get(key, own) != own for key, own in trainer.architecture.items() if key != "version"):
        raise InputError(
            f"the checkpoint in {folder} is from another architecture or other classes: resume with the settings of "
            f"{folder / 'config.yaml'}, or start in another folder with run="
        )
    if problem:
        console.warning("%s: going on from the one before", problem)
        (folder / LAST).unlink(missing_ok=True)  # or the next one would take the place of the whole
    try:
        _require_whole(state)
        trainer.load_state_dict(state)
    except InputError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise InputError(
            f"the checkpoint in {folder} holds what no run wrote ({in_one_line(error)}): restore {LAST}, or "
            "start in another folder with run="
        ) from error


def _require_whole(state: Mapping[str, Any]) -> None:
    """ValueError for a state, with a right hash, in which a run cannot have been."""
    epoch, history = state["epoch"], state["history"]
    if not isinstance(epoch, int) or not isinstance(history, list) or len(history) != epoch:
        raise ValueError(f"after epoch {epoch!r} it has other than as many lines of history")
    if state["precision"] not in PRECISIONS:
        raise ValueError(f"precision {state['precision']!r}")
    if not isinstance(state["random_state"], Mapping):
        raise ValueError("no random state")
