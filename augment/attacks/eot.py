"""Preprocessing of images before a classifier: 8 bits, sensor noise, random transformations."""

import io
from collections.abc import Iterator

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor, nn

from augment.attack_settings import AttackSettings, EOTSettings
from augment.network import Network, Quantization, straight_through
from augment.random_streams import generator
from renderer.image import clamp, to_bytes, to_unit

# Number of noisy versions of an image that `add_sensor_noise` yields. An attack counts as a success
# only if the classifier is wrong in all of them.
NOISE_DRAWS = 3


def preprocessed_model(settings: AttackSettings, classifier: nn.Module) -> nn.Module:
    """Return a classifier that rounds images to 8 bits, if `settings.quantized` asks for it."""
    return Network(classifier, [Quantization()]) if settings.quantized else classifier


def add_sensor_noise(
    images: Float[Tensor, "A V _ H W"],
    deviation: float,
    examples: Int[Tensor, " A"],
    *key: int | str,
) -> Iterator[Tensor]:
    """Add sensor noise to images and round them to 8 bits, as a camera does.

    This is repeated `NOISE_DRAWS` times with different noise. The noise of an example depends only
    on the key and on the index of the example. The deviation is in units of 1/255, and the noisy
    images are rounded to 8 bits.
    """
    generators = [generator(*key, example) for example in examples.tolist()]
    for _ in range(NOISE_DRAWS):
        noise = torch.stack(
            [torch.randn(images.shape[1:], generator=draws) for draws in generators]
        )
        noisy = images + deviation / 255 * noise.to(images)
        yield to_unit(to_bytes(clamp(noisy))).to(images)


class ExpectationOverTransformations:
    """Average predictions over random transformations of an image (EOT, Athalye et al. 2018).

    The log-probabilities of the image and of its transformed copies are
    averaged. Each call draws new transformations. Gradients ignore the JPEG
    compression (straight-through estimator).

    Args:
        settings: Number and strength of the transformations.
        draws: CPU generator of the random numbers.
    """

    def __init__(self, settings: EOTSettings, draws: torch.Generator):
        self.settings = settings
        self._draws = draws

    def __call__(
        self, model: nn.Module, images: Float[Tensor, "N _ H W"], logits: Float[Tensor, "N C"]
    ) -> Float[Tensor, "N C"]:
        """Average the log-probabilities of images and of their random transformations.

        With 0 transformations, the given logits are returned as they are.
        """
        if not self.settings.draws:
            return logits
        log_probabilities = [logits.log_softmax(1)]
        for _ in range(self.settings.draws):
            transformed_logits = model(self._transformed(images)).to(logits.dtype)
            log_probabilities.append(transformed_logits.log_softmax(1))
        return torch.stack(log_probabilities).mean(0)

    def _transformed(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N 3 H W"]:
        """Transform each image at random.

        A transformation shifts, rotates and scales the image, changes the exposure, adds noise and
        compresses the image as JPEG. The quality of the compression is the same for all images of a
        call. Everything else differs between images.
        """
        settings = self.settings
        # Two shifts, a rotation and a relative change of size for each image, shape (N, 4).
        movements = settings.jitter * self._uniform(len(images), 4)
        moved = _moved(images, movements.to(images))
        # Change of the exposure in stops. One stop doubles the exposure.
        stops = settings.exposure * self._uniform(len(images), 1, 1, 1)
        exposed = clamp(moved * (2**stops).to(images))
        noise = settings.noise * torch.randn(images.shape, generator=self._draws)
        noisy = clamp(exposed + noise.to(images))
        quality = int(torch.randint(settings.jpeg, 101, (), generator=self._draws))
        return straight_through(noisy, lambda exact: as_jpeg(exact.cpu(), quality).to(exact))

    def _uniform(self, *shape: int) -> Tensor:
        """Draw a tensor of the given shape with numbers that are uniform in [-1, 1]."""
        return 2 * torch.rand(*shape, generator=self._draws) - 1


def as_jpeg(images: Float[Tensor, "... 3 H W"], quality: int) -> Float[Tensor, "... 3 H W"]:
    """Compress images as JPEG and decompress them. The quality is from 1 to 100."""
    decompressed = []
    for image in to_bytes(images).flatten(0, -4):
        file = io.BytesIO()
        # pillow has the channels last.
        Image.fromarray(image.permute(1, 2, 0).numpy()).save(file, "JPEG", quality=quality)
        with Image.open(file) as read:
            decompressed.append(torch.from_numpy(np.array(read)).permute(2, 0, 1))
    return to_unit(torch.stack(decompressed)).view(images.shape)


def _moved(
    images: Float[Tensor, "N 3 H W"], movements: Float[Tensor, "N 4"]
) -> Float[Tensor, "N 3 H W"]:
    """Shift, rotate and scale images. The pixels at the border are repeated beyond the border.

    Each new pixel takes its value from a position in the given image. The movement is that of these
    positions, so the content of the image moves in the opposite direction. The four numbers of a
    movement are the shift across and the shift down as fractions of the image size, the rotation in
    radians, and g. Distances from the center are multiplied by 1 + g.
    """
    across, down, angle, growth = movements.unbind(1)
    cos = (1 + growth) * angle.cos()
    sin = (1 + growth) * angle.sin()
    # `affine_grid` uses coordinates from -1 to 1. A shift by the whole image is therefore 2.
    first_row = torch.stack([cos, -sin, 2 * across], dim=1)
    second_row = torch.stack([sin, cos, 2 * down], dim=1)
    # Affine maps of the N images, shape (N, 2, 3).
    matrices = torch.stack([first_row, second_row], dim=1)
    grid = F.affine_grid(matrices, list(images.shape), align_corners=False)
    return F.grid_sample(images, grid, padding_mode="border", align_corners=False)
