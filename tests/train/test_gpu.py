"""Training on a GPU agrees with training on a CPU. The tests are skipped without one."""

import warnings
from itertools import count

import pytest
import torch

import norm_balls as nb
from augment.attacks import loop as attack_loop
from renderer.light.nonnegative import nearest_nonnegative
from renderer.vectors import Ball
from tests.runs import completed_run
from train import checkpoints, run_folder
from train.run_folder import read_metrics
from train.training import loop

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def weights_of(config, folder) -> dict[str, torch.Tensor]:
    completed_run(config, folder)
    return checkpoints.load(folder / run_folder.LAST)["model"]


@pytest.mark.parametrize("compile", ["auto", "never"])
def test_a_gpu_trains_as_a_cpu_does_to_rounding(tiny, tmp_path, compile):
    """Train with so low a rate that rounding errors do not grow, and without dropout."""
    overrides = ("train.learning_rate=0.001", "model.dropout=0.0", "train.epochs=2")
    expected = weights_of(tiny(*overrides), tmp_path / "cpu")
    found = weights_of(
        tiny(*overrides, "train.device=cuda", f"train.compile={compile}"), tmp_path / "gpu"
    )
    torch.testing.assert_close(found, expected, rtol=1e-2, atol=1e-3)  # convolutions in TF32
    lines = [read_metrics(tmp_path / name) for name in ("cpu", "gpu")]
    assert lines[1][0]["augment/steps"] == pytest.approx(lines[0][0]["augment/steps"], abs=0.5)


def test_deterministic_runs_repeat_and_interrupted_ones_go_on_bit_for_bit(tiny, tmp_path):
    overrides = ("train.device=cuda", "train.deterministic=true", "train.precision=bfloat16")
    whole = weights_of(tiny(*overrides), tmp_path / "whole")
    again = weights_of(tiny(*overrides), tmp_path / "parts")
    (tmp_path / "parts" / run_folder.LAST).unlink()  # the last epoch is lost
    parts = weights_of(tiny(*overrides, "train.resume=true"), tmp_path / "parts")
    for name, value in whole.items():
        assert torch.equal(value, again[name])
        assert torch.equal(value, parts[name])


@pytest.mark.parametrize("ema_decay", [0.0, 0.9])
def test_no_step_waits_for_the_gpu(tiny, tmp_path, monkeypatch, ema_decay):
    """Between two batches, what synchronizes raises an error. Making a batch may synchronize."""
    training_batches = loop.training_batches

    def watched(*arguments):
        for index, batch in enumerate(training_batches(*arguments)):
            # The first steps compile, which waits for the GPU.
            torch.cuda.set_sync_debug_mode("error" if index > 3 else "default")
            try:
                yield batch
            finally:
                torch.cuda.set_sync_debug_mode("default")

    monkeypatch.setattr(loop, "training_batches", watched)
    few = ("augment=none", "train.epochs=1", "train.batch_size=4")
    weights_of(tiny("train.device=cuda", *few, f"train.ema_decay={ema_decay}"), tmp_path)


def test_no_step_of_an_attack_on_lighting_waits_for_the_gpu(monkeypatch):
    network = nb.load("none").cuda()
    scene = nb.build_scene([("solid:orange:7", "orange")], network.size, views=3, device="cuda")
    evaluate = attack_loop.evaluate
    calls = count()

    def watched(*arguments):
        # The first steps build operators, and choose algorithms of the network.
        torch.cuda.set_sync_debug_mode("error" if next(calls) > 2 else "default")
        try:
            return evaluate(*arguments)
        finally:
            torch.cuda.set_sync_debug_mode("default")

    monkeypatch.setattr(attack_loop, "evaluate", watched)
    steps = nb.StepSettings("l2", radius=0.1)
    settings = nb.AttackSettings(lighting=steps, margin=1e4, allow_negative=True)
    nb.attack(network, scene, settings=settings, force=True)
    assert next(calls) > 20


@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_lights_that_the_cpu_makes_nonnegative_are_waited_for_once(norm, recwarn):
    center = nearest_nonnegative(nb.load_light("grace"))[None].cuda()
    # Warnings are off by default after the first from a line.
    warnings.simplefilter("always")
    torch.cuda.set_sync_debug_mode("warn")
    nearest_nonnegative(2 * center - 1, Ball(center, 0.1, norm))
    torch.cuda.set_sync_debug_mode("default")
    assert len(recwarn) == 1


@pytest.mark.parametrize("albedo", [None, torch.full((5120, 3), 0.5), [[0.5, 0.2, 0.1]] * 5120])
def test_moved_shapes_render_on_a_gpu_as_on_a_cpu(albedo):
    """The last bit of projected points differs, so a few samples at edges may."""
    mesh, light = nb.solid("orange"), nb.load_light("grace")
    vertices = torch.from_numpy(1.01 * mesh.vertices)
    cameras = nb.orbit_cameras(3, 2.2, fov=30.0)
    images = [
        nb.render(mesh, cameras, light.to(device), 64, vertices=vertices, albedo=albedo).cpu()
        for device in ("cpu", "cuda")
    ]
    assert ((images[0] - images[1]).abs().amax(1) > 1e-4).float().mean() <= 1e-3


@pytest.mark.parametrize("options", [{}, {"shadows": True}, {"gloss": nb.Gloss(0.5)}], ids=str)
def test_operators_that_a_gpu_computes_are_those_of_a_cpu(options):
    mesh, light, cameras = nb.solid("cup"), nb.load_light("grace"), nb.orbit_cameras(3, 2.2)
    images = [
        nb.precompute_transfer(mesh, cameras, 64, device=device, **options).image(light)
        for device in ("cpu", "cuda")
    ]
    assert ((images[0] - images[1].cpu()).abs().amax(1) > 1e-4).float().mean() <= 1e-3
