"""Time and error of the drafts that attacks on pose and shape render, beside exact shadows.

    python -m benchmarks.drafts attack=[pose] meshes=[orange_studio.glb] label=orange

The arguments are those of pnb-attack. Random values of the attacked parameters are rendered by
turns as a draft and with all directions. CPU seconds are those of an image and its gradient, on
one thread. The error of a draft is the rms difference of the image values.
"""

import sys
from statistics import median
from time import process_time

import torch
from torch import Tensor

from augment.attacks.problem import build_problem
from scripts.attack import main
from train.checkpoints import load_chosen
from train.commands.attack import build_attacked
from train.settings import read_object

ROUNDS = 3


def timed_gradient(image_of, values: Tensor) -> tuple[float, Tensor, Tensor]:
    """Return the CPU seconds of an image and its gradient, the image, and the gradient."""
    values = values.clone().requires_grad_()
    start = process_time()
    image = image_of(values)
    (gradient,) = torch.autograd.grad(image.square().sum(), values)
    return process_time() - start, image.detach(), gradient


def measure(words: list[str]) -> None:
    """Print the medians of `ROUNDS` rounds, after one that compiles."""
    torch.set_num_threads(1)
    settings = main.read(words)
    item = read_object(settings.meshes[0], "", "meshes[0]")
    item.label = settings.label
    network = load_chosen(settings)
    scene = build_attacked(settings, item, settings.scene, network.size, torch.device("cpu"))
    problem = build_problem(settings.attack, scene)
    first = problem.all_examples[:1]
    draws = torch.Generator().manual_seed(0)
    rows = []
    for _ in range(1 + ROUNDS):
        values = problem.sample(draws)[:1]
        draft, image, gradient = timed_gradient(lambda x: problem.render(x, first), values)
        exact, *others = timed_gradient(lambda x: problem.render(x, first, is_draft=False), values)
        passes, _, _ = timed_gradient(network, image[0])
        error = float((image - others[0]).square().mean().sqrt())
        cosine = float(torch.cosine_similarity(gradient.flatten(), others[1].flatten(), dim=0))
        rows.append((draft, exact, passes, error, cosine))
    names = ("draft, s", "exact, s", "passes of the network, s", "rms error", "cosine of gradients")
    for name, column in zip(names, zip(*rows[1:], strict=True), strict=True):
        print(f"{name}: {median(column):.4f} {[round(value, 4) for value in column]}")


if __name__ == "__main__":
    measure(sys.argv[1:])
