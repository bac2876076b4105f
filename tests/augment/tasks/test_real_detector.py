"""An attack hides a real orange from a published detector: FastestDet, through onnx2torch."""

from pathlib import Path

import pytest
import torch

import norm_balls as nb
from benchmarks.detectors import SIZE, FastestDet, decode

DATA = Path(__file__).parents[4] / "shared/data"

pytestmark = [
    pytest.mark.ecosystem,
    pytest.mark.realdata,
    pytest.mark.filterwarnings("ignore:ignored in .glb files"),
    pytest.mark.skipif(not DATA.exists(), reason="needs ../shared/data"),
]


def test_light_hides_an_orange_from_fastestdet_within_a_few_steps():
    pytest.importorskip("onnx2torch")
    names = (DATA / "weights/coco.names").read_text().split("\n")[:80]
    meshes = [(str(DATA / "meshes/orange_studio.glb"), "orange")]
    scene = nb.build_scene(meshes, size=SIZE, views=4, light="grace", width=3.0)
    light = nb.StepSettings(step_size=0.25, radius=2.0)
    network = FastestDet(DATA / "weights/fastestdet_coco.onnx").eval()
    settings = nb.AttackSettings(lighting=light, max_steps=30, margin=0.0)
    options = {"task": nb.Detection(decode=decode), "settings": settings, "classes": names}
    result = nb.attack(network, scene, force=True, **options)
    # From one side, the detector takes the orange for an apple.
    assert result.clean_correct.sum() == 3
    assert torch.equal(result.success, result.clean_correct)
    assert result.steps.max() <= 10
