from pathlib import Path

import numpy as np
import pytest
import torch
from torchvision.models import get_model

from tests.helpers import save_noise


@pytest.fixture(scope="package")
def photographs(tmp_path_factory) -> Path:
    """Save photographs of two kinds of objects, of which every other one is bright."""
    folder = tmp_path_factory.mktemp("photographs")
    rng = np.random.default_rng(0)
    for name in ("orange", "lemon"):
        for number in range(16):
            dark = 150 * (number % 2)
            save_noise(folder / name / f"{number}.png", rng, (40, 36), dark, dark + 100)
    return folder


@pytest.fixture(scope="package")
def weights(tmp_path_factory) -> Path:
    """Save a network with batch statistics whose predictions differ between images."""
    torch.manual_seed(0)
    network = get_model("shufflenet_v2_x0_5")
    with torch.no_grad():
        for _ in range(30):
            network(torch.randn(16, 3, 32, 32))
        network.fc.weight *= 10
    path = tmp_path_factory.mktemp("weights") / "network.pt"
    torch.save(network.state_dict(), path)
    return path
