"""CPU time of whole attacks on each parameter, relative to the passes of the network alone.

    python -m benchmarks.attacks meshes=[orange_studio.glb] label=orange network=efficientnet_lite0

The arguments are those of pnb-attack without attack=. For each parameter, one attack is run that
pnb-attack would run, without its checks and files, on one thread. Its calls of the network are
recorded. After it, the network alone takes the same calls with the same numbers of images, and
their backward passes. All is CPU time of this process. *First step* is the time from the start to
the first gradient. An attack that ends after a few steps pays for the renders of its start with
few passes. The brackets are the lowest and the highest ratio of the rounds.
"""

import sys
from contextlib import contextmanager
from statistics import median
from time import process_time

import torch

from scripts.attack import main
from train.checkpoints import load_chosen
from train.commands.attack import attacks

ROUNDS = 3
PARAMETERS = ("lighting", "projector", "albedo", "material", "geometry", "pose", "pixels")


@contextmanager
def recorded_calls(network: torch.nn.Module):
    """Yield a list to which each call adds its time, its images, and whether it has a gradient."""
    calls: list[tuple[float, torch.Tensor, bool]] = []

    def record(_, given) -> None:
        images = given[0]
        has_gradient = torch.is_grad_enabled() and images.requires_grad
        calls.append((process_time(), images.detach().clone(), has_gradient))

    hook = network.register_forward_pre_hook(record)
    try:
        yield calls
    finally:
        hook.remove()


def time_alone(network: torch.nn.Module, calls: list[tuple[float, torch.Tensor, bool]]) -> float:
    """Return the CPU time of the same calls of the network without an attack."""
    start = process_time()
    for _, images, has_gradient in calls:
        with torch.set_grad_enabled(has_gradient):
            outputs = network(images.requires_grad_(has_gradient))
            if has_gradient:
                torch.autograd.grad(outputs.logsumexp(1).sum(), images)
    return process_time() - start


def measure(parameter: str, words: list[str]) -> None:
    """Print the medians of `ROUNDS` attacks on one parameter, after one that compiles."""
    settings = main.read([f"attack=[{parameter}]", "device=cpu", *words])
    network = load_chosen(settings)
    rows = []
    for _ in range(1 + ROUNDS):
        with recorded_calls(network) as calls:
            start = process_time()
            found = list(attacks(settings, network))
            seconds = process_time() - start
        first = next(time for time, _, has_gradient in calls if has_gradient) - start
        alone = time_alone(network, calls)
        rows.append((seconds, first, alone, seconds / alone))
    steps = sum(has_gradient for _, _, has_gradient in calls)
    successes = sum(int(result.success.sum()) for _, _, result in found)
    columns = [sorted(column) for column in zip(*rows[1:], strict=True)]
    whole, first, alone, ratio = (f"{median(column):.1f}" for column in columns)
    ends = f"[{columns[3][0]:.1f}, {columns[3][-1]:.1f}]"
    print(f"|{parameter}|{successes}|{steps}|{whole}|{first}|{alone}|{ratio} {ends}|", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    if "--help" in sys.argv:
        sys.exit(print(__doc__))
    print("|attack on|successes|gradients|whole, s|first step, s|passes alone, s|ratio|")
    print("|-|-|-|-|-|-|-|")
    with main.handle_errors():
        for name in PARAMETERS:
            measure(name, sys.argv[1:])
