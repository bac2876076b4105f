"""The metrics of an epoch: their names, and their line on the console."""

from collections.abc import Mapping
from statistics import fmean

from tqdm import tqdm

from train.runs.run_log import PHASES

# Diagnostics of the attack that `epoch_metrics` records for each round, if an epoch
# has several rounds.
SHOWN = ("attack_success_before", "attack_success", "steps")


def epoch_metrics(
    trained: Mapping[str, float],
    validated: Mapping[str, float],
    diagnostics: list[Mapping[str, float]],
    seconds: Mapping[str, float],
) -> dict[str, float]:
    """Name the metrics of an epoch as metrics.jsonl and TensorBoard have them.

    Args:
        trained: Metrics on the training images.
        validated: Metrics on the validation images.
        diagnostics: Diagnostics of the attack, for each round of renders.
        seconds: Time that each phase of the epoch took.

    Returns:
        Metrics by names such as "train/loss". The part before the slash is:

        - "train" or "validation";
        - "augment", for means of the diagnostics over the rounds;
        - "seconds";
        - "round_1", "round_2" and so on, if there are several rounds.
    """
    augment = {}
    for name in diagnostics[0]:
        augment[name] = fmean(of_round[name] for of_round in diagnostics)
    groups = {
        "train": trained,
        "validation": validated,
        "augment": augment,
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
    """Write the line of an epoch for the console.

    Args:
        epoch: The epoch, from 1.
        epochs: The number of epochs.
        metrics: The metrics of the epoch, by the names of `epoch_metrics`.

    Returns:
        The line. If the renders were attacked, it has the fraction of
        successes among the clean-correct renders, which are the renders that
        the network classifies correctly before the attack.
    """
    total = sum(metrics[f"seconds/{name}"] for name in PHASES)
    parts = [
        f"epoch {epoch}/{epochs}",
        f"train loss {metrics['train/loss']:.3f} accuracy {metrics['train/accuracy']:.3f}",
        f"validation accuracy {metrics['validation/accuracy']:.3f}",
    ]
    success = attack_success(metrics, "augment/")
    if success is not None:
        # "attack_success_before" is the fraction that is misclassified before the attack.
        correct = 1 - metrics["augment/attack_success_before"]
        parts.append(f"attack success {success:.2f} of the {correct:.0%} clean-correct")
    duration = f"{total:.0f} s (renders {metrics['seconds/attack']:.1f} s)"
    left = total * (epochs - epoch)
    if left:
        duration += f"; about {tqdm.format_interval(left)} left"
    return "  ".join([*parts, duration])


def attack_success(diagnostics: Mapping[str, float], prefix: str = "") -> float | None:
    """Compute how often an attack succeeds on examples that are correct before it.

    Args:
        diagnostics: Values by name. "attack_success_before" and
            "attack_success" are the fractions of all examples that are
            misclassified before and after the attack.
        prefix: Text before the names of the diagnostics, such as "augment/".

    Returns:
        Among the examples that are classified correctly before the attack, the
        fraction that is misclassified after it. None if no example is correct
        before, or if there was no attack.
    """
    before = diagnostics.get(f"{prefix}attack_success_before", 1.0)
    if before == 1:
        return None
    return (diagnostics[f"{prefix}attack_success"] - before) / (1 - before)
