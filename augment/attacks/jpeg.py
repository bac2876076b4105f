"""Images after JPEG compression."""

import io

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from renderer.image import to_bytes, to_unit


def as_jpeg(images: Tensor, quality: int) -> Tensor:
    """Images (..., 3, H, W) in [0, 1], float32 on the CPU, compressed at a quality from 1 to 100 and read back."""
    flat = [_compressed(image, quality) for image in to_bytes(images).flatten(0, -4)]
    return to_unit(torch.stack(flat)).view(images.shape)


def _compressed(image: Tensor, quality: int) -> Tensor:
    file = io.BytesIO()
    Image.fromarray(image.permute(1, 2, 0).numpy()).save(file, "JPEG", quality=quality)
    with Image.open(file) as read:
        return torch.from_numpy(np.array(read)).permute(2, 0, 1)
