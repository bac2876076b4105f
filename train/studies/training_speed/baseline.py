"""The loop that one writes with torchvision: images through a DataLoader, eager float32, torch's own dropout."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset
from torchvision import transforms

from augment.utils import Phases
from train.data import Split
from train.fit.epoch import PADDING
from train.fit.recipe import TrainSettings
from train.wideresnet import Dropout

Batches = DataLoader[tuple[Tensor, int]]


class Images(Dataset[tuple[Tensor, int]]):
    """A split as torchvision.datasets.CIFAR100 holds it: uint8 arrays that become PIL images one by one."""

    def __init__(self, split: Split, transform: Callable[[Image.Image], Tensor]):
        self._images = split.images.permute(0, 2, 3, 1).contiguous().numpy()
        self._labels = split.labels.tolist()
        self._transform = transform

    def __len__(self) -> int:
        return len(self._labels)

    def __getitem__(self, index: int) -> tuple[Tensor, int]:
        return self._transform(Image.fromarray(self._images[index])), self._labels[index]


def build_loader(
    split: Split, batch_size: int, mean: Sequence[float], std: Sequence[float], workers: int, device: torch.device
) -> Batches:
    """Shuffled batches of the split, cropped, flipped and normalized by torchvision, in `workers` processes."""
    transform = transforms.Compose(
        [
            transforms.RandomCrop(split.images.shape[-1], padding=PADDING, padding_mode="reflect"),
            transforms.RandomHorizontalFlip(),
            transforms.ToTensor(),
            transforms.Normalize(mean, std),
        ]
    )
    return DataLoader(
        Images(split, transform),
        batch_size,
        shuffle=True,
        num_workers=workers,
        pin_memory=device.type == "cuda",
        persistent_workers=workers > 0,
    )


def use_plain_dropout(network: nn.Module) -> None:
    """Replace the project's dropout inside the network by torch's."""
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if isinstance(child, Dropout):
                setattr(parent, name, nn.Dropout(child.p))


class Baseline:
    """Trains a network by itself; a turn is one pass over the loader's images."""

    def __init__(self, network: nn.Module, loader: Batches, settings: TrainSettings, device: torch.device):
        use_plain_dropout(network)
        self._network = network.to(device).train()
        self._loader = loader
        self._device = device
        self._phases = Phases(device)
        self._optimizer = torch.optim.SGD(
            network.parameters(),
            lr=settings.learning_rate,
            momentum=settings.momentum,
            weight_decay=settings.weight_decay,
            nesterov=settings.momentum > 0,
        )

    def __call__(self) -> dict[str, float]:
        with self._phases("training"):
            for images, labels in self._loader:
                images = images.to(self._device, non_blocking=True)
                labels = labels.to(self._device, non_blocking=True)
                loss = F.cross_entropy(self._network(images), labels)
                self._optimizer.zero_grad()
                loss.backward()
                self._optimizer.step()
        return self._phases.take()
