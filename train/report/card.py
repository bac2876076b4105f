"""A run's network for others: half-precision weights, and a card that says what it is and how it was made."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from train.networks import PUBLISHED, PYTHON, load_run, model_title, publish
from train.photographs.figures import figure_title
from train.photographs.text import format_interval
from train.report.summary import RunSummary, complete, summarize
from train.report.tables import aligned
from train.run_folder import checkpoint

RECIPE = (
    "epochs",
    "images_per_epoch",
    "batch_size",
    "learning_rate",
    "momentum",
    "weight_decay",
    "schedule",
    "ranking",
    "distillation",
    "ema_decay",
    "soup",
    "precision",
)


def publish_run(folder: Path, out: Path) -> None:
    """Write a finished run's selected network as half-precision safetensors, and a card beside it."""
    run = summarize(folder)
    with complete(folder):
        card = _card(run, out.name)
    state = checkpoint.load(folder / checkpoint.BEST)
    if not str(state["architecture"].get("name")).startswith(PYTHON):  # whose code only its user runs
        load_run(folder / checkpoint.BEST)  # or raises: nobody could use it
    out.mkdir(parents=True, exist_ok=True)
    publish(out / PUBLISHED, state)
    (out / "README.md").write_text(card, encoding="utf-8")


def _card(run: RunSummary, name: str) -> str:
    config, start = run.config, run.config.train.get("init_from")
    architecture = model_title(**config.model)
    data = Path(config.data.path).name if config.data.name in ("npz", "folder") else config.data.name
    selection = "of which the mean is kept" if config.train.get("soup") else "selected on validation"
    rows = [
        ("network", architecture),
        ("data", f"{data}, {config.data.validation:.0%} of training for validation"),
        *([("begun from", Path(start).name)] if start else []),
        ("augmentation", f"{run.arm}; {_renders(config)}"),
        ("recipe", ", ".join(f"{name} {config.train[name]}" for name in RECIPE if config.train.get(name))),
        ("seed", str(config.seed)),
        ("epoch", f"{run.scores['test/epoch']}, {selection}"),
        ("test accuracy", f"{run.accuracy:.4f}"),
        *(
            (f"{folder}: {figure_title(name, config.label)}", format_interval(figure))
            for folder in run.photographs
            for name, figure in run.figures(folder).items()
        ),
        ("versions", ", ".join(f"{name} {version}" for name, version in config.versions.items())),
    ]
    title = f"# {architecture}, augment={run.arm}"
    note = "Half-precision weights; images are RGB in [0, 1], normalized inside. Score photographs with"
    command = f"`python scripts/evaluate_photos.py run=pretrained/{name} photos=...`."
    return f"{title}\n\n{note} {command}\n\n{aligned(['what', 'value'], rows)}\n"


def _renders(config: DictConfig) -> str:
    """How often which renders are made."""
    often = f"every {config.augment.every} training images" if config.augment.get("every") else "each epoch"
    if config.augment.arm == "none":
        return f"renders {often}: none"
    meshes, hard_negatives = config.scene.meshes, config.scene.get("hard_negatives") or []
    each = len(meshes) + len(hard_negatives), config.scene.views, len(config.scene.backgrounds)
    beside = f" beside {_counted(hard_negatives)}" if hard_negatives else ""
    count = config.augment.examples or math.prod(each)
    return f"renders {often}: {count} renders of {_counted(meshes)}{beside}"


def _counted(meshes: Sequence[Any]) -> str:
    """Names of scene.meshes or scene.hard_negatives, each with how often it is there."""
    counts = Counter(Path(mesh if isinstance(mesh, str) else mesh.mesh).name for mesh in meshes)
    return ", ".join(f"{count} × {name}" if count > 1 else name for name, count in counts.items())
