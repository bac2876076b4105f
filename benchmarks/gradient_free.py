"""Attacks with and without gradients, compared at equal numbers of forward passes.

Run it as a module in the root of the repository:

    python -m benchmarks.gradient_free

It attacks the light of generated fruit before a published network, and prints a
Markdown table.
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

import norm_balls as nb
from augment.attack_settings import CMA_ES, GRADIENT, RANDOM_SEARCH

FRUIT = ("orange", "apple", "pear", "sweet_pepper")
TITLES = {GRADIENT: "gradient", RANDOM_SEARCH: "random search", CMA_ES: "CMA-ES"}
# Steps of the gradient attack that are as long together as the radius.
STEPS_PER_RADIUS = 4
# A lead that no example reaches, so that each uses all of its passes.
UNREACHABLE = 1000.0


@dataclass(frozen=True)
class Outcome:
    """What came of an attack on the examples that were classified correctly before.

    Attributes:
        success: Whether each example is misclassified, also with a sensor's noise.
        lead: Lead of the best wrong logit over the right one.
    """

    success: Tensor
    lead: Tensor

    def cell(self) -> str:
        """Write the successes and the median lead."""
        # Without examples, there is no median.
        lead = median(self.lead.tolist() or [math.nan])
        return f"{int(self.success.sum())} of {len(self.success)}, {lead:+.2f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Attack with each optimizer and each budget, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", default="best", help="name of the published network")
    parser.add_argument("--views", type=int, default=6, help="views of each fruit")
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds of the searches")
    parser.add_argument("--radius", type=float, default=0.1, help="L-infinity radius of the light")
    parser.add_argument("--budgets", type=int, nargs="+", default=[50, 200, 1000])
    options = parser.parse_args(arguments)
    network = nb.load(options.network)
    scene = build_scene(network, options.views)
    header = [f"{budget} passes" for budget in options.budgets]
    print(f"|optimizer|{'|'.join(header)}|")
    print("|-" * (1 + len(header)) + "|")
    for optimizer, title in TITLES.items():
        cells = []
        for budget in options.budgets:
            settings = settings_of(optimizer, budget, options.radius)
            cells.append(attack(network, scene, settings, options.seeds).cell())
        print(f"|{title}|{'|'.join(cells)}|", flush=True)


def build_scene(network: nb.Classifier, view_count: int) -> nb.Scene:
    """Build a scene with an example for each view of each fruit.

    Args:
        network: Network that is attacked.
        view_count: Views of each fruit.

    Returns:
        Scene under the light "grace".
    """
    objects = [(f"solid:{name}:1", name) for name in FRUIT]
    return nb.build_scene(objects, network.size, view_count, light="grace", rasterizer="numpy")


def settings_of(optimizer: str, budget: int, radius: float) -> nb.AttackSettings:
    """Return settings of an attack on the light.

    Args:
        optimizer: Name of the optimizer.
        budget: Forward passes for each example.
        radius: Radius of the L∞ ball of each coefficient.

    Returns:
        Settings by which each example uses all passes.
    """
    ball = nb.StepSettings("linf", radius, "sign", radius / STEPS_PER_RADIUS)
    return nb.AttackSettings(
        lighting=ball,
        optimizer=optimizer,
        max_queries=budget,
        max_steps=budget,
        margin=UNREACHABLE,
        batch_size=256,
    )


def attack(
    network: nb.Classifier, scene: nb.Scene, settings: nb.AttackSettings, seed_count: int
) -> Outcome:
    """Attack a scene under several seeds.

    The seeds also draw the noise of the sensor, so that the gradient attack has
    different successes under them, too.

    Args:
        network: Network that is attacked.
        scene: The scene.
        settings: Settings of the attack.
        seed_count: Number of seeds.

    Returns:
        Outcome of the examples under all seeds.
    """
    successes = []
    leads = []
    for seed in range(seed_count):
        result = nb.attack(network, scene, settings=settings, seed=seed, force=True)
        assert int(result.minimum.queries.max()) <= settings.max_queries
        is_clean = result.clean_correct
        gaps = result.criterion.gap(result.logits_in_views)[:, 0]
        successes.append(result.success[is_clean])
        leads.append(gaps[is_clean])
    return Outcome(torch.cat(successes), torch.cat(leads))


if __name__ == "__main__":
    main()
