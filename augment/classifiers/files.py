"""Classifiers from files that contain a whole network: TorchScript, `torch.export` and ONNX."""

import importlib
import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from augment.classifiers.adapter import ArrayFunction, Classifier, Wrapper
from augment.classifiers.plain_networks import NO_FACTS, NetworkFacts, as_classifier
from augment.classifiers.sources import advice_for_pickles, is_torchscript
from renderer.errors import InputError, require_file, single_line

EXPORTED = ".pt2"
ONNX = ".onnx"
# Endings of the names of files that may be TorchScript.
TORCHSCRIPT = (".pt", ".pth", ".ts", ".jit", ".torchscript")
# Endings of the names of all files that contain a network.
SUFFIXES = (EXPORTED, ONNX, *TORCHSCRIPT)
# Pixels per side of the images of a network, if neither its file nor the setting
# `size` tells another number.
DEFAULT_SIZE = 224


@dataclass(frozen=True)
class Content:
    """Network of a file, and the shape of images that the file records.

    Attributes:
        network: Module or function from images (N, 3, size, size) to logits.
        shape: Sizes of the four dimensions of its images. None for a dimension
            of any size, or of a size that the file does not record.
    """

    network: Callable[[Tensor], Tensor]
    shape: Sequence[int | None] = (None, None, None, None)


def is_network_file(name: str) -> bool:
    """Return whether a name is the path of a file that contains a network.

    The weights that this project writes have the same ending as TorchScript. A
    file with such an ending counts if it exists and is TorchScript.
    """
    path = Path(name)
    if path.suffix.lower() in TORCHSCRIPT:
        return path.is_file() and is_torchscript(path)
    return path.suffix.lower() in SUFFIXES


def load_file(name: str, facts: NetworkFacts = NO_FACTS) -> Classifier:
    """Load a classifier from a file that contains its network.

    Args:
        name: Path of a file of TorchScript, `torch.export` (.pt2) or ONNX
            (.onnx). The network maps images (N, 3, size, size) to logits.
        facts: Classes, size and normalization. Without a size, it is that of
            the file or, if the file records none, 224. Without a
            normalization, the network gets images in [0, 1].

    Returns:
        The classifier.

    Raises:
        InputError: If the file is missing or contains something else, or if
            classes or size do not fit.
    """
    path = Path(name)
    require_file(path, "give the path of a file that contains a network")
    content = _read(path)
    batch_size, _, height, _ = content.shape
    network = content.network
    if batch_size is not None:
        network = InBatches(network, batch_size)
    if isinstance(network, nn.Module):
        # A network of torch.export refuses `eval`, and has the mode of its export.
        for part in network.modules():
            part.training = False
    size = facts.size or height or DEFAULT_SIZE
    return as_classifier(network, size, facts.classes, facts.normalization, name=name)


def build_file(name: str, size: int, facts: NetworkFacts = NO_FACTS) -> Classifier:
    """Load a classifier from a file, for images of another size.

    Args:
        name: Path of the file, see `load_file`.
        size: Pixels per side of the images.
        facts: Classes and normalization.

    Returns:
        The classifier.
    """
    return load_file(name, replace(facts, size=size))


def _read(path: Path) -> Content:
    """Read the network of a file. The ending of its name tells the format.

    Raises:
        InputError: If the file is damaged or has another format.
    """
    readers = {EXPORTED: _read_exported, ONNX: read_onnx}
    read = readers.get(path.suffix.lower(), _read_torchscript)
    try:
        return read(path)
    except InputError:
        raise
    except Exception as error:  # Each library raises many kinds for a damaged file.
        raise InputError(
            f"name={path} cannot be read ({single_line(error)}): "
            "give a file of TorchScript, torch.export (.pt2) or ONNX (.onnx)",
            "name",
        ) from error


def _read_torchscript(path: Path) -> Content:
    """Read a file that `torch.jit.save` wrote."""
    if not is_torchscript(path):
        advice = advice_for_pickles(path)
        if advice is None:
            advice = (
                "contains weights without their network: give its architecture and the weights, "
                f"as in classifier=torchvision:resnet50 weights={path}"
            )
        raise InputError(f"name={path} {advice}", "name")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns that torch.jit is deprecated.
        return Content(Scripted(torch.jit.load(path, map_location="cpu").eval()))


class Scripted(Wrapper):
    """Network of TorchScript.

    torch copies such a network with weights that are no leaves of autograd, so
    that they could not be trained. This class saves and loads it instead.
    """

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return a copy with weights of its own."""
        content = io.BytesIO()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that torch.jit is deprecated
            torch.jit.save(self.network, content)
            content.seek(0)
            copied = type(self)(torch.jit.load(content))
        for weight, copied_weight in zip(self.parameters(), copied.parameters(), strict=True):
            copied_weight.requires_grad_(weight.requires_grad)
        for module, copied_module in zip(self.modules(), copied.modules(), strict=True):
            copied_module.training = module.training
        return copied


def _read_exported(path: Path) -> Content:
    """Read a file that `torch.export.save` wrote."""
    program = torch.export.load(path)
    # The network must have a single input, the images. Its node in the graph has an example
    # value, `node.meta["val"]`, whose shape has symbols for dimensions of any size.
    [name] = program.graph_signature.user_inputs
    [node] = [node for node in program.graph.nodes if node.name == name]
    sizes = [size if isinstance(size, int) else None for size in node.meta["val"].shape]
    return Content(Exported(program.module()), sizes)


class Exported(Wrapper):
    """Network of `torch.export`, which has only the mode in which it was exported."""

    def train(self, mode: bool = True) -> Self:
        """Leave the network as it is, because it refuses `train` and `eval`."""
        self.training = mode
        return self


class InBatches(Wrapper):
    """Network that takes batches of one size, for batches of any size.

    The last batch is filled up with copies of its first image.

    Args:
        network: Module or function from images (batch_size, 3, H, W) to logits.
        batch_size: Number of images that the network takes.
    """

    def __init__(self, network: Callable[[Tensor], Tensor], batch_size: int):
        super().__init__(network)
        self.batch_size = batch_size

    def forward(self, images: Tensor) -> Tensor:
        """Compute the logits (N, C) of images (N, 3, H, W)."""
        # Number of images that fill up the last batch.
        missing_count = -len(images) % self.batch_size
        filled = torch.cat([images, images[:1].expand(missing_count, -1, -1, -1)])
        logits = [self.network(part) for part in filled.split(self.batch_size)]
        return torch.cat(logits)[: len(images)]


def read_onnx(path: Path) -> Content:
    """Read a file of ONNX with onnxruntime, on the CPU.

    Args:
        path: File with one input, images (N, 3, H, W) of float32. Its first
            output is the logits.

    Returns:
        Network without gradients, and the shape of its images.

    Raises:
        InputError: If onnxruntime is not installed.
    """
    try:
        onnxruntime: Any = importlib.import_module("onnxruntime")
    except ImportError as error:
        raise InputError(
            f'name={path} needs onnxruntime: pip install "parametric-norm-balls[onnx]"',
            "name",
        ) from error
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # Log errors and fatal errors.
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    [images] = session.get_inputs()
    sizes = [size if isinstance(size, int) else None for size in images.shape]

    def logits(batch: np.ndarray) -> np.ndarray:
        return session.run(None, {images.name: batch.astype(np.float32)})[0]

    return Content(ArrayFunction(logits), sizes)
