"""Accuracy of networks on photographs, unchanged and in the light of a projector.

The name of each photograph begins with the index of its class, such as
`340_zebra.jpg`. Run it as a module in the root of the repository:

    python -m benchmarks.relit_photographs FOLDER efficientnet_lite0 run:runs/relit

A row of the table is a network, or the mean over the seeds of a training, whose
networks are separated by commas. Differences are from the first row, and from the
row `--control`, with 95% intervals over photographs and seeds.
"""

import argparse
import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import norm_balls as nb
from augment.classifier import Classifier
from augment.network import compute_outputs
from benchmarks.many_objects import ScoredGroup, mean_with_interval
from train.checkpoints import load_network
from train.data.photographs import find_unlabeled, load_photographs
from train.results.tables import Estimate, format_interval

# Photographs per pass.
BATCH = 32


def main(arguments: Sequence[str] | None = None) -> None:
    """Score each network, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of photographs")
    parser.add_argument("networks", nargs="+", help="the original, and NETWORK or NETWORK,NETWORK")
    parser.add_argument("--control", help="row from which differences are also written")
    parser.add_argument("--every", type=int, default=10, help="classes whose index it divides")
    parser.add_argument("--slides", type=int, default=4, help="random slides of each photograph")
    parser.add_argument("--passes", type=int, default=11, help="passes of each search")
    parser.add_argument("--seed", type=int, default=1000, help="seed of the light")
    parser.add_argument("--scores", type=Path, help="folder of scores that later calls read")
    options = parser.parse_args(arguments)
    if options.control and options.control not in options.networks:
        parser.error(f"--control {options.control} is none of the networks")
    rows = {row: score_row(row, options) for row in options.networks}
    first = rows[options.networks[0]]
    print(f"|network|{'|'.join(first)}|")
    print("|-" * (1 + len(first)) + "|")
    for row, columns in rows.items():
        cells = []
        for title, column in columns.items():
            control = rows[options.control][title] if options.control else None
            cells.append(cell(column, first[title], control))
        print(f"|{row}|{'|'.join(cells)}|")


def score_row(row: str, options: argparse.Namespace) -> dict[str, Tensor]:
    """Score the networks of a row, or read the scores of an earlier call.

    Args:
        row: Names of the networks, separated by commas.
        options: Options of the command line.

    Returns:
        Numbers in [0, 1] by column, shape (S, N) each for S networks.
    """
    seeds = [load_or_score(name, options.networks[0], options) for name in row.split(",")]
    return {title: torch.stack([seed[title] for seed in seeds]) for title in seeds[0]}


def load_or_score(name: str, original: str, options: argparse.Namespace) -> dict[str, Tensor]:
    """Score a network, or read the scores of an earlier call.

    Args:
        name: Name of the network.
        original: Name of the original network.
        options: Options of the command line.

    Returns:
        Numbers in [0, 1] by column, shape (N,) each.
    """
    file = None
    if options.scores is not None:
        options.scores.mkdir(parents=True, exist_ok=True)
        given = vars(options) | {"networks": [original, name], "control": None, "scores": None}
        key = hashlib.sha256(repr(sorted(given.items())).encode()).hexdigest()[:16]
        stem = re.sub(r"\W+", "_", name)
        file = options.scores / f"{stem}_{key}.pt"
        if file.exists():
            return torch.load(file)
    classifier = load_network(name)
    photographs, labels = load(options.folder, classifier.size, options.every)
    wanted = predict(load_network(original), photographs)
    columns = score(classifier, photographs, labels, wanted, options)
    if file is not None:
        torch.save(columns, file)
    return columns


def load(folder: Path, size: int, every: int) -> tuple[Tensor, Tensor]:
    """Load the photographs of some classes.

    Args:
        folder: Folder of photographs.
        size: Pixels per side.
        every: Classes with an index that this number divides are loaded.

    Returns:
        Photographs, uint8, shape (N, 3, size, size), and their classes, shape
        (N,).
    """
    chosen = []
    for photograph in find_unlabeled(folder):
        if class_of(photograph.path.name) % every == 0:
            chosen.append(photograph)
    found, images, _ = load_photographs(folder, chosen, size, False)
    return images, torch.tensor([class_of(item.path.name) for item in found])


def class_of(name: str) -> int:
    """Return the index of the class with which the name of a photograph begins."""
    number = name.partition("_")[0]
    if not number.isdecimal():
        raise SystemExit(
            f"error: {name} does not begin with the index of its class, as in 007_cock"
        )
    return int(number)


def score(
    classifier: Classifier,
    photographs: Tensor,
    labels: Tensor,
    wanted: Tensor,
    options: argparse.Namespace,
) -> dict[str, Tensor]:
    """Score a network on each photograph, by column of the table.

    Args:
        classifier: Network.
        photographs: Photographs, uint8, shape (N, 3, size, size).
        labels: Their classes, shape (N,).
        wanted: Classes that the original network predicts, shape (N,).
        options: Options of the command line.

    Returns:
        Numbers in [0, 1], shape (N,) each.
    """
    predicted = predict(classifier, photographs)
    right = []
    kept = []
    for slide in range(options.slides):
        relit = nb.relight_photographs(photographs, options.seed + slide, slides=photographs)
        predicted_relit = predict(classifier, relit)
        right.append(predicted_relit == labels)
        kept.append(predicted_relit == wanted)
    settings = nb.RelightingSettings(passes=options.passes)
    result = nb.attack_photographs(classifier, photographs, settings, seed=options.seed)
    columns = {
        "unchanged": predicted == labels,
        "agreement": predicted == wanted,
        "random slides": torch.stack(right).double().mean(0),
        "agreement, random slides": torch.stack(kept).double().mean(0),
    }
    titles = {"slide": "one slide", "random": "random search", "adversarial": "gradient"}
    for light, title in titles.items():
        columns[title] = (result.source == labels) & result.kept(light)
    return {title: column.double() for title, column in columns.items()}


def predict(classifier: Classifier, photographs: Tensor) -> Tensor:
    """Return the classes that a network predicts for photographs, shape (N,)."""
    return compute_outputs(classifier, photographs, BATCH).argmax(1)


def cell(columns: Tensor, first: Tensor, control: Tensor | None) -> str:
    """Write a mean, and its differences from other rows with intervals.

    Args:
        columns: Numbers of the photographs for each seed, shape (S, N).
        first: Numbers of the first row, shape (1, N).
        control: Numbers of the control, shape (S, N) or (1, N). None for no
            such difference.

    Returns:
        Text such as "0.710, +0.050 [+0.010, +0.090]".
    """
    text = f"{columns.mean():.3f}"
    if (columns - first).any():
        text += f", {format_interval(interval(columns, first), '+')}"
    if control is not None and (columns - control).any():
        text += f" ({format_interval(interval(columns, control), '+')} over the control)"
    return text


def interval(columns: Tensor, other: Tensor) -> Estimate:
    """Return a difference of means with its 95% interval over photographs and seeds.

    Args:
        columns: Numbers of the photographs for each seed, shape (S, N).
        other: Numbers that are subtracted, shape (S, N) or (1, N).
    """
    count = columns.shape[1]
    hits = {"": columns.numpy(), "other": other.numpy()}
    # Each photograph is an object of its own.
    part = ScoredGroup(hits, setups=np.zeros(count), objects=np.arange(count))
    return mean_with_interval([part], "", "other")


if __name__ == "__main__":
    main()
