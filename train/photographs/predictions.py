"""A model's predictions for photographs, and the table predictions.csv."""

import csv
import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch

from augment.losses import log_odds
from augment.utils import eval_mode, progress
from renderer.errors import InputError, in_one_line
from renderer.image import to_unit
from train.photographs.folder import SEPARATOR, Photograph, split_sources

PREDICTIONS = "predictions.csv"
FORMULA = re.compile(r"'*[=+\-@\t\r]")  # the start of a text that a spreadsheet takes for a formula, or of one escaped


@dataclass(frozen=True)
class Prediction:
    """The model's prediction for one photograph; ranks count from 1, the predicted class.

    true_*: of the photograph's own class, None if the model lacks it. label_*, log_odds: of the class under study, the
    last against all other classes, by which photographs are ranked.
    """

    photograph: Photograph
    predicted: str
    probability: float
    true_probability: float | None
    true_rank: int | None
    label_probability: float
    label_rank: int
    log_odds: float


def compute_logits(
    model: Callable[[torch.Tensor], torch.Tensor],
    images: torch.Tensor,
    classes: int,
    batch_size: int,
    device: str | torch.device,
) -> torch.Tensor:
    """The model's logits, (N, classes) float32 on the CPU, for images (N, 3, H, W) uint8 sRGB.

    A module is called in eval mode and left in its own. InputError: logits of another shape, NaN or infinite.
    """
    with eval_mode(model) if isinstance(model, torch.nn.Module) else nullcontext(), torch.inference_mode():
        batches = [model(to_unit(batch.to(device))) for batch in progress(images.split(batch_size), "predictions")]
        logits = torch.cat(batches).float().cpu()
    if logits.shape != (len(images), classes):
        raise InputError(
            f"the model returned logits of shape {tuple(logits.shape)}, not {(len(images), classes)}: "
            "evaluate a checkpoint that was trained on these classes"
        )
    if not logits.isfinite().all():
        raise InputError("the model returned NaN or infinite logits: evaluate a checkpoint of a run that converged")
    return logits


def predict(
    photographs: Sequence[Photograph], logits: torch.Tensor, classes: Sequence[str], label: str
) -> list[Prediction]:
    """Predictions from logits (N, C) in the order of `classes`; label: the class under study."""
    probabilities = logits.double().softmax(dim=1).numpy()
    # Ranks come from the logits, whose order survives where probabilities round to 0; ties go to the first.
    order = logits.argsort(dim=1, descending=True, stable=True)
    ranks = (order.argsort(dim=1) + 1).numpy()
    index = {name: column for column, name in enumerate(classes)}
    odds = log_odds(logits.double(), index[label])
    predictions = []
    for row, photograph in enumerate(photographs):
        true, best = index.get(photograph.label), int(order[row, 0])
        prediction = Prediction(
            photograph,
            predicted=classes[best],
            probability=float(probabilities[row, best]),
            true_probability=None if true is None else float(probabilities[row, true]),
            true_rank=None if true is None else int(ranks[row, true]),
            label_probability=float(probabilities[row, index[label]]),
            label_rank=int(ranks[row, index[label]]),
            log_odds=float(odds[row]),
        )
        predictions.append(prediction)
    return predictions


def outcomes(predictions: Sequence[Prediction], label: str) -> tuple[list[Prediction], ...]:
    """True positives, false negatives and false positives of `label`, each by falling probability."""
    ordered = sorted(predictions, key=lambda prediction: -prediction.probability)
    return (
        [item for item in ordered if item.photograph.label == label == item.predicted],
        [item for item in ordered if item.photograph.label == label != item.predicted],
        [item for item in ordered if item.photograph.label != label == item.predicted],
    )


# ------------------------------------------------------------------------------------- predictions.csv


def write_predictions(path: Path, predictions: Sequence[Prediction], label: str) -> None:
    """Write a row per photograph; None becomes an empty cell."""
    header = ["path", "label", "source", "hard_negatives", "predicted", "probability", "true_probability", "true_rank"]
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(map(escaped, [*header, *_label_columns(label)]))
        for prediction in predictions:
            photograph, *cells = vars(prediction).values()
            names = photograph.path, photograph.label, photograph.source, SEPARATOR.join(photograph.hard_negatives)
            writer.writerow(map(escaped, [*names, *cells]))


def read_predictions(path: Path, label: str) -> list[Prediction]:
    """The predictions that `write_predictions` wrote; InputError for another file, or one about another class."""
    try:
        if not path.is_file():  # opening a pipe would block
            raise ValueError("there is no such file")
        with path.open(newline="", encoding="utf-8") as file:
            return list(_read_rows(csv.reader(file), label))
    except (OSError, LookupError, ValueError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path} cannot be used ({in_one_line(error)}): score the photographs again, with label={label}"
        ) from error


def _read_rows(lines: Iterator[list[str]], label: str) -> Iterator[Prediction]:
    header = next(lines, [])
    for line in lines:
        row = dict(zip(map(unescaped, header), map(unescaped, line), strict=True))
        photograph = Photograph(
            PurePosixPath(row["path"]),
            row["label"],
            row["source"] or None,
            split_sources(row["hard_negatives"]),
        )
        probability, rank, odds = (row[column] for column in _label_columns(label))
        yield Prediction(
            photograph,
            row["predicted"],
            _finite(row["probability"]),
            _finite(row["true_probability"]) if row["true_probability"] else None,
            int(row["true_rank"]) if row["true_rank"] else None,
            _finite(probability),
            int(rank),
            _finite(odds),
        )


def _label_columns(label: str) -> tuple[str, str, str]:
    return f"{label}_probability", f"{label}_rank", f"{label}_log_odds"


def _finite(cell: str) -> float:
    value = float(cell)
    if not math.isfinite(value):
        raise ValueError(f"{cell} is not a finite number")
    return value


def escaped(value: object) -> object:
    """The cell of a table; a text that a spreadsheet would run as a formula gets an apostrophe in front."""
    if value is None or isinstance(value, int | float):
        return value
    return f"'{value}" if FORMULA.match(str(value)) else value


def unescaped(cell: str) -> str:
    """The text that `escaped` got."""
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell) else cell
