"""How much light an attack needs as training goes on (the paper's appendix C): a figure from a run's metrics.

python -m benchmarks.paper.light_change runs/adversarial --out light_change.png
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

from train.runs.run_log import read_metrics

MEASURES = {"light_change": "L2 norm of the light's change", "steps": "steps", "attack_success": "success"}


def main(argv: Sequence[str] | None = None) -> None:
    from matplotlib.figure import Figure

    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("run", type=Path, help="a run with augment=adversarial")
    options.add_argument("--out", type=Path, required=True, help="a .png; its numbers go into a .csv beside it")
    args = options.parse_args(argv)
    lines = [line for line in read_metrics(args.run) if "augment/steps" in line]
    if not lines:
        options.error(f"{args.run} has no finished epoch with attacks: give a run with augment=adversarial")
    rows = [[line["epoch"], *(line[f"augment/{name}"] for name in MEASURES)] for line in lines]
    with args.out.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([["epoch", *MEASURES], *rows])
    figure, (epochs, *series) = Figure(figsize=(9, 2.6), layout="constrained"), zip(*rows, strict=True)
    for axes, values, title in zip(figure.subplots(1, len(MEASURES)), series, MEASURES.values(), strict=True):
        axes.plot(epochs, values, "o-", ms=3)
        axes.set(xlabel="epoch", title=title, ylim=(0, None))
    figure.savefig(args.out, dpi=100)


if __name__ == "__main__":
    main()
