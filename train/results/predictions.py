"""Predictions of a model for photographs, and the table predictions.csv.

A label is the name of a positive class. A model has one prediction for each pair
of a photograph and a label.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from renderer.errors import InputError, single_line
from renderer.io.files import atomic_write
from train.data.photo import SEPARATOR, Photograph, split_sources
from train.settings import label_names

# Files in a folder of scores: predictions, metrics and pictures.
PREDICTIONS = "predictions.csv"
SUMMARY = "summary.json"
CONTACT_SHEET = "contact_sheet.png"
ROC_TABLE = "roc.csv"
ROC_FIGURE = "roc.png"
# Columns about the class that a photograph shows. The columns of a positive class begin with its
# name, and no name can make them equal to these.
TRUE_PROBABILITY = "probability_of_true"
TRUE_RANK = "rank_of_true"


@dataclass(frozen=True)
class Prediction:
    """Prediction of a model for a photograph, and its score for one positive class.

    Probabilities are in [0, 1]. The class with the highest logit has rank 1.

    Attributes:
        photograph: The photograph.
        label: Name of the positive class, which is a class of the model.
        predicted: Name of the predicted class.
        probability: Probability of the predicted class.
        true_probability: Probability of the class that the photograph shows.
            None if the model does not have this class.
        true_rank: Rank of the class that the photograph shows. None if the
            model does not have this class.
        label_probability: Probability of the positive class.
        label_rank: Rank of the positive class.
        log_odds: Log-odds of the positive class against all other classes,
            which are the scores for ROC curves.
    """

    photograph: Photograph
    label: str
    predicted: str
    probability: float
    true_probability: float | None
    true_rank: int | None
    label_probability: float
    label_rank: int
    log_odds: float

    @property
    def positive(self) -> bool:
        """Whether the photograph shows the positive class."""
        return self.photograph.label == self.label


def by_label(predictions: Sequence[Prediction]) -> dict[str, list[Prediction]]:
    """Group predictions by their positive class."""
    groups: dict[str, list[Prediction]] = {}
    for prediction in predictions:
        groups.setdefault(prediction.label, []).append(prediction)
    return groups


def write_predictions(path: Path, predictions: Sequence[Prediction]) -> None:
    """Write predictions to the table predictions.csv, which has a row for each photograph.

    The columns path, label, source, hard_negatives, mesh, predicted,
    probability, probability_of_true and rank_of_true do not depend on the
    positive class. For each positive class, such as orange, there are the
    columns orange_probability, orange_rank and orange_log_odds. The cell of a
    value that is None is empty. `predictions` are in the order of `rank_classes`.
    """
    predictions_by_class = by_label(predictions).values()
    rows = [_to_row(predictions) for predictions in zip(*predictions_by_class, strict=True)]
    table = io.StringIO()
    writer = csv.DictWriter(table, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    atomic_write(path, table.getvalue())


def _to_row(predictions: Sequence[Prediction]) -> dict[str, object]:
    """Convert the predictions for one photograph to a row of predictions.csv."""
    photograph = predictions[0].photograph
    row: dict[str, object] = {
        "path": photograph.path,
        "label": photograph.label,
        "source": photograph.source,
        "hard_negatives": SEPARATOR.join(photograph.hard_negatives),
        "mesh": photograph.mesh,
        "predicted": predictions[0].predicted,
        "probability": predictions[0].probability,
        TRUE_PROBABILITY: predictions[0].true_probability,
        TRUE_RANK: predictions[0].true_rank,
    }
    for prediction in predictions:
        label = prediction.label
        row[f"{label}_probability"] = prediction.label_probability
        row[f"{label}_rank"] = prediction.label_rank
        row[f"{label}_log_odds"] = prediction.log_odds
    return row


def read_predictions(path: Path, label: str | Sequence[str]) -> list[Prediction]:
    """Read the table predictions.csv, which `write_predictions` wrote.

    The predictions come in the order of `rank_classes`.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        return [_from_row(row, name) for name in label_names(label) for row in rows]
    except (OSError, LookupError, ValueError, TypeError, AttributeError, csv.Error) as error:
        raise InputError(
            f"{path} is not a table of predictions for label={label} ({single_line(error)}): "
            f"score the photographs again with pnb-evaluate label={label}",
        ) from error


def _from_row(row: Mapping[str, str], label: str) -> Prediction:
    """Convert a row of predictions.csv to the prediction for one positive class."""
    photograph = Photograph(
        path=PurePosixPath(row["path"]),
        label=row["label"],
        source=row["source"] or None,
        hard_negatives=split_sources(row["hard_negatives"]),
        mesh=row["mesh"] or None,
    )
    true_probability = row[TRUE_PROBABILITY]
    true_rank = row[TRUE_RANK]
    return Prediction(
        photograph=photograph,
        label=label,
        predicted=row["predicted"],
        probability=float(row["probability"]),
        true_probability=float(true_probability) if true_probability else None,
        true_rank=int(true_rank) if true_rank else None,
        label_probability=float(row[f"{label}_probability"]),
        label_rank=int(row[f"{label}_rank"]),
        log_odds=float(row[f"{label}_log_odds"]),
    )
