from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from train.auditing import lights
from train.checkpoints import save
from train.cli import Command, read_settings
from train.data.photo import Photograph
from train.networks import WideResNet, describe
from train.results.compare import Evaluation
from train.results.metrics import Pool
from train.results.predictions import Predictions
from train.results.scoring import rank_classes
from train.results.store import RunSummary
from train.run_folder import BEST, LOCK

FIG_LIME_ORANGE = ["fig", "lime", "orange"]
# Settings of trainings of a small network of torchvision in few steps.
SHORT_TRAINING = [
    *("network=torchvision:shufflenet_v2_x0_5", "size=32", "data.test_fraction=0.25"),
    *("data.validation=0.25", "train.device=cpu", "train.precision=float32", "train.threads=1"),
    "train.batch_size=8",
]

COMPOSED: dict[tuple[str, ...], DictConfig] = {}


def read_quickly(command: Command, words: Sequence[str], overrides: Sequence[str]) -> Any:
    """Return the settings of a command, which is composed once for the same words.

    Composing takes half a second. Only overrides that choose a file need it.
    """
    keys = command.keys.keys() - set(command.groups)
    values = [item for item in overrides if item.partition("=")[0] in keys]
    choices = *words, *(item for item in overrides if item not in values)
    if (command.name, *choices) not in COMPOSED:
        COMPOSED[command.name, *choices] = command.compose(choices)
    changes = OmegaConf.from_dotlist(command.to_overrides(values))
    return read_settings(command.kind, OmegaConf.merge(COMPOSED[command.name, *choices], changes))


def save_untrained_network(folder: Path, size: int) -> None:
    torch.manual_seed(0)
    shape = {"depth": 10, "width": 1, "dropout": 0.0}
    network = WideResNet(len(FIG_LIME_ORANGE), **shape)
    architecture = describe(network, FIG_LIME_ORANGE, size=size, encoding="linear", **shape)
    folder.mkdir()
    save(folder / BEST, {"model": network.state_dict(), "architecture": architecture})


def ranked(
    labels: Sequence[str],
    logits: Any,
    classes: Sequence[str],
    positives: Sequence[str] = ("orange",),
    sources: Sequence[str | None] = (),
    meshes: Sequence[str | None] = (),
) -> Predictions:
    """Rank the classes of images that show objects with some labels."""
    facts = zip_longest(labels, sources, meshes)
    shown = [
        Photograph(PurePosixPath(f"{label}/{number:03}.png"), str(label), source, mesh=mesh)
        for number, (label, source, mesh) in enumerate(facts)
    ]
    return rank_classes(shown, torch.as_tensor(logits).double(), classes, positives)


def evaluation_of(predictions: Predictions) -> Evaluation:
    """Evaluate predictions of a run that has no folder."""
    return Evaluation(RunSummary(Path("run"), "network", {}, {}, None), Pool(predictions))


def attack_shortly(patch: pytest.MonkeyPatch, *kinds: str, steps=2, additional=2) -> None:
    """Attack some kinds of light alone in an audit, in few steps."""
    patch.setattr(lights, "STEPS", steps)
    patch.setattr(lights, "ADDITIONAL_STEPS", additional)
    for kind in lights.KINDS.keys() - {*kinds}:
        patch.delitem(lights.KINDS, kind)


def modification_times(folder: Path) -> dict[Path, int]:
    """Return when each file and folder was written, except for locks."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != LOCK}


def read_markdown(text: str) -> dict[str, list[list[str]]]:
    """Read the rows of cells of each table by the heading or line before it, or by ""."""
    tables = {}
    title = ""
    for paragraph in text.split("\n\n"):
        lines = paragraph.splitlines()
        table = [line for line in lines if line.startswith("|")]
        other_lines = [line for line in lines if not line.startswith("|")]
        if other_lines:
            title = other_lines[-1].removeprefix("### ").removesuffix(":")
        if table:
            tables[title] = _read_rows(table)
    return tables


def _read_rows(lines: list[str]) -> list[list[str]]:
    """Split the lines of one table, whose columns must be aligned, into cells."""
    header, separator, *rows = lines
    assert len({len(line) for line in lines}) == 1
    assert set(separator) == {"|", "-", " "}
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in (header, *rows)]
