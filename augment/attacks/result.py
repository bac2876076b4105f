"""The result of an attack, with figures and animations of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import ImageOps
from torch import Tensor

from augment.attack_settings import AttackSettings
from augment.attacks.loop import Minimum
from augment.attacks.objective import Objective
from augment.attacks.problem import SceneProblem
from augment.classifier import TaskNetwork
from augment.scene.objects import Conditions
from augment.tasks.classification import ClassCriterion, Classification
from augment.tasks.task import Criterion
from renderer.errors import ShortRepr, as_path, require_choice, require_kind, require_whole
from renderer.io.images import PAPER, draw_grid, tiles_of, write_image
from renderer.light.basis import Basis
from renderer.rendering import light_sphere

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Pixels per side of the white ball with which `AttackResult.plot` shows the light.
BALL_SIZE = 96
# Largest number of classes in its bar chart. The most probable classes are drawn.
SHOWN_CLASSES = 5
# Largest number of frames that it writes.
MAX_FRAME_COUNT = 1000
# Pixels per side of the white ball in a frame. Smaller images are enlarged by a whole factor to at
# least this width.
SIDE = 160
# Larger images are reduced to this number of pixels per side, because a .gif file takes up to a
# byte for each pixel of a frame.
MAX_SIDE = 224
# Milliseconds for which a frame is shown, except the first and the last.
FRAME_TIME = 120
# Milliseconds for which the first and the last frame of an animation are shown.
PAUSE = 1200
# What `attack` and its checks say if gradient descent finds no direction.
ZERO_GRADIENT = "the first gradient of some examples is zero: optimizer=random_search needs none"


@dataclass(frozen=True, repr=False)
class AttackResult(ShortRepr):
    """Result of an attack on E examples of V views, with a classifier of C classes.

    `nb.check`, `nb.success_by_radius`, `nb.transfer` and `nb.save` take it as
    an argument.

    Attributes:
        problem: The attacked scene, and the parameters that were changed.
        classifier: The attacked classifier, without the rounding to 8 bits.
        criterion: Source and target class of each view.
        settings: Settings of the attack.
        seed: Seed of the attack.
        images_in_views_before: Images before the attack, in [0, 1] and not
            rounded, shape (E, V, 3, height, width).
        images_in_views: Images after the attack, with the same shape and range.
            Their shadows and bounces are those of the attacked shape and colors.
        evidence_in_views_before: How strongly each class is found in the
            preprocessed images before the attack, shape (E, V, K). These are
            the logits of a classifier.
        evidence_in_views: The same after the attack.
        success_in_views: Whether each view meets the criterion without noise and
            in each draw of sensor noise, shape (E, V), bool.
        minimum: Result of the optimizer, before the final images are rendered. If
            the attack changes shape or colors, the images of the search have
            the shadows and bounces of the original shape. `minimum.success` is
            the success of these images without noise.
        queries: Number of images of each example that the attack evaluated, (E,)
            int64. Images with sensor noise, which decide about successes, are
            included, and so are images that a classifier without gradients does
            not get again.
        seconds: Seconds of the attack in total, and of its parts by name.
    """

    problem: SceneProblem
    classifier: TaskNetwork
    criterion: Criterion
    settings: AttackSettings
    seed: int
    images_in_views_before: Tensor
    images_in_views: Tensor
    evidence_in_views_before: Tensor
    evidence_in_views: Tensor
    success_in_views: Tensor
    minimum: Minimum
    queries: Tensor
    seconds: dict[str, float]

    @property
    def images_before(self) -> Tensor:
        """Images before the attack in [0, 1], one row for each example.

        The shape is (E, V, 3, height, width), or (E, 3, height, width) if an example has one view.
        """
        return self.images_in_views_before.squeeze(1)

    @property
    def images(self) -> Tensor:
        """Images after the attack in [0, 1], one row for each example.

        The shape is (E, V, 3, height, width), or (E, 3, height, width) if an example has one view.
        """
        return self.images_in_views.squeeze(1)

    @property
    def logits_in_views_before(self) -> Tensor:
        """Logits of a classifier before the attack, shape (E, V, C)."""
        return self._logits(self.evidence_in_views_before)

    @property
    def logits_in_views(self) -> Tensor:
        """Logits of a classifier after the attack, shape (E, V, C)."""
        return self._logits(self.evidence_in_views)

    def _logits(self, evidence: Tensor) -> Tensor:
        """Return evidence that consists of logits."""
        if not isinstance(self.criterion, ClassCriterion):
            raise AttributeError(f"an attack on {self.classifier.task} has no logits")
        return evidence

    @property
    def logits_before(self) -> Tensor:
        """Logits of the C classes before the attack, one row for each example.

        The shape is (E, V, C), or (E, C) if an example has one view.
        """
        return self.logits_in_views_before.squeeze(1)

    @property
    def logits(self) -> Tensor:
        """Logits of the C classes after the attack, one row for each example.

        The shape is (E, V, C), or (E, C) if an example has one view.
        """
        return self.logits_in_views.squeeze(1)

    def objective(self) -> Objective:
        """Return the objective of the attack."""
        return Objective(self.classifier, self.criterion, self.settings, self.seed)

    @property
    def success(self) -> Tensor:
        """Return a mask of the examples for which the attack succeeded, shape (E,).

        All views of the example meet the criterion, also with sensor noise. Before the attack,
        the example did not meet it.
        """
        return self.success_in_views.all(1) & ~self.success_before

    @property
    def success_without_noise(self) -> Tensor:
        """Return a mask of the examples for which the attack succeeded without noise, shape (E,).

        All views of the example meet the criterion in their images without sensor noise. Before
        the attack, the example did not meet it.
        """
        predicted = self.criterion.predicted(self.evidence_in_views)
        return self.criterion.reached(predicted) & ~self.success_before

    @property
    def success_with_margin(self) -> Tensor:
        """Return a mask of the successful examples with a sufficient gap, shape (E,).

        The gap, see `Criterion.gap`, is at least `settings.margin` in all views.
        """
        gaps = self.criterion.gap(self.evidence_in_views)
        return self.success & (gaps >= self.settings.margin).all(1)

    @property
    def success_before(self) -> Tensor:
        """Return a mask of the examples that cannot succeed, shape (E,).

        They met the criterion before the attack, or a view did not find their object.
        """
        reached = self.criterion.reached(self.criterion.predicted(self.evidence_in_views_before))
        return reached | ~self.clean_correct if self.criterion.needs_truth else reached

    @property
    def clean_correct(self) -> Tensor:
        """Return a mask of the examples that were classified correctly before the attack.

        All views of such an example are correct. Success rates count only these examples. Shape
        (E,).
        """
        return self._is_found_before.all(1)

    @property
    def _is_found_before(self) -> Tensor:
        """Return a mask of the views in which the true class was found before the attack."""
        return self.criterion.predicted(self.evidence_in_views_before) == self.criterion.source

    @property
    def steps(self) -> Tensor:
        """Number of steps of each example, (E,) int64."""
        return self.minimum.steps

    @property
    def backward_passes(self) -> Tensor:
        """Number of images of each example whose gradient was computed, shape (E,), int64."""
        return self.minimum.backward_passes

    @property
    def conditions(self) -> Conditions:
        """Light, shape, colors and pose of the E examples after the attack."""
        return self.problem.conditions(self.minimum.values, self.problem.all_examples)

    def plot(self, example: int | None = None, view: int | None = None) -> Figure:
        """Draw a view of an example as a figure with four parts.

        The parts are the image before the attack, a white ball in the attacked
        light, the image after the attack, and the probabilities of the true
        class and of the most probable classes before and after.

        Args:
            example: Index of the example. None for the first one with a view
                that was correct before the attack and that the attack fooled.
                If there is none, it is the first that was correct before, or
                else 0.
            view: Index of the view. None chooses it in the same way.

        Returns:
            Figure of matplotlib. `figure.savefig(path)` writes it.

        Raises:
            InputError: If there is no such example or view.
        """
        from matplotlib.figure import Figure  # This import takes half a second.

        example, view = self._shown_view(example, view)
        classes = self.classifier.classes
        # Evidence of the view before and after the attack, shape (2, K).
        parts = (self.evidence_in_views_before, self.evidence_in_views)
        evidence = torch.stack([part[example, view] for part in parts])
        before_title, after_title = self._titles(evidence, example, view)
        light, basis = self.light(self.minimum.values, example)
        pictures = {
            f"before: {before_title}": self.drawn(self.images_in_views_before[example, view]),
            "light after the attack": light_sphere(light, BALL_SIZE, basis=basis),
            f"after: {after_title}": self.drawn(self.images_in_views[example, view]),
        }
        figure = Figure(figsize=(10, 2.6), layout="constrained")
        *panels, chart = figure.subplots(1, 4, width_ratios=[1, 1, 1, 1.2])
        for axes, (title, image) in zip(panels, pictures.items(), strict=True):
            # NumPy has no bfloat16.
            pixels = image.permute(1, 2, 0).clamp(0, 1).float().cpu().numpy()
            axes.imshow(pixels, interpolation="nearest")
            axes.set_title(title, fontsize=9)
            axes.axis("off")

        before, after = self.classifier.task.confidences(evidence.cpu()).float()
        # Order the classes by the larger of their two probabilities.
        shown = before.maximum(after).topk(min(SHOWN_CLASSES, len(classes))).indices
        true_class = int(self.criterion.source[example, view])
        if true_class not in shown:
            shown[-1] = true_class
        # matplotlib draws bars from the bottom to the top, so the most probable class comes last.
        ranked = shown.flip(0)
        heights = np.arange(len(ranked))
        chart.barh(heights + 0.2, before[ranked].numpy(), 0.4, color="#4c78a8", label="before")
        chart.barh(heights - 0.2, after[ranked].numpy(), 0.4, color="#e45756", label="after")
        chart.set_yticks(heights, [classes[index] for index in ranked.tolist()], fontsize=8)
        chart.set_xlim(0, 1)
        chart.set_xlabel(self.classifier.task.confidence, fontsize=8)
        chart.legend(fontsize=8, loc="lower right")
        return figure

    def _repr_png_(self) -> bytes:
        """Return `plot()` as a PNG file, which notebooks display."""
        content = BytesIO()
        self.plot().savefig(content, format="png")
        return content.getvalue()

    def _shown_view(self, example: int | None, view: int | None) -> tuple[int, int]:
        """Return an example and a view, where None is replaced by what shows the attack best."""
        example_count, view_count = self.images_in_views.shape[:2]
        was_correct = self._is_found_before
        # 2 for views that the attack turned from correct to wrong, 1 for others that were correct.
        scores = was_correct * (1 + self.success_in_views.to(was_correct.device).int())
        # The score of a given example or view is the highest.
        if example is not None:
            require_whole("example", example, 0, example_count - 1)
            scores[example] += 3
        if view is not None:
            require_whole("view", view, 0, view_count - 1)
            scores[:, view] += 3
        # The index of the first highest score in the flat list is example · V + view.
        return divmod(int(scores.argmax()), view_count)

    def save_animation(
        self, path: str | Path, example: int = 0, view: int = 0, frame_count: int = 20
    ) -> None:
        """Save how one view changes from the scene's light to the adversarial light.

        Every frame shows the image, its predicted class with its probability,
        and a white ball in the light. The values that the attack found (light,
        shape, colors or pose) are interpolated linearly, so the frames between
        the first and the last are not steps of the search.

        Args:
            path: File to write, with the suffix .gif or .webp.
            example: Index of the example.
            view: Index of the view.
            frame_count: Number of frames, from 2 to 1000. With 20 frames, the
                file has at most 2 MB.

        Raises:
            InputError: If the suffix is another, or if there is no such example
                or view.
            OSError: If the file cannot be written.

        Example:
            >>> from pathlib import Path
            >>> import torch
            >>> import norm_balls as nb
            >>> def logits(images):
            ...     mean = images.mean((1, 2, 3))
            ...     return torch.stack([mean, 0.3 + 0 * mean], dim=1)
            >>> scene = nb.build_scene([("solid:orange", "0")], 8)
            >>> settings = nb.AttackSettings(lighting=nb.StepSettings(step_size=0.5), max_steps=2)
            >>> result = nb.attack(logits, scene, settings=settings)
            >>> result.save_animation("attack.gif", frame_count=4)
            >>> Path("attack.gif").exists()
            True
        """
        path = as_path("path", path)
        require_choice("path: its suffix", path.suffix.lower(), (".gif", ".webp"))
        example, view = self._shown_view(example, view)
        require_whole("frame_count", frame_count, 2, MAX_FRAME_COUNT)
        start = self.problem.start
        change = self.minimum.values.to(start) - start
        examples = self.problem.all_examples[[example]]
        # The first and the last frame are the images of the result itself.
        ends = {0: self.images_in_views_before, frame_count - 1: self.images_in_views}
        images, evidence, balls = [], [], []
        for index in range(frame_count):
            values = start + index / (frame_count - 1) * change
            is_end = index in ends
            rendered = ends[index][examples] if is_end else self.problem.images(values, examples)
            images.append(self.drawn(rendered[0, view]))
            objective = self.objective().select(examples)
            objective = objective.moved(self.problem, values[examples], examples)
            evidence.append(objective.evidence(rendered)[0, view])
            light, basis = self.light(values, example)
            balls.append(light_sphere(light, SIDE, basis=basis))
        titles = self._titles(torch.stack(evidence), example, view)
        shown = torch.stack(images).float()
        # Shrink large images, so that the file stays small.
        scale = MAX_SIDE / max(shown.shape[-2:])
        if scale < 1:
            size = [max(1, round(scale * side)) for side in shown.shape[-2:]]
            shown = torch.nn.functional.interpolate(shown, size, mode="bilinear", antialias=True)
        tiles = tiles_of(shown.cpu(), [(title,) for title in titles], SIDE)
        ball_tiles = tiles_of(balls, [("light",)] * frame_count, SIDE)
        frames = [draw_grid([pair]) for pair in zip(tiles, ball_tiles, strict=True)]
        # All frames get the same size, by empty space at the right and the bottom.
        width, height = np.max([frame.size for frame in frames], axis=0).tolist()
        first, *others = (
            ImageOps.expand(frame, (0, 0, width - frame.width, height - frame.height), PAPER)
            for frame in frames
        )
        times = [PAUSE, *[FRAME_TIME] * (frame_count - 2), PAUSE]
        write_image(path, first, save_all=True, append_images=others, duration=times, loop=0)

    def drawn(self, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
        """Draw what the network finds in an image, such as boxes, on the image."""
        task = self.classifier.task
        if isinstance(task, Classification):
            return image
        with torch.no_grad():
            [output] = self.objective().model(image[None])
        return task.draw(image, output, self.classifier.classes)

    def predictions(
        self, evidence: Float[Tensor, "V K"], example: int, when: str = "", views: Any = ...
    ) -> dict[str, Any]:
        """Return what the network finds in all or some views of an example, for a JSON file.

        `Task.found` explains the keys. Tasks with objects also have the confidence of the true
        class.
        """
        task = self.classifier.task
        criterion = self.criterion.map(lambda rows: rows[example][views])
        found = task.found(evidence, criterion.predicted(evidence), self.classifier.classes, when)
        if criterion.needs_truth:
            of_label = task.confidences(evidence).gather(1, criterion.source[:, None])[:, 0]
            found[f"label_confidence{when}"] = of_label.tolist()
        return found

    def _titles(self, evidence: Float[Tensor, "F K"], example: int, view: int) -> list[str]:
        """Write what is found in frames of a view, with its confidence, such as "orange 97%"."""
        found = self.predictions(evidence, example, views=[view] * len(evidence))
        pairs = zip(found["predicted"], found["confidence"], strict=True)
        return [f"{name} {confidence:.0%}" for name, confidence in pairs]

    def light(self, values: Float[Tensor, "E D"], example: int) -> tuple[Tensor, Basis]:
        """Return coefficients and basis of the light of an example with some attack values."""
        examples = self.problem.all_examples[[example]]
        conditions = self.problem.conditions(values[examples], examples)
        # `conditions` contain one example only, at index 0.
        return conditions.light[0], self.problem.scene.basis_under(conditions, 0)


def require_result(result: object) -> None:
    """Check that a value is the result of an attack."""
    require_kind("result", result, AttackResult, "the result of norm_balls.attack")


def warnings(checks: Mapping[str, Any]) -> list[str]:
    """Return reasons to doubt the strength of an attack, as one sentence each."""
    success = checks["success"]
    reasons = {
        "most successes are lost with sensor noise, and a larger margin helps": (
            checks["success_without_noise"] - success > success
        ),
        "random search does as well or better": 0 < success <= checks["random_search"],
        # The following two are fractions of the examples.
        "the attack did not lower the cost of some examples": checks["cost_fell"] < 1,
        ZERO_GRADIENT: checks["zero_gradient"] > 0,
    }
    return [reason for reason, is_given in reasons.items() if is_given]
