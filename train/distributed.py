"""Training in several processes that `torchrun` starts: one global batch, whatever their number."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from augment import utils


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that torchrun started; a run by itself has none to join."""
    if int(os.environ.get("WORLD_SIZE", 1)) == 1:
        yield
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


def is_process_lost(error: Exception) -> bool:
    """Whether another process is gone that this one waited for: what NCCL raises, or gloo, by its file alone."""
    return isinstance(error, dist.DistError) or "/gloo/" in str(error)


@contextmanager
def first_process_first() -> Iterator[None]:
    """Let the first process do alone what the others then find done, such as a download."""
    if utils.rank() > 0:
        _wait()
    yield
    if utils.rank() == 0:
        _wait()


def broadcast(value: str = "") -> str:
    """The first process's value, which the others wait for."""
    values = [value]
    if utils.world_size() > 1:
        dist.broadcast_object_list(values, src=0)
    return values[0]


def any_process(flag: bool) -> bool:
    """Whether the flag is set in any process."""
    if utils.world_size() == 1:
        return flag
    flags = torch.tensor([float(flag)])  # on the CPU, so that no device has to catch up
    dist.all_reduce(flags, dist.ReduceOp.MAX)
    return bool(flags)


def summed(values: Tensor) -> Tensor:
    """The sum over all processes, in place."""
    if utils.world_size() > 1:
        dist.all_reduce(values)
    return values


def replicated(model: nn.Module) -> nn.Module:
    """The model whose gradients are averaged over all processes; itself where there is but one.

    Batch normalization takes its statistics over the global batch (`nn.SyncBatchNorm`), so that the result does not
    depend on the number of processes.
    """
    if utils.world_size() == 1:
        return model
    synchronize_norms(model)
    return DistributedDataParallel(model)


def synchronize_norms(model: nn.Module) -> None:
    """Replace every batch normalization inside the model by one over all processes."""
    like = next(model.parameters())
    kind: type[nn.Module] = nn.SyncBatchNorm if like.is_cuda else SyncBatchNormCPU
    for parent in list(model.modules()):
        for name, child in parent.named_children():
            if isinstance(child, nn.BatchNorm2d):
                setattr(parent, name, _converted(child, kind, like))


class SyncBatchNormCPU(nn.BatchNorm2d):
    """`nn.SyncBatchNorm`, which is for GPUs alone, in elementary operations; every process has as many rows."""

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return super().forward(x)
        values = x.to(torch.promote_types(x.dtype, torch.float32))
        mean = _average(values.mean((0, 2, 3)))
        centered = values - mean.view(1, -1, 1, 1)
        variance = _average(centered.square().mean((0, 2, 3)))
        self._track(mean.detach(), variance.detach(), utils.world_size() * x.numel() // x.shape[1])
        scale = (variance + self.eps).rsqrt()
        if not self.affine:
            return (centered * scale.view(1, -1, 1, 1)).to(x.dtype)
        return (centered * (self.weight * scale).view(1, -1, 1, 1) + self.bias.view(1, -1, 1, 1)).to(x.dtype)

    @torch.no_grad()
    def _track(self, mean: Tensor, variance: Tensor, count: int) -> None:
        if self.num_batches_tracked is None or self.running_mean is None or self.running_var is None:
            return
        self.num_batches_tracked += 1
        momentum = 1 / float(self.num_batches_tracked) if self.momentum is None else self.momentum
        self.running_mean.lerp_(mean, momentum)
        self.running_var.lerp_(variance * count / (count - 1), momentum)


class _Sum(torch.autograd.Function):
    """The sum over all processes; so is its gradient, since each process's loss depends on every one's values."""

    @staticmethod
    def forward(context: Any, values: Tensor) -> Tensor:
        return summed(values.clone())

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> Tensor:
        return summed(gradient.clone())


def _average(values: Tensor) -> Tensor:
    return _Sum.apply(values) / utils.world_size()


def _converted(norm: nn.BatchNorm2d, kind: type[nn.Module], like: Tensor) -> nn.Module:
    converted = kind(norm.num_features, norm.eps, norm.momentum, norm.affine, norm.track_running_stats)
    converted.to(like.device, like.dtype)
    converted.load_state_dict(norm.state_dict())
    return converted


def _wait() -> None:
    if utils.world_size() > 1:
        dist.barrier()
