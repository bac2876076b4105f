"""Predictions of a model for photographs, and the table predictions.csv.

A label is the name of a positive class. A model has one prediction for each pair
of a photograph and a label.
"""

import csv
import hashlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import torch

from augment.losses import log_odds
from augment.network import Label, NetworkCall, as_class_names, compute_outputs, eval_mode
from renderer.errors import InputError, require_range, single_line
from renderer.io.files import atomic_write
from renderer.settings import MAX_SIZE
from renderer.short_repr import ShortRepr
from renderer.validation import as_folder, require_kind, require_whole
from train.data.photographs import (
    SEPARATOR,
    Photograph,
    find_photographs,
    load_photographs,
    split_sources,
    unsupported_files,
)
from train.settings import label_names

# Name of the table of predictions in the folder of an evaluation.
PREDICTIONS = "predictions.csv"
# Number of images for which the model computes logits in one call.
BATCH = 256
# Columns about the class that a photograph shows. The columns of a positive class begin with its
# name, and no name can make them equal to these.
TRUE_PROBABILITY = "probability_of_true"
TRUE_RANK = "rank_of_true"
# A PyTorch module, or a function, that maps images to logits.
Model = Callable[[torch.Tensor], torch.Tensor]


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


@dataclass(frozen=True, repr=False)
class FolderPredictions(ShortRepr):
    """Predictions of a model for all photographs of a folder.

    Attributes:
        folder: Folder of the photographs.
        predictions: Predictions of all photographs for the first positive
            class, then for the next one, and so on. Those for one class are in
            the order of `images`.
        images: Pixels of the photographs, uint8 sRGB, shape
            (N, 3, size, size).
        labels: Names of the positive classes.
        unreadable: Paths of the photographs that could not be read.
        left_out: Paths of the files whose type is not supported.
        images_hash: Hash of the labels and the photographs. If it is equal for
            two networks, their metrics can be compared.
    """

    folder: Path
    predictions: list[Prediction]
    images: torch.Tensor
    labels: list[str]
    unreadable: list[str]
    left_out: list[str]
    images_hash: str

    @property
    def size(self) -> int:
        """Pixels per side of the images that the model classified."""
        return self.images.shape[-1]

    @property
    def photographs(self) -> list[Prediction]:
        """One prediction for each photograph: the one for the first positive class."""
        return self.predictions[: len(self.images)]


@dataclass
class Predictor:
    """Model that predicts the classes of photographs.

    Attributes:
        model: Module or function that maps images to logits. The images are
            float32 sRGB in [0, 1], shape (N, 3, size, size). The logits have
            the shape (N, len(classes)). A module is called in eval mode. Its
            mode is restored afterwards.
        classes: Names of the classes of the model.
        size: Pixels per side of the images.
        device: Device of the model.
    """

    model: Model
    classes: Sequence[str]
    size: int = 32
    device: str | torch.device = "cpu"

    def __post_init__(self) -> None:
        kinds = "a torch.nn.Module, or a function from images to logits"
        require_kind("model", self.model, Callable, kinds)
        self.classes = as_class_names("classes", self.classes)
        require_whole("size", self.size)
        require_range("size", self.size, 1, MAX_SIZE)

    def predict(
        self,
        folder: Path,
        label: Label,
        skip_unreadable: bool = False,
    ) -> FolderPredictions:
        """Predict the classes of all photographs of a folder."""
        folder = as_folder("folder", folder)
        labels = label_names(label)
        found = find_photographs(folder, self.classes, label)
        photographs, images, unreadable = load_photographs(
            folder,
            found,
            self.size,
            skip_unreadable,
        )
        logits = compute_logits(self.model, images, len(self.classes), self.device)
        return FolderPredictions(
            folder=folder,
            predictions=rank_classes(photographs, logits, self.classes, labels),
            images=images,
            labels=labels,
            unreadable=unreadable,
            left_out=[str(path) for path in unsupported_files(folder)],
            images_hash=_hash(folder, photographs, labels),
        )


def _hash(folder: Path, photographs: Sequence[Photograph], labels: Sequence[str]) -> str:
    """Hash the positive classes and the photographs with SHA-256."""
    digest = hashlib.sha256("\n".join(labels).encode())
    for photograph in photographs:
        content = (folder / photograph.path).read_bytes()
        digest.update(f"{photograph}{photograph.mesh or ''}".encode() + content)
    return digest.hexdigest()


def compute_logits(
    model: Model,
    images: torch.Tensor,
    classes: int,
    device: str | torch.device,
) -> torch.Tensor:
    """Compute the logits of a model for images.

    A module is called in eval mode. Its mode is restored afterwards. The images are 8-bit sRGB,
    and the model gets them in [0, 1]. The logits are on the CPU, and raise InputError if they are
    not finite.
    """
    if classes < 2:
        raise InputError(
            "the model has a single class, so its log-odds are infinite: "
            "evaluate a model with at least two classes",
        )
    checked = partial(NetworkCall("model"), model)
    with eval_mode(model):
        logits = compute_outputs(checked, images, BATCH, device).cpu()
    expected = (len(images), classes)
    if logits.shape != expected:
        raise InputError(
            f"the model returned logits of shape {tuple(logits.shape)}, not {expected}: "
            "evaluate a checkpoint that was trained on these classes",
        )
    if not logits.isfinite().all():
        raise InputError(
            "the model returned NaN or infinite logits: "
            "evaluate a checkpoint of a run that converged",
        )
    return logits


def rank_classes(
    photographs: Sequence[Photograph],
    logits: torch.Tensor,
    classes: Sequence[str],
    labels: Sequence[str],
) -> list[Prediction]:
    """Convert logits to predicted classes with their probabilities, ranks and log-odds.

    All photographs come for the first positive class, then for the next one.
    """
    logits = logits.double()
    probabilities = logits.softmax(dim=1).tolist()
    # Classes are sorted by logits, because small probabilities may all round to 0.
    # Column k of `class_at_rank` has the index of the class with rank k + 1.
    class_at_rank = logits.argsort(dim=1, descending=True, stable=True)
    # The inverse permutation has the rank of each class, from 1, shape (N, C).
    ranks = (class_at_rank.argsort(dim=1) + 1).tolist()
    predicted = class_at_rank[:, 0].tolist()

    predictions = []
    for label in labels:
        label_index = classes.index(label)
        label_odds = log_odds(logits, label_index).tolist()
        for row, photograph in enumerate(photographs):
            true_probability = None
            true_rank = None
            if photograph.label in classes:
                true_index = classes.index(photograph.label)
                true_probability = probabilities[row][true_index]
                true_rank = ranks[row][true_index]
            prediction = Prediction(
                photograph=photograph,
                label=label,
                predicted=classes[predicted[row]],
                probability=probabilities[row][predicted[row]],
                true_probability=true_probability,
                true_rank=true_rank,
                label_probability=probabilities[row][label_index],
                label_rank=ranks[row][label_index],
                log_odds=label_odds[row],
            )
            predictions.append(prediction)
    return predictions


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


def read_predictions(path: Path, label: Label) -> list[Prediction]:
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
        # Earlier versions of the library did not write the column "mesh".
        mesh=row.get("mesh") or None,
    )
    if TRUE_RANK not in row:
        # Earlier versions of the library wrote columns with these names, which also are the
        # columns of a positive class "true".
        if label == "true":
            raise LookupError("an earlier version mixed up the columns of the class 'true'")
        row = {**row, TRUE_PROBABILITY: row["true_probability"], TRUE_RANK: row["true_rank"]}
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
