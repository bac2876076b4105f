"""Adversarial against random perturbations in norm-balls (the paper's Section 4.1 and appendix A).

Every ball is searched by a descent and by as many uniform draws. The space "physical" is light whose radiance is
nowhere negative, which the paper's light may be; "clipped" counts adversaries of any light, without its negative
radiance.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from augment import AttackSettings, StepSettings, attack
from augment.attacks.attack import AttackResult, logits_of
from augment.random_streams import generator
from benchmarks.paper import common
from renderer.light.basis import DEGREE
from renderer.light.environment import light_radiance
from renderer.light.harmonics import project

LIGHT_RADII = (0.02, 0.05, 0.1, 0.3, 1.0, None)
RADII: dict[str, tuple[float | None, ...]] = {  # L∞; the paper's are 0.1, 0.002, and on pixels 0.12, 0.53, 0.82
    "lighting": LIGHT_RADII,  # per coefficient
    "physical": LIGHT_RADII,
    "geometry": (0.0001, 0.0005, 0.002, 0.01, 0.03),  # per vertex and axis
    "pixels": (0.01, 0.12, 0.53, 0.82),
}


def settings_of(space: str, radius: float | None, steps: int) -> AttackSettings:
    """Signed steps of a quarter of the radius; on pixels, of all of it: the fast gradient sign method, repeated."""
    kind, step = "lighting" if space == "physical" else space, None
    if radius is not None:
        step = StepSettings("linf", radius, "sign", radius if space == "pixels" else radius / 4)
    return common.attack_settings(kind, steps, step, allow_negative=space != "physical", batch_size=common.BATCH)


def ball(attacked: AttackResult, space: str, radius: float | None, draws: torch.Generator) -> dict[str, Tensor]:
    """(E,) bool of each of the clean-correct examples: what succeeds in a ball."""
    results = {"adversarial": attacked.success}
    if radius is not None:  # without one there is no uniform draw
        tries = [successes(attacked, attacked.problem.sample(draws)) for _ in range(attacked.settings.max_steps)]
        results |= {"random": tries[0], "search": torch.stack(tries).any(0)}
    if space == "lighting":
        lights = torch.stack([without_negative(light) for light in attacked.conditions.light])
        results["clipped"] = successes(attacked, lights.flatten(1))
    return {name: values[attacked.clean_correct] for name, values in results.items()}


def successes(attacked: AttackResult, values: Tensor) -> Tensor:
    """(E,) bool: whether the classifier errs under values (E, D)."""
    logits = logits_of(attacked.classifier, attacked.problem.images(values), common.BATCH)
    return attacked.goal.reached(logits.argmax(2))


def without_negative(light: Tensor) -> Tensor:
    """A light (49, 3) as an environment map holds it, from which negative radiance is left out."""
    return project(lambda directions: light_radiance(light, directions).clamp(min=0), DEGREE).to(light)


def main(argv: Sequence[str] | None = None) -> None:
    options = common.parser("norm_balls", __doc__)
    options.add_argument("--spaces", nargs="+", choices=RADII, default=list(RADII))
    options.add_argument("--examples", type=int, default=20, help="of each mesh")
    options.add_argument("--steps", type=int, default=10, help="of a descent at most, and draws of a search")
    args, classifier, subjects = common.prepare(options, argv, common.VERTICES)
    for subject in subjects:
        draws = generator(args.seed, subject.name)
        views = common.clean_correct_views(subject, classifier, args.examples, draws)
        scenes = [common.scene_of(subject, classifier.size, part) for part in common.batches(views)]
        for space in args.spaces:
            draws = generator(args.seed, subject.name, space)
            for radius in RADII[space]:
                settings = settings_of(space, radius, args.steps)
                attacks = (attack(classifier, scene, settings=settings, force=True) for scene in scenes)
                parts = [ball(attacked, space, radius, draws) for attacked in attacks]
                counts = {name: int(sum(part[name].sum() for part in parts)) for name in parts[0]}
                row = {"mesh": subject.name, "space": space, "radius": radius}
                common.append(args.out, row | {"n": sum(len(part["adversarial"]) for part in parts)} | counts)


if __name__ == "__main__":
    main()
