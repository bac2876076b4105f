"""What it costs in accuracy that shadows are held from step to step while an attack moves vertices."""

import math
import time
from dataclasses import replace

import torch
from torch import Tensor

from augment import reshading
from augment.attacks.attack import AttackSettings, attack
from augment.attacks.criteria import Goal, adversarial_cost
from augment.attacks.parameters import AttackProblem, StepSettings
from augment.classifiers import Classifier
from augment.objects import SceneObject
from renderer.mesh import Mesh
from train.report.tables import markdown
from train.studies.paper.subjects import recognised_scene

STEP = StepSettings("linf", 0.01, "sign", 0.0005)
EVERY = (1, 2, 5, 10, math.inf)  # steps, each of which moves every coordinate by the step's size
STEPS, EXAMPLES = 20, 16


def table(mesh: Mesh, classifier: Classifier) -> str:
    """By how many steps shadows are held for; the mesh is a cup."""
    chosen, rows = reshading.NEAR, []
    cup = SceneObject("cup", mesh, name="solid:cup")
    drawn = recognised_scene(cup, classifier, "grace", EXAMPLES, 0)
    settings = AttackSettings(geometry=STEP, max_steps=STEPS, margin=2.0)
    try:
        for every in EVERY:
            reshading.NEAR = (every - 0.5) * STEP.step_size
            image = replace(drawn.settings, transport="shadows")
            scene = replace(drawn, settings=image)
            start = time.process_time()
            attacked = attack(classifier, scene, settings=settings, force=True)
            taken = (time.process_time() - start) / int(attacked.steps.sum() + EXAMPLES)
            images, slope = images_and_gradient(attacked.problem, classifier, attacked.goal, attacked.descent.values)
            reshading.NEAR = -1.0  # no shape is near
            exact, true = images_and_gradient(attacked.problem, classifier, attacked.goal, attacked.descent.values)
            success, still = (each & attacked.clean_correct for each in (attacked.descent.success, attacked.success))
            rows.append(
                [
                    held_for(every),
                    f"{1e3 * taken:.0f}",
                    f"{(images - exact).square().mean().sqrt() / exact.max():.2%}",
                    f"{((slope - true).norm(dim=1) / true.norm(dim=1)).mean():.1%}",
                    f"{int(success.sum())} of {int(attacked.clean_correct.sum())}",
                    f"{int((success & still).sum())}",
                ]
            )
    finally:
        reshading.NEAR = chosen
    return markdown(
        ["held for", "ms per step", "image's error", "gradient's error", "success", "with shadows anew"], rows
    )


def held_for(every: float) -> str:
    if every == 1:
        return "one step"
    return f"{every} steps" if math.isfinite(every) else "the whole attack"


def images_and_gradient(
    problem: AttackProblem, classifier: Classifier, goal: Goal, values: Tensor
) -> tuple[Tensor, Tensor]:
    """Of all examples of one view, and of the cost by the values (E, D)."""
    values = values.detach().requires_grad_()
    images = problem.render(values, problem.everything)
    cost = adversarial_cost(classifier(images[:, 0]), goal.source[:, 0]).sum()
    return images.detach(), torch.autograd.grad(cost, values)[0]
