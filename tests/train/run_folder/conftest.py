import pytest
import torch

from train.networks import WideResNet


@pytest.fixture
def network() -> WideResNet:
    """With statistics of its own, as after training."""
    torch.manual_seed(0)
    network = WideResNet(2, 10, 1, 0.0, mean=(0.1, 0.2, 0.3), std=(0.3, 0.2, 0.1))
    with torch.no_grad():
        for _ in range(3):
            network(torch.rand(8, 3, 16, 16))
    return network.eval()
