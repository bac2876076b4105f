"""pnb-evaluate and nb.evaluate: scores of a network on a folder of photographs."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

from augment.classifier import UNIT_RANGE, Classifier, Normalization, TaskNetwork, as_network
from augment.files import NetworkFacts, require_no_facts
from augment.network import device_of, gradient_flags_kept, say_once
from augment.settings import NormalizeLight
from augment.tasks.detection import Detection
from augment.tasks.segmentation import Segmentation
from augment.tasks.task import Task
from renderer.errors import InputError, as_folder, as_path, composed, keyed, require_choice
from renderer.settings import Size
from train.checkpoints import load_chosen, load_run, with_task
from train.command_settings import EvaluateSettings, require_calibration
from train.data.annotations import FITS, LETTERBOX, read_annotations
from train.data.photographs import choose_labels, folder_names, require_outside
from train.device import MixedPrecision, choose_device, choose_precision
from train.results import annotated_scores, scoring
from train.results.annotated_scores import AnnotatedScores, Showing
from train.results.overwrite import output_folder
from train.results.scoring import Predictor, Scores, format_scores
from train.results.store import trained_labels
from train.run_folder import sole_writer
from train.settings import GROUPS, label_names, published_folder
from train.system import is_verbose


def run(settings: EvaluateSettings) -> None:
    """Score a network on photographs, write tables and images, and print a summary."""
    label = settings.label
    if settings.run is None:
        network = load_chosen(settings)
    else:
        # The file of a training run has its classes, size and normalization. These settings
        # are therefore an error here.
        facts = settings.classes, settings.size, settings.normalization, settings.prompt
        require_no_facts(f"run={settings.run}", NetworkFacts(*facts))
        if settings.decode is not None:
            raise settings.wrong("decode", "is for a file, and not for a run: leave it out")
        loaded = load_run(settings.run, settings.weights, settings.network, settings.trust)
        # The returned copy normalizes the light of each image, unless the setting is None.
        network = with_task(loaded.normalizing_light(settings.normalize_light), settings)
        photos = published_folder(Path(settings.photos))
        # The run is scored on the positive classes of its training, if the folder has classes.
        folders = folder_names(photos) if label is None and photos.is_dir() else ()
        if {*folders}.intersection(map(composed, network.classes)):
            label = trained_labels(Path(settings.run)) or None
    with keyed("label"):
        for name in [] if label is None else label_names(label):
            network.label(name)
    names = ("by", "calibrate", "false_positive_rate", "skip_unreadable", "precision", "fit")
    options = {name: getattr(settings, name) for name in (*names, "out", "overwrite")}
    device = choose_device(settings.device)
    scores = evaluate(network, settings.photos, label, device=device, **options)
    if not isinstance(scores, Scores):
        print(f"{scores}\nscores and pictures: {Path(settings.out)}")
        return
    if settings.label is None:
        source = "each class with a sub-folder" if label is None else f"those of {settings.run}"
        print(f"positive classes: {', '.join(scores.predicted.labels)} ({source})")
    text = format_scores(scores) if is_verbose() else str(scores)
    print(f"{text}\ntable, scores and image: {Path(settings.out)}")


@torch.inference_mode(False)  # Weights of the caller would become inference tensors.
def evaluate(
    network: TaskNetwork | Callable[[torch.Tensor], Any],
    photos: str | Path,
    label: str | int | Sequence[str | int] | None = None,
    *,
    classes: Sequence[str] | None = None,
    size: Size | None = None,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
    normalize_light: NormalizeLight = None,
    by: str = "source",
    calibrate: str | Path | None = None,
    false_positive_rate: float | None = None,
    skip_unreadable: bool = False,
    precision: str = "auto",
    fit: str = LETTERBOX,
    task: Task | None = None,
    device: torch.device | str | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
) -> Scores | AnnotatedScores:
    """Score a network on the photographs of a folder.

    Nothing is written unless `out` is given. A detector is scored on photographs
    with boxes, and a segmenter on photographs with masks.

    Args:
        network: A classifier, a detector or a segmenter, or a plain network from
            images to their outputs, such as a `torch.nn.Module`.
        photos: For a detector, a COCO file, a folder with one, or a folder of
            images with label files of YOLO. Photographs are turned as their
            EXIF orientation says. For a segmenter, a folder with `images/` and
            `masks/`: a mask is a gray or palette PNG of the same name, whose
            values are indices of classes, or 255 where pixels do not count. For
            a classifier, a folder with a sub-folder
            of photographs for each class. A sub-folder of any other name holds
            negatives: photographs of other objects. "pretrained/laboratory" is
            installed with the library.
        label: Positive class, or several, by name or index. Recall is the
            fraction of the photographs of a positive class that the network
            finds. None for all classes that have a sub-folder.
        classes: Names of the classes of a plain network, in the order of its
            outputs. None for "0", "1" and so on.
        size: Pixels per side of the images of a plain network, or (height, width).
            None for its own, or 224.
        normalization: "imagenet", or mean and standard deviation, as `attack`
            takes it.
        value_range: Values of black and white that a plain network takes before
            normalization.
        normalize_light: Normalization of the light of each photograph before it
            enters the network. Values are as for `load_classifier`.
        by: Groups of photographs that are scored one by one, in addition to all
            photographs: "class", or a column of the file photos.csv in `photos`,
            "source" or "mesh".
        calibrate: Folder like `photos`. The threshold on the log-odds of each
            positive class is chosen on its photographs, so that their
            false-positive rate is `false_positive_rate`. None for the thresholds
            that are stored with the network, if any.
        false_positive_rate: False-positive rate of these thresholds, in (0, 1).
        skip_unreadable: Whether to leave out photographs that cannot be read.
        precision: "auto" (bfloat16 if the hardware computes in it), "bfloat16"
            or "float32". A detector computes in float32.
        fit: How photographs get the size of a detector or a segmenter:
            "letterbox" keeps their aspect ratio and adds gray borders, "stretch"
            does not. A classifier takes the default alone.
        task: Task of the network, such as `nb.Detection(threshold=0.3)`. None if
            its outputs tell.
        device: Device that computes. None for the device of the network.
        out: Folder to which tables and images of the scores are written. None to
            write no files.
        overwrite: Whether to replace results in `out`.

    Returns:
        Scores of a detector: `overall` and `by_label` have the recall at the
        threshold, AP50 and the false detections per image of the task, and
        `by_source` the same for each folder of photographs. Intervals are over
        photographs. Scores of a segmenter: `miou`, and the IoU of each class in
        `by_class`, of the pixels at the size of the network. Scores of a
        classifier: `overall` has the metrics of all
        photographs, `by_label` the metrics of each positive class, and
        `by_class` the recall of each class of the folder.

    Raises:
        InputError: If the network does not fit its arguments, if it lacks a
            class, or if the photographs cannot be read.

    Example:
        >>> import norm_balls as nb
        >>> def logits(images):
        ...     return images.mean((2, 3))
        >>> classes = ["orange", "lemon", "pear"]
        >>> folder = "pretrained/laboratory"
        >>> scores = nb.evaluate(logits, folder, "orange", classes=classes, size=8)
        >>> scores.overall.recall.n
        280
    """
    # `calibrate` and `false_positive_rate` belong together.
    require_calibration(false_positive_rate, calibrate)
    require_choice("fit", fit, FITS)
    folder = published_folder(as_path("photos", photos))
    device = device_of(network) if device is None else torch.device(device)
    with gradient_flags_kept(network):
        given = size, classes, normalization, value_range, device
        made = as_network(network, *given, normalize_light=normalize_light, task=task).to(device)
        if not isinstance(made, Classifier) and (by != GROUPS[0] or calibrate is not None):
            raise InputError("by and calibrate are for classifiers: leave them out")
        if isinstance(made, Classifier) and fit != LETTERBOX:
            raise InputError(f"fit={fit} is for detectors and segmenters: leave it out", "fit")
        if isinstance(made.task, Segmentation) and label is not None:
            raise InputError("label is for classifiers and detectors: leave it out", "label")
        if isinstance(made.task, Detection):
            annotations = read_annotations(folder)
            # A YAML file stands for the photographs in its folder.
            folder = annotations.file if folder.is_file() else folder
        elif isinstance(made, Classifier):
            labels = choose_labels(as_folder("photos", folder), made.classes, label)
        # The folder of the results. It is checked before the long computation.
        target = None if out is None else output_folder(str(out), overwrite)
        if target:
            require_outside(target, folder)
        with sole_writer(target) if target else nullcontext():
            if not isinstance(made, Classifier):
                found: AnnotatedScores
                how = Showing(fit, skip_unreadable, device)
                if isinstance(made.task, Detection):
                    chosen = None if label is None else label_names(label)
                    found = annotated_scores.evaluate_detector(made, annotations, chosen, how)
                else:
                    found = annotated_scores.evaluate_segmenter(made, folder, how)
                if target:
                    annotated_scores.write(found, target)
                return found
            model = MixedPrecision(made, choose_precision(precision, device))
            predictor = Predictor(model, made.classes, made.size, device)
            # Thresholds that are stored with the network, used if every label has one.
            stored = {point.label: point for point in made.operating_points}
            points = [stored[name] for name in labels] if stored.keys() >= set(labels) else []
            if stored and not points and calibrate is None:
                say_once(f"the stored thresholds are not used: set label={', '.join(stored)}")
            if calibrate is not None and false_positive_rate is not None:
                chosen_on = Path(calibrate), labels, false_positive_rate, skip_unreadable
                points = scoring.choose_operating_points(predictor, *chosen_on)
            scores = scoring.score(predictor.predict(folder, labels, skip_unreadable), by, points)
            if target:
                scoring.write(scores, target)
    return scores
