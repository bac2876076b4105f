"""Networks and weights from files: state dicts, TorchScript, `torch.export` and ONNX.

Files of weights are read without running code from them, and are compared with the network.
TorchScript and `torch.export` are programs: they can overwrite files, and loading them can run any
code. They are loaded only if the user trusts them. ONNX is data.
"""

import argparse
import importlib
import io
import json
import pickle
import re
import sys
import textwrap
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any, Self

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _NormBase
from torch.nn.modules.utils import consume_prefix_in_state_dict_if_present
from torch.utils._pytree import tree_leaves, tree_map

from augment import classifier as classifiers
from augment import network as wrappers
from augment.classifier import Classifier, TaskNetwork
from augment.network import FILE, YOU, Inputs, Network, say_once, unwrapped
from augment.tasks.task import Task, tensors_of
from renderer.errors import InputError, explained, reading, require_file, require_kind, single_line
from renderer.settings import MAX_SIZE, Size, as_size, height_and_width

# A network from images (N, 3, height, width) to logits, and the sizes of the four dimensions of its
# images. None stands for any size, or an unknown one.
Content = tuple[nn.Module, Sequence[int | None]]

# Weights of a network by their names.
State = Mapping[str, Tensor]

EXPORTED = ".pt2"
ONNX = ".onnx"
# Types of the images that a file of ONNX may take, in the words of onnxruntime.
ONNX_TYPES = {"tensor(float16)": "f2", "tensor(float)": "f4", "tensor(double)": "f8"}
# Endings of the names of files that may be TorchScript.
TORCHSCRIPT = (".pt", ".pth", ".ts", ".jit", ".torchscript")
# Endings of the names of all files that contain a network.
SUFFIXES = (EXPORTED, ONNX, *TORCHSCRIPT)
# Beginnings of the names of members of a file of `torch.export` that run code when they are read.
CODE_MEMBERS = ("custom_obj_", "opaque_obj_")
# Largest relative change of the logits of an image with the other images of its batch.
MAX_CHANGE = 0.01
# End of the error about a network that has dropout or the statistics of each batch.
IN_TRAINING_MODE = (
    "was exported in training mode, in which the logits of an image are random or depend on other "
    "images: call eval() before you export it"
)
# Module of transformers that defines the outputs of a network, in the graph of such a file.
OUTPUT_MODULE = re.compile(rb'"(transformers\.[\w.]+)\.\w+\\"')
# Part of the names of their compiled members.
COMPILED = "/aotinductor/"
# Keys under which training scripts store the weights of a network in a checkpoint.
_WRAPPERS = ("state_dict", "model_state_dict", "model_state", "model", "network", "net")
# What else training scripts store in a checkpoint: their arguments, as in those of torchvision, and
# numbers of NumPy, under its present and its former module.
_SCALAR = np.float64(0).__reduce__()[0]
_PERMITTED: list[Any] = [argparse.Namespace, np.dtype]
_PERMITTED += {type(np.dtype(code)) for code in "?bhilqBHILQefd"}
_PERMITTED += [(_SCALAR, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
# Prefixes that `DataParallel`, `torch.compile` and other wrappers of a network add to the names of
# its weights.
_PREFIXES = ("module.", "_orig_mod.", "model.", "network.", "net.")


@dataclass
class NetworkFacts:
    """Classes, image size and normalization that the user gives for a network.

    None leaves the choice to the source of the network, such as torchvision.

    Attributes:
        classes: Names of the classes in the order of the outputs, or a text file with a name in
            each line, which is read. If neither the user nor the source gives names, they are "0",
            "1" and so on.
        size: Pixels per side of the images, or height and width.
        normalization: "imagenet", or mean and standard deviation of the
            channels red, green and blue, in units of [0, 1].
        prompt: Text with {} for the name of a class, for zero-shot networks.
        task: What the outputs mean, for a file that contains a network.
    """

    classes: Any = None
    size: Size | None = None
    normalization: classifiers.Normalization = None
    prompt: str | None = None
    task: Task | None = None

    def __post_init__(self) -> None:
        """Check the facts, and read the file of the classes."""
        if isinstance(self.classes, str | Path):
            require_file(self.classes, "give a text file with the name of a class in each line")
            self.classes = [*filter(None, read_lines(Path(self.classes)))]
        if self.classes is not None:
            self.classes = classifiers.as_class_names("classes", self.classes)
        if self.size is not None:
            self.size = as_size("size", self.size, MAX_SIZE)
        classifiers.mean_and_std(self.normalization)
        require_kind("prompt", self.prompt, str | None, "a text with {} for the name of a class")
        expected = "a task, such as nb.Detection(decode=function)"
        require_kind("task", self.task, Task | None, expected)

    def inputs(self, size: str | None, normalization: str | None) -> Inputs:
        """Return who states the facts about the images of a network, besides the user."""
        normalization = normalization if self.normalization is None else YOU
        return Inputs(YOU if self.size else size, normalization, normalization)


def read_lines(path: Path) -> list[str]:
    """Read the lines of a text file, without spaces at their ends. Some may be empty."""
    with explained(f"{path} is no text in UTF-8", "save it as UTF-8"):
        return [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]


def require_no_facts(name: str, facts: NetworkFacts) -> None:
    """Check that the user gives no facts about a network that defines them itself."""
    for setting, value in vars(facts).items():
        if value is not None:
            reason = f"{setting} cannot be set for {name}, because this network already defines it"
            raise InputError(f"{reason}: leave it out", setting)


def is_network_file(name: str) -> bool:
    """Return whether a name is the path of a file with a network, not with weights alone.

    The suffix decides. Only for .pt and similar suffixes, which files of weights
    have, too, the file must also exist and be TorchScript.
    """
    suffix = Path(name).suffix.lower()
    return suffix in (EXPORTED, ONNX) or (suffix in TORCHSCRIPT and is_torchscript(Path(name)))


def name_from_anywhere(name: str) -> str:
    """Return the name of a network with the absolute path of its file or folder."""
    folder = Path(name.removeprefix("hf:"))
    if name.startswith("hf:") and folder.is_dir():
        return f"hf:{folder.absolute()}"
    return str(Path(name).absolute()) if is_network_file(name) else name


def name_error(name: str | Path, reason: str) -> InputError:
    """Return an error about the argument `name`, which names a network."""
    return InputError(f"name={name} {reason}", "name")


def reading_network(name: str | Path, fault: str, advice: str) -> AbstractContextManager[None]:
    """Name a network in the errors of its files or of a connection."""
    return reading(f"name={name}", fault, advice, "name")


def import_package(package: str, name: str, install: str = "") -> Any:
    """Import an optional package, which the network of a given name needs."""
    advice = f"pip install {install or package}"
    with explained(f"name={name} needs {package}", advice, "name", ImportError):
        return importlib.import_module(package)


def load_file(name: str, facts: NetworkFacts, trust_code: bool) -> TaskNetwork:
    """Load a classifier from a file that contains its network.

    Without a size, that of the file counts or, if it tells none, 224. Without a normalization, the
    network gets images in [0, 1].
    """
    path = Path(name)
    require_file(path, "give the path of a file that contains a network")
    if not trust_code and (path.suffix.lower() == EXPORTED or is_torchscript(path)):
        advice = "set trust=true (trust_code=True in Python) if you trust its author"
        reason = f"is a program, which can run any code and overwrite your files: {advice}"
        raise name_error(path, f"{reason}, otherwise ask for a state dict, safetensors or ONNX")
    readers: dict[str, Callable[[Path], Content]] = {EXPORTED: _read_exported}
    readers[ONNX] = partial(_read_onnx, size=facts.size)
    read = readers.get(path.suffix.lower(), _read_torchscript)
    advice = "give a file of TorchScript, torch.export (.pt2) or ONNX (.onnx)"
    with reading_network(path, "cannot be read", advice):
        # The sizes are those of the four dimensions of images. None stands for any size.
        network, (batch_size, _, height, width) = read(path)

    if batch_size is not None:
        # The file takes batches of one size only. `InBatches` splits other numbers of images.
        network = InBatches(network, batch_size, batch_size)
    # Set the mode without a call of `eval`, which networks of torch.export refuse.
    for module in network.modules():
        module.training = False
    # Images are square if the file fixes one side only. None if it fixes no side.
    size_in_file = (height, width) if height and width else height or width
    given = facts.size or size_in_file, facts.classes, facts.normalization
    named: dict[str, Any] = {"name": name, "size_from": YOU if facts.size else FILE}
    loaded = classifiers.as_network(network, *given, task=facts.task, says=False, **named)
    if isinstance(loaded, Classifier):
        _require_evaluation_outputs(loaded, name)
    return loaded


def _require_evaluation_outputs(classifier: Classifier, name: str) -> None:
    """Raise InputError if logits are random or depend on other images (exported training mode)."""
    shape = (3, 3, *height_and_width(classifier.size))
    # Three random images, the same in each call.
    images = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    # Show the first image beside the second and then beside the third. Its logits must not change.
    with torch.no_grad():
        outputs = [classifier.network(images[[0, other]]) for other in (1, 2)]
    if isinstance(outputs[0], tuple) and len(outputs[0]) > 1:
        of_first = f"the first is used, with {len(classifier.classes)} classes"
        say_once(f"{name} has {len(outputs[0])} outputs: {of_first}")
    first, second = (wrappers.plain_outputs(output).float() for output in outputs)
    if (first[0] - second[0]).abs().max() > MAX_CHANGE * (first.max() - first.min()):
        raise name_error(name, IN_TRAINING_MODE)


def _read_torchscript(path: Path) -> Content:
    """Read a file of TorchScript, which `torch.jit.save` wrote."""
    if not is_torchscript(path):
        reason = "contains weights without their network: give its architecture and the weights"
        example = f"as in network=torchvision:resnet50 weights={path}"
        reason = advice_for_pickles(path) or f"{reason}, {example}"
        raise name_error(path, f"cannot be loaded, because it {reason}")
    with warnings.catch_warnings(action="ignore"):  # Ignore that torch.jit is deprecated.
        network = Scripted(torch.jit.load(path, map_location="cpu").eval())
    return network, (None, None, None, None)  # TorchScript stores no size of the images.


class Scripted(Network):
    """Network of TorchScript that can be copied and then trained.

    `copy.deepcopy` of torch gives such a network weights that are not leaves of
    the graph of autograd, so that they cannot be trained. This class copies the
    network by saving and loading it.
    """

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return a copy with weights of its own."""
        content = io.BytesIO()
        with warnings.catch_warnings(action="ignore"):  # Ignore that torch.jit is deprecated.
            torch.jit.save(self.network, content)
            content.seek(0)
            # The file keeps the modes of the modules, and `requires_grad` of the weights.
            return type(self)(torch.jit.load(content))


def _read_exported(path: Path) -> Content:
    """Read a network that `torch.export.save` wrote to a file."""
    _require_plain_members(path)
    with zipfile.ZipFile(path) as archive:
        graphs = [archive.read(name) for name in archive.namelist() if name.endswith("/model.json")]
    # torch knows the outputs of a network of transformers only if their module is imported.
    for module in {*OUTPUT_MODULE.findall(b"".join(graphs))}:
        import_package(module.decode(), str(path), '"parametric-norm-balls[hf]"')
    program = torch.export.load(path)
    for node in program.graph.nodes:
        schema = getattr(node.target, "_schema", None)
        # `train` is an argument of dropout, and `training` one of batch normalization.
        # Mask of the arguments of an operation that choose between training and evaluation mode.
        modes = [place.name.startswith("train") for place in schema.arguments] if schema else []
        if any(value is True for value in compress(node.args, modes)):
            raise name_error(path, IN_TRAINING_MODE)
    # The network has one input, the images. Find the node of the graph that stands for it.
    inputs = program.graph_signature.user_inputs
    if len(inputs) > 1:
        raise name_error(path, f"takes {', '.join(map(str, inputs))}: export it for images alone")
    [node] = [node for node in program.graph.nodes if node.name == inputs[0]]
    # `node.meta["val"]` is an example of the images. In its shape, the dimensions of fixed size are
    # whole numbers, and the others are symbols.
    shape = node.meta["val"].shape
    sizes = [size if isinstance(size, int) else None for size in shape]
    network: nn.Module = Exported(program.module())
    # A number that is computed, such as a multiple of another one, has no bounds here.
    bounds = None if sizes[0] else program.range_constraints.get(shape[0].node.expr)
    if bounds is not None:
        # A missing upper bound is an infinity of sympy.
        least, most = int(bounds.lower), int(min(bounds.upper, sys.maxsize))
        # Files often say that they take two images or more, and take one.
        if least > 2 or most < sys.maxsize:
            network = InBatches(network, least, most)
    return network, sizes


def _require_plain_members(path: Path) -> None:
    """Raise InputError if a member of a file of `torch.export` runs code when it is read.

    These are pickled objects that `torch.load(weights_only=True)` refuses, tensors that are pickled
    (`use_pickle`), custom and opaque objects, and compiled libraries. A name that occurs twice
    could hide one of them.
    """
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        for name in names:
            file_name = Path(name).name
            if (
                names.count(name) > 1
                or file_name.startswith(CODE_MEMBERS)
                or COMPILED in name
                or (file_name.endswith(".json") and _uses_pickle(archive.read(name)))
                or (file_name.endswith(".pt") and not _is_readable(archive.read(name)))
            ):
                advice = "export it with tensors alone as its constants and example inputs"
                reason = f"has the member {name}, which could run any code when it is read"
                raise name_error(path, f"{reason}: {advice}")


def _uses_pickle(content: bytes) -> bool:
    """Return whether a JSON text has, at any depth, an entry use_pickle that is true."""
    found: list[Any] = []
    json.loads(content, object_hook=lambda entries: found.append(entries.get("use_pickle")))
    return any(found)


def _is_readable(content: bytes) -> bool:
    """Return whether torch can read pickled bytes without running code. No bytes are readable."""
    try:
        if content:
            torch.load(io.BytesIO(content), weights_only=True)
    except Exception:  # `torch.load` raises errors of many types.
        return False
    return True


class Exported(Network):
    """Network of `torch.export`, which has only the mode in which it was exported."""

    def train(self, mode: bool = True) -> Self:
        """Leave the network as it is, because it refuses `train` and `eval`."""
        self.training = mode
        return self


class InBatches(Network):
    """Give a network batches of a size that it takes, whatever the number of images is.

    The last batch is filled up with copies of the first image.

    Args:
        network: Module or function from images (B, 3, H, W) to logits.
        least: Smallest number of images that the network takes.
        most: Largest number of images that it takes.
    """

    def __init__(self, network: Callable[[Tensor], Tensor], least: int, most: int):
        super().__init__(network)
        self.least = least
        self.most = most

    def forward(self, images: Tensor) -> Any:
        """Compute the outputs of images (N, 3, H, W). A list of outputs becomes a tuple."""
        # Without images, the network gets black ones.
        shown = images if len(images) else nn.functional.pad(images, (0,) * 7 + (1,))
        # Number of copies that fill up the last batch.
        last_count = (len(shown) - 1) % self.most + 1
        missing_count = max(0, self.least - last_count)
        filled = torch.cat([shown, shown[:1].expand(missing_count, -1, -1, -1)])
        parts = [self.network(batch) for batch in filled.split(self.most)]
        joined = tree_map(lambda *of: torch.cat(of), *parts)
        # A file that suppresses boxes itself has a row for each box that is left.
        if any(len(leaf) != len(filled) for leaf in tensors_of(joined)):
            advice = "export it without suppression of boxes, or write a python: function"
            raise InputError(f"the file did not return one row for each image: {advice}")
        joined = tree_map(lambda leaf: leaf[: len(images)], joined)
        return tuple(joined) if isinstance(joined, list) else joined


def _read_onnx(path: Path, size: Size | None) -> Content:
    """Read a file of ONNX, with gradients if onnx2torch is installed and converts it exactly."""
    network, sizes, is_last = read_onnx(path)
    # Free dimensions become those of two images of the user's size, or else of 224 pixels.
    defaults = (2, 3, *height_and_width(size or classifiers.USUAL_SIZE))
    shape = [fixed or default for fixed, default in zip(sizes, defaults, strict=True)]
    images = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    expected = network(images)
    try:
        with torch.no_grad():
            converted = importlib.import_module("onnx2torch").convert(str(path)).eval()
            converted = Converted(converted, is_last, bool(network.has_probabilities))
            # Compare all outputs of the converted network with those of onnxruntime.
            for pair in zip(tree_leaves(converted(images)), tree_leaves(expected), strict=True):
                torch.testing.assert_close(*pair, rtol=1e-3, atol=1e-3)
    # onnx2torch may be absent. It lacks some operations, and fails in many ways.
    except Exception as error:
        reason = single_line(error)
        say_once(f"{path} has no gradients, since onnx2torch fails ({reason}): attacks search")
        return network, sizes
    return converted, sizes


class Converted(Network):
    """Network of onnx2torch, with channels first and logits, as `read_onnx` gives them."""

    def __init__(self, network: nn.Module, is_last: bool, has_probabilities: bool):
        super().__init__(network)
        self.is_last, self.has_probabilities = is_last, has_probabilities

    def forward(self, images: Tensor) -> Any:
        """Compute the outputs of images (N, 3, H, W)."""
        outputs: Any = self.network(images.permute(0, 2, 3, 1) if self.is_last else images)
        # Several outputs are a list of onnx2torch.
        outputs = tuple(outputs) if isinstance(outputs, list) else outputs
        return wrappers.log_probabilities(outputs) if self.has_probabilities else outputs


def read_onnx(path: Path) -> tuple[wrappers.Function, list[int | None], bool]:
    """Read a file of ONNX with onnxruntime, on the CPU.

    The network has no gradients. Its one input is images. Several outputs are a tuple.
    Return also the sizes of images (N, 3, H, W), and whether the file has channels last, as those
    of TensorFlow have.
    """
    onnxruntime = import_package("onnxruntime", str(path), '"parametric-norm-balls[onnx]"')
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # Log errors and fatal errors.
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    images, *others = session.get_inputs()
    if others or images.type not in ONNX_TYPES:
        given = ", ".join(f"{entry.name} of {entry.type}" for entry in (images, *others))
        raise name_error(path, f"takes {given}: export it with one input of float32")
    sizes = [size if isinstance(size, int) else None for size in images.shape]
    is_last = sizes[3] == 3 != sizes[1]
    if is_last:
        sizes = [sizes[axis] for axis in (0, 3, 1, 2)]

    def outputs(batch: np.ndarray) -> Any:
        batch = batch.transpose(0, 2, 3, 1) if is_last else batch
        found = session.run(None, {images.name: batch.astype(ONNX_TYPES[images.type])})
        return found[0] if len(found) == 1 else tuple(map(torch.from_numpy, found))

    return wrappers.Function(outputs, wrappers.ARRAYS), sizes, is_last


def read_weights(path: Path) -> State:
    """Read the weights of a network without running code from the file.

    Return the state dict on the CPU, without the prefixes of `DataParallel` and `torch.compile`.
    """
    require_file(path, "give the path of a file of weights")
    try:
        if path.suffix.lower() == ".safetensors":
            return _without_prefixes(safetensors.torch.load_file(path))
        with torch.serialization.safe_globals(_PERMITTED):
            content = torch.load(path, map_location="cpu", weights_only=True)
        return _without_prefixes(_state_dict(content))
    # torch and safetensors raise many kinds of errors for damaged files.
    except Exception as error:
        reason = textwrap.shorten(str(error), 200)
        if isinstance(error, pickle.UnpicklingError):
            reason = "it is not a file of weights, or contains other objects"
        fault = f"cannot be read ({reason}): save a network's state_dict() alone"
        if (advice := advice_for_pickles(path)) is not None:
            fault = f"cannot be loaded, because it {advice}"
        raise InputError(f"weights={path} {fault}", "weights") from error


def _state_dict(content: Any) -> State:
    """Find the state dict in the content of a file of weights."""
    # A mapping that has not only tensors is a checkpoint. Look under the usual keys.
    while isinstance(content, Mapping) and not all(
        isinstance(value, Tensor) for value in content.values()
    ):
        # Names of mappings. Those of moving averages contain "ema", as in timm and torchvision.
        names = [key for key, value in content.items() if isinstance(value, Mapping)]
        used = next((key for key in _WRAPPERS if key in names), None)
        if used is None:
            raise TypeError(f"it contains no weights, but {', '.join(map(str, content))}")
        for average in (key for key in names if "ema" in re.split(r"[_.]", str(key).lower())):
            say_once(f"{used} of the checkpoint is used: save {average} alone to use that")
        content = content[used]
    if not isinstance(content, Mapping):
        raise TypeError(f"it contains a value of type {type(content).__name__}")
    return content


def _without_prefixes(state: Any) -> State:
    """Remove prefixes such as "module." from the names of weights, if all names have them."""
    # torch.optim.swa_utils.AveragedModel counts averages beside the weights.
    state.pop("n_averaged", None)
    for prefix in _PREFIXES:
        if state and all(key.startswith(prefix) for key in state):
            # This keeps the versions of modules, without which MNASNet cannot be loaded.
            consume_prefix_in_state_dict_if_present(state, prefix)
            return _without_prefixes(state)
    return state


def advice_for_pickles(path: Path) -> str | None:
    """Return advice for a user who gave a file with a whole network as a file of weights.

    Its subject is the file. None stands for a file without a network.
    """
    if is_torchscript(path):
        return f"is TorchScript, which contains its own network: set network={path} trust=true"
    try:
        names = torch.serialization.get_unsafe_globals_in_checkpoint(path)
    except Exception:  # `torch.save` did not write the file.
        return None
    if not any(name.startswith("torch.nn.modules.") for name in names):
        return None
    return (
        "contains a pickled module, which runs code when it is loaded: if you made the file, save "
        f'its weights with the two lines network = torch.load("{path}", weights_only=False) and '
        'torch.save(network.state_dict(), "weights.pth")'
    )


def is_torchscript(path: Path) -> bool:
    """Return whether a file is an archive of TorchScript, which contains constants.pkl."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def fill(classifier: Classifier, state: State, source: str | Path) -> Classifier:
    """Load weights into the network of a classifier.

    The classifier is changed in place and returned.
    """
    misfit = f"weights={source} do not fit {classifier.name}"
    with explained(misfit, "use weights of that network", "weights"):
        load_weights(unwrapped(classifier), state)
    return classifier


def load_weights(network: nn.Module, state: State) -> None:
    """Load weights, with or without the versions of modules, which safetensors does not store."""
    weights: Any = OrderedDict(state)
    # MNASNet cannot be loaded without its version. With the version of batch normalization,
    # older files would be refused.
    modules = network.named_modules()
    own = {key: {"version": of._version} for key, of in modules if not isinstance(of, _NormBase)}
    weights._metadata = getattr(state, "_metadata", own)
    network.load_state_dict(weights)
