"""A pretended GPU: tensors that say `cuda:0`, compute on the CPU, and do not mix with others.

Tensors on the wrong device and steps that wait for a GPU are found without one. Kernels, memory and
times of a GPU are not tested.
"""

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock, patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

GPU, CPU = torch.device("cuda", 0), torch.device("cpu")
aten = torch.ops.aten
INDEXING = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
# Functions of torch.cuda that do nothing here.
DRIVER_CALLS = (
    *("synchronize", "empty_cache", "set_device", "manual_seed", "manual_seed_all", "_lazy_init"),
    *("set_rng_state", "set_rng_state_all", "reset_peak_memory_stats"),
)
# The packages whose lines are counted.
OWN = tuple(f"{Path(__file__).parents[1] / name}/" for name in ("renderer", "augment", "train"))


class GpuTensor(Tensor):
    """A tensor of the pretended GPU. PyTorch itself takes it for one on the CPU."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> "GpuTensor":
        facts = {"strides": held.stride(), "storage_offset": held.storage_offset()}
        made = Tensor._make_wrapper_subclass(cls, held.shape, dtype=held.dtype, **facts)
        made.held = held
        return made

    def __init__(self, held: Tensor):
        """Do nothing, because `__new__` has made the tensor."""

    device = property(lambda self: GPU)
    is_cuda = property(lambda self: True)

    def __format__(self, form: str) -> str:
        return format(self.item(), form)

    def untyped_storage(self):
        return self.held.untyped_storage()

    def __deepcopy__(self, memo):
        copied = GpuTensor(self.held.detach().clone())
        if isinstance(self, torch.nn.Parameter):
            copied = torch.nn.Parameter(copied, self.requires_grad)
        memo[id(self)] = copied.requires_grad_(self.requires_grad)
        return copied

    @classmethod
    def __torch_function__(cls, function, types, arguments=(), options=None):
        if function in (Tensor.numpy, Tensor.__array__):
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        if function is Tensor.tolist:
            _wait()
            return arguments[0].held.tolist()
        with torch._C.DisableTorchFunctionSubclass():
            return function(*arguments, **(options or {}))

    @classmethod
    def __torch_dispatch__(cls, function, types, arguments=(), options=None):
        return _dispatched(function, arguments, options or {})


class _Move(torch.autograd.Function):
    """Copy a tensor to another device. Its gradient goes back."""

    @staticmethod
    def forward(context, tensor, dtype, device):
        context.tensor = tensor
        copied = aten._to_copy(_held(tensor), dtype=dtype)
        return GpuTensor(copied) if device.type == "cuda" else copied

    @staticmethod
    def backward(context, gradient):
        moved = _move(gradient, context.tensor.dtype, context.tensor.device, waits=True)
        return moved, None, None


def _held(leaf):
    return leaf.held if isinstance(leaf, GpuTensor) else leaf


def _move(tensor, dtype, device, waits):
    device = tensor.device if device is None else torch.device(device)
    dtype = dtype or tensor.dtype
    if device.type == tensor.device.type:
        return tensor if dtype == tensor.dtype else aten._to_copy(tensor, dtype=dtype)
    if waits:
        _wait()
    return _Move.apply(tensor, dtype, device)


def _wait() -> None:
    """Note the line of the project that waits for the GPU."""
    frame = sys._getframe(1)
    while frame.f_back and not frame.f_code.co_filename.startswith(OWN):
        frame = frame.f_back
    _state.waits[f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"] += 1


def is_read(function, arguments) -> bool:
    """Return whether a CPU waits for the result of an operation on a GPU."""
    kind = function.overloadpacket
    if kind in INDEXING:
        indices = [leaf for leaf in tree_leaves(arguments[1]) if isinstance(leaf, Tensor)]
        return any(index.dtype == torch.bool for index in indices)
    return kind in (aten._local_scalar_dense, aten.nonzero)


def _dispatched(function, arguments, options):
    """Run an operation on the CPU. Its results are on the GPU if a tensor that it gets is."""
    kind = function.overloadpacket
    tensors = [leaf for leaf in tree_leaves((arguments, options)) if isinstance(leaf, Tensor)]
    is_on_gpu = [isinstance(tensor, GpuTensor) for tensor in tensors]
    given = options.get("device")
    is_gpu = any(is_on_gpu)
    if is_gpu and not all(is_on_gpu) and kind not in (aten.copy_, aten._to_copy):
        mixed = [x for x, on_gpu in zip(tensors, is_on_gpu, strict=True) if not on_gpu and x.dim()]
        # Indices on the CPU may select from a tensor on the GPU, but not the other way around.
        if mixed and not (kind in INDEXING and is_on_gpu[0]):
            raise RuntimeError(f"{function}: all tensors must be on one device, not cuda:0 and cpu")
        if any(index.numel() for index in mixed):
            _wait()
    if is_gpu and is_read(function, arguments):
        _wait()
    held_arguments, held_options = tree_map(_held, (arguments, options))
    if given is not None:
        held_options["device"] = CPU
    held_options.pop("pin_memory", None)
    result = function(*held_arguments, **held_options)
    if kind is aten.copy_:
        is_gpu = is_on_gpu[0]
    elif kind is aten._local_scalar_dense:
        return result
    # `_Functions` moves tensors, so that other copies stay on their device.
    elif kind is not aten._to_copy and given is not None and not (tensors and _state.depth):
        is_gpu = bool(_state.depth) or torch.device(given).type == "cuda"
    if not is_gpu:
        return result
    # An operation in place returns the tensor that it got.
    known = {id(tensor.held): tensor for tensor in tensors if isinstance(tensor, GpuTensor)}

    def on_gpu(leaf):
        if not isinstance(leaf, Tensor):
            return leaf
        return known[id(leaf)] if id(leaf) in known else GpuTensor(leaf)

    return tree_map(on_gpu, result)


class _Functions(TorchFunctionMode):
    """Moves tensors where a function names a device. Other functions keep their results there."""

    def __torch_function__(self, function, types, arguments=(), options=None):
        options = options or {}
        source = arguments[0] if arguments else None
        if function in (Tensor.to, Tensor.cpu, Tensor.cuda):
            return _to(function, *arguments, **options)
        if function is Tensor.pin_memory:
            return source
        if function is Tensor.new_tensor and isinstance(source, GpuTensor):
            made = torch.tensor(arguments[1], dtype=options.get("dtype", source.dtype))
            return _move(made, None, GPU, waits=made.numel())
        if function in (torch.asarray, torch.as_tensor, torch.tensor):
            if isinstance(source, Tensor):
                return _move(source, options.get("dtype"), options.get("device"), waits=True)
            if torch.device(options.get("device") or CPU).type == "cuda":
                made = function(*arguments, **options | {"device": CPU})
                return _move(made, None, GPU, waits=made.numel())
        leaves = tree_leaves((arguments, options))
        is_backward = function in (torch.autograd.grad, torch.autograd.backward, Tensor.backward)
        if is_backward or not any(isinstance(leaf, GpuTensor) for leaf in leaves):
            return function(*arguments, **options)
        # What a function of C++ makes from a tensor of the GPU is on the GPU.
        with nullcontext() if options.get("device") is not None else _inheriting():
            return function(*arguments, **options)


def _to(function, tensor, *arguments, non_blocking=False, copy=False, **options):
    with torch._C.DisableTorchFunctionSubclass():
        device, dtype = {Tensor.cpu: CPU, Tensor.cuda: GPU}.get(function), None
        if arguments and isinstance(arguments[0], Tensor):
            device, dtype = arguments[0].device, arguments[0].dtype
        elif device is None:
            options.pop("memory_format", None)
            device, dtype, *_ = torch._C._nn._parse_to(*arguments, **options)
        is_waiting = not (non_blocking and torch.device(device or CPU).type == "cuda")
        moved = _move(tensor, dtype, device, is_waiting)
        return moved.clone() if copy and moved is tensor else moved


class _Operations(TorchDispatchMode):
    """Runs operations that get no tensor of the GPU, such as those that make one."""

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        return _dispatched(function, arguments, options or {})


@contextmanager
def _inheriting() -> Iterator[None]:
    """Let new tensors be on the GPU, because what they are made from is there."""
    _state.depth += 1
    try:
        yield
    finally:
        _state.depth -= 1


_run_backward = torch.autograd.graph._engine_run_backward


def _run_backward_inheriting(outputs, *arguments, **options):
    if not any(isinstance(output, GpuTensor) for output in outputs):
        return _run_backward(outputs, *arguments, **options)
    with _inheriting(), _Functions():
        return _run_backward(outputs, *arguments, **options)


_Seeded = torch.Generator


class _Generator(_Seeded):
    """A generator of random numbers that takes the name of any device."""

    def __new__(cls, device="cpu"):
        made = _Seeded.__new__(cls, "cpu")
        made.pretended = torch.device(device)
        return made

    device = property(lambda self: self.pretended)


# Waits by lines, and the number of nested functions whose results are on the GPU.
_state = SimpleNamespace(waits=Counter(), depth=0)


@contextmanager
def pretended_gpu() -> Iterator[Counter[str]]:
    """Pretend that there is a GPU, and yield the number of waits for it at each line."""
    memory = (8 << 30, 8 << 30)
    facts = SimpleNamespace(total_memory=memory[1], name="pretended GPU", major=9, minor=0)
    answers = {"is_available": True, "is_initialized": True, "device_count": 1, "current_device": 0}
    answers |= {"mem_get_info": memory, "get_device_properties": facts}
    answers |= {"memory_reserved": 0, "memory_allocated": 0}
    answers |= {"get_device_capability": (9, 0), "is_bf16_supported": True}
    answers |= {"get_rng_state": torch.zeros(16, dtype=torch.uint8)}
    answers |= dict.fromkeys(DRIVER_CALLS)
    stream = MagicMock()
    stream.record_event.return_value.elapsed_time.return_value = 1.0
    calls = {name: lambda *_, _value=value, **__: _value for name, value in answers.items()}
    calls |= {"current_stream": lambda *_: stream}
    _state.waits = Counter()
    converts = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    with ExitStack() as stack:
        stack.callback(torch.__future__.set_overwrite_module_params_on_conversion, converts)
        stack.enter_context(patch.multiple(torch.cuda, **calls))
        for module in (torch.autograd, torch.autograd.graph):
            changed = {"_engine_run_backward": _run_backward_inheriting}
            stack.enter_context(patch.multiple(module, **changed))
        stack.enter_context(patch.object(torch, "Generator", _Generator))
        stack.enter_context(_Operations())
        stack.enter_context(_Functions())
        yield _state.waits
