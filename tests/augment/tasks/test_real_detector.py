"""An attack hides a real orange from a published detector: FastestDet, through onnx2torch."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

import norm_balls as nb

DATA = Path(__file__).parents[4] / "shared/data"
CELLS = 22
SIZE = 352

pytestmark = [
    pytest.mark.ecosystem,
    pytest.mark.realdata,
    pytest.mark.filterwarnings("ignore:ignored in .glb files"),
    pytest.mark.skipif(not DATA.exists(), reason="needs ../shared/data"),
]


class FastestDet(nn.Module):
    """The converted network takes BGR images one by one."""

    def __init__(self) -> None:
        super().__init__()
        convert = pytest.importorskip("onnx2torch").convert
        self.network = convert(str(DATA / "weights/fastestdet_coco.onnx"))

    def forward(self, images: Tensor) -> Tensor:
        return torch.cat([self.network(image.flip(1)) for image in images.split(1)])


def decode(outputs: Tensor) -> list[dict[str, Tensor]]:
    """Read objectness o, a box and 80 class probabilities p of each cell. Scores are o^.6 p^.4."""
    rows, columns = torch.meshgrid(torch.arange(CELLS), torch.arange(CELLS), indexing="ij")
    objectness, box, classes = outputs.split([1, 4, 80], dim=1)
    center = (torch.stack([columns, rows]) + box[:, :2].tanh()) / CELLS
    half = box[:, 2:].sigmoid() / 2
    boxes = SIZE * torch.cat([center - half, center + half], dim=1).flatten(2).mT
    scores = (objectness**0.6 * classes**0.4).flatten(2).mT
    return [{"boxes": one, "scores": score} for one, score in zip(boxes, scores, strict=True)]


def test_light_hides_an_orange_from_fastestdet_within_a_few_steps():
    names = (DATA / "weights/coco.names").read_text().split("\n")[:80]
    meshes = [(str(DATA / "meshes/orange_studio.glb"), "orange")]
    scene = nb.build_scene(meshes, size=SIZE, views=4, light="grace", width=3.0)
    light = nb.StepSettings(step_size=0.25, radius=2.0)
    result = nb.attack(
        FastestDet().eval(),
        scene,
        task=nb.Detection(decode=decode),
        settings=nb.AttackSettings(lighting=light, max_steps=30, margin=0.0),
        classes=names,
        force=True,
    )
    # From one side, the detector takes the orange for an apple.
    assert result.clean_correct.sum() == 3
    assert torch.equal(result.success, result.clean_correct)
    assert result.steps.max() <= 10
