from pathlib import Path

import pytest
import torch
from torchvision.models import get_model


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
