"""Renders, attacks, transforms and training keep to one GPU, which is pretended."""

from copy import deepcopy

import pytest
import torch

import norm_balls as nb
from augment.scene.lights import MODELS
from augment.tasks.classification import is_correct, label_loss
from renderer.light import skylight
from tests.pretend_gpu import GpuTensor, pretended_gpu
from tests.runs import completed_run
from train.run_folder import read_metrics

STEPS = nb.StepSettings("l2", radius=0.1, step_size=0.02)
PROJECTOR = ({"projector": STEPS}, {"projector": nb.ProjectorSettings()})
# Settings of each attack, and options of its scene.
ATTACKS = [
    ({"lighting": STEPS}, {}),
    ({"geometry": STEPS}, {"silhouettes": True}),
    ({"pose": nb.PoseSettings()}, {"silhouettes": True}),
    ({"albedo": STEPS}, {}),
    ({"material": nb.MaterialSettings()}, {}),
    ({"pixels": STEPS}, {}),
    ({"skylight": nb.SkylightSettings()}, {}),
    PROJECTOR,
    ({"lamps": STEPS}, {"lamps": nb.LampsSettings([[0, 1.0, 3.0]])}),
    ({"lighting": STEPS, "optimizer": "random_search", "max_queries": 3}, {}),
    ({"lighting": STEPS, "eot": nb.EOTSettings(draws=2, jitter=0.2)}, {}),
]
# Settings of attacks, options of their scenes, and how often each view may wait in a step.
STEPS_OF = [
    ({"lighting": STEPS, "allow_negative": True}, {}, 0),
    ({"albedo": STEPS}, {}, 0),
    ({"material": nb.MaterialSettings()}, {}, 0),
    ({"pixels": nb.StepSettings("l2", radius=1e-3, step_size=1e-4)}, {}, 0),  # fools nothing
    ({"skylight": nb.SkylightSettings()}, {}, 0),
    (*PROJECTOR, 0),
    ({"geometry": STEPS}, {}, 8),
    ({"geometry": STEPS}, {"silhouettes": True}, 21),
    ({"pose": nb.PoseSettings()}, {"silhouettes": True}, 24),
]
RENDERS = [{}, {"normals": "smooth"}, {"gloss": nb.Gloss(0.5)}, {"shadows": True, "bounces": 1}]


@pytest.fixture(scope="module")
def network():
    return nb.load("none")


def test_tensors_of_the_pretended_gpu_do_not_mix_with_others():
    with pretended_gpu() as waits:
        here = torch.ones(3, device="cuda", requires_grad=True)
        with pytest.raises(RuntimeError, match="on one device"):
            here + torch.ones(3)
        with pytest.raises(TypeError, match="numpy"):
            here.detach().numpy()
        (2 * here.cpu()).sum().backward()
        assert isinstance(here.grad, GpuTensor)
        assert here.grad.tolist() == [2, 2, 2]
        assert waits.total() == 3


@pytest.mark.parametrize("silhouettes", [False, True])
@pytest.mark.parametrize("options", RENDERS, ids=str)
def test_renders_on_a_gpu_are_those_on_a_cpu(options, silhouettes):
    mesh, light = nb.solid("cup"), nb.load_light("grace")

    def render(device):
        vertices = torch.from_numpy(mesh.vertices).to(device).requires_grad_()
        moved = {"vertices": vertices, "silhouettes": silhouettes}
        images = nb.render(mesh, nb.orbit_cameras(2, 2.2), light.to(device), 24, **moved, **options)
        images.square().sum().backward()
        return images.detach(), vertices.grad

    expected = render("cpu")
    with pretended_gpu():
        for on_gpu, on_cpu in zip(render("cuda"), expected, strict=True):
            assert on_gpu.is_cuda
            torch.testing.assert_close(on_gpu.cpu(), on_cpu, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("options", "of_scene"), ATTACKS, ids=[next(iter(options)) for options, _ in ATTACKS]
)
def test_attacks_on_a_gpu_end_as_on_a_cpu(options, of_scene, network, monkeypatch):
    # The pretended GPU cannot read files of safetensors.
    fit = skylight._library_fit()
    monkeypatch.setattr(skylight, "_library_fit", lambda: fit)

    def attack(network, device):
        meshes = [("solid:orange:7", "orange")]
        scene = nb.build_scene(meshes, 32, samples=1, device=device, **of_scene)
        settings = nb.AttackSettings(**{"max_steps": 1, "margin": 1e3} | options)
        return nb.attack(network, scene, settings=settings, force=True)

    expected = attack(network, "cpu")
    with pretended_gpu():
        found = attack(deepcopy(network).cuda(), "cuda")
        assert found.success.is_cuda
        torch.testing.assert_close(found.images.cpu(), expected.images, rtol=0, atol=2e-2)


@pytest.mark.parametrize(
    ("options", "of_scene", "waits_of_view"), STEPS_OF, ids=[next(iter(row[0])) for row in STEPS_OF]
)
def test_steps_of_an_attack_wait_for_a_gpu_only_for_sizes(
    options, of_scene, waits_of_view, network, monkeypatch
):
    """Attacks wait every fourth step, to drop finished examples. Sizes are those of a shape."""
    fit = skylight._library_fit()
    monkeypatch.setattr(skylight, "_library_fit", lambda: fit)
    counts = []  # The number of waits before each pass of the network with a gradient.
    with pretended_gpu() as waits:
        on_gpu = deepcopy(network).cuda()

        def count(_, given):
            if given[0].requires_grad:
                counts.append(waits.total())

        on_gpu.register_forward_pre_hook(count)
        meshes = [("solid:orange:7", "orange")]
        scene = nb.build_scene(meshes, 32, samples=1, device="cuda", **of_scene)
        settings = nb.AttackSettings(**options, margin=1e3, max_steps=3)
        nb.attack(on_gpu, scene, settings=settings, force=True)
    # The first passes build what the others use again.
    assert counts[-1] - counts[-2] <= waits_of_view
    assert len(counts) > 2


def test_light_on_images_stays_on_the_gpu(network):
    images = torch.rand(4, 3, 32, 32)
    with pretended_gpu():
        on_gpu, labels = images.cuda(), torch.arange(4).cuda()
        for name in MODELS:
            assert nb.RandomLighting(name)(on_gpu).is_cuda
        assert nb.AdversarialLighting(deepcopy(network).cuda())(on_gpu, labels).is_cuda
        assert nb.relight_photographs((255 * on_gpu).to(torch.uint8)).is_cuda


def test_a_training_on_a_gpu_is_one_on_a_cpu(tiny, tmp_path):
    overrides = ("model.dropout=0.0", "train.epochs=2", "train.compile=never")
    completed_run(tiny(*overrides), tmp_path / "cpu")
    with pretended_gpu():
        completed_run(tiny(*overrides, "train.device=cuda"), tmp_path / "gpu")
    expected, found = (read_metrics(tmp_path / name) for name in ("cpu", "gpu"))
    for epoch in range(2):
        loss = pytest.approx(expected[epoch]["train/loss"], rel=1e-3)
        assert found[epoch]["train/loss"] == loss


@pytest.mark.parametrize("absent", [(), (1,)])
def test_losses_of_labels_do_not_wait_for_a_gpu(absent):
    with pretended_gpu() as waits:
        logits, labels = torch.rand(4, 3, device="cuda"), torch.tensor([0, -1, 2, -3]).cuda()
        waits.clear()
        label_loss(logits, labels, absent=absent)
        is_correct(logits.argmax(1), labels, absent)
    assert waits.total() == 0
