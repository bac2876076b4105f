"""Light on images that a network handles worst, found by gradient among that of random light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn
from torch.utils._pytree import tree_map_only
from torchvision import tv_tensors
from torchvision.transforms import v2

from augment.classifier import CheckedNetwork, TaskNetwork
from augment.lighting import Light, RandomLighting
from augment.network import frozen_eval_mode
from augment.scene.lights import LightModel
from augment.settings import NO_CLASS_PIXEL
from augment.tasks.classification import Classification
from augment.tasks.detection import Detection
from augment.tasks.segmentation import Segmentation
from augment.tasks.task import BACKGROUND, NO_GRADIENT, Criterion, Task
from renderer import errors
from renderer.errors import InputError
from renderer.image import require_unit_range

# A step changes each number in [0, 1] by this, divided by the number of steps.
STEP = 0.5


class AdversarialLighting:
    """Show images in light that a network handles badly.

    The light models are those of `RandomLighting`. Each image begins with a
    random light. `steps` times, each number in [0, 1] of its light takes a step
    of 0.5 / `steps` along the sign of the gradient of the task's cost. Each
    image gets the light with the lowest cost of those that were tried. The
    network sees each image in `steps` + 1 lights, and once more in unchanged
    light if there are no targets. There are `steps` backward passes.

    Args:
        model: Network from images in [0, 1] to outputs. Its mode and its
            gradient flags are restored after each call. Meanwhile, no other
            thread may use it.
        task: What its outputs mean, such as `nb.Detection()`. None for
            classification, or that of a network of `nb.load_classifier`.
        steps: Number of steps along the gradient.
        lights: Light models, as for `RandomLighting`.
        strength: Fraction of the light that is changed, in [0, 1].
        classes: Names of the classes of a detector or a segmenter.

    Attributes:
        forward_passes: Forward passes for each image with targets.
        backward_passes: Backward passes for each image.

    Raises:
        InputError: If an argument has the wrong type or range.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> model = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * 8 * 8, 2))
        >>> lighting = nb.AdversarialLighting(model, lights="cast_shadow")
        >>> images = torch.randint(256, (4, 3, 8, 8), dtype=torch.uint8)
        >>> lighting(images, torch.tensor([0, 1, 0, 1])).shape
        torch.Size([4, 3, 8, 8])
    """

    def __init__(
        self,
        model: nn.Module,
        task: Task | None = None,
        steps: int = 1,
        lights: Sequence[str | LightModel] | Mapping[Any, float] | str | None = None,
        strength: float = 1.0,
        classes: Sequence[str] = (),
    ):
        errors.require_kind("model", model, nn.Module, "a torch.nn.Module")
        errors.require_kind("task", task, Task | None, "a task, such as nb.Detection(), or None")
        errors.require_whole("steps", steps, 1)
        if isinstance(model, TaskNetwork):
            model = model if task is None else model.with_task(task)
            task, classes = model.task, model.classes
        self.model, self.task, self.steps = model, task or Classification(), steps
        if not (classes or isinstance(self.task, Classification)):
            raise InputError(f"classes is empty: name the classes of the {self.task.name} network")
        self.classes = [*classes]
        self.forward_passes, self.backward_passes = steps + 1, steps
        self.lighting = RandomLighting(lights, strength=strength)

    @torch.compiler.disable  # type: ignore[untyped-decorator, unused-ignore]
    def __call__(
        self, images: Shaped[Tensor, "N C H W"], targets: Any = None
    ) -> Shaped[Tensor, "N C H W"]:
        """Show images in light that the network handles badly.

        Args:
            images: Images, bytes or in [0, 1].
            targets: What they show: labels (N,), or a list of dictionaries with
                "boxes" and "labels", or label maps (N, H, W), in which 255 and
                negative numbers stand for no class. None for what the network
                finds in the images as they are.

        Returns:
            Images of the same dtype and size.

        Raises:
            InputError: If images or targets have another shape, if floats are far
                from [0, 1], or if a label is not that of a class.
        """
        errors.require_kind("images", images, Tensor, "a tensor (N, 3, H, W)")
        errors.require_shape("images", images, "N", 3, "H", "W")
        if images.is_floating_point() and images.numel():
            require_unit_range(images)
        is_inference = torch.is_inference_mode_enabled()
        with torch.inference_mode(False):
            if is_inference:
                # Autograd cannot save a tensor that inference mode made.
                images, targets = tree_map_only(Tensor, Tensor.clone, (images, targets))
            worst = self._search(images, targets, self.lighting.make_params([images])["lights"])
            return self.lighting.apply(images, {"lights": worst})

    def _search(
        self, images: Tensor, targets: Any, lights: list[Light | None]
    ) -> list[Light | None]:
        """Return the light of each image in which the cost of the task is lowest."""
        # None stands for unchanged light, which `RandomLighting` can draw.
        if not any(lights):
            return lights
        is_float = images.is_floating_point()
        # The gradient ends at the images, because what made them belongs to the caller.
        unit = images.detach().float() / (1 if is_float else torch.iinfo(images.dtype).max)
        # Networks of another precision get images of this precision.
        given = images.dtype if is_float else unit.dtype
        network = CheckedNetwork(self.model, "model", self.task, len(self.classes) or None)
        best, lowest = lights, torch.full((len(unit),), torch.inf, device=unit.device)
        with frozen_eval_mode(self.model):
            image_of_row, criterion = self._criterion(network, unit.to(given), targets)
            if not len(image_of_row):
                return lights
            rows = image_of_row.tolist()
            # The last light needs no gradient, because no step follows.
            for step in range(self.steps + 1):
                with torch.set_grad_enabled(step < self.steps):
                    # The numbers of these lights are leaves of the graph, which get gradients.
                    leaves = [light and _leaf(light) for light in lights]
                    relit = self.lighting.apply(unit, {"lights": leaves})
                    outputs = _in_float32(network(relit.to(given)))
                    is_list = isinstance(outputs, list)
                    chosen = [outputs[row] for row in rows] if is_list else outputs[rows]
                    # The cost of an image is the sum of the costs of its objects.
                    costs = criterion.cost(chosen)
                    cost = costs.new_zeros(len(unit)).index_add(0, image_of_row, costs)
                    if step < self.steps:
                        # The cost of a detector that finds nothing is constant.
                        if not cost.requires_grad and not is_list:
                            raise InputError(f"the network {NO_GRADIENT}")
                        if cost.requires_grad:
                            # Other tensors, such as those of the caller, get no gradient.
                            cost.sum().backward(inputs=[light.values for light in leaves if light])
                is_lower = (cost < lowest).tolist()
                lowest = torch.minimum(lowest, cost.detach())
                pairs = zip(is_lower, lights, best, strict=True)
                best = [new if lower else old for lower, new, old in pairs]
                if step < self.steps:
                    lights = [light and self._stepped(light) for light in leaves]
        return best

    def _criterion(
        self, network: CheckedNetwork, unit: Float[Tensor, "N 3 H W"], targets: Any
    ) -> tuple[Int[Tensor, " E"], Criterion]:
        """Return what the cost is about, with one row for each object, and the image of each."""
        classes = self.classes
        if targets is None:
            with torch.no_grad():
                outputs = _in_float32(network(unit))
        elif isinstance(self.task, Detection):
            expected = 'a dictionary with "boxes" and "labels" for each image'
            given = errors.as_list("targets", targets, Mapping, expected)
            if not all({"boxes", "labels"} <= item.keys() for item in given):
                raise InputError(f"targets has no boxes or no labels: give {expected}")
            reader = Detection().reader("targets: the data set", len(classes))
            found = (_as_found(item["boxes"], item["labels"]) for item in given)
            outputs = [reader.detections(item, unit, is_raw=False) for item in found]
        else:
            outputs, classes = self._as_outputs(targets, unit)
        if len(outputs) != len(unit):
            raise InputError(f"{len(outputs)} targets are given for {len(unit)} images: give each")
        # Each row is one object in one image. `map` drops the axis of its single view.
        image_of_row, criterion = self.task.as_found(outputs, classes)
        return image_of_row.to(unit.device), criterion.map(lambda rows: rows[:, 0].to(unit.device))

    def _as_outputs(
        self, targets: Any, unit: Float[Tensor, "N 3 H W"]
    ) -> tuple[Float[Tensor, "M ..."], list[str]]:
        """Return the outputs of a network that is sure of labels or of label maps, and its classes.

        Pixels without a class get a further class, which is no object.
        """
        targets = errors.as_integers("targets", targets)
        is_map = isinstance(self.task, Segmentation)
        size = unit.shape[2:] if is_map else ()
        errors.require_shape("targets", targets, len(targets), *size)
        count = len(self.classes) or max(targets.flatten().tolist(), default=0) + 1
        has_class = (targets >= 0) & (targets < count)
        is_wrong = ~has_class
        # Pixels of a map may have no class.
        if is_map:
            is_wrong &= (targets >= 0) & (targets != NO_CLASS_PIXEL)
        if is_wrong.any():
            label = int(targets[is_wrong][0])
            last = f" to {count - 1}" if self.classes else ""
            raise InputError(f"targets has the label {label}: give labels from 0{last}")
        if not is_map:
            return F.one_hot(targets, count).float(), self.classes
        # The class is the last axis of `one_hot`, but the first axis of the outputs of an image.
        outputs = F.one_hot(targets.where(has_class, count), count + 1).movedim(-1, 1)
        return outputs.float(), [*self.classes, BACKGROUND]

    def _stepped(self, light: Light) -> Light:
        """Move the numbers of a light along the sign of their gradient, within [0, 1]."""
        values = light.values.detach().clone()
        gradient = light.values.grad
        if gradient is not None:
            # The light is differentiable in its first numbers only. The others stay.
            smooth = slice(light.model.dimensions)
            moved = values[smooth] - STEP / self.steps * gradient[smooth].sign()
            values[smooth] = moved.clamp(0, 1)
        return light._replace(values=values)


def _as_found(boxes: Any, labels: Any) -> dict[str, Tensor]:
    """Return the boxes and labels of an image as a detector that is sure of them does."""
    if isinstance(boxes, tv_tensors.BoundingBoxes):
        corners = tv_tensors.BoundingBoxFormat.XYXY
        fault = f"targets has boxes of the format {boxes.format.name}"
        with errors.explained(fault, "give boxes of the format XYXY", "", ValueError):
            boxes = v2.functional.convert_bounding_box_format(boxes, new_format=corners)
    boxes = torch.as_tensor(boxes, dtype=torch.float32).as_subclass(Tensor)
    labels = errors.as_integers("labels", labels)
    return {"boxes": boxes.reshape(-1, 4), "labels": labels, "scores": torch.ones(len(labels))}


def _in_float32(outputs: Any) -> Any:
    """Convert floating-point outputs of a network, in which costs of half precision would round."""
    return tree_map_only(Tensor, lambda of: of.float() if of.is_floating_point() else of, outputs)


def _leaf(light: Light) -> Light:
    """Return a light whose numbers get a gradient."""
    return light._replace(values=light.values.detach().clone().requires_grad_())
