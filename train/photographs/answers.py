"""Ask a model about images: its probabilities, and where it ranks the classes that matter."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass

import torch

from augment.labels import log_odds
from augment.model_state import eval_mode
from augment.progress import progress
from renderer.errors import InputError
from renderer.image import to_unit
from train.photographs.folder import Photograph


@dataclass(frozen=True)
class Answer:
    """What the model says of one photograph.

    Ranks count from 1, the model's prediction. The figures of the true class are None for a class that
    the model lacks. `asked` is the class that the evaluation is about; its log-odds against all others are the score
    by which photographs are ranked.
    """

    photograph: Photograph
    prediction: str
    probability: float
    true_probability: float | None
    true_rank: int | None
    asked_probability: float
    asked_rank: int
    asked_log_odds: float | None


def ask(
    model: Callable[[torch.Tensor], torch.Tensor],
    images: torch.Tensor,
    classes: int,
    batch_size: int,
    device: str | torch.device,
) -> torch.Tensor:
    """The model's logits, (N, classes) float32 on the CPU, for images (N, 3, H, W) uint8 sRGB.

    A module is asked in eval mode and left as it was found. Raises InputError for logits of another shape or not
    finite.
    """
    with eval_mode(model) if isinstance(model, torch.nn.Module) else nullcontext(), torch.inference_mode():
        batches = [model(to_unit(batch.to(device))) for batch in progress(images.split(batch_size), "answers")]
        logits = torch.cat(batches).float().cpu()
    if logits.shape != (len(images), classes):
        raise InputError(
            f"the model answers in shape {tuple(logits.shape)}, not {(len(images), classes)}: "
            "evaluate a checkpoint that was trained on these classes"
        )
    if not logits.isfinite().all():
        raise InputError("the model's logits are not finite: evaluate a checkpoint of a run that did not diverge")
    return logits


def rank_classes(
    photographs: Sequence[Photograph], logits: torch.Tensor, classes: Sequence[str], label: str
) -> list[Answer]:
    """What the logits, (N, C) in the order of `classes`, say of each photograph; `label` is the asked class."""
    probabilities = logits.double().softmax(dim=1).numpy()
    # Ranks come from the logits, whose order survives where probabilities round to 0; ties go to the first.
    order = logits.argsort(dim=1, descending=True, stable=True)
    ranks = (order.argsort(dim=1) + 1).numpy()
    index = {name: column for column, name in enumerate(classes)}
    asked = index[label]
    odds = log_odds(logits.double(), asked)
    answers = []
    for row, photograph in enumerate(photographs):
        true, best = index.get(photograph.label), int(order[row, 0])
        answers.append(
            Answer(
                photograph,
                prediction=classes[best],
                probability=float(probabilities[row, best]),
                true_probability=None if true is None else float(probabilities[row, true]),
                true_rank=None if true is None else int(ranks[row, true]),
                asked_probability=float(probabilities[row, asked]),
                asked_rank=int(ranks[row, asked]),
                asked_log_odds=float(odds[row]),
            )
        )
    return answers
