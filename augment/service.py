"""Source of renders for a training loop, which are rendered again from time to time.

Each such regeneration attacks the current weights of the network, or draws the lighting at random.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from augment import distributed, network, random_streams, tasks
from augment.attacks.loop import minimize
from augment.attacks.objective import Objective, preprocessed_model
from augment.attacks.problem import SceneProblem, build_problem, warn_of_changed_light
from augment.augmentation_settings import AugmentationSettings, views_of
from augment.classifier import CheckedNetwork
from augment.progress import Phases
from augment.renders import SHOWN_EXAMPLES, AttackExamples, Renders
from augment.scene.build import MeshItem, build_scene, warn_of_exposure, with_needed_degree
from augment.scene.scene import Scene
from augment.scene.truth import NO_OBJECT, Truth
from augment.scene.vary import vary
from augment.tasks.classification import ClassCriterion, Classification, class_index
from augment.tasks.task import NO_CLASS, Criterion, Task
from renderer.errors import InputError, as_integers, require_kind, require_shape, require_whole
from renderer.image import to_unit
from renderer.light.files import perturb
from renderer.settings import Size

# Largest number of random renders that are classified to estimate the error rate. The standard
# error of this estimate is at most 0.032.
CLASSIFIED = 250


class _Made(NamedTuple):
    """Renders of E examples: their attack values, images, and numbers about both.

    `is_wrong` marks renders that figures may show. None if the network finds objects. `truth` has
    the objects in the images if it was needed.
    """

    values: Float[Tensor, "E D"]
    images: Float[Tensor, "E 3 H W"]
    diagnostics: dict[str, float]
    is_wrong: Bool[Tensor, " E"] | None = None
    truth: Truth | None = None


@dataclass(eq=False, repr=False)
class AugmentationService:
    """Source of labeled renders for a training loop.

    Each call of `regenerate` renders the examples of the scene again, attacked
    with the current weights of the network or in random lighting. With
    `settings.warm_start`, each attack starts at the result of the previous one.

    Attributes:
        settings: Settings of the augmentation.
        scene: Scene of E examples with one view each. None if nothing is
            rendered.
        labels: Labels of the examples, shape (E,), int64. They may be
            complementary, see `augment.attacks.objective`.
        seed: Seed of all random numbers.
        phases: Timer of the attacks.
        positive_classes: Classes that the network must tell from all others. The
            examples of other classes are attacked until they are classified as
            one of these, which take turns. If the list is empty, every example
            is attacked until it is misclassified.
        rank: Index of this process among those that train together. Each
            process attacks a part of the examples, and gets all renders.
        world_size: Number of these processes.
        images: Images of a folder that replace the renders with
            `mode="folder"`, shape (E, 3, H, W), uint8.
        task: Task of the network: classification, detection or segmentation.
            Without classification, the renders have targets, and a negative
            label stands for an object that has no class.
        classes: Names of the classes of a detector or a segmenter, in the order
            of its labels.
    """

    settings: AugmentationSettings
    scene: Scene | None
    labels: Tensor
    seed: int
    phases: Phases
    positive_classes: Sequence[int] = ()
    rank: int = 0
    world_size: int = 1
    images: Tensor | None = None
    task: Task = field(default_factory=Classification)
    classes: Sequence[str] = ()
    _last_values: Tensor | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        """Check the arguments, and raise the degree of the lighting if the settings need it."""
        expected = "nb.AugmentationSettings(...)"
        require_kind("settings", self.settings, AugmentationSettings, expected)
        require_whole("seed", self.seed)
        require_kind("scene", self.scene, Scene | None, "the scene of build_scene, or None")
        require_kind("task", self.task, Task, "a task, such as nb.Detection()")
        self.labels = as_integers("labels", self.labels)
        self.positive_classes = as_integers("positive_classes", self.positive_classes).tolist()
        if self.scene is not None:
            require_shape("labels", self.labels, len(self.scene))
            if self.scene.views > 1:
                raise InputError("scene has examples of several views: build it with shared=False")
        if self._finds_objects and self.settings.mode == "folder":
            reason = f"mode=folder has images without boxes, but the task is {self.task.name}"
            raise InputError(f"{reason}: choose random or adversarial")
        if self._finds_objects and max(self.labels.tolist(), default=-1) >= len(self.classes):
            reason = f"classes has {len(self.classes)} names, fewer than labels"
            raise InputError(f"{reason}: name all classes in the order of the network's labels")
        source = "images" if self.settings.mode == "folder" else "scene"
        if self.settings.renders and getattr(self, source) is None:
            raise InputError(f"{source} is None, but mode={self.settings.mode} needs it: give one")
        attack = self.settings.attack
        if self.scene is not None and self.settings.renders:
            self.scene = with_needed_degree(self.scene, attack, self.settings.vary.gloss)
            if not attack.allow_negative:
                warn_of_changed_light(self.scene, build_problem(attack, self.scene).scene)

    @classmethod
    def from_meshes(
        cls,
        meshes: Sequence[MeshItem | Sequence[MeshItem]],
        size: Size,
        settings: AugmentationSettings | None = None,
        *,
        seed: int = 0,
        task: Task | None = None,
        classes: Sequence[str] = (),
        **of_scene: Any,
    ) -> AugmentationService:
        """Build a source of renders for any training loop.

        There are `settings.examples` renders, as many of each mesh as possible.
        Without settings, or with `examples=None`, there is a render for each
        mesh, camera and background.

        Args:
            meshes: Pairs of a mesh and its class, by index or, with `classes`, by
                name. A mesh is a file, solid:NAME or a `Mesh`. With a task that finds objects,
                entries are those of `build_scene`: a class may have its name,
                "" and −1 stand for no class, and a list has several objects.
            size: Pixels per side of the renders, or (height, width).
            settings: Settings of the augmentation.
            seed: Seed of all random numbers.
            task: Task of the network, such as `nb.Detection()`, for which the
                renders get boxes and masks. None for classification.
            classes: Names of the classes of the network.
            of_scene: Further arguments of `build_scene`. By default, there are
                as many views as `settings.examples` needs (10 without it).
                Without `scene`, there are 5 gray backgrounds, and without
                `renderer`, 8 × 8 samples per pixel and flat shading.

        Returns:
            The service.

        Raises:
            InputError: If an argument has the wrong type, or if `build_scene`
                refuses one.

        Example:
            >>> from torch import nn
            >>> import norm_balls as nb
            >>> meshes = [("solid:orange", 0), ("solid:apple", 1)]
            >>> service = nb.AugmentationService.from_meshes(meshes, 8, views=1, samples=1)
            >>> model = nn.Sequential(nn.Flatten(), nn.Linear(3 * 8 * 8, 2))
            >>> service.regenerate(model, number=0).images.shape
            torch.Size([10, 3, 8, 8])
        """
        settings = AugmentationSettings.or_default("settings", settings)
        # Given cameras are the views themselves.
        options: dict[str, Any] = {"views": 1 if of_scene.get("cameras") else 10}
        if of_scene.get("scene") is None:
            options["backgrounds"] = [0.0, 0.25, 0.5, 0.75, 1.0]
        if of_scene.get("renderer") is None:
            options |= {"samples": 8, "normals": "flat"}
        options |= of_scene
        count = settings.examples
        if count == 0:
            raise InputError("settings.examples is 0: give the number of renders, or None")
        if count and not {"views", "cameras"} & of_scene.keys():
            of_settings = getattr(options.get("scene"), "backgrounds", ())
            backgrounds = len(options.get("backgrounds", of_settings))
            options["views"] = views_of(count, len(meshes), backgrounds)
        scene = build_scene(meshes, size, attack=settings.attack, vary=settings.vary, **options)
        scene = scene.with_count(count) if count else scene
        task = task or Classification()
        # Labels of the examples: names of classes or their indices.
        names: Sequence[Any] = scene.labels
        if isinstance(task, Classification):
            for item in scene.objects:
                if not (classes and isinstance(item.label, str)):
                    require_whole(f"meshes: the label of {item.name}", item.label)
            names = [
                class_index(classes, label, "meshes") if isinstance(label, str) else label
                for label in names
            ]
        elif classes:
            names = [_index_of(label, classes) for label in names]
        else:
            raise InputError("classes is empty: name all classes of the network")
        labels = torch.tensor(names, device=scene.lights.device)
        settings = replace(settings, examples=len(scene))
        return cls(settings, scene, labels, seed, Phases(labels.device), task=task, classes=classes)

    def __len__(self) -> int:
        """Return the number of renders that `regenerate` returns."""
        if self.images is None:
            return len(self.labels) if self.settings.renders else 0
        examples = self.settings.examples
        return len(self.labels) if examples is None else examples

    @torch.inference_mode(False)  # Attacks need autograd.
    def regenerate(self, model: nn.Module, number: int) -> Renders:
        """Make the renders for the current weights of a network.

        The mode, the gradient flags and the random state of the network are
        restored afterwards.

        Args:
            model: A network from images (N, 3, height, width) in [0, 1] to logits.
            number: How often the renders were made before in this run. The
                random numbers depend on this number and on the seed alone, so
                that a resumed run repeats them.

        Returns:
            The labeled renders.

        Raises:
            InputError: If the network fails, or has no logit for a label.
        """
        require_kind("model", model, nn.Module, "a torch.nn.Module from images to outputs")
        require_whole("number", number)
        model = self._checked(model)
        if self.images is not None and self.settings.renders:
            return self._from_folder(model, self.images, number)
        if self.scene is None or not self.settings.renders:
            return Renders(torch.zeros(0, 3, 1, 1), self.labels[:0], {})
        problem = self.problem(number)
        make = self._random if self.settings.mode == "random" else self._adversarial
        made = make(model, problem, number)
        if number == 0:
            warn_of_exposure(problem.scene)
        diagnostics = made.diagnostics | _changes(problem, made.values)
        if made.is_wrong is None:
            truth = made.truth or self._truth(problem, made.values)
            return Renders(made.images, self.labels, diagnostics, targets=truth.targets())
        # Classification has no boxes, but a few examples for figures.
        return Renders(made.images, self.labels, diagnostics, self._examples(model, problem, made))

    def _examples(self, model: nn.Module, problem: SceneProblem, made: _Made) -> AttackExamples:
        """Render and classify some examples of a successful attack, evenly spaced, for a figure."""
        assert made.is_wrong is not None
        rows = torch.nonzero(made.is_wrong).squeeze(1)
        rows = rows[network.evenly_spaced(len(rows), SHOWN_EXAMPLES).to(rows.device)]
        before = problem.conditions(problem.start[rows], rows)
        after = problem.conditions(made.values[rows], rows)
        with network.frozen_eval_mode(model), torch.no_grad():
            # Each example has one view.
            images = [problem.scene.render(one, rows)[:, 0] for one in (before, after)]
            logits = [model(one).float() if len(rows) else one.new_zeros(0, 0) for one in images]
        predictions = torch.stack(logits).softmax(2)
        lights = torch.stack([before.light, after.light])
        shown = torch.stack(images)
        return AttackExamples(shown, lights, predictions, self.labels[rows], problem.scene.basis)

    def problem(self, number: int) -> SceneProblem:
        """Vary the scene at random, and return what an attack on it may change."""
        assert self.scene is not None
        draws = random_streams.generator(self.seed, number, "rows")
        scene = vary(self.scene, self.settings.vary, draws, once=self.settings.mode == "random")
        return build_problem(self.settings.attack, scene)

    def values(self, model: nn.Module | None, problem: SceneProblem, number: int) -> Tensor:
        """Return the values of a problem with this number: random ones, or those of an attack."""
        if self.settings.mode == "random" or model is None:
            return self._random_values(problem, number)
        return self._adversarial(self._checked(model), problem, number).values

    def _checked(self, model: nn.Module) -> CheckedNetwork:
        """Return a network whose outputs the task reads and checks."""
        return CheckedNetwork(model, "model", self.task, len(self.classes) or None)

    @property
    def _finds_objects(self) -> bool:
        """Whether the network finds objects in images, whose boxes and masks are the targets."""
        return not isinstance(self.task, Classification)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the state of the service, so that a run can be resumed with it.

        Returns:
            Dictionary with these entries:
            - "scene": hash of the scene, which `load_state_dict` compares;
            - "values": only with `warm_start`: the D attack values of each
              example after the last attack, shape (E, D). The next attack
              starts there.
        """
        state = {"scene": self._scene_hash}
        if self._last_values is not None:
            state["values"] = self._last_values.cpu()
        return state

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore a state of the service.

        Args:
            state: A result of `state_dict`.

        Raises:
            InputError: If the state is not a result of `state_dict`, or if it
                belongs to a service with another scene.
        """
        stored = state.get("scene") if isinstance(state, Mapping) else None
        if stored is None or not torch.equal(torch.as_tensor(stored).cpu(), self._scene_hash):
            advice = "resume with the same meshes, labels, views and light"
            raise InputError(f"state is of another scene, or not of a service: {advice}")
        values = state.get("values") if self.settings.warm_start else None
        if values is not None and self.scene is not None:
            start = build_problem(self.settings.attack, self.scene).start
            require_shape("state['values']", values, *start.shape)
        self._last_values = None if values is None else values.to(self.labels.device)

    @cached_property
    def _scene_hash(self) -> Tensor:
        """Compute a SHA-256 hash (32 bytes) of labels, scene and image sizes.

        Numbers are rounded first, so that the same settings have the same hash on all machines.
        """
        shown: list[object] = [self.labels.tolist(), list(self.positive_classes)]
        shown += [] if self.images is None else [tuple(self.images.shape)]
        shown += [] if self.scene is None else [_describe_scene(self.scene)]
        return torch.tensor(list(hashlib.sha256(repr(shown).encode()).digest()), dtype=torch.uint8)

    def _from_folder(self, model: nn.Module, images: Tensor, number: int) -> Renders:
        """Select the next images of a folder in place of renders, and classify some of them.

        Each pass through the folder has another random order, and a selection may begin in one pass
        and end in another. `number` selections were made before.
        """
        count, image_count = len(self), len(images)
        # The same number always selects the same images, so that a resumed run repeats them.
        # Imagine all passes one after the other. The first selected image is at this position.
        first = number * count
        passes = range(first // image_count, (first + count - 1) // image_count + 1)
        draws = [random_streams.generator(self.seed, index, "folder") for index in passes]
        orders = [torch.randperm(image_count, generator=each) for each in draws]
        rows = torch.cat(orders)[first % image_count :][:count].to(images.device)
        selected = to_unit(images[rows])
        labels = self.labels[rows]
        _, diagnostics = self._classify(model, selected, labels)
        return Renders(selected, labels, diagnostics)

    def _random(self, model: nn.Module, problem: SceneProblem, number: int) -> _Made:
        """Render all examples with random values of the parameters, such as random lighting."""
        values = self._random_values(problem, number)
        # This process renders its own rows in their single view, and gets those of the others.
        own = self._own_rows(len(self.labels))
        of_all = own, len(self.labels), self.world_size
        images = distributed.all_gather_rows(problem.images(values, own)[:, 0], *of_all)
        if self._finds_objects:
            truth = self._truth(problem, values)
            return _Made(values, images, self._find(model, images, truth), truth=truth)
        is_error, diagnostics = self._classify(model, images, self.labels)
        return _Made(values, images, diagnostics, is_error)

    def _truth(self, problem: SceneProblem, values: Float[Tensor, "E D"]) -> Truth:
        """Return class, box and mask of the objects in all images, with the given attack values."""
        # Index of the class of each first object, by the label in the scene.
        known = dict(zip(problem.scene.labels, self.labels.tolist(), strict=True))

        def index_of(label: str | int) -> int:
            return known[label] if label in known else _index_of(label, self.classes)

        every = problem.all_examples
        truth = problem.scene.truth(index_of, every, problem.conditions(values, every))
        # All negative labels become −1, which stands for no class.
        return replace(truth, labels=truth.labels.clamp(min=NO_OBJECT))

    def _find(self, model: nn.Module, images: Tensor, truth: Truth) -> dict[str, float]:
        """Return the diagnostics "attack_success" and "loss" of a network that finds objects.

        The first is the fraction of up to `CLASSIFIED` images in which the first object is not
        found.
        """
        rows = self._shown(truth)
        if not len(rows):
            return {}
        rows = rows[network.evenly_spaced(len(rows), CLASSIFIED).to(rows.device)]
        criterion = self._criterion(truth, rows)
        objective = Objective(model, criterion, self.settings.attack, phases=self.phases)
        with network.frozen_eval_mode(model):
            # The new axis is that of the single view of each example.
            score, _ = objective.score(images[rows, None], needs_gradient=False)
        # An attack lowers the cost, and a training loss is its negative.
        return {"attack_success": _mean(score.is_success), "loss": -_mean(score.cost)}

    def _shown(self, truth: Truth) -> Int[Tensor, " A"]:
        """Return the examples whose first object is visible and has a class."""
        # The last two axes of `is_shown` are the views and the objects.
        return torch.nonzero((self.labels >= 0) & truth.is_shown[:, 0, 0]).squeeze(1)

    def _criterion(self, truth: Truth, rows: Int[Tensor, " A"]) -> Criterion:
        """Return the criterion that the first objects of examples are not found."""
        source = self.labels[rows, None]
        return self.task.criterion(source, lambda: truth.select(rows), len(self.classes))

    def _classify(
        self, model: nn.Module, images: Float[Tensor, "E 3 H W"], labels: Int[Tensor, " E"]
    ) -> tuple[Tensor, dict[str, float]]:
        """Classify up to `CLASSIFIED` of the images, evenly spaced, to estimate the error rate.

        Return the mask of the images known to be misclassified, and the diagnostics
        "attack_success" (their fraction) and "loss" (the mean).
        """
        rows = network.evenly_spaced(len(labels), CLASSIFIED).to(labels.device)
        with network.frozen_eval_mode(model), self.phases("attack_classifier"):
            attacked_model = preprocessed_model(self.settings.attack, model)
            batch_size = self.settings.attack.batch_size
            logits = network.compute_outputs(attacked_model, images[rows], batch_size)
        tasks.classification.require_known(labels, logits)
        # With several positive classes, an image of another class must not be classified as any of
        # them. Its complementary label stands for the first, and `absent` has the others.
        absent = self.positive_classes[1:]
        is_misclassified = ~tasks.classification.is_correct(logits.argmax(1), labels[rows], absent)
        loss = tasks.classification.label_loss(logits, labels[rows], absent=absent)
        is_error = torch.zeros_like(labels, dtype=torch.bool)
        is_error[rows] = is_misclassified
        return is_error, {"attack_success": _mean(is_misclassified), "loss": _mean(loss)}

    def _adversarial(self, model: nn.Module, problem: SceneProblem, number: int) -> _Made:
        """Attack the examples, of which each process has a part.

        Examples that show a detector no object with a class get random values instead.
        """
        attack = self.settings.attack
        seed = random_streams.stream_seed(self.seed, number)
        # Values of all examples. The results of the attack replace those of the attacked ones.
        start = values = self._attack_start(problem, number)
        # Indices of the attacked examples.
        attacked = problem.all_examples
        if self._finds_objects:
            values = self._random_values(problem, number)
            truth = self._truth(problem, start)
            attacked = self._shown(truth)
            if not len(attacked):
                return self._random(model, problem, number)
            criterion = self._criterion(truth, attacked)
        else:
            criterion = self._attack_criterion()
        # Positions of this process's part among the attacked examples, and their indices.
        own = self._own_rows(len(attacked))
        shard = attacked[own]
        objective = Objective(model, criterion.select(own), attack, seed, self.phases)
        draws = random_streams.generator(self.seed, number, "restart")
        restarts = (problem.sample(draws)[shard] for _ in range(attack.restarts))
        result = minimize(problem, objective, examples=shard, start=start[shard], restarts=restarts)
        # The attack may have moved the objects. Decide about its images with their new positions.
        objective = objective.moved(problem, result.values, shard)
        with network.frozen_eval_mode(model), self.phases("attack_classifier"):
            is_fooled = objective.fooled_in_views(result.images, result.predicted, shard)
        # Examples that are misclassified before the attack count as successes.
        of_all = own, len(attacked), self.world_size
        success = distributed.all_gather_rows(is_fooled.all(1) | result.success_before, *of_all)
        # Replace the result of this process by the results of all processes.
        result = result.map(lambda part: distributed.all_gather_rows(part, *of_all))
        values = values.index_copy(0, attacked, result.values)
        if self.settings.warm_start:
            self._last_values = values
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
        if self._finds_objects:
            # Render all examples, since the attack has images of the attacked ones only.
            return _Made(values, problem.images(values, problem.all_examples)[:, 0], diagnostics)
        return _Made(values, result.images[:, 0], diagnostics, success & ~result.success_before)

    def _own_rows(self, count: int) -> Int[Tensor, " A"]:
        """Return the indices of those of some examples that this process renders or attacks.

        With more processes than examples, several processes get the same example.
        """
        return torch.arange(self.rank % count, count, self.world_size).to(self.labels.device)

    def _attack_criterion(self) -> ClassCriterion:
        """Return the source and the target class of the attack on each example.

        If there are no positive classes (classes that the network must tell from all others), the
        attack only lowers the probability of the label. The same holds for examples of a positive
        class. All other examples are attacked towards a positive class, each class in turn.
        """
        if not self.positive_classes:
            return ClassCriterion(self.labels[:, None])
        positive_classes = torch.tensor(self.positive_classes, device=self.labels.device)
        # A negative label says which class an example does not show. Such an example has no
        # source class.
        source = torch.where(self.labels < 0, NO_CLASS, self.labels)
        indices = torch.arange(len(self.labels), device=self.labels.device)
        target = positive_classes[indices % len(positive_classes)]
        target[torch.isin(self.labels, positive_classes)] = NO_CLASS
        return ClassCriterion(source[:, None], target[:, None])

    def _attack_start(self, problem: SceneProblem, number: int) -> Float[Tensor, "E D"]:
        """Return the attack values at which the next attack starts.

        With `warm_start`, they are the values at which the previous attack ended, projected to the
        norm-balls, whose centers may have moved. With `init="random"`, they are random. Otherwise
        they are those of the scene. `number` tells how often the renders were made before.
        """
        if self._last_values is not None:
            return problem.project(self._last_values, problem.all_examples)
        if self.settings.init == "random":
            return self._random_values(problem, number)
        return problem.start

    def _random_values(self, problem: SceneProblem, number: int) -> Float[Tensor, "E D"]:
        """Draw random values of all attacked parameters. `number` selects the random numbers."""
        settings = self.settings.random_light
        parts = []
        for parameter, start in problem.split_by_parameter(problem.start):
            if parameter.name == "lighting":
                # `perturb` returns a light plus random changes. Give it a light of zero, to get
                # the changes alone.
                no_light = torch.zeros(start.shape[1] // 3, 3, dtype=start.dtype)
                draws = random_streams.generator(self.seed, number, "lights")
                offsets = perturb(no_light, len(start), settings.amplitude, settings.radius, draws)
                parts.append(start + offsets.flatten(1).to(start))
            else:
                draws = random_streams.generator(self.seed, number, parameter.name)
                parts.append(parameter.sample(draws).to(start))
        return problem.project(torch.cat(parts, dim=1), problem.all_examples)


def _index_of(label: str | int, classes: Sequence[str]) -> int:
    """Return the index of the class of an object, which "" and −1 say to have none."""
    return NO_OBJECT if label in ("", NO_OBJECT) else class_index(classes, label, "meshes")


def _describe_scene(scene: Scene) -> list[object]:
    """Return texts and rounded numbers about a scene that are the same on all machines."""
    objects = []
    for item in scene.objects:
        counts = (len(item.mesh.vertices), len(item.mesh.faces))
        extent = _rounded(item.mesh.vertices.std(axis=0))
        objects.append((str(item.label), item.name, counts, extent, f"{item.albedo_scale:.3g}"))
    examples = []
    for example in scene.examples:
        cameras = [_rounded(vars(camera.fixed()).values()) for camera in example.cameras]
        examples.append((example.object, example.background, f"{example.exposure:.3g}", cameras))
    # Lights and backgrounds are described by their sums, norms and means, which identify them.
    lights = scene.lights.flatten(1).unique(dim=0).double()
    sizes = [*lights.sum(1).tolist(), *lights.norm(dim=1).tolist()]
    backgrounds = scene.backgrounds.mean((2, 3)).flatten().tolist()
    settings = [scene.settings.size, scene.settings.encoding, str(scene.basis)]
    return [*settings, *objects, *examples, _rounded(backgrounds), _rounded(sizes)]


def _rounded(values: Iterable[float]) -> list[str]:
    """Format numbers with three digits, so that rounding errors do not change the texts."""
    return [f"{float(value):.3g}" for value in values]


def _changes(problem: SceneProblem, values: Float[Tensor, "E D"]) -> dict[str, float]:
    """Compute the L2 norm of each change, such as "light_change", averaged over the examples."""
    before = problem.conditions(problem.start, problem.all_examples)
    after = problem.conditions(values, problem.all_examples)
    # Fields that are None are not attacked.
    return {
        f"{name}_change": _mean((changed - getattr(before, name)).flatten(1).norm(dim=1))
        for name, changed in vars(after).items()
        if changed is not None
    }


def _mean(values: Tensor) -> float:
    """Return the mean of all values, computed in double precision."""
    return float(values.double().mean())
