"""The log of a training run: metrics of its epochs, and images of its renders and attacks."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate
from tqdm import tqdm

from augment.renders import AttackExamples
from renderer.image import to_bytes
from renderer.io.files import atomic_write, remove_unfinished
from renderer.io.images import draw_grid, tiles_of, write_image
from renderer.rendering import light_sphere
from train.run_folder import METRICS, PHASES, RENDERS, attack_success

# Measurements of the attack on the training renders. A round is a part of the training
# with the same renders. If an epoch has several rounds, the log has these measurements
# of each round.
SHOWN = ("attack_success_before", "attack_success", "steps")
# Images of an attack are reduced or enlarged to about this width in pixels.
EXAMPLE = 128
# All renders of an epoch are logged as one image, a grid with this many columns.
GRID_COLUMNS = 20
# Metrics or measurements by their names.
Numbers = Mapping[str, float]


@runtime_checkable
class Logger(Protocol):
    """Anything with a method `log`, such as a run of Weights & Biases."""

    def log(self, values: Numbers, step: int) -> Any:
        """Record the metrics of an epoch, which counts from 1, by their names."""


class RunLog:
    """Writer of the metrics and images of a training run.

    Metrics go to metrics.jsonl and to a logger or, without one, to TensorBoard, images to the
    sub-folder renders/. All methods raise OSError if the disk is full.
    """

    def __init__(self, folder: Path, history: Sequence[Any] = (), logger: Logger | None = None):
        """Begin the log.

        `history` replaces the lines in metrics.jsonl, because a resumed run repeats the epochs
        after its checkpoint.
        """
        self._metrics = folder / METRICS
        self._renders = folder / RENDERS
        atomic_write(self._metrics, "".join(json.dumps(line) + "\n" for line in history))
        remove_unfinished(self._renders)
        self._logger = logger
        self._board: Any = None
        if logger is None:
            # This import takes half a second. Programs that only read metrics do not need it.
            from torch.utils.tensorboard import SummaryWriter

            # Events after the checkpoint are removed, since the resumed run writes them again.
            self._board = SummaryWriter(str(folder), purge_step=len(history) + 1)

    def scalars(self, values: Numbers, step: int, is_final: bool = False) -> None:
        """Write the metrics of an epoch, or the final scores, to the log.

        `step` is the epoch, which counts from 1. The final scores, after which nothing is logged,
        have the step after the last epoch.
        """
        with open(self._metrics, "a") as file:
            file.write(json.dumps(values if is_final else {"epoch": step, **values}) + "\n")
        if self._logger is not None:
            self._logger.log(dict(values), step=step)
            return
        for name, value in values.items():
            self._board.add_scalar(name, value, step)
        if is_final:
            self._board.close()
        else:
            self._board.flush()

    def renders(self, images: Float[Tensor, "N 3 H W"], epoch: int) -> None:
        """Write the training renders of an epoch as one image with a grid of renders.

        The image goes to renders/epoch_EPOCH.png and, without a logger, to TensorBoard.
        """
        from torchvision.utils import make_grid

        grid = make_grid(to_bytes(images.cpu()), nrow=GRID_COLUMNS, padding=1, pad_value=255)
        self._renders.mkdir(exist_ok=True)
        write_image(self._renders / f"epoch_{epoch:03d}.png", grid, compress_level=1)
        if self._board is not None:
            self._board.add_image("renders", grid, epoch)

    def attack_examples(self, found: AttackExamples, classes: Sequence[str], epoch: int) -> None:
        """Write an image of successful attacks on training renders: renders/attacks_EPOCH.png.

        Each attack has a row with four images: the render before the attack, a
        white ball in the same lighting, and both after the attack. The predicted
        class and the true class stand below a render.
        """
        # A negative label is complementary: the render shows no object of the positive class.
        labels = [classes[one] if one >= 0 else "negative" for one in found.labels]
        columns = {}
        # The fields of `found` have the state before the attack at index 0,
        # and the state after it at index 1.
        for index, name in enumerate(("before", "after")):
            images = found.images[index]
            highest, predicted = found.predictions[index].max(1)
            captions = [
                (f"{value:.0%} {classes[shown]}", label)
                for value, shown, label in zip(highest, predicted, labels, strict=True)
            ]
            reduced = interpolate(images, min(EXAMPLE, images.shape[-1]), mode="area")
            columns[name] = tiles_of(reduced, captions, EXAMPLE)
            lights = found.lights[index]
            balls = (light_sphere(light, EXAMPLE // 2, basis=found.basis) for light in lights)
            columns[f"light {name}"] = tiles_of(balls)
        self._renders.mkdir(exist_ok=True)
        grid = draw_grid([*zip(*columns.values(), strict=True)], [*columns])
        write_image(self._renders / f"attacks_{epoch:03d}.png", grid)


def epoch_metrics(
    trained: Numbers, validated: Numbers, diagnostics: Sequence[Numbers], seconds: Numbers
) -> dict[str, float]:
    """Join the metrics of an epoch under the names that metrics.jsonl and TensorBoard have.

    "augment/" has means of the diagnostics over all rounds, and "round_1/" those of one of several
    rounds. A round without a visible object lacks some of them.
    """
    names = dict.fromkeys(name for one in diagnostics for name in one)
    means = {name: fmean(one[name] for one in diagnostics if name in one) for name in names}
    groups = {"train": trained, "validation": validated, "augment": means, "seconds": seconds}
    for number, one in enumerate(diagnostics if len(diagnostics) > 1 else (), 1):
        groups[f"round_{number}"] = {name: one[name] for name in SHOWN if name in one}
    return {f"{group}/{key}": value for group, of in groups.items() for key, value in of.items()}


def format_epoch(epoch: int, epochs: int, metrics: Numbers) -> str:
    """Write the line that the console shows after an epoch.

    The success of the attack counts only renders that are classified correctly before it.
    """
    total = sum(metrics[f"seconds/{name}"] for name in PHASES)
    parts = [
        f"epoch {epoch}/{epochs}",
        f"train loss {metrics['train/loss']:.3f} accuracy {metrics['train/accuracy']:.3f}",
        f"validation accuracy {metrics['validation/accuracy']:.3f}",
    ]
    success = attack_success(metrics, "augment/")
    if success is not None:
        # "attack_success_before" is the fraction of renders that are misclassified
        # before the attack.
        correct = 1 - metrics["augment/attack_success_before"]
        parts.append(f"attack success {success:.2f} of the {correct:.0%} clean-correct")
    duration = f"{total:.0f} s (renders {metrics['seconds/attack']:.1f} s)"
    left = total * (epochs - epoch)
    if left:
        duration += f"; about {tqdm.format_interval(left)} left"
    return "  ".join([*parts, duration])
