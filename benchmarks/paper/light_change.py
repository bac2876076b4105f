"""Draw how much light an attack needs as training continues (the paper's appendix C).

python -m benchmarks.paper.light_change runs/adversarial --out light_change.png

All measures are means over the clean-correct renders of an epoch, which the
network classifies correctly before the attack.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.common import Row, write_csv
from train.run_folder import attack_success, read_metrics

# Measures of a round of attacks, with the titles of their axes.
MEASURES = {"light_change": "L2 norm of the light's change", "steps": "steps", "success": "success"}


def main(argv: Sequence[str] | None = None) -> None:
    """Draw the measures over the epochs, and write them to a CSV file.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="a run with augment=adversarial")
    parser.add_argument(
        "--out", type=Path, required=True, help="a .png; its numbers go into a .csv beside it"
    )
    options = parser.parse_args(argv)
    epochs = [
        measure_epoch(line)
        for line in read_metrics(options.run)
        if attack_success(line, "augment/") is not None
    ]
    if not epochs:
        parser.error(
            f"{options.run} has no epoch with attacks on clean-correct renders: give a run with "
            "augment=adversarial"
        )
    write_csv(options.out.with_suffix(".csv"), epochs)
    draw_measures(epochs, options.out)


def measure_epoch(line: Mapping[str, float]) -> Row:
    """Compute the measures of an epoch over its clean-correct renders.

    The log has means over all renders. The others are not attacked, so their
    change and their number of steps are 0.

    Args:
        line: Metrics of the epoch. At least one render is clean-correct.

    Returns:
        The number of the epoch, the fraction of clean-correct renders, and the
        measures by name.
    """
    correct = 1 - line["augment/attack_success_before"]
    return {
        "epoch": line["epoch"],
        "clean_correct": correct,
        "light_change": line["augment/light_change"] / correct,
        "steps": line["augment/steps"] / correct,
        "success": attack_success(line, "augment/"),
    }


def draw_measures(epochs: Sequence[Row], path: Path) -> None:
    """Draw each measure over the epochs, with axes of its own.

    Args:
        epochs: Measures of each epoch.
        path: File to write.
    """
    figure = Figure(figsize=(9, 2.6), layout="constrained")
    all_axes = figure.subplots(1, len(MEASURES))
    numbers = [measures["epoch"] for measures in epochs]
    for axes, (name, title) in zip(all_axes, MEASURES.items(), strict=True):
        axes.plot(numbers, [measures[name] for measures in epochs], "o-", ms=3)
        axes.set(xlabel="epoch", title=title, ylim=(0, None))
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
