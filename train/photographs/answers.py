"""Ask a model about images: its probabilities, and where it ranks the classes that matter; photographs.csv of them."""

import csv
import math
import re
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import astuple, dataclass
from pathlib import Path, PurePath, PurePosixPath

import torch

from augment.labels import log_odds
from augment.utils import eval_mode, progress
from renderer.errors import InputError
from renderer.image import to_unit
from train.photographs.folder import SEPARATOR, Photograph, split_sources

ANSWERS = "photographs.csv"
FORMULA = re.compile(r"'*[=+\-@\t\r]")  # how a name begins that is taken for one, or that has been made text


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


def outcomes(answers: Sequence[Answer], label: str) -> tuple[list[Answer], list[Answer], list[Answer]]:
    """Hits, misses and false alarms of `label`, each from the surest to the least sure."""
    ordered = sorted(answers, key=lambda answer: -answer.probability)
    mine = [answer for answer in ordered if answer.photograph.label == label]
    return (
        [answer for answer in mine if answer.prediction == label],
        [answer for answer in mine if answer.prediction != label],
        [answer for answer in ordered if answer.photograph.label != label and answer.prediction == label],
    )


def write_answers(path: Path, answers: Sequence[Answer], label: str) -> None:
    """Write the answers about the class `label`; what is None is left empty."""
    header = ["path", "label", "source", "look_alikes", "prediction", "probability", "true_probability", "true_rank"]
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(map(as_cell, [*header, f"{label}_probability", f"{label}_rank", f"{label}_log_odds"]))
        for answer in answers:
            (*photograph, look_alikes), *said = astuple(answer)
            writer.writerow(map(as_cell, [*photograph, SEPARATOR.join(look_alikes), *said]))


def read_answers(path: Path, label: str) -> list[Answer]:
    """What `write_answers` wrote; log-odds are None where an older version wrote it.

    InputError for a file that is no such table, or tells of another class.
    """
    try:
        if not path.is_file():  # a pipe would be waited for
            raise ValueError("there is no such file")
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = ([as_written(cell) for cell in row] for row in csv.reader(file))
            return [_read_row(dict(zip(header, row, strict=True)), label) for row in rows if row]
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise InputError(f"{path} cannot be used: score the photographs again, with label={label}") from error


def _read_row(row: dict[str, str], label: str) -> Answer:
    path, source, rivals = PurePosixPath(row["path"]), row["source"] or None, row.get("look_alikes", "")
    return Answer(
        Photograph(path, row["label"], source, split_sources(rivals)),
        prediction=row["prediction"],
        probability=_number(row["probability"]),
        true_probability=_number(row["true_probability"]) if row["true_probability"] else None,
        true_rank=int(row["true_rank"]) if row["true_rank"] else None,
        asked_probability=_number(row[f"{label}_probability"]),
        asked_rank=int(row[f"{label}_rank"]),
        asked_log_odds=_number(row[f"{label}_log_odds"]) if row.get(f"{label}_log_odds") else None,
    )


def _number(cell: str) -> float:
    value = float(cell)
    if not math.isfinite(value):
        raise ValueError(f"{cell} is no finite number")
    return value


def as_cell(value: object) -> object:
    """A name that a spreadsheet would take for a formula begins with an apostrophe: it is text then. Else as it is."""
    is_formula = isinstance(value, str | PurePath) and FORMULA.match(str(value))
    return f"'{value}" if is_formula else value


def as_written(cell: str) -> str:
    """What `as_cell` was given, as text."""
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell) else cell
