"""Two processes against one, over gloo on a CPU."""

import copy
import os
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.multiprocessing as multiprocessing
import torch.nn.functional as F
from omegaconf import OmegaConf
from PIL import Image

from augment import utils
from train import checkpoint, loop
from train.networks import WideResNet
from train.run import load_data, run
from train.run_folder import read_metrics
from train.runtime import Interrupted, SyncBatchNormCPU, any_process, process_group, replicated, summed
from train.settings import ExperimentSettings, read_settings

ROOT = Path(__file__).parents[2]
BATCH = torch.rand(12, 3, 8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
LABELS = torch.arange(12) % 3


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def as_process(index: int, port: int, task: Callable[[Path], None], folder: Path) -> None:
    os.environ |= {"WORLD_SIZE": "2", "RANK": str(index), "LOCAL_RANK": str(index)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    with process_group():
        task(folder)


def in_two_processes(task: Callable[[Path], None], folder: Path) -> None:
    multiprocessing.spawn(as_process, (free_port(), task, folder), nprocs=2)


def network() -> WideResNet:
    torch.manual_seed(0)
    return WideResNet(3, 10, 1, dropout=0.4).double()


def train_two_steps(folder: Path) -> None:
    """Writes the losses, the gradients of the second step, and the buffers, and what the processes agree on."""
    model = network()
    replica, losses = replicated(model), []
    shard = torch.arange(12).view(utils.world_size(), -1)[utils.rank()]
    for step in range(2):
        torch.manual_seed(step)
        loss = F.cross_entropy(replica(BATCH[shard]), LABELS[shard])
        model.zero_grad()
        loss.backward()
        losses.append(float(summed(loss.detach().clone())) / utils.world_size())
    five, one = (utils.shard(total, utils.rank(), utils.world_size()) for total in (5, 1))
    state = {
        "losses": losses,
        "gradients": {name: parameter.grad for name, parameter in model.named_parameters()},
        "buffers": dict(model.named_buffers()),
        "any": [any_process(utils.rank() == 1), any_process(False)],
        "merged": utils.merged(10 * five, five, 5, utils.world_size()),
        "few": utils.merged(one + 7, one, 1, utils.world_size()),
    }
    torch.save(state, folder / f"{utils.rank()}_of_{utils.world_size()}.pt")


@pytest.fixture(scope="module")
def folder(tiny, tmp_path_factory) -> Path:
    """What two processes wrote, one task after the other; for the runs, a configuration at a learning rate so low that
    rounding does not grow."""
    folder = tmp_path_factory.mktemp("distributed")
    for name, overrides in [("config", ()), ("resume", ("train.resume=true",))]:
        settings = tiny("train.learning_rate=0.001", *overrides)
        OmegaConf.save(OmegaConf.structured(settings), folder / f"{name}.yaml")
    in_two_processes(all_tasks, folder)
    return folder


def all_tasks(folder: Path) -> None:
    train_two_steps(folder)
    run_from_file(folder / "config.yaml", folder / "two")
    run_until_a_signal(folder / "config.yaml", folder / "mixed")


@pytest.fixture(scope="module")
def steps(folder) -> list[dict]:
    """Of one process, and of each of two."""
    train_two_steps(folder)
    return [torch.load(folder / name, weights_only=True) for name in ("0_of_1.pt", "0_of_2.pt", "1_of_2.pt")]


def test_losses_gradients_and_statistics_are_those_of_one_process_to_rounding(steps):
    """In float64, with dropout and batch normalization over the whole batch."""
    one, *two = steps
    for found in two:
        torch.testing.assert_close(found["losses"], one["losses"], rtol=1e-12, atol=0)
        torch.testing.assert_close(found["gradients"], one["gradients"], rtol=1e-9, atol=1e-13)
        torch.testing.assert_close(found["buffers"], one["buffers"], rtol=1e-12, atol=1e-14)
    assert max(gradient.abs().max() for gradient in one["gradients"].values()) > 0.1
    for kind in ("gradients", "buffers"):
        assert all(torch.equal(value, two[1][kind][name]) for name, value in two[0][kind].items())


def test_processes_agree_and_their_shards_become_whole(steps):
    one, *two = steps
    assert one["any"] == [False, False] and one["merged"].tolist() == [0, 10, 20, 30, 40]
    for found in two:
        assert found["any"] == [True, False]
        assert found["merged"].tolist() == [0, 10, 20, 30, 40] and found["few"].tolist() == [7]


@pytest.mark.parametrize(
    "options",
    [{}, {"track_running_stats": False}, {"affine": False, "momentum": None}],
    ids=str,
)
def test_a_norm_over_all_processes_is_torchs_where_there_is_one_process(options):
    norm = torch.nn.BatchNorm2d(3, **options).double()
    synchronized = copy.deepcopy(norm)
    synchronized.__class__ = SyncBatchNormCPU
    for _ in range(2):
        torch.testing.assert_close(synchronized(BATCH), norm(BATCH))
    torch.testing.assert_close(synchronized.state_dict(), norm.state_dict())
    torch.testing.assert_close(synchronized.eval()(BATCH), norm.eval()(BATCH))


# ---------------------------------------------------------------------------------------- whole runs


def run_from_file(config: Path, folder: Path) -> None:
    settings = read_settings(ExperimentSettings, OmegaConf.load(config))
    run(settings, load_data(settings), folder)


def run_until_a_signal(config: Path, folder: Path) -> None:
    """The second process alone gets it, in the second step of the second epoch."""
    training_batches = loop.training_batches

    def signalled(split, batch_size, seed, now, *rest):
        for count, batch in enumerate(training_batches(split, batch_size, seed, now, *rest), 1):
            if (now.epoch, count, utils.rank()) == (1, 2, 1):
                signal.raise_signal(signal.SIGTERM)
            yield batch

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "training_batches", signalled)
        with pytest.raises(Interrupted):
            run_from_file(config, folder)


@pytest.fixture(scope="module")
def runs(folder) -> Path:
    """An adversarial run by one process, by two, and by two until a signal and then by one."""
    run_from_file(folder / "config.yaml", folder / "one")
    state = checkpoint.load(folder / "mixed" / checkpoint.LAST)
    assert (state["epoch"], state["under_way"]["step"]) == (1, 2)
    run_from_file(folder / "resume.yaml", folder / "mixed")
    return folder


@pytest.mark.parametrize("name", ["two", "mixed"])
def test_a_run_does_not_depend_on_the_number_of_its_processes(runs, name):
    first, other = (checkpoint.load(runs / folder / checkpoint.LAST) for folder in ("one", name))
    torch.testing.assert_close(other["model"], first["model"], rtol=1e-3, atol=1e-5)  # float32, three epochs
    torch.testing.assert_close(other["service"], first["service"], rtol=0, atol=1e-3)
    for epoch in (1, 2, 3):
        grids = [np.asarray(Image.open(runs / folder / "renders" / f"epoch_00{epoch}.png")) for folder in ("one", name)]
        np.testing.assert_allclose(*(grid.astype(int) for grid in grids), atol=1)  # of 255, where rounding decides
    lines = [read_metrics(runs / folder) for folder in ("one", name)]
    assert [line.get("epoch") for line in lines[1]] == [1, 2, 3, None]
    for one, found in zip(*lines, strict=True):
        for key in (key for key in one if not key.startswith("seconds/")):
            assert found[key] == pytest.approx(one[key], rel=1e-3), key
    assert all(line["augment/light_change"] > 0 for line in lines[0][:-1])


def test_one_process_writes_for_all(runs):
    files = [{path.name for path in (runs / name).iterdir() if "tfevents" not in path.name} for name in ("one", "two")]
    assert files[0] == files[1]
    assert len(list((runs / "two").glob("events.out.tfevents.*"))) == 1


@pytest.mark.slow
def test_torchrun_trains_one_run_and_a_signal_tells_how_to_go_on(tiny_npz, tmp_path):
    """The command of the README; the second call goes on where SIGTERM stopped the first."""
    small = ["model.depth=10", "model.width=1", "train.batch_size=16", "renderer.samples=2", "augment.examples=10"]
    data = ["data=npz", f"data.path={tiny_npz}", "evaluate.photos=null", "compare=[]"]
    overrides = [*small, *data, "train.device=cpu", "train.epochs=20", "train.checkpoint_every=1000"]
    start = [sys.executable, "-m", "torch.distributed.run", "--nproc_per_node=2", "-m", "train"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen([*start, *overrides], cwd=tmp_path, env=environment, **pipes) as first:
        for line in first.stdout:
            if line.startswith("epoch 1/"):
                first.terminate()
                break
        (advice,) = [line for line in first.stdout if line.startswith("ended by SIGTERM")]
    assert first.returncode != 0
    command = shlex.split(advice.partition("to go on: ")[2])
    assert command[:4] == ["torchrun", "--nproc_per_node=2", "-m", "train"]
    (folder,) = (tmp_path / "runs").glob("*/*")
    epochs = checkpoint.load(folder / checkpoint.LAST)["epoch"]
    assert 1 <= epochs < 20
    done = subprocess.run([*start, *command[4:]], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"after epoch {epochs}" in done.stdout and done.stdout.count("| adversarial") == 1
    assert [line.get("epoch") for line in read_metrics(folder)] == [*range(1, 21), None]
