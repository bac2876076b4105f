"""Compare adversarial with random perturbations in norm-balls.

This is the paper's Section 4.1 and its appendix A. Every ball is searched by a
gradient descent, and by as many uniform draws as the descent has steps. The
space "physical" is light without negative radiance, which the paper's light may
have. The count "clipped" is the number of adversaries of any light that succeed
without their negative radiance.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from augment import AttackSettings, Classifier, Scene, StepSettings, attack
from augment.attacks.result import AttackResult
from augment.network import compute_outputs
from augment.random_streams import generator
from benchmarks.common import Row
from benchmarks.paper import common
from renderer.light.basis import DEGREE
from renderer.light.environment import light_radiance
from renderer.light.harmonics import project

# Radii per coefficient of the light. None is no limit.
LIGHT_RADII = (0.02, 0.05, 0.1, 0.3, 1.0, None)
# Radii of the L∞ balls. The paper has 0.1 for the light, 0.002 for the shape,
# and 0.12, 0.53 and 0.82 for pixels. A radius of the shape is per vertex and
# axis.
RADII: dict[str, tuple[float | None, ...]] = {
    "lighting": LIGHT_RADII,
    "physical": LIGHT_RADII,
    "geometry": (0.0001, 0.0005, 0.002, 0.01, 0.03),
    "pixels": (0.01, 0.12, 0.53, 0.82),
}


def make_settings(space: str, radius: float | None, steps: int) -> AttackSettings:
    """Return the settings of an attack in a ball.

    The steps follow the signs of the gradient. Each is a quarter of the radius,
    but the whole radius on pixels, which is the fast gradient sign method,
    repeated.

    Args:
        space: Key of `RADII`.
        radius: Radius of the ball. None takes the paper's attack without a
            ball.
        steps: Largest number of steps.

    Returns:
        The settings.
    """
    kind = "lighting" if space == "physical" else space
    step = None
    if radius is not None:
        step_size = radius if space == "pixels" else radius / 4
        step = StepSettings("linf", radius, "sign", step_size)
    return common.attack_settings(
        kind, steps, step, allow_negative=space != "physical", batch_size=common.BATCH_SIZE
    )


def search_ball(
    attacked: AttackResult, space: str, radius: float | None, draws: torch.Generator
) -> dict[str, Tensor]:
    """Check which searches of a ball succeed for each clean-correct example.

    Args:
        attacked: Result of the descent in the ball.
        space: Key of `RADII`.
        radius: Radius of the ball. None has no uniform draws.
        draws: Generator of the random numbers.

    Returns:
        Success of each of the C clean-correct examples, bool, shape (C,), for
        "adversarial" (the descent), "random" (one draw), "search" (any of the
        draws) and "clipped" (the descent without negative radiance).
    """
    results = {"adversarial": attacked.success}
    if radius is not None:
        draws_succeed = []
        for _ in range(attacked.settings.max_steps):
            values = attacked.problem.sample(draws)
            draws_succeed.append(is_successful(attacked, values))
        results["random"] = draws_succeed[0]
        results["search"] = torch.stack(draws_succeed).any(0)
    if space == "lighting":
        lights = [without_negative_radiance(light) for light in attacked.conditions.light]
        results["clipped"] = is_successful(attacked, torch.stack(lights).flatten(1))
    return {name: success[attacked.clean_correct] for name, success in results.items()}


def is_successful(attacked: AttackResult, values: Tensor) -> Tensor:
    """Check which of E examples the classifier misclassifies.

    Args:
        attacked: Result of an attack on the examples.
        values: Values of the attacked parameter, shape (E, D).

    Returns:
        Whether the attack's criterion is reached, bool, shape (E,).
    """
    images = attacked.problem.images(values)
    logits = compute_outputs(attacked.classifier, images, common.BATCH_SIZE)
    return attacked.criterion.reached(logits.argmax(2))


def without_negative_radiance(light: Tensor) -> Tensor:
    """Set the negative radiance of a light to 0.

    An environment map cannot hold negative radiance either.

    Args:
        light: SH coefficients, shape (49, 3).

    Returns:
        SH coefficients of the clipped light, shape (49, 3).
    """

    def clipped_radiance(directions: Tensor) -> Tensor:
        return light_radiance(light, directions).clamp(min=0)

    return project(clipped_radiance, DEGREE).to(light)


def count_successes(
    classifier: Classifier,
    scenes: Sequence[Scene],
    space: str,
    radius: float | None,
    steps: int,
    draws: torch.Generator,
) -> Row:
    """Search a ball around the examples of several scenes.

    Args:
        classifier: Classifier to attack.
        scenes: Scenes of the same object.
        space: Key of `RADII`.
        radius: Radius of the ball. None is no limit.
        steps: Largest number of steps of the descent.
        draws: Generator of the random numbers.

    Returns:
        Number of clean-correct examples as "n", and the number of successes
        of each search.
    """
    settings = make_settings(space, radius, steps)
    parts = []
    for scene in scenes:
        attacked = attack(classifier, scene, settings=settings, force=True)
        parts.append(search_ball(attacked, space, radius, draws))
    row: Row = {"n": sum(len(part["adversarial"]) for part in parts)}
    for name in parts[0]:
        row[name] = sum(int(part[name].sum()) for part in parts)
    return row


def main(argv: Sequence[str] | None = None) -> None:
    """Search the balls of all spaces for each mesh, and append a record for each ball.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = common.make_parser("norm_balls", __doc__)
    parser.add_argument("--spaces", nargs="+", choices=RADII, default=list(RADII))
    common.add_examples(parser)
    parser.add_argument(
        "--steps",
        type=int,
        default=10,
        help="largest number of steps of a descent, and number of draws of a search",
    )
    setup = common.prepare(parser, argv, common.VERTICES)
    options = setup.options
    classifier = setup.classifier
    for subject, views in common.subjects_with_views(setup):
        scenes = [
            common.make_scene(subject, classifier.size, part) for part in common.batches(views)
        ]
        for space in options.spaces:
            draws = generator(options.seed, subject.name, space)
            for radius in RADII[space]:
                record = {"mesh": subject.name, "space": space, "radius": radius}
                record |= count_successes(classifier, scenes, space, radius, options.steps, draws)
                common.append(options.out, record)


if __name__ == "__main__":
    main()
