"""Predictions of a network for photographs as columns, and the table predictions.csv.

A label is the name of a positive class. A network has one prediction for each pair
of a photograph and a label.
"""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from renderer.errors import ShortRepr, explained
from renderer.io.files import remove_unfinished
from train.data.photo import SEPARATOR, Photograph, split_sources
from train.results.tables import write_csv
from train.run_folder import write_json
from train.settings import label_names

# Files in a folder of scores: predictions, metrics and pictures.
PREDICTIONS = "predictions.csv"
SUMMARY = "summary.json"
CONTACT_SHEET = "contact_sheet.png"
ROC_TABLE = "roc.csv"
ROC_FIGURE = "roc.png"
# Files of an attack: predictions for photographs in the light of a projector, transferred
# adversaries, and the success at each radius.
RELIT = "relit.json"
TRANSFERS = "transfer.jsonl"
SWEEP_TABLE = "sweep.csv"
SWEEP_FIGURE = "sweep.png"
# Columns about the class that a photograph shows. The columns of a positive class begin with its
# name, and no name can make them equal to these.
TRUE_PROBABILITY = "probability_of_true"
TRUE_RANK = "rank_of_true"
# Ends of the names of the columns of a positive class, by the attribute of `Predictions`.
OF_LABEL = {"label_probability": "probability", "label_rank": "rank", "log_odds": "log_odds"}


@dataclass(frozen=True, eq=False, repr=False)
class Predictions(ShortRepr):
    """Columns with a row for each pair of a photograph and a positive class.

    All photographs come for the first positive class, then for the next one. Probabilities are in
    [0, 1]. The class with the highest logit has rank 1.

    Attributes:
        photograph: The photographs.
        label: Names of the positive classes, which are classes of the network.
        predicted: Names of the predicted classes.
        probability: Probabilities of the predicted classes.
        true_probability: Probability of the class that the photograph shows.
            NaN if the network does not have this class.
        true_rank: Rank of the class that the photograph shows. Infinite if the
            network does not have this class.
        label_probability: Probabilities of the positive classes.
        label_rank: Ranks of the positive classes.
        log_odds: Log-odds of the positive class against all other classes,
            which are the scores for ROC curves.
    """

    photograph: np.ndarray
    label: np.ndarray
    predicted: np.ndarray
    probability: np.ndarray
    true_probability: np.ndarray
    true_rank: np.ndarray
    label_probability: np.ndarray
    label_rank: np.ndarray
    log_odds: np.ndarray

    @classmethod
    def of_labels(
        cls, shared: Mapping[str, Any], by_label: Mapping[str, Mapping[str, Any]]
    ) -> "Predictions":
        """Join the columns of each positive class, for which the `shared` columns are repeated."""
        columns = {name: np.tile(as_column(shared[name]), len(by_label)) for name in shared}
        columns["label"] = as_column([*by_label]).repeat(len(shared["photograph"]))
        # Rows of the first class come first, and then those of the next classes.
        for name in OF_LABEL:
            columns[name] = np.concatenate([of_label[name] for of_label in by_label.values()])
        return cls(**columns)

    def __len__(self) -> int:
        return len(self.label)

    def __getitem__(self, rows: Any) -> "Predictions":
        """Choose rows, as an index of NumPy chooses items."""
        return Predictions(*(getattr(self, item.name)[rows] for item in fields(self)))

    @cached_property
    def shown(self) -> np.ndarray:
        """Names of the classes that the photographs show."""
        return as_column([item.label for item in self.photograph])

    @cached_property
    def source(self) -> np.ndarray:
        """Sources of the photographs. None for an unknown one."""
        return as_column([item.source for item in self.photograph])

    @cached_property
    def positive(self) -> np.ndarray:
        """Whether each photograph shows the positive class."""
        return self.shown == self.label

    @property
    def labels(self) -> list[str]:
        """Names of the positive classes, each once."""
        return [*dict.fromkeys(self.label)]

    @property
    def by_label(self) -> dict[str, "Predictions"]:
        """The rows of each positive class."""
        return {label: self[self.label == label] for label in self.labels}


def as_column(values: Sequence[object]) -> np.ndarray:
    """Make an array of numbers, or else of objects."""
    is_number = all(isinstance(value, int | float | np.number) for value in values)
    return np.array(values, None if is_number else object)


def write_predictions(path: Path, predictions: Predictions) -> None:
    """Write predictions to the table predictions.csv, which has a row for each photograph.

    For each positive class, such as orange, there are the columns orange_probability, orange_rank
    and orange_log_odds. The cell of a value that is unknown is empty.
    """
    by_label = predictions.by_label
    # All labels have the same photographs and the same predicted classes.
    first = next(iter(by_label.values()))
    photographs = first.photograph
    columns: dict[str, Iterable[object]] = {
        "path": [item.path for item in photographs],
        "label": first.shown,
        "source": first.source,
        "hard_negatives": [SEPARATOR.join(item.hard_negatives) for item in photographs],
        "mesh": [item.mesh for item in photographs],
        "predicted": first.predicted,
        "probability": first.probability.tolist(),
        TRUE_PROBABILITY: ["" if np.isnan(p) else p for p in first.true_probability.tolist()],
        TRUE_RANK: ["" if np.isinf(rank) else int(rank) for rank in first.true_rank.tolist()],
    }
    for label, rows in by_label.items():
        for name, end in OF_LABEL.items():
            columns[f"{label}_{end}"] = getattr(rows, name).tolist()
    write_csv(path, [columns, *zip(*columns.values(), strict=True)])


def begin_scores(out: Path) -> None:
    """Make a folder ready for scores. Without a summary, no folder counts as scored."""
    out.mkdir(parents=True, exist_ok=True)
    remove_unfinished(out)
    (out / SUMMARY).unlink(missing_ok=True)


def write_summary(out: Path, summary: Mapping[str, Any]) -> None:
    """Write summary.json, the last file of a folder of scores. Its values may be dataclasses."""
    write_json(out / SUMMARY, summary, indent=2, ensure_ascii=False, allow_nan=False)


def read_predictions(path: Path, label: str | Sequence[str]) -> Predictions:
    """Read the table predictions.csv, which `write_predictions` wrote."""
    fault = f"{path} is no table of predictions for label={label}"
    with explained(fault, "score the photographs again with pnb-evaluate"):
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        photographs = []
        for row in rows:
            about = row["source"] or None, split_sources(row["hard_negatives"]), row["mesh"] or None
            photographs.append(Photograph(PurePosixPath(row["path"]), row["label"], *about))

        # An empty cell is the value `unknown`. Without one, it raises ValueError.
        def numbers(name: str, unknown: str = "") -> list[float]:
            return [float(row[name] or unknown) for row in rows]

        shared = {
            "photograph": photographs,
            "predicted": [row["predicted"] for row in rows],
            "probability": numbers("probability"),
            "true_probability": numbers(TRUE_PROBABILITY, "nan"),
            "true_rank": numbers(TRUE_RANK, "inf"),
        }
        by_label = {
            one: {name: numbers(f"{one}_{end}") for name, end in OF_LABEL.items()}
            for one in label_names(label)
        }
        return Predictions.of_labels(shared, by_label)
