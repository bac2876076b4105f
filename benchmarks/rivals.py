"""Spherical harmonics beside sphericart, and an attack on pixels beside foolbox.

    pip install sphericart-torch foolbox
    python -m benchmarks.rivals

writes the panels "spherical harmonics" and "attack on pixels" of docs/renderer_pareto.csv, and
draws the first of them in its figure. Both take some minutes on one thread. Times are medians over
rounds in which all calls take turns, and ratios are to the other library.

Harmonics: values at 10,000 unit vectors, and values with the gradient of a random linear function
of them, from autograd. Both libraries get the same vectors. Errors are relative to a third
implementation (`benchmarks.reference`) in float64.

Attack: the same network, images, L∞ norm-ball, step size and number of steps of projected gradient
descent from the images. `nb.attack` renders the images first, stops an example once it is
misclassified, and checks it. The time of foolbox is that of the attack alone. `no early stop` is
our attack with a margin that no example reaches, so that it takes all steps. The error is the
fraction of the images whose prediction has not changed.
"""

import argparse
import statistics
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import norm_balls as nb
from benchmarks import reference
from benchmarks.common import Row, machine, quartiles_of_ratio, relative_error, times_in_turn
from benchmarks.renderer import write_panels
from renderer.light.harmonics import basis

DEGREES = (6, 17, 39)
POINTS = 10_000
EPSILON, STEP_SIZE = 8 / 255, 1 / 255
STEPS = (1, 2, 3, 5, 10)
UNREACHED_MARGIN = 1e4


def gradient(evaluate: Callable[[Tensor], Tensor], points: Tensor, weights: Tensor) -> Tensor:
    """Return the gradient of the weighted sum of harmonics with respect to the points."""
    points = points.detach().requires_grad_()
    [result] = torch.autograd.grad(evaluate(points), points, weights)
    return result


def compare(
    panel: str,
    setting: str,
    calls: Mapping[str, Callable[[], object]],
    rounds: int,
    errors: Mapping[str, float],
) -> list[Row]:
    """Time the calls of all libraries in turn, relative to the first one.

    Args:
        panel: What is compared.
        setting: Setting of the comparison.
        calls: Call of each library. The first library is the one to compare with.
        rounds: Number of rounds.
        errors: Error of each library.

    Returns:
        A row for each library.
    """
    times = times_in_turn(calls, rounds)
    rows: list[Row] = []
    for name, of_call in times.items():
        low, middle, high = quartiles_of_ratio(of_call, times[next(iter(calls))])
        row = {"panel": panel, "setting": f"{name} ({setting})", "image_error": errors[name]}
        row |= {"time_ms": statistics.median(of_call), "ratio": middle}
        row |= {"ratio_low": low, "ratio_high": high}
        print(row, flush=True)
        rows.append(row)
    return rows


def harmonics(rounds: int) -> list[Row]:
    """Compare the harmonics of both libraries, for each degree and type of numbers."""
    from sphericart.torch import SphericalHarmonics

    draws = torch.Generator().manual_seed(0)
    exact_points = torch.randn(POINTS, 3, generator=draws, dtype=torch.float64)
    exact_points /= exact_points.norm(dim=1, keepdim=True)
    rows: list[Row] = []
    for degree in DEGREES:
        exact = torch.empty(POINTS, (degree + 1) ** 2, dtype=torch.float64)
        for index, values in reference.harmonics(exact_points, degree):
            exact[:, index] = values
        contenders: dict[str, Callable[[Tensor], Tensor]] = {
            "sphericart": SphericalHarmonics(degree),
            "norm_balls": partial(basis, degree=degree),
        }
        for dtype in (torch.float32, torch.float64):
            points, weights = exact_points.to(dtype), torch.randn_like(exact, dtype=dtype)
            setting = f"degree {degree}, {str(dtype).removeprefix('torch.')}"
            errors, values_of, gradients_of = {}, {}, {}
            for name, evaluate in contenders.items():
                # Libraries may differ in the signs of harmonics.
                errors[name] = relative_error(evaluate(points).abs(), exact.abs())
                values_of[name] = partial(evaluate, points)
                gradients_of[name] = partial(gradient, evaluate, points, weights)
            rows += compare("spherical harmonics, values", setting, values_of, rounds, errors)
            rows += compare("spherical harmonics, gradients", setting, gradients_of, rounds, errors)
    return rows


def attacks(rounds: int, count: int) -> list[Row]:
    """Compare attacks on the pixels of the same renders, for each number of steps."""
    import foolbox

    classifier = nb.load("none").eval()
    label = list(classifier.classes).index("orange")
    ball = nb.StepSettings(norm="linf", radius=EPSILON, step="sign", step_size=STEP_SIZE)

    def our_attack(scene: nb.Scene, **settings: Any) -> nb.AttackResult:
        """Attack the pixels without sensor noise and rounding, which foolbox lacks."""
        chosen = nb.AttackSettings(pixels=ball, quantized=False, sensor_noise=0, **settings)
        return nb.attack(classifier, scene, settings=chosen, force=True)

    # Examples that are misclassified before an attack are of no use for a comparison.
    meshes = [(f"solid:orange:{seed}", "orange") for seed in range(count)]
    scene = nb.build_scene(meshes, classifier.size, backgrounds=[0.4])
    with torch.no_grad():
        is_known = classifier(our_attack(scene, max_steps=0).images).argmax(1) == label
    known = [mesh for mesh, is_used in zip(meshes, is_known.tolist(), strict=True) if is_used]
    scene = nb.build_scene(known, classifier.size, backgrounds=[0.4])
    images = our_attack(scene, max_steps=0).images
    labels = torch.full((len(images),), label)
    theirs = foolbox.PyTorchModel(classifier, bounds=(0, 1))
    rows: list[Row] = []
    for steps in STEPS:
        pgd = foolbox.attacks.LinfPGD(abs_stepsize=STEP_SIZE, steps=steps, random_start=False)
        calls: dict[str, Callable[[], Tensor]] = {
            "foolbox": lambda pgd=pgd: pgd(theirs, images, labels, epsilons=EPSILON)[1]
        }
        for name, margin in (("norm_balls", 0.0), ("no early stop", UNREACHED_MARGIN)):
            attack = partial(our_attack, scene, max_steps=steps, margin=margin)
            calls[name] = lambda attack=attack: attack().images
        errors = {
            name: (classifier(call()).argmax(1) == labels).float().mean().item()
            for name, call in calls.items()
        }
        setting = f"{steps} steps, {len(images)} images"
        rows += compare("attack on pixels, 32²", setting, calls, rounds, errors)
    return rows


def main() -> None:
    """Measure both parts, and write their panels."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the figure")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--objects", type=int, default=12, help="oranges that are attacked")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(machine())
    rows = harmonics(options.rounds) + attacks(options.rounds, options.objects)
    write_panels(options.out, rows)


if __name__ == "__main__":
    main()
