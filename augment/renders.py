"""Labeled renders for a training loop, and examples of attacks on them for figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.utils.data import Dataset

from renderer.light.basis import HARMONICS, Basis

# Largest number of successfully attacked renders that are kept for figures each time that the
# renders of a training run are made.
SHOWN_EXAMPLES = 4


@dataclass(frozen=True)
class AttackExamples:
    """S renders for which an attack during training succeeded, to be shown in figures.

    The first axis of images, lights and predictions is the time: index 0 is before the attack,
    and index 1 is after it. Images are in [0, 1]. Lights are RGB coefficients in the basis.
    Predictions are probabilities of the C classes.
    """

    images: Float[Tensor, "2 S 3 H W"]
    lights: Float[Tensor, "2 S _ 3"]
    predictions: Float[Tensor, "2 S C"]
    labels: Int[Tensor, " S"]
    basis: Basis = HARMONICS

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True)
class Renders(Dataset[tuple[Tensor, Any]]):
    """Labeled renders for training, as a data set of PyTorch.

    An item is a pair of an image on the CPU and a label as an int. The data set
    can be concatenated with other data whose labels are ints. Labels that are
    tensors, as in a `TensorDataset`, must be converted to ints before, because
    PyTorch's `DataLoader` cannot mix both types in a batch.

    For a detector or a segmenter, an item is an image and its target, as the
    detectors of torchvision take them in training. The `DataLoader` then needs
    `collate_fn=lambda batch: tuple(zip(*batch))`.

    Attributes:
        images: Images in [0, 1], shape (E, 3, H, W).
        labels: Labels, shape (E,), int64.
        diagnostics: Numbers about the attack, such as its success rate, by name.
        attack_examples: A few successfully attacked renders, before and after
            the attack. None if nothing is rendered, and for detectors and segmenters.
        targets: For a detector or a segmenter, the n visible objects of each
            image that have a class, on the CPU: "boxes" (n, 4) float32, which
            are left, top, right and bottom in pixels, "labels" (n,) int64, and
            "masks" (n, H, W) uint8. An image may show none. None for a
            classifier.
    """

    images: Float[Tensor, "E 3 H W"]
    labels: Shaped[Tensor, "E ..."]
    diagnostics: Mapping[str, float]
    attack_examples: AttackExamples | None = None
    targets: Sequence[dict[str, Tensor]] | None = None

    def __len__(self) -> int:
        """Return the number of examples."""
        return len(self.labels)

    def __getitem__(self, index: int) -> tuple[Tensor, Any]:
        """Return an image (3, H, W) in [0, 1] on the CPU, and its label or its target."""
        target = int(self.labels[index]) if self.targets is None else self.targets[index]
        return self.images[index].cpu(), target
