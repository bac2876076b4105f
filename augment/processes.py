"""The processes that train together (`torchrun`): which examples are whose, and how shares become whole again."""

import torch
import torch.distributed as dist
from torch import Tensor


def count() -> int:
    """How many there are; 1 for a run by itself."""
    return dist.get_world_size() if dist.is_initialized() else 1


def index() -> int:
    """This one's number, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def share(total: int) -> Tensor:
    """Ascending indices of this process's examples: every `count()`-th, and at least one, which others may have too."""
    return torch.arange(index() % total, total, count())


def merged(part: Tensor, examples: Tensor, total: int) -> Tensor:
    """All `total` rows, of which every process has those of its examples; the same in every process."""
    if count() == 1:
        return part
    parts = [(part, examples)] * count()  # to be overwritten
    dist.all_gather_object(parts, (part.cpu(), examples.cpu()))
    whole = part.new_empty(total, *part.shape[1:])
    for rows, places in parts:
        whole[places.to(whole.device)] = rows.to(whole.device)
    return whole
