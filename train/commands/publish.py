"""pnb-publish: write the network of a training run as half-precision safetensors."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from augment.network import Classifier
from renderer.errors import InputError
from train.command_settings import PublishSettings
from train.networks import PYTHON
from train.results import scoring
from train.results.overwrite import require_replaceable
from train.results.scoring import Predictor
from train.results.store import summarize, trained_labels
from train.run_folder import PUBLISHED
from train.saved_networks import load_run, load_selected, publish
from train.settings import mapped, published
from train.system.user_errors import keyed, writable_folder
from train.system.verbosity import shortened


def publish_network(settings: PublishSettings) -> None:
    """Write the network of a training run with its settings and scores, and print the folder."""
    out = writable_folder(settings.out, "out")
    folder = Path(settings.run)
    path, state = load_selected(folder)
    # `run` may be the folder of a published network, which is then replaced, for example
    # to add a detection threshold to it.
    is_replaced = path.resolve() == (out / PUBLISHED).resolve()
    own_files = [PUBLISHED] if is_replaced else []
    require_replaceable(out, "out", settings.overwrite, own_files)
    is_training_run = path.suffix != Path(PUBLISHED).suffix
    if is_training_run:
        state |= _describe_run(folder)
    # A Python function of the user may build the network. It is called only if the
    # network must be calibrated.
    is_python = str(state["architecture"].get("name")).startswith(PYTHON)
    if settings.calibrate or not is_python:
        # `load_run` raises an InputError if nobody could load the published network.
        network = load_run(path, model=settings.network, trust_code=settings.trust)
        if settings.calibrate and settings.false_positive_rate:
            label = settings.label if settings.label is not None else trained_labels(folder)
            if not label:
                raise InputError(
                    f"label is not set, and run={folder} records no positive class: "
                    "set label=CLASS",
                    "label",
                )
            state["operating_point"] = _calibrate(
                network, settings.calibrate, label, settings.false_positive_rate
            )
    out.mkdir(parents=True, exist_ok=True)
    publish(out / PUBLISHED, state)
    print(f"published in {settings.out}")


def _describe_run(folder: Path) -> dict[str, Any]:
    """Collect "settings", "versions" of packages and "scores" of a run for the published file."""
    run = summarize(folder)
    photographs = {name: scores.to_published() for name, scores in run.photographs.items()}
    return {
        "settings": mapped(dict(run.settings), _without_folder),
        "versions": dict(run.config.versions),
        "scores": {**run.scores, **photographs},
    }


def _without_folder(text: str) -> str:
    """Remove the folders from an absolute path, because other machines do not have them.

    Other values than absolute paths are returned as they are.
    """
    return Path(text).name if text.startswith("/") else text


def _calibrate(
    network: Classifier,
    folder: str,
    label: Any,
    false_positive_rate: float,
) -> list[dict[str, Any]]:
    """Choose a detection threshold for each positive class on photographs, and print it.

    The thresholds have at most `false_positive_rate`. The weights of `network` are rounded to 16
    bits.
    """
    # Published weights have 16 bits, so the thresholds are chosen with rounded weights.
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
