"""What one round of adversarial renders costs, measured in a process of its own, whose peak memory is then its own."""

import os
import resource
import socket
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import torch

from augment import processes
from augment.build import build_scene
from augment.phases import Phases
from augment.service import AugmentationService, AugmentationSettings, TrainingAttackSettings
from train.distributed import process_group
from train.wideresnet import WideResNet

GREYS = (0.0, 0.25, 0.5, 0.75, 1.0)
SURE = 30.0  # the logit of the label: every attack takes all its steps


@dataclass(frozen=True)
class Load:
    """renders: per round, meshes × views × 5 backgrounds. size: pixels per side. processes: that share the round."""

    renders: int = 100
    size: int = 32
    meshes: int = 1
    processes: int = 1
    steps: int = 30

    @property
    def views(self) -> int:
        return self.renders // (self.meshes * len(GREYS))


@dataclass(frozen=True)
class Cost:
    """operators, attack, classifier: seconds to build what is kept of the views, to attack, and of that in the network.
    memory: bytes at the peak beyond those before, of the first process.
    """

    operators: float
    attack: float
    classifier: float
    memory: int


def measure(load: Load) -> Cost:
    """In as many processes as it has, on one thread each. RuntimeError where one of them fails."""
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    received, sent = context.Pipe(duplex=False)
    started = [context.Process(target=_attack, args=(load, rank, port, sent)) for rank in range(load.processes)]
    for process in started:
        process.start()
    for process in started:
        process.join()
    if any(process.exitcode for process in started):
        raise RuntimeError(f"{load} ended with {[process.exitcode for process in started]}")
    return received.recv()


def _attack(load: Load, rank: int, port: int, sent: Connection) -> None:
    torch.set_num_threads(1)
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(load.processes)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    with process_group():
        cost = _cost(load)
        if processes.rank() == 0:
            sent.send(Cost(**cost))


def _cost(load: Load) -> dict[str, Any]:
    before, phases = _peak(), Phases()
    meshes = [(f"solid:orange:{seed}", "orange") for seed in range(load.meshes)]
    with phases("operators"):
        scene = build_scene(
            meshes, load.size, load.views, backgrounds=GREYS, samples=2, normals="flat", visibility="software"
        )
        assert scene.stacks
    attack = TrainingAttackSettings(max_steps=load.steps)
    labels = torch.zeros(len(scene), dtype=torch.int64)
    service = AugmentationService(AugmentationSettings(attack=attack), scene, labels, 0, phases)
    with phases("attack"):
        service.regenerate(sure_network(), 0)
    seconds = phases.take()
    return {
        "operators": seconds["operators"],
        "attack": seconds["attack"],
        "classifier": seconds["attack_classifier"],
        "memory": _peak() - before,
    }


def sure_network() -> WideResNet:
    """WideResNet-10-1, which calls everything by label 0 and keeps a gradient."""
    torch.manual_seed(0)
    network = WideResNet(10, 10, 1, 0.0).eval()
    with torch.no_grad():
        network.head.weight[0], network.head.bias[0] = 0, SURE
    return network


def _peak() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def described(load: Load) -> str:
    """What differs from the default."""
    default = asdict(Load())
    return ", ".join(f"{name} {value:,}" for name, value in asdict(load).items() if value != default[name]) or "default"


def timed(function: Callable[[], object]) -> float:
    """Seconds."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start
