"""The publish command: write the network of a run as half-precision safetensors."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from augment.classifiers import Classifier
from train.command_settings import PublishSettings
from train.evaluation.scores import scoring
from train.evaluation.scores.predictions import Predictor
from train.networks import PYTHON
from train.report.results import require_replaceable
from train.report.summary import summarize
from train.runs.saved_networks import PUBLISHED, load_run, load_selected, publish
from train.settings import mapped, published
from train.system.user_errors import keyed, writable_folder
from train.system.verbosity import shortened


def publish_network(settings: PublishSettings) -> None:
    """Write the network of a run, and print its folder.

    Args:
        settings: Settings of pnb-publish.

    Raises:
        InputError: If there is no network, or if it cannot be loaded from what
            would be written.
    """
    out = writable_folder(settings.out, "out")
    given = Path(settings.run)
    path, state = load_selected(given)
    # A published network may be written again, with another operating point.
    is_in_place = path.resolve() == (out / PUBLISHED).resolve()
    own = [PUBLISHED] if is_in_place else []
    require_replaceable(out, "out", settings.overwrite, own)
    is_run = path.suffix != Path(PUBLISHED).suffix
    if is_run:
        state |= _describe_run(given)
    # A network may be built by a Python function of the user. Publishing calls
    # this function only if the network has to be calibrated.
    is_python = str(state["architecture"].get("name")).startswith(PYTHON)
    if settings.calibrate or not is_python:
        # Loading fails for a network that nobody could use.
        network = load_run(path, model=settings.model)
        if settings.calibrate and settings.false_positive_rate:
            state["operating_point"] = _calibrate(
                network, settings.calibrate, settings.label, settings.false_positive_rate
            )
    out.mkdir(parents=True, exist_ok=True)
    publish(out / PUBLISHED, state)
    print(f"published in {settings.out}")


def _describe_run(folder: Path) -> dict[str, Any]:
    """Collect the facts about a run that are stored in the file of its published network.

    Args:
        folder: Folder of the run.

    Returns:
        "settings" by dotted key, "versions" of the packages by name, and
        "scores" by name: metrics, and the scores of each folder of photographs.
    """
    run = summarize(folder)
    photographs = {name: scores.to_published() for name, scores in run.photographs.items()}
    return {
        "settings": mapped(dict(run.settings), _without_folder),
        "versions": dict(run.config.versions),
        "scores": {**run.scores, **photographs},
    }


def _without_folder(text: str) -> str:
    """Replace an absolute path, which exists only on this machine, by the name of its file."""
    return Path(text).name if text.startswith("/") else text


def _calibrate(
    network: Classifier,
    folder: str,
    label: Any,
    false_positive_rate: float,
) -> list[dict[str, Any]]:
    """Choose the threshold of each label on a folder of photographs, and print it.

    Args:
        network: Network to publish. Its weights are rounded to 16 bits.
        folder: Folder of photographs.
        label: Positive class, or several.
        false_positive_rate: False-positive rate that the threshold must not
            exceed, in (0, 1).

    Returns:
        Fields of the operating point of each label.
    """
    # The thresholds are those of the published weights, which have 16 bits.
    network.half().float()
    with keyed(folder="calibrate"):
        points = scoring.choose_operating_points(
            Predictor(network, network.classes, network.size),
            published(Path(folder)),
            label,
            false_positive_rate,
        )
    entries = [asdict(point) for point in points]
    lines = []
    for entry in entries:
        meaning = scoring.describe_point(entry)
        lines.append(f"{entry['label']}: threshold {entry['threshold']:.3f} for {meaning}")
    print("\n".join(shortened(lines)))
    return entries
