"""Divide examples among the processes of a distributed training, and gather their results."""

import torch.distributed as dist
from jaxtyping import Int, Shaped
from torch import Tensor


def world_size() -> int:
    """Return the number of processes that train together, which is 1 without `torchrun`."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """Return the index of this process among those that train together, counted from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def all_gather_rows(
    part: Shaped[Tensor, "A ..."], examples: Int[Tensor, " A"], total: int, world_size: int
) -> Shaped[Tensor, "total ..."]:
    """Collect the results for all examples from all processes.

    `examples` has the index of each row of this process. Every process gets the same result.
    """
    if world_size == 1:
        return part
    # Make a list with an entry for each process. `all_gather_object` replaces entry i by what
    # process i sends.
    parts = [(part, examples)] * world_size
    dist.all_gather_object(parts, (part.cpu(), examples.cpu()))
    whole = part.new_empty(total, *part.shape[1:])
    for rows, indices in parts:
        whole[indices.to(whole.device)] = rows.to(whole.device)
    return whole
