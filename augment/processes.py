"""The processes that train together (`torchrun`): which examples are whose, and how shares become whole again."""

import torch
import torch.distributed as dist
from torch import Tensor


def world_size() -> int:
    """How many there are; 1 for a run by itself."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """This one's number, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def share(total: int) -> Tensor:
    """Ascending indices of this process's examples: every `world_size()`-th, at least one, also if others have it."""
    return torch.arange(rank() % total, total, world_size())


def merged(part: Tensor, examples: Tensor, total: int) -> Tensor:
    """All `total` rows, of which every process has those of its examples; the same in every process."""
    if world_size() == 1:
        return part
    parts = [(part, examples)] * world_size()  # to be overwritten
    dist.all_gather_object(parts, (part.cpu(), examples.cpu()))
    whole = part.new_empty(total, *part.shape[1:])
    for rows, places in parts:
        whole[places.to(whole.device)] = rows.to(whole.device)
    return whole
