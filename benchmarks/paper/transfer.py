"""Check whether lights and shapes that deceive one network from some views deceive more.

`networks` shows them to other networks (the paper's Table 3), and `views` from
other views (Table 4). An adversary is recorded at the first step that succeeds,
and after ten further steps. Both are compared with random changes that are as
large in every coefficient or coordinate.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from augment import AttackSettings, Classifier
from augment.attacks.loop import minimize
from augment.attacks.objective import Objective
from augment.attacks.problem import SceneProblem, build_problem
from augment.random_streams import generator
from augment.scene.objects import SceneObject
from augment.tasks.classification import ClassCriterion
from benchmarks.paper import common
from renderer.errors import MAX_SCALE

# Number of steps after the first success.
ADDITIONAL_STEPS = 10
# A descent ends when its margin is reached. No logit reaches this margin, so
# that a descent takes all its steps.
ENDLESS_MARGIN = MAX_SCALE
# Numbers of views that share an attacked light or shape.
ATTACKED_VIEW_COUNTS = (1, 5)


class SharedProblem:
    """An attack problem whose V examples become the V views of a single example.

    The views share one vector of D values, such as a light or a shape. Unlike
    the views of a scene's example, they may have different backgrounds.

    Args:
        problem: Problem of V examples with one view each, whose values start
            equal.

    Attributes:
        start: Values at which the attack starts, shape (1, D).
        group_size: Largest number of examples that are rendered at once.
    """

    def __init__(self, problem: SceneProblem):
        self._problem = problem
        self.start = problem.start[:1]
        self.group_size = problem.group_size
        # The steps and the norm-ball are those of the first example.
        self.scale_gradient = problem.scale_gradient
        self.search_scale = problem.search_scale
        self.project = problem.project

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        """Render all views with the same values.

        Args:
            values: Values of the single example, shape (1, D).
            examples: Not used, because there is one example.

        Returns:
            Images, shape (1, V, 3, size, size).
        """
        all_views = self._problem.all_examples
        images = self._problem.render(values.expand(len(all_views), -1), all_views)
        return images.transpose(0, 1)


@dataclass(frozen=True)
class Adversaries:
    """Values of E examples that a descent found, each of shape (E, D).

    Attributes:
        start: Values at which the descent started.
        first: Values at the first success, or at the end if there was none.
        further: Best values after ADDITIONAL_STEPS more steps.
    """

    start: Tensor
    first: Tensor
    further: Tensor

    def first_random(self, draws: torch.Generator) -> Tensor:
        """Return `first` with random signs of its changes from the start."""
        return with_random_signs(self.first, self.start, draws)

    def further_random(self, draws: torch.Generator) -> Tensor:
        """Return `further` with random signs of its changes from the start."""
        return with_random_signs(self.further, self.start, draws)


def find_adversaries(
    classifier: Classifier,
    problem: SceneProblem | SharedProblem,
    settings: AttackSettings,
    label: str,
    view_count: int,
) -> Adversaries:
    """Attack all examples of a problem until they succeed, and then for more steps.

    Args:
        classifier: Classifier to attack.
        problem: Problem of E examples.
        settings: Settings of the attack.
        label: Class of all examples.
        view_count: Number of views of each example.

    Returns:
        Values of all examples.
    """
    labels = torch.full((len(problem.start), view_count), classifier.label(label))
    criterion = ClassCriterion(labels)
    first = minimize(problem, Objective(classifier, criterion, settings)).values
    further_settings = replace(settings, max_steps=ADDITIONAL_STEPS, margin=ENDLESS_MARGIN)
    further_objective = Objective(classifier, criterion, further_settings)
    further = minimize(problem, further_objective, start=first).values
    return Adversaries(problem.start, first, further)


def with_random_signs(values: Tensor, start: Tensor, draws: torch.Generator) -> Tensor:
    """Change each value by as much as an attack did, but up or down at random.

    The result is as far from the start in every norm. It does not change values
    that the attack left unchanged, for example because they reach no pixel.

    Args:
        values: Values after the attack, shape (E, D).
        start: Values before the attack, shape (E, D).
        draws: Generator of the random numbers.

    Returns:
        Values with random signs of the changes, shape (E, D).
    """
    signs = 2 * torch.randint(2, values.shape, generator=draws) - 1
    return start + (values - start) * signs.to(values)


def measure_networks(
    subject: SceneObject, networks: Sequence[Classifier], options: argparse.Namespace
) -> None:
    """Attack the first network, and append the predictions of all networks.

    There is a record for each batch of views and each kind of attack. Each
    network gets images of its own size.

    Args:
        subject: Object to render.
        networks: Networks. The first is attacked.
        options: Parsed command line.
    """
    draws = generator(options.seed, subject.name, "transfer")
    all_views = common.clean_correct_views(subject, networks[0], options.examples, draws)
    for views in common.batches(all_views):
        scenes = [common.make_scene(subject, network.size, views) for network in networks]
        for kind in common.STEPS:
            settings = common.attack_settings(kind, options.steps)
            problems = [build_problem(settings, scene) for scene in scenes]
            found = find_adversaries(
                networks[0], problems[0], settings, subject.label, view_count=1
            )
            states = {
                "before": found.start,
                "first": found.first,
                "first_random": found.first_random(draws),
                "further": found.further,
                "further_random": found.further_random(draws),
            }
            predictions = {}
            for network, problem in zip(networks, problems, strict=True):
                predictions[network.name] = {
                    state: common.predict(network, problem.images(values))
                    for state, values in states.items()
                }
            record = {
                "kind": kind,
                "mesh": subject.name,
                "label": subject.label,
                "predictions": predictions,
            }
            common.append(options.out, record)


def measure_views(
    subject: SceneObject, classifier: Classifier, set_index: int, options: argparse.Namespace
) -> None:
    """Attack some views, and append the predictions in views that were not attacked.

    There is a record for each number of attacked views and each kind of attack.

    Args:
        subject: Object to render.
        classifier: Classifier to attack.
        set_index: Number of the set of views, which seeds the draws.
        options: Parsed command line.
    """
    draws = generator(options.seed, subject.name, "unseen views", set_index)
    unseen_views = common.clean_correct_views(subject, classifier, options.examples, draws)
    for view_count in ATTACKED_VIEW_COUNTS:
        views = common.clean_correct_views(subject, classifier, view_count, draws)
        scene = common.make_scene(subject, classifier.size, views)
        for kind in common.STEPS:
            settings = common.attack_settings(kind, options.steps)
            problem = SharedProblem(build_problem(settings, scene))
            found = find_adversaries(classifier, problem, settings, subject.label, view_count)
            states = {
                "first": found.first,
                "further": found.further,
                "random": found.further_random(draws),
            }
            record = {
                "mesh": subject.name,
                "label": subject.label,
                "set": set_index,
                "kind": kind,
                "attacked": view_count,
                "predictions": predict_in_views(
                    subject, classifier, settings, states, unseen_views
                ),
            }
            common.append(options.out, record)


def predict_in_views(
    subject: SceneObject,
    classifier: Classifier,
    settings: AttackSettings,
    states: dict[str, Tensor],
    views: Sequence[common.View],
) -> dict[str, list[str]]:
    """Predict the class of an object in several views for each state.

    Args:
        subject: Object to render.
        classifier: Classifier of the images.
        settings: Settings of the attack, which say what the values mean.
        states: Values of each state, shape (1, D).
        views: Views of the object.

    Returns:
        Predicted class in each view, by state.
    """
    predictions: dict[str, list[str]] = {state: [] for state in states}
    for batch in common.batches(views):
        problem = build_problem(settings, common.make_scene(subject, classifier.size, batch))
        for state, values in states.items():
            images = problem.images(values.expand(len(batch), -1))
            predictions[state] += common.predict(classifier, images)
    return predictions


def main(argv: Sequence[str] | None = None) -> None:
    """Attack each mesh, and append the predictions of other networks or in other views.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = common.make_parser(None, __doc__)
    add = parser.add_argument
    add("study", choices=("networks", "views"))
    add(
        "--examples",
        type=int,
        default=20,
        help="number of views of each mesh, or of unseen views of each set",
    )
    add("--sets", type=int, default=3, help="number of sets of attacked views of each mesh")
    add(
        "--steps",
        type=int,
        default=30,
        help="largest number of steps of a descent (the paper's appendix C)",
    )
    add("--targets", nargs="*", default=[], help="networks that are not attacked, NAME[=WEIGHTS]")
    setup = common.prepare(parser, argv, common.VERTICES)
    options = setup.options
    if options.study == "networks":
        targets = [common.load_named_network(target) for target in options.targets]
        for subject in setup.subjects:
            measure_networks(subject, [setup.classifier, *targets], options)
    else:
        for subject in setup.subjects:
            for set_index in range(options.sets):
                measure_views(subject, setup.classifier, set_index, options)


if __name__ == "__main__":
    main()
