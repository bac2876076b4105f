"""A classifier: a network whose outputs are logits, with the names of its classes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from augment import network as wrappers
from augment.exposure import DIM, IsDim, light_settings, with_normalized_light
from augment.settings import NormalizedLightSettings, NormalizeLight, read_normalized_light
from augment.switch import DIM_NAME, LIT_NAME, Chooser, Recognizer, Switch
from augment.tasks import recognized_task
from augment.tasks.classification import TWO_CLASSES, Classification, class_index, log_odds
from augment.tasks.task import Task, gradient_of, tensors_of
from renderer import errors
from renderer.errors import InputError
from renderer.image import require_unit_range
from renderer.settings import MAX_SIZE, Size, as_size, height_and_width

# normalization="imagenet": mean and standard deviation of most networks trained on ImageNet.
IMAGENET = "imagenet"
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# Default values of black and white that a network takes.
UNIT_RANGE = (0.0, 1.0)
# Pixels per side of the images of most networks that were trained on ImageNet.
USUAL_SIZE = 224
# Number of images that count the outputs. Logits of one could look like probabilities by chance.
CHECKED_COUNT = 2
# Network or function from images to outputs.
ImageFunction = Callable[[Tensor], Any]
# Name of one positive class, or names of several.
Label = str | Sequence[str]
Normalization = str | tuple[Sequence[float], Sequence[float]] | None
# A network is called with a gray image, and so many others, to find out whether it has gradients.
GRAY = 0.5
MAX_PROBED = 8


@dataclass(frozen=True)
class OperatingPoint:
    """Threshold for the decision whether an image shows a class.

    An image shows the class if its log-odds of the class exceed the threshold.
    The threshold was chosen on a folder of photographs: it is the lowest one at
    which the false-positive rate is at most `false_positive_rate`.

    Attributes:
        label: Name of the class.
        threshold: Threshold of the log-odds.
        false_positive_rate: Largest permitted fraction of the photographs
            without the class that exceed the threshold, in [0, 1].
        folder: Name of the folder of photographs.
        images: Hash of the photographs.
        negatives: Number of photographs that do not show the class.
    """

    label: str
    threshold: float
    false_positive_rate: float
    folder: str
    images: str
    negatives: int


class CheckedNetwork(wrappers.Network):
    """Network whose failures are errors of one sentence, and whose outputs a task checks.

    Attributes:
        title: Name of the network at the start of error messages.
        task: What the outputs mean. None returns them as they are.
    """

    def __init__(
        self,
        network: ImageFunction,
        title: str,
        task: Task | None = None,
        class_count: int | None = None,
    ):
        super().__init__(network)
        self.title = title
        self.task = task
        self._read = None if task is None else task.reader(title, class_count)

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Any:
        """Compute the outputs of images in the form of the task, and check them."""
        # A network of a task inside, and both of a switch, have read their own outputs already.
        is_read = isinstance(self.network, TaskNetwork | Switch)
        task = None if is_read else self.task
        # A network may change its images in place, such as the normalization of torchvision.
        images = images.clone()
        try:
            outputs = self.network(images) if task is None else task.outputs(self.network, images)
        except Exception as error:
            # The caller handles errors of memory. An `InputError` already tells what is wrong.
            if isinstance(error, InputError) or errors.is_out_of_memory(error):
                raise
            given = f"{images.dtype} images {tuple(images.shape)}".removeprefix("torch.")
            kind = f"{type(error).__name__}: {errors.single_line(error)}"
            remedy = "give the size of its images, or use a network that takes such images"
            # Images of another precision or device than the weights are the most frequent causes.
            weights = [weight for weight in self.parameters() if weight.is_floating_point()]
            for fact in ("dtype", "device"):
                wanted = getattr(images, fact)
                found = {getattr(weight, fact) for weight in weights}
                if found and wanted not in found:
                    names = ", ".join(sorted(str(each).removeprefix("torch.") for each in found))
                    remedy = f"its weights are {names}, convert it with network.to({wanted})"
            raise InputError(f"{self.title} fails on {given} ({kind}): {remedy}") from error
        if self._read is None or is_read:
            return outputs
        return self._read(outputs, images)


class TaskNetwork(CheckedNetwork):
    """Frozen network of a task, with the size of its images and the names of its classes.

    The parameters of the network get no gradient. The network stays in evaluation mode, even after
    `train()`. Images are not resized. `Classifier` explains the arguments.
    """

    task: Task

    def __init__(
        self,
        network: ImageFunction,
        size: Size,
        classes: Sequence[str],
        name: str = "callable",
        normalize_light: NormalizeLight = None,
        task: Task = Classification(),  # noqa: B008 (It has no state.)
    ):
        kind = "classifier" if isinstance(task, Classification) else f"{task.name} network"
        expected = "a torch.nn.Module, or a function of images"
        errors.require_kind("network", network, Callable, expected)
        names = as_class_names(f"{kind} {name}: classes", classes)
        super().__init__(network, f"{kind} {name}", task, len(names))
        own = wrappers.NETWORK if wrappers.normalization_of(self.network) else None
        self.inputs = wrappers.Inputs(wrappers.YOU, own, None)
        self.network = with_normalized_light(self.network, normalize_light)
        self.size = as_size(f"{kind} {name}: size", size, MAX_SIZE)
        self.classes = names
        self.name = name
        # Whether an image is in the light of the training of this network.
        self.recognizer: Recognizer | None = None
        if len(set(self.classes)) < len(self.classes):
            reason = f"{self.title}: classes has a name that occurs twice"
            raise InputError(f"{reason}: give each class a name of its own")
        self.requires_grad_(False).eval()

    def forward(self, images: Float[Tensor, "N 3 height width"]) -> Any:
        """Compute the outputs of images: logits of a classifier, or those of another task.

        Args:
            images: RGB images in [0, 1], shape (N, 3, height, width).

        Returns:
            Logits of a classifier, shape (N, C).

        Raises:
            InputError: If the images have another size or are far from [0, 1].
                Also if the network fails, or returns anything but finite logits
                with a gradient.
        """
        if isinstance(images, Tensor | np.ndarray) and images.dtype in (torch.uint8, np.uint8):
            advice = "use floating-point RGB in [0, 1], such as images / 255"
            raise InputError(f"images is {errors.describe(images)}: {advice}")
        images = errors.as_tensor("images", images)
        shape = (3, *height_and_width(self.size))
        errors.require_shape(f"images of {self.title}", images, "N", *shape)
        outputs = super().forward(images)
        # The check may wait until the GPU is idle, so the network is called before.
        if len(images):
            require_unit_range(images)
        self.task.require_finite(outputs, images, self.title)
        return outputs

    @property
    def normalized_light(self) -> NormalizedLightSettings | None:
        """Settings with which the light of images is normalized. None if it is not normalized."""
        inner = self.network
        return inner.other.normalized_light if isinstance(inner, Switch) else light_settings(inner)

    def normalizing_light(self, normalize_light: NormalizeLight = True) -> Self:
        """Return a classifier that first normalizes the light of images.

        It shares the network. It has no operating points, because its logits differ. With a
        second network (`with_dim`, `with_lit`), the images of that one alone are normalized.

        Args:
            normalize_light: True for the defaults, or a mapping with fields of
                `NormalizedLightSettings`. With None or False, the classifier
                itself is returned.

        Raises:
            InputError: If this classifier normalizes the light already.

        Example:
            >>> import torch
            >>> import norm_balls as nb
            >>> def logits(images):
            ...     return images.mean((2, 3))
            >>> classifier = nb.Classifier(logits, size=8, classes=["red", "green", "blue"])
            >>> dark = torch.full((1, 3, 8, 8), 0.1)
            >>> classifier.normalizing_light({"level": 1.0})(dark).round(decimals=3)
            tensor([[1., 1., 1.]])
        """
        if read_normalized_light(normalize_light) is None:
            return self
        inner = self.network
        if isinstance(inner, Switch):
            other = inner.other.normalizing_light(normalize_light)
            return self.with_network(Switch(inner.network, other, inner.chooses))
        return self.with_network(inner, normalize_light)

    def with_dim(self, dim: Self, below: float = DIM) -> Self:
        """Return a network that shows dim images alone to another network.

        Args:
            dim: Network for dim images, with the same task, size and classes.
            below: An image is dim if the 98th percentile of its linear values
                is below this value, above 0 and at most 1. Of 2,439 photographs
                in ordinary light, 14 are below the default, 0.25, which
                `normalize_light` with `average` always uses.

        Raises:
            InputError: If the networks differ in task, size or classes.

        Example:
            >>> import torch
            >>> import norm_balls as nb
            >>> plain = nb.Classifier(lambda x: x.mean((2, 3)), 8, ["red", "green", "blue"])
            >>> switched = plain.with_dim(plain.normalizing_light())
            >>> switched(torch.full((1, 3, 8, 8), 0.1)).round(decimals=3)
            tensor([[1., 1., 1.]])
        """
        errors.require_number("below", below, 1e-6, 1)
        return self._with_other(dim, "dim", IsDim(below), DIM_NAME)

    def with_lit(self, lit: Self) -> Self:
        """Return a network that shows images in an unusual light to another network.

        Every image passes through both networks, because the other network
        recognizes the light of its own training.

        Args:
            lit: Network of a run with `train.recognize=true`, with the same task,
                size and classes.

        Raises:
            InputError: If the networks differ in task, size or classes, or if
                `lit` recognizes no light.

        Example:
            >>> import norm_balls as nb
            >>> switched = nb.load("none").with_lit(nb.load_run("runs/stripes"))  # doctest: +SKIP
        """
        recognizer = getattr(lit, "recognizer", None)
        if recognizer is None:
            name = getattr(lit, "title", "lit")
            raise InputError(f"{name} recognizes no light: give one trained with recognize")
        return self._with_other(lit, "lit", recognizer, LIT_NAME)

    def _with_other(self, other: Self, key: str, chooses: Chooser, prefix: str) -> Self:
        """Return a network that shows images which `chooses` chooses to another network."""
        errors.require_kind(key, other, TaskNetwork, "a network with its task, size and classes")
        for name in ("task", "size", "classes"):
            if getattr(other, name) != getattr(self, name):
                reason = f"{key} has another {name} than {self.title}"
                raise InputError(f"{reason}: give a network of the same task, size and classes")
        name = f"{prefix}{self.name}+{other.name}"
        return self.with_network(Switch(self, other, chooses), name=name)

    def with_network(
        self,
        network: nn.Module,
        normalize_light: NormalizeLight = None,
        name: str | None = None,
        task: Task | None = None,
    ) -> Self:
        """Return a copy with another network of the same images, and without operating points."""
        options: Any = {} if isinstance(self, Classifier) else {"task": task or self.task}
        given = self.size, self.classes, name or self.name, normalize_light
        made = type(self)(network, *given, **options)
        made.inputs, made.recognizer = self.inputs, self.recognizer
        return made

    def with_task(self, task: Task) -> Self:
        """Return a copy with other settings of its task, such as the goal of attacks."""
        if type(task) is not type(self.task):
            reason = f"task is {task}, but {self.title} has the task {self.task}"
            raise InputError(f"{reason}: leave the task out")
        changed: Any = task
        decode = getattr(self.task, "decode", None)
        if decode is not None and changed.decode is None:
            changed = replace(changed, decode=decode)
        return self.with_network(self.network, task=changed)

    def describe_inputs(self) -> str:
        """Write size, normalization and value range of the images, each with who states it."""
        return self.inputs.describe(self.network, self.size)

    def is_differentiable(self, render: Callable[[], Tensor]) -> bool:
        """Return whether the outputs have a gradient in the pixels that is not zero.

        It is missing if images are converted to bytes, and zero if they are rounded. Constant
        outputs count as differentiable, and so does a network with weights that finds nothing.

        Args:
            render: Function that makes the images of a scene, to which a gray
                one is added.
        """
        images = render()[:MAX_PROBED]
        gray = images.new_full((1, 3, *height_and_width(self.size)), GRAY)
        totals = []
        with torch.enable_grad(), wrappers.frozen_eval_mode(self):
            for image in torch.cat([images, gray]).split(1):
                shown = image.clone().requires_grad_()
                try:
                    outputs = [item for item in tensors_of(super().forward(shown)) if item.numel()]
                except InputError:
                    # A function that converts images to NumPy fails on images with gradients.
                    return False
                if not outputs:
                    continue
                total = torch.stack([item.double().square().sum() for item in outputs]).sum()
                gradient = gradient_of(total, shown)
                if gradient is None or gradient.any():
                    return gradient is not None
                totals.append(float(total.detach()))
        # All gradients are zero. Those of constant outputs are right.
        has_weights = next(self.parameters(), None) is not None
        return len({*totals}) == 1 if totals else has_weights

    def train(self, mode: bool = True) -> Self:
        """Do nothing but keep evaluation mode, whatever `mode` is."""
        return super().train(False)

    def label(self, class_name: str | int) -> int:
        """Return the index of a class.

        Args:
            class_name: Name of the class, or its index.

        Raises:
            InputError: If there is no such class. The message suggests similar
                names.
        """
        return class_index(self.classes, class_name, self.title)


class Classifier(TaskNetwork):
    """Frozen classifier from RGB images in [0, 1] to logits of C classes.

    If the network is a module of torch, the logits are differentiable with
    respect to the pixels. The parameters of the network get no gradient. The
    network stays in evaluation mode, even after `train()`. Images are not
    resized.

    Args:
        network: Function from images, shape (N, 3, height, width), to logits,
            shape (N, C). It takes tensors or NumPy arrays. If it is a
            `torch.nn.Module`, it is frozen, put in evaluation mode and moved
            with the classifier.
        size: Pixels per side of the images, or height and width, from 1 to 4,096.
        classes: Names of the C classes in the order of the logits, at least
            two. Each name occurs once, because labels are found by name.
        name: Name of the classifier in messages.
        normalize_light: How the light of each image is normalized before the
            network sees it: True for the defaults, or a mapping with fields of
            `NormalizedLightSettings`. None for no normalization.

    Attributes:
        operating_points: Thresholds for `detect`, at most one for each class.
            Empty if the network has none.
        inputs: Who states size, normalization and value range of the images:
            the user, the file of the network, or the library that published
            it. What nobody states is assumed.

    Raises:
        InputError: If a class name occurs twice, if there are fewer than two
            classes, or if the size is out of range.
    """

    operating_points: Sequence[OperatingPoint] = ()

    def __init__(
        self,
        network: Callable[[Tensor], Tensor],
        size: Size,
        classes: Sequence[str],
        name: str = "callable",
        normalize_light: NormalizeLight = None,
    ):
        """Check the arguments, which the docstring of the class explains. Freeze the network."""
        super().__init__(network, size, classes, name, normalize_light)
        if len(self.classes) < 2:
            raise InputError(f"classifier {name} has classes={self.classes}: {TWO_CLASSES}")

    def detect(
        self, images: Float[Tensor, "N 3 height width"], label: str | None = None
    ) -> Bool[Tensor, " N"]:
        """Decide which images show a class, by the threshold that is stored for the class.

        Args:
            images: RGB images in [0, 1], shape (N, 3, height, width).
            label: Name of the class. May be None if there is exactly one
                operating point.

        Returns:
            Mask of the images that show the class, shape (N,).

        Raises:
            InputError: If the class has no operating point, or if `forward`
                refuses the images.
        """
        points = [point for point in self.operating_points if label in (None, point.label)]
        if len(points) != 1:
            known = ", ".join(point.label for point in self.operating_points)
            remedy = f"set label to one of {known}" if known else "store one with nb.publish"
            raise InputError(f"{self.title} has no operating point for label={label}: {remedy}")
        (point,) = points
        return log_odds(self(images).double(), self.label(point.label)) > point.threshold


def as_class_names(name: str, classes: object) -> tuple[str, ...]:
    """Convert a list of names of classes to a tuple of strings."""
    expected = "a list of the names of the classes, in the order of the logits"
    names = errors.as_list(name, classes, str, expected)
    # Strings of NumPy are of a class of their own, which files of settings cannot hold.
    return tuple(str(errors.composed(item)) for item in names)


def remembering(classifier: TaskNetwork) -> TaskNetwork:
    """Return a copy of a classifier that classifies each different image only once."""
    is_remembering = isinstance(classifier.network, wrappers.Remembered)
    if is_remembering or not isinstance(classifier, Classifier):
        return classifier
    return classifier.with_network(wrappers.Remembered(classifier.network))


def as_network(
    network: TaskNetwork | ImageFunction,
    size: Size | None = None,
    classes: Sequence[str] | None = None,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
    device: torch.device | str | None = None,
    argument: str = "network",
    name: str | None = None,
    normalize_light: NormalizeLight = None,
    dtype: torch.dtype = torch.float32,
    task: Task | None = None,
    size_from: str = wrappers.YOU,
    says: bool = True,
) -> TaskNetwork:
    """Make a network of a task of a plain network, and check it on gray images.

    Without a size, that of the network counts or, if it tells none, 224. Classes are those that the
    task knows by default, such as "0", "1" and so on. Mean and standard deviation are in units of
    `value_range`, the values of black and white. Without a task, the outputs decide, which a line
    says. A `TaskNetwork` only gets `normalize_light`. `size_from` tells who states the size, and
    `says` whether to log what images the network gets.
    """
    errors.require_kind("task", task, Task | None, "a task, such as nb.Detection(), or None")
    if size is not None:
        size = as_size("size", size, MAX_SIZE)
    if isinstance(network, TaskNetwork):
        if classes is not None or normalization is not None or value_range != UNIT_RANGE:
            given = "classes, normalization and value_range"
            raise InputError(f"{given} are for a plain network: leave them out")
        if size not in (None, network.size):
            advice = f"use the size of its images, {network.size}"
            raise InputError(f"size={size} does not fit {network.title}: {advice}")
        if task is not None and task != network.task:
            network = network.with_task(task)
        if says:
            wrappers.say_inputs(network.name, network.network, network.size, network.inputs)
        return network.normalizing_light(normalize_light)
    # `train` and `eval` of YOLO(...) of Ultralytics start a training. The network is inside.
    if type(network).__module__.startswith("ultralytics.") and hasattr(network, "predictor"):
        network = network.model.float().eval()  # type: ignore[attr-defined]
    expected = "a torch.nn.Module, a function to logits, or a Classifier"
    errors.require_kind(argument, network, Callable, expected)
    names = None if classes is None else as_class_names("classes", classes)
    if isinstance(network, type):
        name = network.__name__
        raise InputError(f"{argument} is the class {name}: give a network, such as {name}(...)")
    require_evaluation_mode(network, argument)
    if isinstance(network, nn.Module) and any(weight.is_meta for weight in network.parameters()):
        raise InputError(f"{argument} is on the device meta: load its weights first")
    device = wrappers.device_of(network) if device is None else errors.as_device(device)
    function = _preprocessed(network, normalization, value_range).to(device)
    name = name or type(network).__name__
    # Who states the size, for the line that is logged. None: assumed.
    sizer: str | None = size_from
    if size is None:
        known_size = wrappers.own_size(network)
        sizer = wrappers.NETWORK if known_size else None
        # timm records the size of the published weights, which need not be those of the network.
        published = getattr(network, "pretrained_cfg", {}).get("input_size", [USUAL_SIZE])
        size = known_size or published[-1]
    stated_by_network = wrappers.NETWORK if wrappers.normalization_of(network) else None
    normalizer = stated_by_network if normalization is None else wrappers.YOU
    # A mean is in the units of the value range. The default range is an object of its own.
    is_stated = normalization is not None or value_range is not UNIT_RANGE
    limits = (0.0, 1.0) if normalization == IMAGENET else (value_range[0], value_range[1])
    inputs = wrappers.Inputs(sizer, normalizer, wrappers.YOU if is_stated else None, limits)
    if says:
        wrappers.say_inputs(name, function, size, inputs)
    # Gray images of different shades, to find errors before an attack begins.
    shades = torch.linspace(0.3, 0.7, CHECKED_COUNT, device=device, dtype=dtype)
    images = shades.view(-1, 1, 1, 1).expand(-1, 3, *height_and_width(size)).contiguous()
    with torch.no_grad():
        outputs = CheckedNetwork(function, argument)(images)
    if task is None:
        task = recognized_task(outputs, argument)
        if not isinstance(task, Classification):
            wrappers.say_once(f"network {name}: its outputs are of {task.name}")
    count = task.output_count(network, task.reader(argument)(outputs, images))
    if names is not None and count not in (None, len(names)):
        reason = f"classes has {len(names)} names, but the network returns {count} outputs"
        raise InputError(f"{reason}: give one name per output")
    known = names or task.class_names(network, count)
    if known is None:
        raise InputError("classes is None, but the network does not name its classes: give them")
    if isinstance(task, Classification):
        made: TaskNetwork = Classifier(function, size, known, name, normalize_light)
    else:
        made = TaskNetwork(function, size, known, name, normalize_light, task)
    made.inputs = inputs
    return made


def require_evaluation_mode(network: object, argument: str) -> None:
    """Check that no module of a network is in training mode."""
    modules = network.modules() if isinstance(network, nn.Module) else ()
    if not any(getattr(part, "training", False) for part in modules):
        return
    # A module of torch.export has its own attribute `eval`, which raises an error.
    if "eval" in vars(network):
        raise InputError(f"{argument} {wrappers.NO_EVAL}")
    raise InputError(f"{argument} is a network in training mode: call its method eval() first")


def _preprocessed(
    network: Callable[..., Any], normalization: Normalization, value_range: tuple[float, float]
) -> nn.Module:
    """Return a network that takes images in [0, 1], scales and normalizes them."""
    module = network if isinstance(network, nn.Module) else wrappers.Function(network)
    mean, std = mean_and_std(normalization)
    limits = "the values of black and white"
    ends = errors.as_list("value_range", value_range, float | int, limits)
    if len(ends) != 2:
        raise InputError(f"value_range has the length {len(ends)}: give {limits}")
    black, white = map(float, ends)
    if not black < white:
        raise InputError(f"value_range is ({black}, {white}): give black before white")
    if normalization is None and (black, white) == UNIT_RANGE:
        return module.eval()
    if normalization is not None:
        own = wrappers.normalization_of(module)
        if own:
            reason = f"normalization is given, but in the network, images are {own} again"
            raise InputError(f"{reason}: leave normalization out")
        if normalization == IMAGENET:
            # Scaling the mean and the standard deviation of ImageNet to the range of the network
            # is the same as normalizing values in [0, 1] with them.
            black, white = UNIT_RANGE
        if not black <= min(mean) <= max(mean) <= white:
            reason = f"normalization has the mean {tuple(mean)}, outside of {black:g} to {white:g}"
            raise InputError(f"{reason}: give it in the units of value_range")
    # A value x in [0, 1] becomes (black + span · x - mean) / std for the network. This is equal to
    # (x - scaled_mean) / scaled_std, which `ChannelNormalization` computes.
    span = white - black
    scaled_mean = [(value - black) / span for value in mean]
    scaled_std = [value / span for value in std]
    return wrappers.Network(module, [wrappers.ChannelNormalization(scaled_mean, scaled_std)]).eval()


def mean_and_std(normalization: Normalization) -> tuple[Sequence[float], Sequence[float]]:
    """Return the mean and the standard deviation of the channels red, green and blue.

    None stands for mean 0 and standard deviation 1.
    """
    if normalization is None:
        return (0.0,) * 3, (1.0,) * 3
    if isinstance(normalization, str) and normalization == IMAGENET:
        return IMAGENET_MEAN, IMAGENET_STD
    expected = "'imagenet', or (mean, std) of three numbers each"
    rows = errors.as_list("normalization", normalization, tuple | list, expected)
    if [len(row) for row in rows] != [3, 3] or not min(rows[1]) > 0:
        raise InputError(f"normalization is {errors.describe(normalization)}: give {expected}")
    return rows[0], rows[1]
