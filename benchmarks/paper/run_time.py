"""The cost of an attack's iteration, and the number of iterations it takes (the paper's Section 4.2, "Runtime").

python -m benchmarks.paper.run_time --out run_time.jsonl --turns 5 --passes 10 --examples 20 \\
    --meshes orange_studio.glb '{mesh: orange_sketchfab.glb, albedo_scale: 3}'
python -m benchmarks.paper.table run_time.jsonl

An iteration renders, asks the classifier, differentiates both, steps and projects. The attack and the classifier's own
forward and input-gradient pass are timed in turns, in processor time, which leaves out other processes.
"""

import time
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from augment import AttackSettings, Classifier, Scene
from augment.attacks.descent import DescentResult, Goal, descend
from augment.losses import adversarial_cost
from augment.objects import SceneObject
from augment.utils import Phases, generator
from benchmarks.common import seconds
from benchmarks.paper import common
from renderer import ImageSettings, load_light, orbit_cameras
from renderer.errors import FACTOR
from renderer.rasterizer import choose
from train.networks import load_classifier

WIDTHS = (2.0, 2.8, 4.0, 5.7, 8.0)  # of the field of view: each halves the pixels of the one before
BATCH = 32  # images per pass through the classifier, as in conf/attack.yaml
NEVER = FACTOR  # the margin of a logit at which an example leaves


def classifier_pass(classifier: Classifier, images: Tensor, labels: Tensor, batch_size: int) -> None:
    """Logits and the gradient of their cost by the images."""
    for part, label in zip(images.split(batch_size), labels.split(batch_size), strict=True):
        variable = part.detach().requires_grad_(True)
        torch.autograd.grad(adversarial_cost(classifier(variable), label).sum(), variable)


class ProcessorTime(Phases):
    """Phases in the time of this process."""

    def _now(self) -> float:
        return time.process_time()


def descent(classifier: Classifier, scene: Scene, settings: AttackSettings, phases: Phases) -> DescentResult:
    labels = torch.tensor([[classifier.label(label)] for label in scene.labels])
    problem = settings.problem(scene)
    with phases("attack"):
        return descend(classifier, problem, Goal(labels), settings, phases)


def iteration(
    classifier: Classifier, scene: Scene, settings: AttackSettings, turns: int
) -> dict[str, int | list[float]]:
    """Covered pixels of a view, and milliseconds per iteration of every turn but the first, which rehearses.

    bare: the classifier's pass alone. whole: an iteration of the attack. inside: its part in the classifier.
    """
    passes, phases = settings.max_steps + 1, ProcessorTime()
    images = common.images_of(scene)[:, 0]
    labels = torch.tensor([classifier.label(label) for label in scene.labels])
    alone = partial(classifier_pass, classifier, images, labels, settings.batch_size)
    times: dict[str, list[float]] = {"bare": [], "whole": [], "inside": []}
    for _ in range(turns + 1):
        descent(classifier, scene, settings, phases)
        taken = phases.take()
        times["whole"].append(taken["attack"])
        times["inside"].append(taken["attack_classifier"])
        times["bare"].append(sum(seconds(alone) for _ in range(passes)))
    pixels = int(np.mean([int((view > 0).sum()) for stack in scene.stacks for view in stack.coverage]))
    return {"pixels": pixels, **{name: [1000 * taken / passes for taken in times[name][1:]] for name in times}}


def grid(
    subjects: Sequence[SceneObject],
    classifier: Classifier,
    light: str,
    views: int,
    width: float,
    grays: Sequence[float],
) -> Scene:
    """Every subject from a ring of views on every gray, with smooth normals and 2×2 samples a pixel."""
    size = classifier.size
    backgrounds = torch.tensor(grays).view(-1, 1, 1, 1).expand(-1, 3, size, size)
    settings = ImageSettings(size, samples=2, normals="smooth")
    return Scene.grid(subjects, orbit_cameras(views, width), backgrounds, load_light(light), settings, choose())


def main(argv: Sequence[str] | None = None) -> None:
    options = common.parser("run_time", __doc__)
    options.add_argument("--examples", type=int, default=50, help="of each mesh that are attacked until they fool")
    options.add_argument("--steps", type=int, default=30, help="of these attacks at most")
    options.add_argument("--passes", type=int, default=5, help="of a descent that is timed; two of many examples")
    options.add_argument("--turns", type=int, default=20, help="of each such descent")
    options.add_argument("--widths", type=float, nargs="+", default=WIDTHS, help="of the field of view")
    options.add_argument("--many", type=int, default=100, help="examples at once, as in training")
    options.add_argument("--trained", default="run:pretrained/none", help="network of the training's attack")
    args, classifier, subjects = common.prepare(options, argv, common.VERTICES)
    first, trained = subjects[0], load_classifier(args.trained)
    many = args.many // len(common.GRAYS)  # views
    for kind in ("lighting", "geometry"):
        setups = [(first.name, grid([first], classifier, args.light, 1, width, (0.5,))) for width in args.widths]
        at_once = grid([first], classifier, args.light, many, args.widths[0], common.GRAYS)
        setups.append((f"{first.name}, {len(at_once)} examples", at_once))
        for setup, scene in setups:
            passes = args.passes if len(scene) == 1 else 2
            settings = common.attack_settings(kind, passes - 1, margin=NEVER, batch_size=BATCH)
            common.append(
                args.out, {"setup": setup, "kind": kind, **iteration(classifier, scene, settings, args.turns)}
            )
    scene = grid(subjects, trained, args.light, many // len(subjects), 2.0, common.GRAYS)
    settings = common.attack_settings("lighting", args.passes - 1, margin=NEVER, batch_size=len(scene))
    setup = f"{trained.name}, {len(scene)} examples"
    common.append(args.out, {"setup": setup, "kind": "lighting", **iteration(trained, scene, settings, args.turns)})
    for subject in subjects:
        draws = generator(args.seed, subject.name)
        for view in common.recognized_views(subject, classifier, args.light, args.examples, draws):
            one = common.scene_of(subject, classifier.size, args.light, [view])
            start = time.process_time()
            result = descent(classifier, one, common.attack_settings("lighting", args.steps), Phases())
            spent = time.process_time() - start  # with what is rendered once
            numbers = {"success": bool(result.success[0]), "steps": int(result.steps[0]), "seconds": spent}
            common.append(args.out, {"mesh": subject.name, **numbers})


if __name__ == "__main__":
    main()
