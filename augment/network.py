"""A network: images in [0, 1] pass through its transforms and then through the raw network.

`compute_outputs` is the one function that shows many images to a network. It returns what the
network returns. What an output means, such as logits, is known where a task uses it.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_pre_hook

from augment.distributed import rank
from augment.progress import progress
from renderer.errors import InputError, is_out_of_memory
from renderer.image import straight_through, to_bytes, to_unit
from renderer.modes import without_autocast
from renderer.settings import Size, height_and_width

# Number of images that a network sees at a time if nothing else is said.
BATCH = 256
# Probabilities may be rounded to multiples of this number.
ROUNDED = 1e-3
# The sum of many rounded probabilities may differ from 1 by at most this much.
MAX_DEVIATION = 0.01
# Who states a fact about the images, besides the library that published the network.
YOU, FILE, NETWORK, DATA = "you", "the file", "the network", "the training images"
# Names of the mean of the channels in networks that normalize images themselves. That of the
# standard deviation ends with "std" instead.
MEANS = ("mean", "image_mean", "pixel_mean")
# Parts of the names of modules that normalize images, such as `Normalize` of torchvision.
NORMALIZING = "Normaliz", "RCNNTransform"
# What a function takes: tensors, arrays of float32, or tensors without gradients.
TENSORS, ARRAYS, DETACHED = "tensors", "arrays", "detached tensors"

# End of a sentence about a network of torch.export in training mode.
NO_EVAL = (
    "is of torch.export, which has no eval(): save it by torch.export.save, and load it by "
    "nb.load_classifier"
)

Result = TypeVar("Result")


@dataclass(frozen=True)
class Inputs:
    """Who states the facts about the images of a network, such as "you". None: it is assumed.

    Attributes:
        size: Who states the pixels per side.
        normalization: Who states mean and standard deviation.
        value_range: Who states the values of black and white.
        limits: Values of black and white before the normalization.
    """

    size: str | None
    normalization: str | None
    value_range: str | None
    limits: tuple[float, float] = (0.0, 1.0)

    def describe(self, network: Any, size: Size) -> str:
        """Write the facts about the images of a network, each with who states it."""
        black, white = self.limits
        height, width = height_and_width(size)
        facts = (
            (f"{height} × {width} pixels", self.size),
            (normalization_of(network, self.limits) or "not normalized", self.normalization),
            (f"values from {black:g} to {white:g}", self.value_range),
        )
        return "; ".join(f"{fact}, {f'stated by {by}' if by else 'assumed'}" for fact, by in facts)


FROM_FILE = Inputs(FILE, FILE, FILE)
FROM_DATA = Inputs(DATA, DATA, DATA)


class Network(nn.Module):
    """A network, and the transforms of the images that it gets.

    It is in the mode of the network, training or evaluation.

    Attributes:
        transforms: Modules from images to images, applied one after the other. The first one gets
            RGB images (N, 3, H, W) in [0, 1].
        network: Module from transformed images to outputs, whatever these are.
    """

    def __init__(self, network: Callable[[Any], Any], transforms: Sequence[nn.Module] = ()):
        super().__init__()
        if isinstance(network, nn.parallel.DistributedDataParallel):
            # Its passes wait for those of the other processes, which may make fewer of them.
            network = network.module
        self.transforms = nn.ModuleList(transforms)
        self.network: Any = network if isinstance(network, nn.Module) else Function(network)
        # `train` of a network of torch.export raises an error.
        for part in (self, self.transforms, *self.transforms):
            part.training = getattr(self.network, "training", False)

    def forward(self, images: Tensor, *targets: Any) -> Any:
        """Compute the outputs of RGB images (N, 3, H, W) in [0, 1].

        A detector in training mode also takes targets.
        """
        for transform in self.transforms:
            images = transform(images)
        return self.network(images, *targets)


def plain_outputs(outputs: Any) -> Any:
    """Return what a network computes for images, without what its library puts around it.

    Of a tuple, this is the first entry, and of an output of transformers, its `logits`. Outputs of
    object detectors (`pred_boxes`) and of segmenters of torchvision (`out`) are kept.
    """
    if isinstance(outputs, tuple) and outputs:
        return plain_outputs(outputs[0])
    if hasattr(outputs, "pred_boxes") or isinstance(outputs, Tensor | np.ndarray):
        return outputs
    if isinstance(outputs, Mapping) and "pred_boxes" not in outputs and "logits" in outputs:
        return outputs["logits"]
    return getattr(outputs, "logits", outputs)


def unwrapped(network: Any, own_alone: bool = False) -> Any:
    """Return the raw network in `Network` modules and, unless `own_alone`, in wrappers of torch."""
    if isinstance(network, Network):
        return unwrapped(network.network, own_alone)
    if own_alone:
        return network
    is_parallel = isinstance(network, nn.DataParallel | nn.parallel.DistributedDataParallel)
    # `torch.compile` keeps the network under the name _orig_mod.
    inner = network.module if is_parallel else getattr(network, "_orig_mod", None)
    return network if inner is None else unwrapped(inner)


def text_vectors(network: nn.Module, class_count: int) -> list[str]:
    """Return the names of matrices with a row or column for each class, outside of layers of torch.

    A zero-shot network multiplies them by the features of an image.
    """
    # Plain attributes, buffers and parameters of each module, by their full names.
    return [
        f"{prefix}.{name}".lstrip(".")
        for prefix, module in network.named_modules()
        if not type(module).__module__.startswith(("torch.nn.", "torch.jit."))
        for name, value in {**vars(module), **module._buffers, **module._parameters}.items()
        if isinstance(value, Tensor) and value.is_floating_point()
        if value.ndim == 2 and class_count in value.shape
    ]


def keep_text_vectors(network: nn.Module, class_count: int, kind: type[Tensor] = Tensor) -> None:
    """Register text vectors that are plain tensors as buffers, so that they are saved and copied.

    With `nn.Parameter` as the kind, the last of them becomes a parameter.
    """
    names = text_vectors(network, class_count)
    for full_name in names[-1:] if kind is nn.Parameter else names:
        prefix, _, name = full_name.rpartition(".")
        module = network.get_submodule(prefix)
        value = getattr(module, name)
        if kind is nn.Parameter and not isinstance(value, nn.Parameter):
            delattr(module, name)
            module.register_parameter(name, nn.Parameter(value.detach().clone()))
        elif name in vars(module):
            delattr(module, name)
            module.register_buffer(name, value.detach().clone())


class ChannelNormalization(nn.Module):
    """Transform RGB images in [0, 1] to (x − mean) / std.

    The images get the memory layout "channels last", with which convolutions on a CPU are about a
    quarter faster. Mean and standard deviation are in units of [0, 1], and in the order of the
    channels of the network: with `bgr`, blue, green and red.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Sequence[float], std: Sequence[float], bgr: bool = False):
        super().__init__()
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std, dtype=torch.float32).view(1, 3, 1, 1))
        self.bgr = bgr

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N 3 H W"]:
        ordered = images.flip(1) if self.bgr else images
        return ((ordered - self.mean) / self.std).contiguous(memory_format=torch.channels_last)


class Quantization(nn.Module):
    """Transform images by rounding to 8 bits per channel, with the gradient of the identity."""

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N 3 H W"]:
        return straight_through(images, lambda exact: to_unit(to_bytes(exact)).to(exact))


class Function(nn.Module):
    """Module of a function from images to scores that takes tensors or NumPy arrays.

    The first call finds out which of them the function takes: it is called with a tensor and, if
    it fails or does not return a tensor, with an array of float32, and then with a tensor without
    gradients. Scores that are no tensor have no gradients. If they are probabilities in the first
    call, their logarithms are returned in all calls.

    Attributes:
        takes: What the function takes. None before the first call.
        has_probabilities: Whether scores that are no tensor are probabilities. None before the
            first call.
    """

    def __init__(self, function: Callable[[Any], Any], takes: str | None = None):
        super().__init__()
        self.function = function
        self.takes = takes
        self.has_probabilities: bool | None = None

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Any:
        """Compute the scores (N, C) of images."""
        if self.takes is not None:
            return self._call(images, self.takes)
        # Kinds of the modules in training mode that the first call runs.
        in_training: list[str] = []

        # A function hides the networks that it calls. A hook that torch calls before each module
        # finds those in training mode.
        def note(module: nn.Module, _: object) -> None:
            # Transformations of images are modules in training mode, too, but have no weights.
            has_weights = next(module.parameters(recurse=False), None) is not None
            kinds = nn.modules.dropout._DropoutNd | nn.modules.batchnorm._NormBase
            if getattr(module, "training", False) and (has_weights or isinstance(module, kinds)):
                in_training.append(type(module).__name__)

        with register_module_forward_pre_hook(note):
            scores = self._first_call(images)
        if in_training:
            self.takes = None
            reason = f"the function calls a network in training mode ({in_training[0]})"
            raise InputError(f"{reason}: call the method eval() of the network first")
        return scores

    def _first_call(self, images: Tensor) -> Any:
        """Compute the scores of images, and find out what the function takes."""
        returned, failures = None, []
        for takes in (TENSORS, ARRAYS, DETACHED):
            try:
                scores = self._call(images, takes)
            except Exception as error:  # Users' functions raise errors of many kinds.
                failures.append(error)
                continue
            if isinstance(scores, Tensor) or _is_structured(scores):
                self.takes = takes
                return scores
            returned = scores
        # All calls failed. The error for tensors tells most.
        if len(failures) == 3:
            raise failures[0]
        return returned  # The caller raises an error, because this is not a tensor.

    def _call(self, images: Tensor, takes: str) -> Any:
        """Compute the scores of images in the form that the function takes."""
        if takes == TENSORS:
            return self.function(images)
        detached = images.detach()
        given = detached if takes == DETACHED else detached.cpu().float().numpy()
        # A network in the function does not expect autocast, whose results NumPy may not know.
        outputs = without_autocast(self.function)(given)
        if _is_structured(outputs):
            return outputs
        scores = torch.as_tensor(np.asarray(outputs)).to(images)
        if self.has_probabilities is None and scores.ndim == 2:
            self.has_probabilities = are_probabilities(scores)
        return log_probabilities(scores) if self.has_probabilities else scores


def log_probabilities(probabilities: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
    """Compute logarithms, where 0 is replaced by the smallest positive number."""
    return probabilities.clamp(min=torch.finfo(probabilities.dtype).tiny).log()


def _is_structured(outputs: Any) -> bool:
    """Return whether outputs are those of a detector, a segmenter or a library, and no array."""
    entries = outputs if isinstance(outputs, list | tuple) else [outputs]
    return any(isinstance(item, Tensor | Mapping) or hasattr(item, "logits") for item in entries)


def are_probabilities(outputs: Float[Tensor, "N C"]) -> bool:
    """Return whether outputs of a network are probabilities.

    They are in [0, 1], and each row sums to 1 up to rounding to three decimals. A single class does
    not count.
    """
    if outputs.shape[1] < 2 or not outputs.is_floating_point():
        return False
    values = outputs.detach()
    # C probabilities that are rounded to 0.001 may change their sum by C · 0.001 / 2.
    rounding = max(torch.finfo(values.dtype).eps, ROUNDED * outputs.shape[1] / 2)
    deviation = (values.double().sum(1) - 1).abs().max()
    return bool((values.min() >= 0) & (deviation <= min(rounding, MAX_DEVIATION)))


class Remembered(Network):
    """Network that sees each different image only once. Its outputs have no gradients.

    An attack shows the same image to a network several times: before, during and after the search.
    This is expensive if the network is slow or paid for.

    Attributes:
        outputs: Output of each image so far, by the hash of the image.
    """

    def __init__(self, network: Callable[[Any], Any]):
        super().__init__(network)
        self.outputs: dict[bytes, Tensor] = {}

    def forward(self, images: Tensor) -> Tensor:
        # The same bytes are another image in another dtype.
        dtype = str(images.dtype).encode()
        contents = [image.numpy().tobytes() for image in images.detach().cpu()]
        keys = [blake2b(content, digest_size=16, key=dtype).digest() for content in contents]
        # Index of each new image in the batch, by its hash. Equal images have one entry.
        new_images = {key: index for index, key in enumerate(keys) if key not in self.outputs}
        if new_images:
            indices = torch.tensor(list(new_images.values()), device=images.device)
            outputs = plain_outputs(self.network(images.detach()[indices]))
            self.outputs.update(zip(new_images, outputs.detach(), strict=True))
        return torch.stack([self.outputs[key] for key in keys]).to(images)


@torch.no_grad()
def compute_outputs(
    network: Callable[[Tensor], Any],
    images: Tensor | Iterable[Tensor],
    batch_size: int = BATCH,
    device: torch.device | str | None = None,
) -> Any:
    """Return the outputs (..., *) of a network for many images (..., 3, H, W), without gradients.

    Lists of one output for each image, such as those of a detector, become one list.

    The images are in [0, 1] or have 8 bits. They can also come as an iterable of batches
    (N, 3, H, W), which are read one after the other. A network of torch is in eval mode meanwhile.
    `device` is that of the network. None if the images are there, too.
    """
    limit = BatchSize(batch_size)
    batches: Iterable[Tensor] = images
    if isinstance(images, Tensor):
        # All dimensions before (3, H, W) become one dimension of images.
        batches = progress(images.flatten(0, -4).split(batch_size), "predictions")
    outputs: list[Any] = []
    with eval_mode(network):
        for batch in batches:
            moved = batch if device is None else batch.to(device)
            shown = to_unit(moved) if moved.dtype == torch.uint8 else moved

            # The default value binds the function to the present batch.
            def compute(rows: slice, shown: Tensor = shown) -> Any:
                result = network(shown[rows])
                # The network may compute in half precision.
                return result.to(shown.dtype) if isinstance(result, Tensor) else result

            # A batch without images is shown, too, because its outputs tell the shape of a row.
            # `limit.map` calls `compute` with smaller slices if memory runs out.
            outputs += limit.map(compute, len(shown) or 1)
    if outputs and isinstance(outputs[0], list):
        return [output for batch in outputs for output in batch]
    joined = torch.cat(outputs)
    # Outputs get the dimensions of the images before (3, H, W) again.
    return joined.unflatten(0, images.shape[:-3]) if isinstance(images, Tensor) else joined


def evenly_spaced(count: int, limit: int) -> Int[Tensor, " N"]:
    """Return up to `limit` indices of a list of some length, at equal distances."""
    return torch.linspace(0, max(count - 1, 0), min(limit, count)).round().long()


@dataclass
class BatchSize:
    """Number of images that a classifier sees at a time. It is halved when memory runs out.

    Attributes:
        images: Number of images, at least 1. It does not grow again.
    """

    images: int

    def map(self, compute: Callable[[slice], Result], total: int) -> Iterator[Result]:
        """Call a function for one batch of images after the other.

        The function takes the slice of the images of a batch. If memory runs out, it is called
        again with half of it.
        """
        begin = 0
        while begin < total:
            part = slice(begin, begin + self.images)
            try:
                result = compute(part)
            except (RuntimeError, MemoryError) as error:
                if self.images == 1 or not is_out_of_memory(error):
                    raise
                self.images //= 2
                say_once(f"memory ran out: {self.images} images per pass from now on")
            else:
                yield result
                begin = part.stop
                continue
            # Empty the cache outside of the `except` block, because the error refers to tensors
            # there.
            torch.cuda.empty_cache()


@contextmanager
def eval_mode(network: Any) -> Iterator[None]:
    """Set a network to eval mode in a `with` block, and then restore the mode of each module.

    A function is left as it is.
    """
    modules = [*network.modules()] if isinstance(network, nn.Module) else []
    # A frozen module of TorchScript has no mode.
    flags = [getattr(module, "training", False) for module in modules]
    try:
        # `eval` of a large network takes as long as rendering an image, so call it only if needed.
        if any(flags):
            try:
                network.eval()
            except NotImplementedError as error:
                raise InputError(f"the network {NO_EVAL}") from error
        yield
    finally:
        if any(flags):
            # Modules of LoRA, for example, merge their weights when the mode changes.
            for module, flag in zip(modules, flags, strict=True):
                if flag and type(module).train is not nn.Module.train:
                    module.train(True)
            for module, flag in zip(modules, flags, strict=True):
                module.training = flag


@contextmanager
def frozen_eval_mode(network: nn.Module) -> Iterator[None]:
    """Set a network to eval mode, without gradients of its parameters, in a `with` block.

    The mode of each module, `requires_grad` of each parameter and the state of
    the global random generators are restored after the block.
    """
    # Networks may draw random numbers on the GPUs on which they lie.
    gpus = {weight.device for weight in network.parameters() if weight.is_cuda}
    with gradient_flags_kept(network), eval_mode(network), torch.random.fork_rng([*gpus]):
        # Modules of TorchScript lack `requires_grad_`.
        for parameter in network.parameters():
            parameter.requires_grad_(False)
        yield


def device_of(network: object) -> torch.device:
    """Return the device of the parameters of a network. It is the CPU if there are none."""
    parameters = network.parameters() if isinstance(network, nn.Module) else ()
    return next((parameter.device for parameter in parameters), torch.device("cpu"))


@contextmanager
def gradient_flags_kept(network: object) -> Iterator[None]:
    """Restore `requires_grad` of all parameters of a network at the end of a `with` block."""
    parameters = dict(network.named_parameters()) if isinstance(network, nn.Module) else {}
    flags = {name: parameter.requires_grad for name, parameter in parameters.items()}
    try:
        yield
    finally:
        # The first pass of an FSDP network replaces its parameters.
        replaced = network.named_parameters() if isinstance(network, nn.Module) else ()
        for name, parameter in [*parameters.items(), *replaced]:
            parameter.requires_grad_(flags.get(name, parameter.requires_grad))


def own_size(network: object) -> int | None:
    """Return the pixels per side that a transformer of torchvision or timm was built for.

    Its position embeddings have a fixed size. None for any other network.
    """
    for module in network.modules() if isinstance(network, nn.Module) else ():
        for size in (getattr(module, "image_size", None), getattr(module, "img_size", None)):
            found = size[0] if isinstance(size, tuple) and size else size
            if isinstance(found, int):
                return found
    return None


def say_inputs(name: str, network: Any, size: Size, inputs: Inputs) -> None:
    """Log what images a network gets and who states that, once for each text."""
    if rank() == 0:
        say_once(f"network {name}: images of {inputs.describe(network, size)}")
        if inputs.size is None:
            say_once(f"network {name}: size={size} is assumed: give size=, if its images differ")


@cache
def say_once(text: str) -> None:
    """Log a text, which is shown without any settings of `logging`."""
    logging.getLogger(__name__).warning(text)


def normalization_of(network: Any, limits: tuple[float, float] = (0.0, 1.0)) -> str:
    """Describe the first mean and standard deviation of three channels in a network, if any.

    They are in the units of `limits`, the values of black and white. Mean 0 and standard
    deviation 1 give "".
    """
    black, white = limits
    for module in network.modules() if isinstance(network, nn.Module) else ():
        for name in MEANS:
            mean, std = _channels(module, name), _channels(module, name.replace("mean", "std"))
            # A mean alone may be that of three features.
            if mean and (std or name != "mean"):
                std = std or [1.0] * 3
                # The network normalizes values in [0, 1]. Convert to the units of the limits.
                mean = [black + (white - black) * value for value in mean]
                std = [(white - black) * value for value in std]
                if np.allclose([*mean, *std], [0, 0, 0, 1, 1, 1], atol=1e-6):
                    return ""
                means, stds = (", ".join(f"{value:.3g}" for value in row) for row in (mean, std))
                order = " of blue, green and red" if getattr(module, "bgr", False) else ""
                return f"normalized by mean ({means}) and std ({stds}){order}"
    return ""


def _channels(module: nn.Module, name: str) -> list[float]:
    """Return the numbers of this name with which a module normalizes three channels, or [].

    Tensors count. Lists and single numbers, which may only document what the user has to do, count
    in modules that are named after it.
    """
    own = getattr(module, "original_name", type(module).__name__)  # A script has another class.
    is_named = any(part in str(own) for part in NORMALIZING)
    # `kornia.augmentation.Normalize` keeps them in a dictionary.
    flags = getattr(module, "flags", None)
    value = flags.get(name) if isinstance(flags, dict) else getattr(module, name, None)
    # A network of OpenMMLab does not call the preprocessor that it contains.
    is_called = "BaseDataPreprocessor" not in [kind.__name__ for kind in type(module).__mro__]
    kinds = Tensor | np.ndarray | list | tuple | float | int if is_named else Tensor
    if not (is_called and isinstance(value, kinds)):
        return []
    try:
        given = value if isinstance(value, Tensor) else np.array(value, dtype=float)
    except (TypeError, ValueError):  # Words, such as the names of the channels.
        return []
    numbers = given.flatten().tolist()
    numbers *= 3 if is_named and len(numbers) == 1 else 1
    return numbers if len(numbers) == 3 else []
