"""Do lights and shapes that deceive one network, from one side, deceive others, or from other sides (Tables 3 and 4)?

An adversary is recorded at the first step that succeeds, and after ten further steps, beside random changes that are as
large in every coefficient or coordinate.
"""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from augment import AttackSettings, Classifier
from augment.attacks.descent import Goal, descend
from augment.attacks.problem import AttackProblem, build_problem
from augment.random_streams import generator
from augment.scene.objects import SceneObject
from benchmarks.paper import common
from renderer.errors import FACTOR
from train.runs.saved_networks import load_network

FURTHER = 10  # steps that an adversary goes on for
ATTACKED = (1, 5)  # views that share one light or shape


def as_one_example(problem: AttackProblem) -> Any:
    """All examples of a problem, of one view each, as the views of a single one that share one light or shape."""
    everything = problem.everything

    def render(values: Tensor, examples: Tensor) -> Tensor:
        return problem.render(values.expand(len(everything), -1), everything).transpose(0, 1)

    same = {"take_step": problem.take_step, "project": problem.project, "at_once": problem.at_once}
    return SimpleNamespace(start=problem.start[:1], render=render, **same)


def adversaries(
    classifier: Classifier, problem: AttackProblem, settings: AttackSettings, label: str, views: int
) -> tuple[Tensor, Tensor]:
    """(E, D) values where a descent first succeeds or ends, and the best of `FURTHER` steps on. views: of each."""
    goal = Goal(torch.full((len(problem.start), views), classifier.label(label)))
    first = descend(classifier, problem, goal, settings)
    longer = replace(settings, max_steps=FURTHER, margin=FACTOR)  # which no logit reaches: all steps are taken
    return first.values, descend(classifier, problem, goal, longer, start=first.values).values


def with_random_signs(values: Tensor, start: Tensor, draws: torch.Generator) -> Tensor:
    """The start (E, D) with each entry changed by as much as in values (E, D), but up or down at random.

    It is as far in any norm, and changes nothing that could not reach a pixel.
    """
    signs = 2 * torch.randint(2, values.shape, generator=draws) - 1
    return start + (values - start) * signs.to(values)


def to_networks(subject: SceneObject, classifier: Classifier, others: Sequence[Classifier], args: Namespace) -> None:
    """A record per batch of views and kind of attack: the predictions of all networks, each at its own size."""
    draws = generator(args.seed, subject.name, "transfer")
    for views in common.batches(common.clean_correct_views(subject, classifier, args.examples, draws)):
        scenes = [common.scene_of(subject, network.size, views) for network in (classifier, *others)]
        for kind in common.STEPS:
            settings = common.attack_settings(kind, args.steps)
            problems = [build_problem(settings, scene) for scene in scenes]
            start = problems[0].start
            first, further = adversaries(classifier, problems[0], settings, subject.label, views=1)
            states = {"before": start, "first": first, "first_random": with_random_signs(first, start, draws)}
            states |= {"further": further, "further_random": with_random_signs(further, start, draws)}
            predicted = {
                network.name: {name: common.predictions(network, problem.images(states[name])) for name in states}
                for network, problem in zip((classifier, *others), problems, strict=True)
            }
            record = {"kind": kind, "mesh": subject.name, "label": subject.label}
            common.append(args.out, record | {"predictions": predicted})


def to_views(subject: SceneObject, classifier: Classifier, index: int, args: Namespace) -> None:
    """A record per number of attacked views and kind of attack: the predictions in views that were not attacked."""
    draws = generator(args.seed, subject.name, "unseen views", index)
    unseen = common.clean_correct_views(subject, classifier, args.examples, draws)
    for count in ATTACKED:
        attacked = common.clean_correct_views(subject, classifier, count, draws)
        for kind in common.STEPS:
            settings = common.attack_settings(kind, args.steps)
            problem = as_one_example(build_problem(settings, common.scene_of(subject, classifier.size, attacked)))
            first, further = adversaries(classifier, problem, settings, subject.label, count)
            random = with_random_signs(further, problem.start, draws)
            states = {"first": first, "further": further, "random": random}
            predicted: dict[str, list[str]] = {name: [] for name in states}
            for part in common.batches(unseen):
                elsewhere = build_problem(settings, common.scene_of(subject, classifier.size, part))
                for name, values in states.items():
                    predicted[name] += common.predictions(classifier, elsewhere.images(values.expand(len(part), -1)))
            record = {"mesh": subject.name, "label": subject.label, "set": index, "kind": kind, "attacked": count}
            common.append(args.out, record | {"predictions": predicted})


def main(argv: Sequence[str] | None = None) -> None:
    options = common.parser(None, __doc__)
    options.add_argument("study", choices=("networks", "views"))
    options.add_argument("--examples", type=int, default=20, help="views of each mesh, or unseen ones of each set")
    options.add_argument("--sets", type=int, default=3, help="of attacked views, of each mesh")
    options.add_argument("--steps", type=int, default=30, help="of a descent at most (the paper's appendix C)")
    options.add_argument("--targets", nargs="*", default=[], help="networks that are not attacked, NAME[=WEIGHTS]")
    args, classifier, subjects = common.prepare(options, argv, common.VERTICES)
    others = [load_network(*target.split("=", 1)) for target in args.targets] if args.study == "networks" else []
    for subject in subjects:
        if args.study == "networks":
            to_networks(subject, classifier, others, args)
        else:
            for index in range(args.sets):
                to_views(subject, classifier, index, args)


if __name__ == "__main__":
    main()
