"""The augmentation service: fresh labelled renders, made against the current weights whenever they are asked for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from augment import processes
from augment.build import Shown, build_scene
from augment.descent import AttackResult, Part, descend_in_parts
from augment.goal import NO_CLASS, Goal
from augment.labels import is_right, label_loss, require_known
from augment.memory import BatchSize
from augment.model_state import as_found
from augment.parameters import Lighting
from augment.perturbation import Perturbation
from augment.phases import Phases
from augment.scene import Conditions, Scene
from augment.seeding import generator, stream_seed
from augment.service_settings import AugmentationSettings
from augment.specimens import Specimens, choose_specimens
from augment.variation import vary
from renderer.arguments import checked, require_fields
from renderer.errors import InputError, require_range
from renderer.lights import perturb

if TYPE_CHECKING:
    from jaxtyping import Float, Int


@dataclass(frozen=True)
class Renders(Dataset[tuple[Tensor, int]]):
    """Labelled examples: images in [0, 1], labels, and diagnostics as plain numbers.

    specimens: a few of those that fool, with what they were before; None where that is not known any more.
    As a data set, pairs of an image on the CPU and its label as a number: `data + renders` is both.
    """

    images: Float[Tensor, "E 3 H W"]
    labels: Int[Tensor, " E"]
    diagnostics: Mapping[str, float]
    specimens: Specimens | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: int) -> tuple[Tensor, int]:
        return self.images[index].cpu(), int(self.labels[index])


@dataclass(eq=False, repr=False)
class AugmentationService:
    """Holds the scene and, where lights continue, the adversaries' values from one regeneration to the next.

    Where several processes train together, each attacks its share of the examples, and all get all renders.
    scene: None where nothing is rendered; one view per example. labels: (E,) int64, see `augment.labels`.
    label: the class that is to be told from look-alikes, the examples of all other labels: attacks light these
    towards it. None: every attack leads away from the example's own class.
    """

    settings: AugmentationSettings
    scene: Scene | None
    labels: Tensor
    seed: int
    phases: Phases
    label: int | None = None
    _continued: Tensor | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        require_fields(self)
        settings = self.settings
        if self.scene is None and settings.renders:
            raise InputError(f"augment.arm={settings.arm} renders augment.examples={settings.examples}: give a scene")

    @classmethod
    @checked
    def from_meshes(
        cls,
        meshes: Sequence[tuple[Shown, int]],
        size: int,
        settings: AugmentationSettings | None = None,
        *,
        views: int = 10,
        backgrounds: Sequence[float | str | Path] = (0.0, 0.25, 0.5, 0.75, 1.0),
        seed: int = 0,
        device: torch.device | str = "cpu",
        **of_scene: Any,
    ) -> AugmentationService:
        """For any training loop: meshes × views × backgrounds renders, as the paper has them unless told otherwise.

        meshes: (file, solid:NAME or `Mesh`; the index of its class) each. size: pixels per side. of_scene: further
        arguments of `build_scene`; as in the paper, 8 × 8 samples per pixel and flat shading are the default.
        """
        named = [(mesh, str(label)) for mesh, label in meshes]
        choices = {"samples": 8, "normals": "flat", "backgrounds": backgrounds, "device": device, **of_scene}
        scene = build_scene(named, size, views, **choices)
        labels = torch.tensor([int(label) for label in scene.labels], device=device)
        settings = replace(settings or AugmentationSettings(), examples=len(scene))
        return cls(settings, scene, labels, seed, Phases(device))

    def __len__(self) -> int:
        """Examples per regeneration."""
        return len(self.labels) if self.settings.renders else 0

    @checked
    def regenerate(self, model: nn.Module, number: int) -> Renders:
        """Fresh examples for the model's current weights; the model is left as it was found.

        number: counts the regenerations of a run from 0. The draw depends on it and the seed alone, so a resumed run
        repeats it.
        """
        require_range("number", number, 0, math.inf)
        if self.scene is None or not self.settings.renders:
            return Renders(torch.zeros(0, 3, 1, 1), self.labels[:0], {})
        random = self.settings.arm == "random"
        lights = self.settings.random.candidates if random else 1
        scene = vary(self.scene, self.settings.vary, generator(self.seed, number, "rows"), lights)
        make = self._random if random else self._adversarial
        return make(model, self.settings.attack.problem(scene), number)

    def state_dict(self) -> dict[str, Tensor]:
        """The adversaries' values (E, D), where they continue; empty otherwise."""
        return {} if self._continued is None else {"values": self._continued.cpu()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` gave; InputError where it is from another number of examples or an old version."""
        if not state:
            return
        if "values" not in state:
            raise InputError("the checkpoint continues lights as an older version kept them: resume with that version")
        if len(state["values"]) != len(self.labels):
            raise InputError(
                f"augment.examples: the checkpoint continues {len(state['values'])} examples and the scene has "
                f"{len(self.labels)}; resume with the settings of the run"
            )
        self._continued = state["values"].to(self.labels.device)

    def _random(self, model: nn.Module, problem: Perturbation, number: int) -> Renders:
        values = self._perturbed(problem, number)
        images = problem.images(values)[:, 0]
        with as_found(model), torch.no_grad(), self.phases("attack_classifier"):
            batches = BatchSize(self.settings.attack.batch_size).map(lambda part: model(images[part]), len(images))
            logits = torch.cat(list(batches))
        labels = self.labels.repeat(self.settings.random.candidates)
        require_known(labels, logits)
        fooled, losses = ~is_right(logits.argmax(1), labels), label_loss(logits, labels)
        worst = losses.unflatten(0, (-1, len(self))).argmax(0) * len(self) + torch.arange(len(self)).to(labels)
        diagnostics = {"fooled": _mean(fooled[worst]), "loss": _mean(losses[worst])}
        kept = torch.zeros_like(fooled).index_fill(0, worst, True)
        specimens = choose_specimens(model, problem, values, fooled & kept, labels)
        return Renders(images[worst], self.labels, diagnostics | _changes(problem, values), specimens)

    def _adversarial(self, model: nn.Module, problem: Perturbation, number: int) -> Renders:
        attack, goal = self.settings.attack, self._goal()
        mine = processes.share(len(problem.start)).to(problem.start.device)
        part = Part(problem, mine, self._start(problem, number)[mine])
        draws = generator(self.seed, number, "restart")
        restarts = (problem.sample(draws)[mine] for _ in range(attack.restarts))
        seen = attack.observed(model, stream_seed(self.seed, number))
        result = descend_in_parts(seen, part, goal.of(mine), attack, self.phases, restarts, problem.scene.at_once)
        result = result.merged(mine, len(problem.start))
        if self.settings.lights == "continue":
            self._continued = result.values
        diagnostics = self._attack_diagnostics(result) | _changes(problem, result.values)
        newly_fooled = result.fooled & ~result.fooled_before
        specimens = choose_specimens(model, problem, result.values, newly_fooled, self.labels)
        return Renders(result.images[:, 0], self.labels, diagnostics, specimens)

    def _goal(self) -> Goal:
        if self.label is None:
            return Goal(self.labels[:, None])
        decrease = torch.where(self.labels < 0, NO_CLASS, self.labels)
        increase = torch.where(self.labels == self.label, NO_CLASS, self.label)
        return Goal(decrease[:, None], increase[:, None])

    def _start(self, problem: Perturbation, number: int) -> Tensor:
        if self._continued is not None:
            return self._continued
        return self._perturbed(problem, number) if self.settings.start == "random" else problem.start

    def _perturbed(self, problem: Perturbation, number: int) -> Tensor:
        """Random values (E, D), within the norm-balls."""
        random, drawn = self.settings.random, []
        for kind, start in zip(problem.kinds, problem.split(problem.start), strict=True):
            if isinstance(kind, Lighting):
                none = torch.zeros(start.shape[1] // 3, 3, dtype=start.dtype)
                draws = generator(self.seed, number, "lights")
                offsets = perturb(none, len(start), random.amplitude, random.radius, draws)
                drawn.append(start + offsets.flatten(1).to(start))
            else:
                drawn.append(kind.sample(generator(self.seed, number, kind.name), problem.everything).to(start))
        return problem.project(torch.cat(drawn, dim=1), problem.everything)

    def _attack_diagnostics(self, result: AttackResult) -> dict[str, float]:
        attack = self.settings.attack
        return {
            "fooled_before": _mean(result.fooled_before),
            "fooled": _mean(result.fooled),
            "steps": _mean(result.steps),
            "used_all_steps": _mean(result.steps == attack.max_steps * (1 + attack.restarts)),
            "loss_before": -_mean(result.cost_before),
            "loss": -_mean(result.cost),
            "zero_gradient": _mean(result.zero_gradient),
        }


def _changes(problem: Perturbation, values: Tensor) -> dict[str, float]:
    """The mean L2 norm of what changed of each condition, and the share of values that are clamped."""
    before, after = (problem.conditions(each, problem.everything) for each in (problem.start, values))
    changes = {
        f"{part.name}_change": _mean((value - getattr(before, part.name)).flatten(1).norm(dim=1))
        for part in fields(Conditions)
        if (value := getattr(after, part.name)) is not None
    }
    return changes | {"clamped": _mean(problem.scene.clamped_share(after, problem.everything))}


def _mean(values: Tensor) -> float:
    return float(values.double().mean())
