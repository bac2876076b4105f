import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.multiprocessing as multiprocessing
from omegaconf import OmegaConf
from PIL import Image

from augment import AugmentationService, AugmentationSettings, distributed
from augment.progress import Phases
from augment.scene.scene import Scene
from tests.runs import completed_run
from train import checkpoints, run_folder
from train.cli import read_settings
from train.device import Interrupted, SignalHandler, process_group, wrap_ddp
from train.run_folder import read_metrics
from train.settings import ExperimentSettings

ROOT = Path(__file__).parents[3]
EPOCHS = 2


def group_norms(patch: pytest.MonkeyPatch) -> None:
    """Replace batch norms, whose statistics on a CPU are those of one process alone."""
    patch.setattr(torch.nn, "BatchNorm2d", lambda channels: torch.nn.GroupNorm(1, channels))


def one_of_two(index: int, port: int, folder: Path) -> None:
    """Do in one of two processes everything that the tests compare."""
    os.environ |= {"WORLD_SIZE": "2", "RANK": str(index), "LOCAL_RANK": str(index)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    with pytest.MonkeyPatch.context() as patch, process_group():
        group_norms(patch)
        run_from_file(folder / "config.yaml", folder / "two")
        random_mode(folder / f"random_{index}.pt")
        folder_mode(folder / f"folder_{index}.pt")
        spare_weights(folder / f"spare_{index}.pt")


def run_from_file(config: Path, folder: Path) -> None:
    completed_run(read_settings(ExperimentSettings, OmegaConf.load(config)), folder)


def linear() -> torch.nn.Module:
    return torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(192, 2))


def random_mode(file: Path) -> None:
    meshes = [("solid:table", 0), ("solid:plate", 1)]
    count = []
    with pytest.MonkeyPatch.context() as patch:
        render = Scene.render
        counted = lambda self, *args: (count.append(len(args[1])), render(self, *args))[1]  # noqa: E731
        patch.setattr(Scene, "render", counted)
        options = {"views": 3, "samples": 1, "rasterizer": "numpy"}
        settings = AugmentationSettings(mode="random")
        service = AugmentationService.from_meshes(meshes, 8, settings, **options)
        service.rank = distributed.rank()
        service.world_size = distributed.world_size()
        torch.manual_seed(0)
        made = service.regenerate(linear(), 0)
    torch.save((made.images, made.diagnostics, count[0]), file)


def folder_mode(file: Path) -> None:
    torch.manual_seed(0)
    images = torch.randint(256, (9, 3, 8, 8)).byte()
    labels = torch.arange(9) % 2
    settings = AugmentationSettings(mode="folder", folder="unread", examples=5)
    process = (), distributed.rank(), distributed.world_size()
    service = AugmentationService(settings, None, labels, 0, Phases(), *process, images)
    made = service.regenerate(linear(), 1)
    torch.save((made.images, made.labels, torch.tensor(made.diagnostics["attack_success"])), file)


def spare_weights(file: Path) -> None:
    """Compute gradients twice with a layer that the outputs do not use."""
    model = linear()
    model.spare = torch.nn.ModuleList([torch.nn.Linear(2, 2)])
    model.forward = lambda images: model[1](model[0](images))
    wrapped = wrap_ddp(model, 8)
    for _ in range(2):
        wrapped(torch.full((1, 192), 1.0 + distributed.rank())).sum().backward()
    torch.save(model[1].weight.grad, file)


@pytest.fixture(scope="module")
def runs(tiny, tmp_path_factory) -> Path:
    """Train by one process and by two, at a rate at which rounding errors do not grow."""
    folder = tmp_path_factory.mktemp("distributed")
    settings = tiny("train.learning_rate=0.001", f"train.epochs={EPOCHS}")
    OmegaConf.save(OmegaConf.structured(settings), folder / "config.yaml")
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    once_for_both = [__name__, "torch._dynamo", "torch.utils.tensorboard", "torchvision.utils"]
    multiprocessing.set_forkserver_preload(once_for_both)
    multiprocessing.start_processes(one_of_two, (port, folder), nprocs=2, start_method="forkserver")
    with pytest.MonkeyPatch.context() as patch:
        group_norms(patch)
        run_from_file(folder / "config.yaml", folder / "one")
    return folder


@pytest.mark.slow
def test_a_run_does_not_depend_on_the_number_of_its_processes(runs):
    first, other = (checkpoints.load(runs / name / run_folder.LAST) for name in ("one", "two"))
    torch.testing.assert_close(other["model"], first["model"], rtol=1e-3, atol=1e-5)  # float32
    torch.testing.assert_close(other["service"], first["service"], rtol=0, atol=1e-3)
    for epoch in range(1, EPOCHS + 1):
        file = Path("renders", f"epoch_00{epoch}.png")
        grids = [np.asarray(Image.open(runs / name / file)).astype(int) for name in ("one", "two")]
        np.testing.assert_allclose(*grids, atol=1)  # Rounding changes values by 1 of 255.
    expected, lines = (read_metrics(runs / name) for name in ("one", "two"))
    assert [line.get("epoch") for line in lines] == [*range(1, EPOCHS + 1), None]
    for one, line in zip(expected, lines, strict=True):
        for key in (key for key in one if not key.startswith("seconds/")):
            assert line[key] == pytest.approx(one[key], rel=1e-3), key
    assert all(line["augment/light_change"] > 0 for line in expected[:-1])
    assert len(list((runs / "two").glob("events.out.tfevents.*"))) == 1  # one process writes


@pytest.mark.slow
def test_each_process_renders_its_shard_of_the_random_arm_and_gets_the_images_of_one_as_of_a_folder(
    runs,
):
    random_mode(runs / "random.pt")
    images, diagnostics, count = torch.load(runs / "random.pt")
    assert count == len(images) == 30
    for index in range(2):
        shared, described, part = torch.load(runs / f"random_{index}.pt")
        torch.testing.assert_close(shared, images, rtol=0, atol=1e-6)
        assert part == 15
        assert described == pytest.approx(diagnostics, rel=1e-5)
    folder_mode(runs / "folder.pt")
    whole = torch.load(runs / "folder.pt")
    for index in range(2):
        assert all(map(torch.equal, torch.load(runs / f"folder_{index}.pt"), whole))


@pytest.mark.slow
def test_gradients_are_averaged_also_if_a_layer_has_none(runs):
    """The gradients of a pass are the inputs, 1 and 2, so that of two passes is 2 · 1.5."""
    for index in range(2):
        assert torch.load(runs / f"spare_{index}.pt").eq(3).all()


@pytest.mark.slow
def test_torchrun_trains_one_run_and_a_signal_tells_how_to_go_on(tiny_npz, tmp_path):
    """The command of the README; the second call goes on where SIGTERM stopped the first."""
    overrides = [
        *("experiment=paper", "data=npz", f"data.path={tiny_npz}", "photos=null", "compare=[]"),
        *("model.depth=10", "model.width=1", "train.batch_size=16", "renderer.samples=2"),
        *("augment.examples=10", "scene.views=1", "hard_negatives=[]"),
        *("meshes=['solid:orange','solid:pear']", "train.device=cpu", "train.epochs=20"),
        "train.checkpoint_every=1000",
    ]
    start = [sys.executable, "-m", "torch.distributed.run", "--nproc_per_node=2", "-m", "train"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen([*start, *overrides], cwd=tmp_path, env=environment, **pipes) as first:
        # The first epoch has ended when its metrics are written.
        while not any(file.read_text() for file in tmp_path.glob("runs/*/*/metrics.jsonl")):
            assert first.poll() is None
            time.sleep(0.1)
        first.terminate()
        (advice,) = [line for line in first.stdout if line.startswith("ended by SIGTERM")]
    assert first.returncode != 0
    command = shlex.split(advice.partition("to go on: ")[2])
    assert command[:6] == start
    assert len(command) == 8
    (folder,) = (tmp_path / "runs").glob("*/*")
    epochs = checkpoints.load(folder / run_folder.LAST)["epoch"]
    assert 1 <= epochs < 20
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"after epoch {epochs}" in done.stdout
    assert done.stdout.count("| adversarial") == 1
    assert [line.get("epoch") for line in read_metrics(folder)] == [*range(1, 21), None]


def test_the_end_of_a_worker_by_the_same_signal_ends_the_process_as_the_signal_does():
    with pytest.raises(Interrupted) as ended, SignalHandler():
        signal.raise_signal(signal.SIGINT)
        raise RuntimeError("DataLoader worker (pid 7) is killed by signal: Interrupt.")
    assert ended.value.code == 128 + signal.SIGINT


def test_a_signal_that_torchrun_passes_on_to_a_process_that_has_it_ends_nothing(monkeypatch):
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "1")
    with pytest.raises(Interrupted), SignalHandler() as handler:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert handler.requested()
        handler.stop()


@pytest.mark.parametrize("error", [None, ZeroDivisionError])
def test_a_signal_that_is_not_asked_for_acts_at_the_end_and_hides_no_error(error):
    with pytest.raises(error or KeyboardInterrupt), SignalHandler():
        signal.raise_signal(signal.SIGINT)
        if error:
            raise error
