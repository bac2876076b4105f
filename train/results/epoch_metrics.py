"""The metrics of an epoch: their names, and their line on the console."""

from collections.abc import Mapping
from statistics import fmean

from tqdm import tqdm

from train.run_folder import PHASES

# Measurements of the attack on the training renders. A round is a part of the training
# with the same renders. If an epoch has several rounds, the log has these measurements
# of each round.
SHOWN = ("attack_success_before", "attack_success", "steps")


def epoch_metrics(
    trained: Mapping[str, float],
    validated: Mapping[str, float],
    diagnostics: list[Mapping[str, float]],
    seconds: Mapping[str, float],
) -> dict[str, float]:
    """Join the metrics of an epoch under the names that metrics.jsonl and TensorBoard have.

    "augment/" has means of the diagnostics over all rounds, and "round_1/" those of one of several
    rounds.
    """
    means = {}
    for name in diagnostics[0]:
        means[name] = fmean(of_round[name] for of_round in diagnostics)
    groups = {
        "train": trained,
        "validation": validated,
        "augment": means,
        "seconds": seconds,
    }
    if len(diagnostics) > 1:
        for number, of_round in enumerate(diagnostics, 1):
            shown = {name: of_round[name] for name in SHOWN if name in of_round}
            groups[f"round_{number}"] = shown
    metrics: dict[str, float] = {}
    for group, values in groups.items():
        metrics |= {f"{group}/{name}": value for name, value in values.items()}
    return metrics


def format_epoch(epoch: int, epochs: int, metrics: Mapping[str, float]) -> str:
    """Write the line that the console shows after an epoch.

    The success of the attack counts only renders that are classified correctly before it.
    """
    total = sum(metrics[f"seconds/{name}"] for name in PHASES)
    parts = [
        f"epoch {epoch}/{epochs}",
        f"train loss {metrics['train/loss']:.3f} accuracy {metrics['train/accuracy']:.3f}",
        f"validation accuracy {metrics['validation/accuracy']:.3f}",
    ]
    success = attack_success(metrics, "augment/")
    if success is not None:
        # "attack_success_before" is the fraction of renders that are misclassified
        # before the attack.
        correct = 1 - metrics["augment/attack_success_before"]
        parts.append(f"attack success {success:.2f} of the {correct:.0%} clean-correct")
    duration = f"{total:.0f} s (renders {metrics['seconds/attack']:.1f} s)"
    left = total * (epochs - epoch)
    if left:
        duration += f"; about {tqdm.format_interval(left)} left"
    return "  ".join([*parts, duration])


def attack_success(diagnostics: Mapping[str, float], prefix: str = "") -> float | None:
    """Compute the success rate of an attack on renders that are classified correctly before it.

    With the fraction b of misclassified renders before the attack, and the
    fraction a after it, the rate is (a - b) / (1 - b). It is None without an attack or for b = 1.
    """
    before = diagnostics.get(f"{prefix}attack_success_before", 1.0)
    if before == 1:
        return None
    return (diagnostics[f"{prefix}attack_success"] - before) / (1 - before)
