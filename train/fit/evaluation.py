"""A network's loss and accuracy on labeled images."""

import torch
import torch.nn.functional as F
from torch import nn

from augment import utils
from augment.utils import eval_mode
from renderer.image import to_unit
from train.data import Split
from train.distributed import summed

BATCH = 512  # images at a time


@torch.no_grad()
def evaluate(model: nn.Module, split: Split) -> dict[str, float]:
    """Mean cross entropy and top-1 accuracy in eval mode; the model's mode is restored.

    Every process of a run scores its share of the images; all get the result.
    """
    share = slice(utils.rank(), None, utils.world_size())
    loss_sum, correct = totals = torch.zeros(2, device=split.images.device)
    with eval_mode(model):
        for images, labels in zip(split.images[share].split(BATCH), split.labels[share].split(BATCH), strict=True):
            logits = model(to_unit(images))
            loss_sum += F.cross_entropy(logits, labels, reduction="sum")
            correct += (logits.argmax(1) == labels).sum()
    loss_sum, correct = summed(totals).tolist()
    return {"loss": loss_sum / len(split), "accuracy": correct / len(split)}
