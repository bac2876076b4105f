"""Keep the outputs of a classifier, so that it never classifies the same image twice."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import blake2b

import torch
from torch import Tensor

from augment.classifiers.adapter import Classifier, Wrapper


class Remembered(Wrapper):
    """Call a function from images to scores only once for each different image.

    An attack shows the same image to a classifier several times: before, during
    and after the search. This is expensive if the function is slow or paid for.
    The scores have no gradients.

    Attributes:
        scores: Scores of the C classes for each image so far, shape (C,), by the
            hash of the image.
    """

    def __init__(self, network: Callable[[Tensor], Tensor]):
        super().__init__(network)
        self.scores: dict[bytes, Tensor] = {}

    def forward(self, images: Tensor) -> Tensor:
        """Compute the scores (N, C) of images (N, 3, H, W)."""
        keys = [_digest(image) for image in images.detach().cpu()]
        # Index of each new image in the batch, by its hash. Equal images have one entry.
        new_images = {}
        for index, key in enumerate(keys):
            if key not in self.scores:
                new_images[key] = index
        if new_images:
            indices = torch.tensor(list(new_images.values()), device=images.device)
            scores = self.network(images.detach()[indices])
            self.scores.update(zip(new_images, scores.detach(), strict=True))
        return torch.stack([self.scores[key] for key in keys]).to(images)


def _digest(image: Tensor) -> bytes:
    """Return a hash of the dtype and the values of an image (3, H, W)."""
    content = image.numpy().tobytes()
    return blake2b(content, digest_size=16, key=str(image.dtype).encode()).digest()


def remembering(classifier: Classifier) -> Classifier:
    """Return a copy of a classifier that classifies each different image only once."""
    if isinstance(classifier.function, Remembered):
        return classifier
    function = Remembered(classifier.function)
    remembered = Classifier(function, classifier.size, classifier.classes, classifier.name)
    remembered.operating_points = classifier.operating_points
    return remembered
