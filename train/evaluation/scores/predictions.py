"""A model's predictions for photographs, and the table predictions.csv."""

import csv
import hashlib
import io
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch

from augment.classifiers.adapter import Label, NetworkCall, as_class_names
from augment.losses import log_odds
from augment.model_passes import eval_mode
from augment.progress import progress
from renderer.errors import InputError, in_one_line, require_range
from renderer.image import to_unit
from renderer.io.files import write_whole
from renderer.settings import MAX_SIZE
from renderer.validation import as_folder, require_kind, require_whole
from train.data.photographs import SEPARATOR, Photograph, find_photographs, left_out, load_photographs, split_sources
from train.settings import label_names

PREDICTIONS = "predictions.csv"
BATCH = 256
Model = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Prediction:
    """The model's prediction for one photograph, about one class under study, `label`; ranks count from 1, the
    predicted class.

    true_*: of the photograph's own class, None if the model lacks it. label_*, log_odds: of the class under study, the
    last against all other classes, by which photographs are ranked.
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
        """Whether the photograph shows the class under study."""
        return self.photograph.label == self.label


@dataclass(frozen=True)
class FolderPredictions:
    """Predictions of a model for all photographs of a folder.

    Attributes:
        folder: Folder of the photographs.
        predictions: Predictions about each label, one label after the other.
            Those about one label are in the order of the images.
        images: Photographs, uint8 sRGB, shape (N, 3, size, size).
        labels: Classes under study.
        unreadable: Paths of the photographs that could not be read.
        left_out: Paths of the files of kinds that are not read.
        images_hash: Hash of the labels and the photographs. It is equal where
            the metrics of two networks can be compared.
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
        """Pixels per side of the images that the model was shown."""
        return self.images.shape[-1]

    @property
    def photographs(self) -> list[Prediction]:
        """One prediction for each photograph, which is about the first label."""
        return self.predictions[: len(self.images)]


@dataclass
class Predictor:
    """A model, and what it takes to ask it about photographs.

    Attributes:
        model: Module or function from images (N, 3, size, size), float32 sRGB
            in [0, 1], to logits (N, len(classes)). A module is called in eval
            mode and left in its own.
        classes: Names of the classes of the model.
        size: Pixels per side of the images.
        device: Device of the model.

    Raises:
        InputError: If the model cannot be called, or the classes or the size
            are wrong.
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

    def predict(self, folder: Path, label: Label, skip_unreadable: bool = False) -> FolderPredictions:
        """Predict the classes of all photographs of a folder.

        Args:
            folder: Folder of photographs, as `find_photographs` takes it.
            label: Class under study, or several.
            skip_unreadable: Whether to leave out photographs that cannot be
                read. Otherwise they are an error.

        Returns:
            Predictions about each label, with the photographs.

        Raises:
            InputError: As of `find_photographs`, `load_photographs` and
                `compute_logits`.
        """
        folder = as_folder("folder", folder)
        labels = label_names(label)
        found = find_photographs(folder, self.classes, label)
        photographs, images, unreadable = load_photographs(folder, found, self.size, skip_unreadable)
        logits = compute_logits(self.model, images, len(self.classes), self.device)
        return FolderPredictions(
            folder=folder,
            predictions=predict(photographs, logits, self.classes, labels),
            images=images,
            labels=labels,
            unreadable=unreadable,
            left_out=[str(path) for path in left_out(folder)],
            images_hash=_hash(folder, photographs, labels),
        )


def _hash(folder: Path, photographs: Sequence[Photograph], labels: Sequence[str]) -> str:
    """Hash the labels, and the files of photographs with what is known of them."""
    digest = hashlib.sha256("\n".join(labels).encode())
    for photograph in photographs:
        content = (folder / photograph.path).read_bytes()
        digest.update(f"{photograph}{photograph.mesh or ''}".encode() + content)
    return digest.hexdigest()


def compute_logits(model: Model, images: torch.Tensor, classes: int, device: str | torch.device) -> torch.Tensor:
    """The model's logits, (N, classes) float32 on the CPU, for images (N, 3, H, W) uint8 sRGB.

    A module is called in eval mode and left in its own. InputError: logits of another shape, NaN or infinite, or of one
    class.
    """
    if classes < 2:
        raise InputError("the model has a single class, whose odds are infinite: evaluate one with other classes, too")
    with (
        eval_mode(model) if isinstance(model, torch.nn.Module) else nullcontext(),
        torch.inference_mode(),
    ):
        call = NetworkCall("model")
        batches = [call(model, to_unit(batch.to(device))) for batch in progress(images.split(BATCH), "predictions")]
        logits = torch.cat(batches).float().cpu()
    if logits.shape != (shape := (len(images), classes)):
        advice = "evaluate a checkpoint that was trained on these classes"
        raise InputError(f"the model returned logits of shape {tuple(logits.shape)}, not {shape}: {advice}")
    if not logits.isfinite().all():
        raise InputError("the model returned NaN or infinite logits: evaluate a checkpoint of a run that converged")
    return logits


def predict(
    photographs: Sequence[Photograph],
    logits: torch.Tensor,
    classes: Sequence[str],
    labels: Sequence[str],
) -> list[Prediction]:
    """Predictions from logits (N, C) in the order of `classes`: about the first of `labels` for all photographs, then
    about the next."""
    probabilities = logits.double().softmax(dim=1).tolist()
    # Ranks come from the logits, whose order survives where probabilities round to 0; ties go to the first.
    order = logits.argsort(dim=1, descending=True, stable=True)
    ranks = (order.argsort(dim=1) + 1).tolist()
    predictions = []
    for label in labels:
        studied = classes.index(label)
        odds = log_odds(logits.double(), studied).tolist()
        for photograph, by_class, places, score in zip(photographs, probabilities, ranks, odds, strict=True):
            best, true = places.index(1), (None, None)
            if photograph.label in classes:
                index = classes.index(photograph.label)
                true = by_class[index], places[index]
            row = classes[best], by_class[best], *true, by_class[studied], places[studied], score
            predictions.append(Prediction(photograph, label, *row))
    return predictions


def by_label(predictions: Sequence[Prediction]) -> dict[str, list[Prediction]]:
    """The predictions about each class under study."""
    labels = dict.fromkeys(item.label for item in predictions)
    return {label: [item for item in predictions if item.label == label] for label in labels}


def write_predictions(path: Path, predictions: Sequence[Prediction]) -> None:
    """Write a row per photograph, with columns for each class under study; None becomes an empty cell."""
    groups = by_label(predictions)
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    columns = dict.fromkeys(name for label in groups for name in _columns(label))
    writer.writerow(["path", "label", "source", "hard_negatives", "mesh", *columns])
    for items in zip(*groups.values(), strict=True):
        cells: dict[str, object] = {}
        for item in items:
            photograph, label, *values = vars(item).values()
            cells |= zip(_columns(label), values, strict=True)
        names = {**vars(photograph), "hard_negatives": SEPARATOR.join(photograph.hard_negatives)}
        writer.writerow([*names.values(), *cells.values()])
    write_whole(path, table.getvalue())


def read_predictions(path: Path, label: Label) -> list[Prediction]:
    """The predictions that `write_predictions` wrote; InputError for another file, or one about another class."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [*csv.DictReader(file)]
            return [_read_row(row, name) for name in label_names(label) for row in rows]
    except (OSError, LookupError, ValueError, TypeError, AttributeError, csv.Error) as error:
        advice = f"score the photographs again, with label={label}"
        raise InputError(f"{path} cannot be used ({in_one_line(error)}): {advice}") from error


def _read_row(row: dict[str, str], label: str) -> Prediction:
    names = row["source"] or None, split_sources(row["hard_negatives"]), row.get("mesh") or None
    cells = (kind(row[name]) if row[name] else None for name, kind in _columns(label).items())
    return Prediction(Photograph(PurePosixPath(row["path"]), row["label"], *names), label, *cells)  # type: ignore[arg-type]


def _columns(label: str) -> dict[str, Callable[[str], object]]:
    """The columns of a prediction about a class, in the order of its fields, with their types."""
    predicted = {
        "predicted": str,
        "probability": float,
        "true_probability": float,
        "true_rank": int,
    }
    return {
        **predicted,
        f"{label}_probability": float,
        f"{label}_rank": int,
        f"{label}_log_odds": float,
    }
