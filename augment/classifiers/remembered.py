"""Remembers the outputs of a function, so that it never gets the same image twice."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import blake2b

import torch
from torch import Tensor

from augment.classifiers.adapter import Classifier, Wrapper


class Remembered(Wrapper):
    """Function from images to scores that is called once for each different image.

    An attack shows the same image to a classifier several times: before the
    search, in it and after it. That costs much if the function is slow or paid
    for. The outputs are kept without gradients.

    Attributes:
        scores: Scores (C,) of each image that was shown, by the hash of the image.
    """

    def __init__(self, network: Callable[[Tensor], Tensor]):
        super().__init__(network)
        self.scores: dict[bytes, Tensor] = {}

    def forward(self, images: Tensor) -> Tensor:
        """Compute the scores (N, C) of images (N, 3, H, W)."""
        keys = [_digest(image) for image in images.detach().cpu()]
        # Index in `images` of each image without remembered scores, by the hash of the
        # image. Equal images have one entry, so the network classifies them once.
        row_of_key = {key: row for row, key in enumerate(keys) if key not in self.scores}
        if row_of_key:
            rows = torch.tensor(list(row_of_key.values()), device=images.device)
            scores = self.network(images.detach()[rows])
            self.scores.update(zip(row_of_key, scores.detach(), strict=True))
        return torch.stack([self.scores[key] for key in keys]).to(images)


def _digest(image: Tensor) -> bytes:
    """Return a hash of the dtype and the values of an image (3, H, W)."""
    content = image.numpy().tobytes()
    return blake2b(content, digest_size=16, key=str(image.dtype).encode()).digest()


def remembering(classifier: Classifier) -> Classifier:
    """Return a copy of a classifier that remembers the logits of each image.

    Args:
        classifier: A classifier without gradients.

    Returns:
        A classifier that calls the same function once for each different image.
    """
    if isinstance(classifier.function, Remembered):
        return classifier
    function = Remembered(classifier.function)
    remembered = Classifier(function, classifier.size, classifier.classes, classifier.name)
    remembered.operating_points = classifier.operating_points
    return remembered
