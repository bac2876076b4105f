"""Measure how long an attack on the light takes until it succeeds.

This is the paper's Section 4.2, "Runtime". Times are those of the process, which
leave out other processes. They include what is precomputed of the view.
"""

import time
from collections.abc import Sequence

import torch

from augment import AttackSettings, Classifier
from augment.attacks.loop import minimize
from augment.attacks.objective import Objective
from augment.attacks.problem import build_problem
from augment.scene.objects import SceneObject
from augment.tasks.classification import ClassCriterion
from benchmarks.common import Row
from benchmarks.paper import common


def measure_attack(
    subject: SceneObject, classifier: Classifier, view: common.View, settings: AttackSettings
) -> Row:
    """Attack a view, and measure the seconds.

    Args:
        subject: Object to render.
        classifier: Classifier to attack.
        view: View that is classified correctly before.
        settings: Settings of the attack.

    Returns:
        Record of the attack.
    """
    scene = common.make_scene(subject, classifier.size, [view])
    criterion = ClassCriterion(torch.tensor([[classifier.label(subject.label)]]))
    start = time.process_time()
    problem = build_problem(settings, scene)
    result = minimize(problem, Objective(classifier, criterion, settings))
    seconds = time.process_time() - start
    return {
        "mesh": subject.name,
        "success": bool(result.success[0]),
        "steps": int(result.steps[0]),
        "seconds": seconds,
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Attack views of each mesh, and append a record for each.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = common.make_parser("run_time", __doc__)
    common.add_examples(parser)
    parser.add_argument(
        "--steps",
        type=int,
        default=30,
        help="largest number of steps of an attack (the paper's appendix C)",
    )
    setup = common.prepare(parser, argv, common.VERTICES)
    options = setup.options
    settings = common.attack_settings("lighting", options.steps)
    for subject, views in common.subjects_with_views(setup):
        for view in views:
            record = measure_attack(subject, setup.classifier, view, settings)
            common.append(options.out, record)


if __name__ == "__main__":
    main()
