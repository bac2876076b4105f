"""Success against radius: in how large a norm-ball an adversary lies, and whether a random search finds one there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from augment.attacks.checks import fooled_by_draws
from augment.attacks.run import Attacked
from augment.attacks.settings import AttackSettings
from augment.descent import Part, descend_in_parts
from augment.phases import Phases
from augment.progress import progress
from augment.seeding import generator
from renderer.errors import InputError


@dataclass(frozen=True)
class Sweep:
    """What norm-balls of R radii hold for the N examples that were recognised before.

    radii: of each kind of parameter by name, R times, ascending. adversarial, random: (R, N) bool, whether a descent or
    a random search has fooled the classifier in this ball or in a smaller one, which lies within it.
    """

    radii: list[dict[str, float]]
    adversarial: Tensor
    random: Tensor


def sweep(attacked: Attacked, scales: Sequence[float]) -> Sweep:
    """Search the balls around an attack's start from the smallest on, in both ways with as many renders.

    scales: times the radius of each kind, or where that is None, times 1. In each ball, examples that are not fooled
    yet go on from where they ended in the one before, for `max_steps` more, or get as many uniform draws.
    """
    if not scales:
        raise InputError("scales is empty: give what to multiply the radii by")
    settings, problem, goal = attacked.settings, attacked.problem, attacked.goal
    kinds = settings.kinds
    seen, draws = settings.observed(attacked.classifier, attacked.seed), generator(attacked.seed, "sweep")
    values, fooled = problem.start.clone(), attacked.result.fooled_before.clone()
    random, radii, found = fooled.clone(), [], []
    for scale in progress(sorted(set(scales)), "radii"):
        radii.append({name: scale * (1.0 if kind.radius is None else kind.radius) for name, kind in kinds.items()})
        balls = within(settings, radii[-1]).problem(problem.scene)
        left = torch.nonzero(~fooled).squeeze(1)
        if len(left):
            part, phases = Part(balls, left, values[left]), Phases(values.device)
            result = descend_in_parts(seen, part, goal.of(left), settings, phases, (), problem.scene.at_once)
            values[left], fooled[left] = result.values, result.fooled
        random = fooled_by_draws(attacked, random, partial(balls.sample, draws))
        found.append((fooled[attacked.recognised].cpu(), random[attacked.recognised].cpu()))
    return Sweep(radii, *map(torch.stack, zip(*found, strict=True)))


def within(settings: AttackSettings, radii: Mapping[str, float]) -> AttackSettings:
    """The settings with radii by kind."""
    kinds: dict[str, Any] = {name: replace(kind, radius=radii[name]) for name, kind in settings.kinds.items()}
    return replace(settings, **kinds)
