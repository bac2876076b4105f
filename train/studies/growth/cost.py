"""What one round of adversarial renders costs, measured in a process of its own, whose peak memory is then its own."""

import os
import resource
import socket
import time
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from multiprocessing.queues import SimpleQueue
from operator import attrgetter

import torch
from torch.multiprocessing.spawn import start_processes

from augment.build import build_scene
from augment.service import AugmentationService, AugmentationSettings, TrainingAttackSettings
from augment.utils import Phases, rank, world_size
from train.distributed import process_group
from train.wideresnet import WideResNet

GRAYS = (0.0, 0.25, 0.5, 0.75, 1.0)
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
        return self.renders // (self.meshes * len(GRAYS))


@dataclass(frozen=True)
class Cost:
    """operators, attack: seconds of one core to build what is kept of the views and to attack. elapsed: seconds of the
    attack by the clock. network: the share of those in the network. kept: bytes of the views' operators. memory: bytes
    at the peak beyond those before.
    """

    operators: float
    attack: float
    elapsed: float
    network: float
    kept: int
    memory: int


def measure(load: Load) -> Cost:
    """Of the slowest process, of as many as it has, on one thread each. ProcessException where one of them fails."""
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    costs = context.SimpleQueue()
    start_processes(_attack, (load, port, costs), load.processes, start_method="forkserver")
    return max((costs.get() for _ in range(load.processes)), key=attrgetter("attack"))


def _attack(rank: int, load: Load, port: int, costs: "SimpleQueue[Cost]") -> None:
    torch.set_num_threads(1)
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(load.processes)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    with process_group():
        costs.put(_cost(load))


def _cost(load: Load) -> Cost:
    before, phases, start = _peak(), Phases(), time.process_time()
    meshes = [(f"solid:orange:{seed}", "orange") for seed in range(load.meshes)]
    scene = build_scene(meshes, load.size, load.views, backgrounds=GRAYS, samples=2, normals="flat", rasterizer="numpy")
    kept = sum(stack.transfer.nbytes + stack.albedo.nbytes for stack in scene.stacks)
    built = time.process_time()
    labels = torch.zeros(len(scene), dtype=torch.int64)
    attack = AugmentationSettings(attack=TrainingAttackSettings(max_steps=load.steps))
    service = AugmentationService(attack, scene, labels, 0, phases, None, rank(), world_size())
    with phases("attack"):
        service.regenerate(sure_network(), 0)
    attacked, seconds = time.process_time(), phases.take()
    return Cost(
        operators=built - start,
        attack=attacked - built,
        elapsed=seconds["attack"],
        network=seconds["attack_classifier"] / seconds["attack"],
        kept=kept,
        memory=_peak() - before,
    )


def sure_network() -> WideResNet:
    """WideResNet-10-1, which calls everything by label 0 and keeps a gradient."""
    torch.manual_seed(0)
    network = WideResNet(10, 10, 1, 0.0).eval()
    with torch.no_grad():
        network.head.weight[0], network.head.bias[0] = 0, SURE
    return network


def _peak() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def described(load: Load, usual: Load = Load(0, 0, 0, 0, 0)) -> str:
    """What differs from the usual."""
    changed = {name: value for name, value in asdict(load).items() if value != getattr(usual, name)}
    return ", ".join(f"{name} {value:,}" for name, value in changed.items()) or "as it is"
