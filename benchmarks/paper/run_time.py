"""How long an attack on the light takes until it succeeds (the paper's Section 4.2, "Runtime").

Times are of the processor, which leaves out other processes, and hold what is precomputed of the view.
"""

import time
from collections.abc import Sequence

import torch

from augment.attacks.descent import Goal, descend
from augment.attacks.problem import build_problem
from augment.random_streams import generator
from benchmarks.paper import common


def main(argv: Sequence[str] | None = None) -> None:
    options = common.parser("run_time", __doc__)
    options.add_argument("--examples", type=int, default=20, help="of each mesh")
    options.add_argument("--steps", type=int, default=30, help="of an attack at most (the paper's appendix C)")
    args, classifier, subjects = common.prepare(options, argv, common.VERTICES)
    settings = common.attack_settings("lighting", args.steps)
    for subject in subjects:
        draws, goal = generator(args.seed, subject.name), Goal(torch.tensor([[classifier.label(subject.label)]]))
        for view in common.clean_correct_views(subject, classifier, args.examples, draws):
            scene = common.scene_of(subject, classifier.size, [view])
            start = time.process_time()
            result = descend(classifier, build_problem(settings, scene), goal, settings)
            row = {"success": bool(result.success[0]), "steps": int(result.steps[0])}
            common.append(args.out, {"mesh": subject.name, **row, "seconds": time.process_time() - start})


if __name__ == "__main__":
    main()
