"""Time and error of the drafts that attacks on pose and shape render, beside exact shadows.

    python -m benchmarks.drafts attack=[pose] meshes=[orange_studio.glb] label=orange
    python -m benchmarks.drafts success attack=[pose] meshes=[orange_studio.glb] label=orange \
        network=run:pretrained/none scene.views=8 renderer.samples=8

The arguments are those of pnb-attack. Random values of the attacked parameters are rendered by
turns as a draft and exactly. CPU seconds are those of an image and its gradient, on one thread. The
error of a draft is the rms difference of the image values.

With `success`, the examples that are classified correctly are attacked in drafts of 2², 3², 4² and
8² samples for each pixel, with the same start and steps. A draft has at most renderer.samples², so
set that to 8. A success is one in the exact images.
"""

import sys
from statistics import median
from time import process_time

import torch
from torch import Tensor

from augment.attacks.loop import evaluate, minimize
from augment.attacks.objective import Objective
from augment.attacks.problem import SceneProblem, build_problem, source_labels
from augment.classifier import Classifier
from augment.scene import render
from scripts.attack import main
from train.checkpoints import load_chosen
from train.command_settings import AttackExperimentSettings
from train.commands.attack import build_attacked
from train.settings import read_object

ROUNDS = 3
# Samples along one side of a pixel of the compared drafts.
SAMPLES = (2, 3, 4, 8)


def timed_gradient(image_of, values: Tensor) -> tuple[float, Tensor, Tensor]:
    """Return the CPU seconds of an image and its gradient, the image, and the gradient."""
    values = values.clone().requires_grad_()
    start = process_time()
    image = image_of(values)
    (gradient,) = torch.autograd.grad(image.square().sum(), values)
    return process_time() - start, image.detach(), gradient


def read(words: list[str]) -> tuple[AttackExperimentSettings, Classifier, SceneProblem]:
    """Return the settings, the network and the attacked scene."""
    settings = main.read([*words, "device=cpu"])
    item = read_object(settings.meshes[0], "", "meshes[0]")
    item.label = settings.label
    network = load_chosen(settings)
    scene = build_attacked(settings, item, settings.scene, network.size)
    return settings, network, build_problem(settings.attack, scene)


def measure(words: list[str]) -> None:
    """Print the medians of `ROUNDS` rounds, after one that compiles."""
    _, network, problem = read(words)
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


def count_successes(words: list[str]) -> None:
    """Print the successes of attacks with drafts of each number of samples."""
    settings, network, problem = read(words)
    every = problem.all_examples
    labels = source_labels(problem.scene, every.device, network)
    criterion = network.task.criterion(labels, problem.scene.truth, len(network.classes))
    objective = Objective(network, criterion, settings.attack, 0)
    predicted = criterion.predicted(objective.evidence(problem.images(problem.start)))
    correct = every[(predicted == labels).all(1)]
    objective = objective.select(correct)
    # Gradients of the cost at the same random values of each example.
    values = problem.sample(torch.Generator().manual_seed(0))[correct]
    gradients = {}
    for samples in SAMPLES:
        render.DRAFT_SAMPLES = samples
        gradients[samples] = evaluate(problem, objective, values[:, None], correct, True).gradient
    for samples in SAMPLES:
        render.DRAFT_SAMPLES = samples
        cosines = torch.cosine_similarity(gradients[samples], gradients[max(SAMPLES)])
        start = process_time()
        found = minimize(problem, objective, examples=correct, start=problem.start[correct])
        seconds = process_time() - start
        attacked = problem.start.index_copy(0, correct, found.values)
        _, with_noise, without_noise = objective.judge(problem.images(attacked, correct), correct)
        print(
            f"{samples}²: cosine of gradients {cosines.median():.3f}, search {seconds:.1f} s, "
            f"{int(found.steps.sum())} steps, {len(correct)} of {len(every)} correct before, "
            f"successes in drafts {int(found.success.sum())}, in exact images "
            f"{int(without_noise.sum())}, with noise {int(with_noise.all(1).sum())}",
            flush=True,
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    if "--help" in sys.argv:
        sys.exit(print(__doc__))
    with main.handle_errors():
        if sys.argv[1:2] == ["success"]:
            count_successes(sys.argv[2:])
        else:
            measure(sys.argv[1:])
