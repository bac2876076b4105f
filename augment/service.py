"""Fresh labeled renders for a training loop, attacked with the weights that the network has at the moment."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from augment import distributed
from augment.attacks.attack import fooled_in_views, logits_of, warn_of_changed_light
from augment.attacks.descent import DescentResult, Goal, descend
from augment.attacks.eot import preprocessed_model
from augment.attacks.problem import AttackProblem, build_problem
from augment.classifiers.adapter import NetworkCall
from augment.losses import NO_CLASS, is_right, label_loss, require_known
from augment.model_passes import as_found
from augment.progress import Phases
from augment.random_streams import generator, stream_seed
from augment.scene.build import Shown, build_scene
from augment.scene.conditions import Conditions
from augment.scene.degree import with_needed_degree
from augment.scene.scene import Scene
from augment.scene.variation import vary
from augment.settings import AugmentationSettings
from renderer.errors import InputError, describe
from renderer.image import to_unit
from renderer.light.basis import HARMONICS, Basis
from renderer.light.presets import perturb
from renderer.validation import (
    as_array,
    as_integers,
    as_list,
    as_tensor,
    require_kind,
    require_seed,
    require_whole,
)

SHOWN_EXAMPLES = 4  # of an attack, to look at
CLASSIFIED = 250  # of random renders, for diagnostics: a success rate within .06


@dataclass(frozen=True)
class AttackExamples:
    """S successful examples of a regeneration, before the attack and after it.

    images: (2, S, 3, H, W) in [0, 1]. lights: (2, S, basis.size, 3). predictions: (2, S, C) probabilities.
    """

    images: Tensor
    lights: Tensor
    predictions: Tensor
    labels: Tensor
    basis: Basis = HARMONICS

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True)
class Renders(Dataset[tuple[Tensor, int]]):
    """Labeled examples. As a data set, it holds pairs of an image on the CPU and a label.

    With data of the same kind, `data + renders` is both. A data set with labels
    as tensors, such as a `TensorDataset`, needs them as numbers for that, since
    PyTorch's `DataLoader` makes a batch of one kind of labels.

    Attributes:
        images: Images in [0, 1], shape (E, 3, H, W).
        labels: Labels, shape (E,), int64.
        diagnostics: Plain numbers about the regeneration.
        attack_examples: A few successful examples with what they were before
            the attack. None if nothing is rendered.

    Example:
        >>> tensors = torch.utils.data.TensorDataset(torch.rand(2, 3, 8, 8), torch.tensor([0, 1]))
        >>> data = [(image, int(label)) for image, label in tensors]
        >>> renders = Renders(torch.rand(1, 3, 8, 8), torch.tensor([2]), {})
        >>> both = torch.utils.data.ConcatDataset([data, renders])
        >>> [(images, labels)] = torch.utils.data.DataLoader(both, batch_size=3)
        >>> labels
        tensor([0, 1, 2])
    """

    images: Tensor
    labels: Tensor
    diagnostics: Mapping[str, float]
    attack_examples: AttackExamples | None = None

    def __len__(self) -> int:
        """Return the number of examples."""
        return len(self.labels)

    def __getitem__(self, index: int) -> tuple[Tensor, int]:
        """Return an image (3, H, W) in [0, 1] on the CPU, and its label."""
        return self.images[index].cpu(), int(self.labels[index])


@dataclass(eq=False, repr=False)
class AugmentationService:
    """The scene and, with `warm_start`, the attack's values from one regeneration to the next.

    scene: with one view per example; None where nothing is rendered. labels: (E,) int64, see `augment.losses`.
    studied: the classes that hard negatives, the examples of all other labels, are attacked towards, in turn.
    Without any, every attack leads away from the example's own class. rank, world_size: of this process among those
    that train together; each attacks its shard of the examples, and all get all renders. images: (E, 3, H, W)
    uint8, of arm="folder".
    """

    settings: AugmentationSettings
    scene: Scene | None
    labels: Tensor
    seed: int
    phases: Phases
    studied: Sequence[int] = ()
    rank: int = 0
    world_size: int = 1
    images: Tensor | None = None
    _last_values: Tensor | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        require_kind("settings", self.settings, AugmentationSettings, "augment.AugmentationSettings(...)")
        require_seed("seed", self.seed)
        require_kind("scene", self.scene, Scene | None, "the scene of build_scene, or None")
        require_kind("phases", self.phases, Phases, "augment.progress.Phases()")
        self.labels = as_integers("labels", self.labels)
        self.studied = [int(label) for label in as_integers("studied", self.studied)]
        if self.scene is not None and self.labels.shape != (len(self.scene),):
            raise InputError(
                f"labels has shape {tuple(self.labels.shape)}: give one of each of {len(self.scene)} examples"
            )
        if self.images is not None:
            if not isinstance(self.images, Tensor):
                self.images = torch.from_numpy(as_array("images", self.images))
            if self.images.dtype != torch.uint8 or self.images.shape[:2] != (len(self.labels), 3):
                raise InputError(f"images is {describe(self.images)}: give bytes (E, 3, H, W), one for each label")
        source = "images" if self.settings.arm == "folder" else "scene"
        if self.settings.renders and getattr(self, source) is None:
            raise InputError(
                f"{source} is None, and arm={self.settings.arm} needs examples: give a scene, or images for a folder"
            )
        attack = self.settings.attack
        if self.scene is not None and self.settings.renders:
            self.scene = with_needed_degree(self.scene, attack.material, self.settings.vary.gloss)
            if not attack.allow_negative:
                warn_of_changed_light(self.scene, build_problem(attack, self.scene).scene)

    @classmethod
    def from_meshes(
        cls,
        meshes: Sequence[tuple[Shown, int]],
        size: int,
        settings: AugmentationSettings | None = None,
        *,
        seed: int = 0,
        **of_scene: Any,
    ) -> AugmentationService:
        """A service for any training loop: meshes × views × backgrounds renders, as in the paper by default.

        meshes: pairs of a file, solid:NAME or `Mesh`, and the index of its class. size: pixels per side. of_scene:
        further arguments of `build_scene`, by default the paper's: 10 views, 5 grays, 8 × 8 samples and flat shading.

        >>> service = AugmentationService.from_meshes([("solid:orange", 0), ("solid:apple", 1)], 8, views=1, samples=1)
        >>> model = nn.Sequential(nn.Flatten(), nn.Linear(3 * 8 * 8, 2))
        >>> service.regenerate(model, number=0).images.shape
        torch.Size([10, 3, 8, 8])
        """
        require_kind("settings", settings, AugmentationSettings | None, "augment.AugmentationSettings(...) or None")
        require_seed("seed", seed)
        expected = "a list of pairs of a mesh and the index of its class, such as ('solid:orange', 53)"
        members = as_list("meshes", meshes, tuple | list, expected)
        for index, member in enumerate(members):
            if len(member) != 2:
                raise InputError(f"meshes[{index}] is {describe(member)}: give {expected}")
            require_whole(f"meshes[{index}]: its label", member[1])
        named = [(mesh, str(label)) for mesh, label in members]
        paper: dict[str, Any] = {"views": 10, "samples": 8, "normals": "flat"}
        paper["backgrounds"] = [0.0, 0.25, 0.5, 0.75, 1.0]
        settings = settings or AugmentationSettings()
        scene = build_scene(named, size, attack=settings.attack, vary=settings.vary, **paper | of_scene)
        labels = torch.tensor([int(label) for label in scene.labels], device=scene.lights.device)
        settings = replace(settings, examples=len(scene))
        return cls(settings, scene, labels, seed, Phases(labels.device))

    def __len__(self) -> int:
        """Examples per regeneration."""
        if self.images is None:
            return len(self.labels) if self.settings.renders else 0
        return len(self.labels) if self.settings.examples is None else self.settings.examples

    def regenerate(self, model: nn.Module, number: int) -> Renders:
        """Fresh examples for the model's current weights; the model keeps its mode, gradients and random state.

        model: images (N, 3, size, size) in [0, 1] → logits. number: counts a run's regenerations from 0. The draw
        depends on it and on the seed alone, so a resumed run repeats it. InputError: a label that has no logit.
        """
        require_kind("model", model, nn.Module, "a torch.nn.Module from images to logits")
        require_seed("number", number)
        model = CheckedNetwork(model)
        if self.images is not None and self.settings.renders:
            return self._from_folder(model, self.images, number)
        if self.scene is None or not self.settings.renders:
            return Renders(torch.zeros(0, 3, 1, 1), self.labels[:0], {})
        once = self.settings.arm == "random"
        scene = vary(self.scene, self.settings.vary, generator(self.seed, number, "rows"), once)
        make = self._random if once else self._adversarial
        shard = distributed.shard(len(scene), self.rank, self.world_size).to(scene.lights.device)
        return make(model, build_problem(self.settings.attack, scene), number, shard)

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a resumed run needs.

        Returns:
            "scene": a hash of what is shown, which `load_state_dict` compares. "values", with `warm_start` once there
            was an attack: the values (E, D) that the next attack begins with.
        """
        state = {"scene": self._scene_hash}
        return state if self._last_values is None else {**state, "values": self._last_values.cpu()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the result of `state_dict`.

        Raises:
            InputError: If the state is of a service with another scene, or is none.
        """
        expected = "the result of state_dict of a service with the same scene"
        require_kind("state", state, Mapping, expected)
        if "scene" not in state or state.keys() - {"scene", "values"}:
            raise InputError(f"state holds {', '.join(map(str, state)) or 'nothing'}: give {expected}")
        values = state.get("values")
        if values is not None:
            values = as_tensor("state", values)
            if values.ndim != 2 or len(values) != len(self.labels):
                counts = f"{len(values)} examples and the scene has {len(self.labels)}"
                raise InputError(f"state: it continues {counts}; resume with the settings of the run")
        if not torch.equal(torch.as_tensor(state["scene"]).cpu(), self._scene_hash):
            raise InputError("state is of another scene: resume with the same meshes, labels, views and light")
        self._last_values = None if values is None else values.to(self.labels.device)

    @cached_property
    def _scene_hash(self) -> Tensor:
        """Hash what is shown, to some digits, so that the same settings agree on all machines."""
        shown: list[object] = [self.labels.tolist(), list(self.studied)]
        if self.images is not None:
            shown.append(tuple(self.images.shape))
        if self.scene is not None:
            shown.append(_describe_scene(self.scene))
        return torch.tensor(list(hashlib.sha256(repr(shown).encode()).digest()), dtype=torch.uint8)

    def _from_folder(self, model: nn.Module, images: Tensor, number: int) -> Renders:
        """The images that are next in passes over the whole folder, each in an order of its own."""
        total, first = len(images), number * len(self)
        passes = range(first // total, (first + len(self) - 1) // total + 1)
        order = torch.cat([torch.randperm(total, generator=generator(self.seed, part, "folder")) for part in passes])
        rows = order[first - passes.start * total :][: len(self)].to(images.device)
        shown, labels = to_unit(images[rows]), self.labels[rows]
        return Renders(shown, labels, self._errors(model, shown, labels)[1])

    def _random(self, model: nn.Module, problem: AttackProblem, number: int, shard: Tensor) -> Renders:
        values = self._random_values(problem, number)
        images = problem.images(values, shard)[:, 0]
        images = distributed.merged(images, shard, len(self.labels), self.world_size)
        success, diagnostics = self._errors(model, images, self.labels)
        examples = choose_attack_examples(model, problem, values, success, self.labels)
        return Renders(images, self.labels, diagnostics | _changes(problem, values), examples)

    def _errors(self, model: nn.Module, images: Tensor, labels: Tensor) -> tuple[Tensor, dict[str, float]]:
        """On which of `CLASSIFIED` examples the model errs, (E,) bool, of all images (E, 3, H, W) with labels (E,); and
        how often, with the mean loss."""
        rows = torch.linspace(0, len(labels) - 1, min(CLASSIFIED, len(labels))).round().long().to(labels.device)
        with as_found(model), self.phases("attack_classifier"):
            attacked_model = preprocessed_model(self.settings.attack, model)
            logits = logits_of(attacked_model, images[rows, None], self.settings.attack.batch_size)[:, 0]
        require_known(labels, logits)
        success = ~is_right(logits.argmax(1), labels[rows], self.studied[1:])
        loss = label_loss(logits, labels[rows], absent=self.studied[1:])
        errors = torch.zeros_like(labels, dtype=torch.bool).index_copy(0, rows, success)
        return errors, {"attack_success": _mean(success), "loss": _mean(loss)}

    def _adversarial(self, model: nn.Module, problem: AttackProblem, number: int, shard: Tensor) -> Renders:
        attack, goal = self.settings.attack, Goal(self.labels[:, None])
        if self.studied:
            studied = torch.tensor(self.studied, device=self.labels.device)
            source = torch.where(self.labels < 0, NO_CLASS, self.labels)
            in_turn = studied[torch.arange(len(self.labels), device=self.labels.device) % len(studied)]
            target = torch.where(torch.isin(self.labels, studied), NO_CLASS, in_turn)
            goal = Goal(source[:, None], target[:, None])
        start = self._last_values
        if start is None:
            start = self._random_values(problem, number) if self.settings.init == "random" else problem.start
        draws = generator(self.seed, number, "restart")
        restarts = (problem.sample(draws)[shard] for _ in range(attack.restarts))
        result = descend(
            preprocessed_model(attack, model),
            problem,
            goal.of(shard),
            attack,
            self.phases,
            examples=shard,
            start=start[shard],
            restarts=restarts,
            seed=stream_seed(self.seed, number),
        )
        with as_found(model), self.phases("attack_classifier"):
            fooled = fooled_in_views(
                preprocessed_model(attack, model),
                result.images,
                result.predicted,
                shard,
                goal.of(shard),
                attack,
                stream_seed(self.seed, number),
            )
        success = fooled.all(1) | result.success_before  # as no attack was needed there
        success = distributed.merged(success, shard, len(self.labels), self.world_size)
        shards = [getattr(result, item.name) for item in fields(result)]
        result = DescentResult(*(distributed.merged(rows, shard, len(self.labels), self.world_size) for rows in shards))
        if self.settings.warm_start:
            self._last_values = result.values
        diagnostics = {
            "attack_success_before": _mean(result.success_before),
            "attack_success": _mean(success),
            "steps": _mean(result.steps),
            "used_all_steps": _mean(result.steps == attack.max_steps * (1 + attack.restarts)),
            "loss_before": -_mean(result.cost_before),
            "loss": -_mean(result.cost),
            "zero_gradient": _mean(result.zero_gradient),
        }
        if attack.sensor_noise:
            diagnostics["attack_success_without_noise"] = _mean(result.success)
        new_success = success & ~result.success_before
        examples = choose_attack_examples(model, problem, result.values, new_success, self.labels)
        return Renders(result.images[:, 0], self.labels, diagnostics | _changes(problem, result.values), examples)

    def _random_values(self, problem: AttackProblem, number: int) -> Tensor:
        random, parts = self.settings.random_light, []
        for parameter, start in problem.by_parameter(problem.start):
            if parameter.name == "lighting":
                zero = torch.zeros(start.shape[1] // 3, 3, dtype=start.dtype)
                draws = generator(self.seed, number, "lights")
                offsets = perturb(zero, len(start), random.amplitude, random.radius, draws)
                parts.append(start + offsets.flatten(1).to(start))
            else:
                parts.append(parameter.sample(generator(self.seed, number, parameter.name)).to(start))
        return problem.project(torch.cat(parts, dim=1), problem.everything)


def _describe_scene(scene: Scene) -> list[object]:
    """Describe a scene's objects, cameras, backgrounds and lights by plain values of a few digits."""
    described: list[object] = [scene.settings.size, scene.settings.encoding, str(scene.basis)]
    for item in scene.objects:
        extent = item.mesh.vertices.std(axis=0)
        counts = len(item.mesh.vertices), len(item.mesh.faces)
        described.append((item.label, item.name, counts, _rounded(extent), f"{item.albedo_scale:.3g}"))
    for example in scene.examples:
        cameras = [_rounded(list(vars(camera.fixed()).values())) for camera in example.cameras]
        described.append((example.object, example.background, f"{example.exposure:.3g}", cameras))
    backgrounds = scene.backgrounds.mean((2, 3)).flatten()
    lights = scene.lights.flatten(1).unique(dim=0).double()
    described.append(_rounded(backgrounds.tolist()))
    described.append(_rounded([*lights.sum(1).tolist(), *lights.norm(dim=1).tolist()]))
    return described


def _rounded(values: Iterable[float]) -> list[str]:
    """Write numbers with three digits, so that the rounding of a computation is not seen."""
    return [f"{float(value):.3g}" for value in values]


class CheckedNetwork(nn.Module):
    """A network of the training loop, whose outputs are refused if they cannot be logits."""

    def __init__(self, model: nn.Module):
        super().__init__()
        self.model = model
        self._call_network = NetworkCall("model")

    def forward(self, images: Tensor) -> Tensor:
        return self._call_network(self.model, images)


def choose_attack_examples(
    model: nn.Module, problem: AttackProblem, values: Tensor, success: Tensor, labels: Tensor
) -> AttackExamples:
    """Up to `SHOWN_EXAMPLES` of the examples with success (E,), evenly spaced, under values (E, D).

    The problem's examples have one view each. The model keeps its state.
    """
    rows = torch.nonzero(success).squeeze(1)
    chosen = torch.linspace(0, max(len(rows) - 1, 0), min(SHOWN_EXAMPLES, len(rows))).round().long()
    rows = rows[chosen.to(rows.device)]
    sides = [problem.conditions(end[rows], rows) for end in (problem.start, values)]
    with as_found(model), torch.no_grad():
        images = [problem.scene.render(side, rows)[:, 0] for side in sides]
        predictions = [model(side).float().softmax(1) if len(rows) else side.new_zeros(0, 0) for side in images]
    lights = torch.stack([side.light for side in sides])
    return AttackExamples(torch.stack(images), lights, torch.stack(predictions), labels[rows], problem.scene.basis)


def _changes(problem: AttackProblem, values: Tensor) -> dict[str, float]:
    """The mean L2 norm of each condition's change."""
    before, after = (problem.conditions(end, problem.everything) for end in (problem.start, values))
    return {
        f"{part.name}_change": _mean((value - getattr(before, part.name)).flatten(1).norm(dim=1))
        for part in fields(Conditions)
        if (value := getattr(after, part.name)) is not None
    }


def _mean(values: Tensor) -> float:
    return float(values.double().mean())
