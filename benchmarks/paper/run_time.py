"""The cost of an attack's iteration, and the number of iterations it takes (the paper's Section 4.2, "Runtime").

An iteration renders, asks the classifier, differentiates both, steps and projects. The attack and the classifier's own
forward and input-gradient pass are timed in turns, in processor time, which leaves out other processes.
"""

import time
from collections.abc import Sequence

import torch

from augment import AttackSettings, Classifier, Scene
from augment.attacks.descent import DescentResult, Goal, descend
from augment.losses import adversarial_cost
from augment.utils import Phases, generator
from benchmarks.common import Row, seconds
from benchmarks.paper import common
from renderer import orbit_cameras
from renderer.errors import FACTOR

WIDTHS = (2.0, 2.8, 4.0, 5.7, 8.0)  # of the image in world units: each halves the pixels of the one before


class ProcessorTime(Phases):
    """Phases in the time of this process."""

    def _now(self) -> float:
        return time.process_time()


def descent(classifier: Classifier, scene: Scene, settings: AttackSettings, phases: Phases) -> DescentResult:
    labels = torch.tensor([[classifier.label(label)] for label in scene.labels])
    problem = settings.problem(scene)
    with phases("attack"):
        return descend(classifier, problem, Goal(labels), settings, phases)


def iteration(classifier: Classifier, scene: Scene, settings: AttackSettings, turns: int) -> Row:
    """Covered pixels of the one view, and milliseconds per iteration of every turn but the first, which rehearses.

    bare: the classifier's pass alone. whole: an iteration of the attack. inside: its part in the classifier.
    """
    passes, phases = settings.max_steps + 1, ProcessorTime()
    image = common.images_of(scene)[:, 0].requires_grad_()
    label = torch.tensor([classifier.label(label) for label in scene.labels])

    def classifier_passes() -> None:
        for _ in range(passes):
            torch.autograd.grad(adversarial_cost(classifier(image), label).sum(), image)

    row: Row = {"pixels": int((scene.stacks[0].coverage > 0).sum()), "bare": [], "whole": [], "inside": []}
    for turn in range(turns + 1):
        descent(classifier, scene, settings, phases)
        spent, bare = phases.take(), seconds(classifier_passes)
        if turn:
            times = {"bare": bare, "whole": spent["attack"], "inside": spent["attack_classifier"]}
            for name, value in times.items():
                row[name].append(1000 * value / passes)
    return row


def main(argv: Sequence[str] | None = None) -> None:
    options = common.parser("run_time", __doc__)
    options.add_argument("--examples", type=int, default=50, help="of each mesh that are attacked until they succeed")
    options.add_argument("--steps", type=int, default=30, help="of these attacks at most")
    options.add_argument("--passes", type=int, default=5, help="of a descent that is timed")
    options.add_argument("--turns", type=int, default=20, help="of each such descent")
    options.add_argument("--widths", type=float, nargs="+", default=WIDTHS, help="of the image in world units")
    args, classifier, subjects = common.prepare(options, argv, common.VERTICES)
    for kind in common.STEPS:
        settings = common.attack_settings(kind, args.passes - 1, margin=FACTOR)  # which no logit reaches
        for width in args.widths:
            scene = common.scene_of(subjects[0], classifier.size, args.light, [(*orbit_cameras(1, width), 0.5)])
            times = iteration(classifier, scene, settings, args.turns)
            common.append(args.out, {"setup": subjects[0].name, "kind": kind, **times})
    settings = common.attack_settings("lighting", args.steps)
    for subject in subjects:
        draws = generator(args.seed, subject.name)
        for view in common.clean_correct_views(subject, classifier, args.light, args.examples, draws):
            scene = common.scene_of(subject, classifier.size, args.light, [view])
            start = time.process_time()
            result = descent(classifier, scene, settings, Phases())
            spent = time.process_time() - start  # with what is rendered once
            row = {"success": bool(result.success[0]), "steps": int(result.steps[0]), "seconds": spent}
            common.append(args.out, {"mesh": subject.name, **row})


if __name__ == "__main__":
    main()
