"""What the outputs of a network mean: classification, detection or segmentation.

Each task is one module with a subclass of `Task`, and one line of `TASKS`.
"""

from typing import Any

from augment.tasks.classification import Classification
from augment.tasks.detection import Detection
from augment.tasks.segmentation import Segmentation
from augment.tasks.task import Task
from renderer.errors import InputError, describe

# The tasks with their default settings, of which the first that recognizes outputs is chosen.
TASKS: tuple[Task, ...] = (Classification(), Detection(), Segmentation())


def recognized_task(outputs: Any, title: str) -> Task:
    """Return the task of a network by the type of its outputs."""
    for task in TASKS:
        if task.recognizes(outputs):
            return task
    known = "; ".join(f"{task.name}: {task.returns}" for task in TASKS)
    raise InputError(f"{title} returned {describe(outputs)}, which is of no task: return {known}")
