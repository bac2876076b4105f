"""Divides examples among the processes of a distributed training, and gathers their results."""

import torch
import torch.distributed as dist
from torch import Tensor


def world_size() -> int:
    """Return the number of processes that train together, which is 1 without `torchrun`."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """Return the number of this process, counted from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def shard(total: int, rank: int, world_size: int) -> Tensor:
    """Return the examples of one process.

    Args:
        total: The number of examples, at least 1.
        rank: The number of the process, counted from 0.
        world_size: The number of processes.

    Returns:
        Ascending indices, int64: every `world_size`-th example, and at least
        one, even if another process has it, too.

    Example:
        >>> shard(5, rank=1, world_size=2)
        tensor([1, 3])
    """
    return torch.arange(rank % total, total, world_size)


def all_gather_rows(part: Tensor, examples: Tensor, total: int, world_size: int) -> Tensor:
    """Gather the rows of all examples from all processes.

    Args:
        part: The rows of this process, shape (A, ...).
        examples: The examples of these rows, shape (A,), int64.
        total: The number of examples of all processes.
        world_size: The number of processes.

    Returns:
        The rows of all examples, shape (total, ...), the same in every process.
    """
    if world_size == 1:
        return part
    # These entries are placeholders. `all_gather_object` replaces entry i by what
    # process i sends.
    parts = [(part, examples)] * world_size
    dist.all_gather_object(parts, (part.cpu(), examples.cpu()))
    whole = part.new_empty(total, *part.shape[1:])
    for rows, indices in parts:
        whole[indices.to(whole.device)] = rows.to(whole.device)
    return whole
