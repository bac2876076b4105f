"""Preprocessing of images before a classifier: 8 bits, sensor noise, random transformations."""

import io
from collections.abc import Callable, Iterator

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn

from augment.attack_settings import AttackSettings, EOTSettings
from augment.random_streams import generator
from renderer.image import clamp, to_bytes, to_unit

# Number of images with sensor noise that `stored` yields for each image. An attack counts as a
# success only if the classifier is wrong in all of them.
NOISE_DRAWS = 3


class Quantized(nn.Module):
    """Model whose images are rounded to 8 bits per channel. The derivative passes straight through.

    Args:
        model: Model of images in [0, 1].
    """

    def __init__(self, model: nn.Module):
        super().__init__()
        self.model = model

    def forward(self, images: Tensor) -> Tensor:
        """Return the output of the model for rounded images (N, 3, H, W) in [0, 1]."""
        return self.model(straight_through(images, _round_to_bytes))


def _round_to_bytes(images: Tensor) -> Tensor:
    """Round images in [0, 1] to 8 bits, and keep their dtype."""
    return to_unit(to_bytes(images)).to(images)


def preprocessed_model(settings: AttackSettings, classifier: nn.Module) -> nn.Module:
    """Put the rounding of images to 8 bits before a classifier, if the settings ask for it.

    Args:
        settings: Settings of the attack.
        classifier: A model from images in [0, 1] to logits.

    Returns:
        A model from images in [0, 1] to logits. It is the classifier itself
        without `settings.quantized`.
    """
    return Quantized(classifier) if settings.quantized else classifier


def stored(images: Tensor, deviation: float, examples: Tensor, *key: int | str) -> Iterator[Tensor]:
    """Yield images as a camera stores them, once for each draw of its noise.

    A sensor adds its noise before the values are rounded, and so does this
    function. The noise of an example depends on the key and its index alone,
    not on the other examples or the device. No other random stream changes.

    Args:
        images: Images in [0, 1], shape (A, V, 3, H, W).
        deviation: Standard deviation of the Gaussian noise, in steps of 8 bits
            (1/255).
        examples: Indices of the examples, shape (A,), int64.
        key: Key of the random stream, such as the seed of an attack; see
            `augment.random_streams.stream_seed`.

    Yields:
        Images of 8 bits as values in [0, 1], of the type of `images`, shape
        (A, V, 3, H, W), in each of `NOISE_DRAWS` draws.
    """
    draws = [generator(*key, example) for example in examples.tolist()]
    for _ in range(NOISE_DRAWS):
        noise = torch.stack([torch.randn(images.shape[1:], generator=draw) for draw in draws])
        noisy = images + deviation / 255 * noise.to(images)
        yield to_unit(to_bytes(clamp(noisy))).to(images)


class ExpectationOverTransformations:
    """Average of the log-probabilities of a model over an image and random transformations of it.

    The transformations are drawn anew in each call. The derivative passes
    straight through their compression.

    Args:
        settings: How many transformations, and how strong they are.
        draws: CPU generator of the random numbers.
    """

    def __init__(self, settings: EOTSettings, draws: torch.Generator):
        self.settings = settings
        self._draws = draws

    def __call__(self, model: nn.Module, images: Tensor, logits: Tensor) -> Tensor:
        """Return the average log-probabilities.

        Args:
            model: Classifier with its preprocessing.
            images: Images in [0, 1], shape (N, 3, H, W).
            logits: Logits of these images, shape (N, C).

        Returns:
            Average log-probabilities, shape (N, C). They are the logits
            themselves if nothing is to be drawn.
        """
        if not self.settings.draws:
            return logits
        log_probabilities = [logits.log_softmax(1)]
        for _ in range(self.settings.draws):
            transformed_logits = model(self._transformed(images))
            log_probabilities.append(transformed_logits.log_softmax(1))
        return torch.stack(log_probabilities).mean(0)

    def _transformed(self, images: Tensor) -> Tensor:
        """Transform each image at random.

        A transformation shifts, rotates and scales the image, changes the
        exposure, adds noise and compresses the image as JPEG. All images are
        compressed with the same quality. The rest is drawn for each image.

        Args:
            images: Images in [0, 1], shape (N, 3, H, W).

        Returns:
            Transformed images in [0, 1], shape (N, 3, H, W).
        """
        settings = self.settings
        # Two shifts, an angle and a growth for each image, shape (N, 4).
        movements = settings.jitter * self._uniform(len(images), 4)
        moved = _moved(images, movements.to(images))
        # One stop is a factor of 2.
        stops = settings.exposure * self._uniform(len(images), 1, 1, 1)
        exposed = clamp(moved * (2**stops).to(images))
        noise = settings.noise * torch.randn(images.shape, generator=self._draws)
        noisy = clamp(exposed + noise.to(images))
        quality = int(torch.randint(settings.jpeg, 101, (), generator=self._draws))
        return straight_through(noisy, lambda exact: as_jpeg(exact.cpu(), quality).to(exact))

    def _uniform(self, *shape: int) -> Tensor:
        """Draw a tensor of the given shape with numbers that are uniform in [-1, 1]."""
        return 2 * torch.rand(*shape, generator=self._draws) - 1


def straight_through(images: Tensor, change: Callable[[Tensor], Tensor]) -> Tensor:
    """Change images, but compute gradients as if the images had not been changed.

    Args:
        images: Images, of any shape.
        change: A function from images to images of the same shape. It need not be
            differentiable.

    Returns:
        Changed images. Their derivative with respect to `images` is the identity.
    """
    # The difference has no gradient, because it is computed from detached images.
    exact = images.detach()
    return images + (change(exact) - exact)


def as_jpeg(images: Tensor, quality: int) -> Tensor:
    """Compress images and read them back.

    Args:
        images: Images in [0, 1] on the CPU, shape (..., 3, H, W).
        quality: Quality of the compression, from 1 to 100.

    Returns:
        Images in [0, 1], shape (..., 3, H, W), float32.
    """
    compressed = []
    for image in to_bytes(images).flatten(0, -4):
        file = io.BytesIO()
        Image.fromarray(image.permute(1, 2, 0).numpy()).save(file, "JPEG", quality=quality)
        with Image.open(file) as read:
            compressed.append(torch.from_numpy(np.array(read)).permute(2, 0, 1))
    return to_unit(torch.stack(compressed)).view(images.shape)


def _moved(images: Tensor, movements: Tensor) -> Tensor:
    """Shift, rotate and scale images. The pixels at the border are repeated beyond the border.

    Args:
        images: Images, shape (N, 3, H, W).
        movements: Shift across and down as fractions of the width, angle in
            radians, and growth as a fraction of the size, shape (N, 4). They
            describe where the new pixels lie in the given image, so the content
            of the image moves in the opposite direction.

    Returns:
        Moved images, shape (N, 3, H, W).
    """
    across, down, angle, growth = movements.unbind(1)
    cos = (1 + growth) * angle.cos()
    sin = (1 + growth) * angle.sin()
    # The affine map of each image as two rows of three numbers, shape (N, 6).
    # `affine_grid` uses coordinates from -1 to 1, so an image is 2 units wide.
    rows = torch.stack([cos, -sin, 2 * across, sin, cos, 2 * down], dim=1)
    grid = F.affine_grid(rows.view(-1, 2, 3), list(images.shape), align_corners=False)
    return F.grid_sample(images, grid, padding_mode="border", align_corners=False)
