"""Draw how much light an attack needs as training continues (the paper's appendix C).

python -m benchmarks.paper.light_change runs/adversarial --out light_change.png
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from train.runs.run_log import read_metrics

# Measures of a round of attacks, with the titles of their axes.
MEASURES = {
    "light_change": "L2 norm of the light's change",
    "steps": "steps",
    "attack_success": "success",
}


def main(argv: Sequence[str] | None = None) -> None:
    """Draw the measures over the epochs, and write them to a CSV file.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="a run with augment=adversarial")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        help="a .png; its numbers go into a .csv beside it",
    )
    options = parser.parse_args(argv)
    epochs = [line for line in read_metrics(options.run) if "augment/steps" in line]
    if not epochs:
        parser.error(
            f"{options.run} has no finished epoch with attacks: give a run with augment=adversarial"
        )
    write_measures(epochs, options.out.with_suffix(".csv"))
    draw_measures(epochs, options.out)


def write_measures(epochs: Sequence[dict[str, float]], path: Path) -> None:
    """Write a row of measures for each epoch to a CSV file.

    Args:
        epochs: Metrics of each epoch.
        path: File to write.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["epoch", *MEASURES])
        for line in epochs:
            measures = [line[f"augment/{name}"] for name in MEASURES]
            writer.writerow([line["epoch"], *measures])


def draw_measures(epochs: Sequence[dict[str, float]], path: Path) -> None:
    """Draw each measure over the epochs, with axes of its own.

    Args:
        epochs: Metrics of each epoch.
        path: File to write.
    """
    figure = Figure(figsize=(9, 2.6), layout="constrained")
    all_axes = figure.subplots(1, len(MEASURES))
    numbers = [line["epoch"] for line in epochs]
    for axes, (name, title) in zip(all_axes, MEASURES.items(), strict=True):
        values = [line[f"augment/{name}"] for line in epochs]
        axes.plot(numbers, values, "o-", ms=3)
        axes.set(xlabel="epoch", title=title, ylim=(0, None))
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
