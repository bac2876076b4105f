"""Write and read the metrics and the images of a training run."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from augment.service import AttackExamples
from renderer.image import to_bytes
from renderer.io.files import atomic_write, remove_unfinished
from renderer.io.images import write_image
from renderer.io.tiles import draw_grid, tiles_of
from renderer.rendering import light_sphere
from train.runs.checkpoint import BEST, LAST, PREVIOUS
from train.runs.run_config import opened_text, parse_object
from train.runs.run_lock import FAILURE

METRICS = "metrics.jsonl"
# Subfolder with the images of the epochs.
RENDERS = "renders"
# Subfolder with the scores of the network that the run began with.
BEFORE = "before"
# Largest width of the images of an attack in pixels. Smaller images are
# enlarged to about this width.
EXAMPLE = 128
# Phases of an epoch, whose seconds are logged. Other phases are parts of these.
PHASES = ("attack", "training", "evaluation", "input_output")
# Renders in a row of the grid of an epoch.
GRID_COLUMNS = 20


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Read metrics.jsonl.

    The file has one line for each epoch, and then a line with the final scores.
    If a crash cut the last line short, the line is left out.

    Args:
        folder: Folder of the run.

    Returns:
        Metrics by name, for each line. Empty if there is no file.

    Raises:
        InputError: If the file is damaged.
    """
    path = folder / METRICS
    if not path.is_file():
        return []
    with opened_text(path) as text:
        lines = [parse_object(line) for line in text.split("\n")[:-1]]
        for line in lines:
            if any(not isinstance(value, int | float) for value in line.values()):
                raise ValueError("a value is not a number")
        return lines


def remove_run(folder: Path) -> None:
    """Remove the results of a run, before another run starts in its folder.

    The scores on photographs, the log and the report remain, because the next
    run writes files of the same names.

    Args:
        folder: Folder of the run.
    """
    for name in (LAST, PREVIOUS, BEST, METRICS, FAILURE):
        (folder / name).unlink(missing_ok=True)
    for events in folder.glob("events.out.tfevents.*"):
        events.unlink()
    for name in (RENDERS, BEFORE):
        shutil.rmtree(folder / name, ignore_errors=True)


class RunLog:
    """Writer of metrics.jsonl, of TensorBoard's events and of images.

    All methods raise OSError if the disk is full.
    """

    def __init__(self, folder: Path, history: Sequence[Mapping[str, float]] = ()):
        """Begin the log.

        Args:
            folder: Folder of the run.
            history: Metrics of the earlier epochs of a resumed run. They
                replace the lines of metrics.jsonl, because a resumed run
                repeats the epochs after its checkpoint.
        """
        # This import takes half a second, and programs that only read metrics
        # do not need it.
        from torch.utils.tensorboard import SummaryWriter

        self._metrics = folder / METRICS
        self._renders = folder / RENDERS
        self._epoch_count = len(history)
        atomic_write(self._metrics, "".join(json.dumps(line) + "\n" for line in history))
        remove_unfinished(self._renders)
        self._board = SummaryWriter(str(folder), purge_step=self._epoch_count + 1)

    def scalars(self, values: Mapping[str, float], epoch: int | None = None) -> None:
        """Log numbers.

        Args:
            values: Numbers by name. TensorBoard groups names such as
                "train/loss" by the part before the slash.
            epoch: Number of the epoch, from 1. None for the final scores, which
                end the log. TensorBoard shows them one step after the last epoch.
        """
        line = values if epoch is None else {"epoch": epoch, **values}
        with open(self._metrics, "a") as file:
            file.write(json.dumps(line) + "\n")
        if epoch is not None:
            self._epoch_count = epoch
        for name, value in values.items():
            self._board.add_scalar(name, value, epoch or self._epoch_count + 1)
        if epoch is None:
            self._board.close()
        else:
            self._board.flush()

    def renders(self, images: Tensor, epoch: int) -> None:
        """Write renders as a grid to TensorBoard and to renders/epoch_EPOCH.png.

        Args:
            images: Renders, shape (E, 3, H, W), in [0, 1].
            epoch: Number of the epoch, from 1.
        """
        from torchvision.utils import make_grid

        tiles = to_bytes(images.cpu())
        grid = make_grid(tiles, nrow=GRID_COLUMNS, padding=1, pad_value=255)
        self._renders.mkdir(exist_ok=True)
        path = self._renders / f"epoch_{epoch:03d}.png"
        write_image(path, Image.fromarray(grid.permute(1, 2, 0).numpy()), compress_level=1)
        self._board.add_image("renders", grid, epoch)

    def attack_examples(
        self,
        attack_examples: AttackExamples,
        classes: Sequence[str],
        epoch: int,
    ) -> None:
        """Write successful attacks to renders/attacks_EPOCH.png, one in each row.

        A row shows the images and white balls in the lighting, before and after
        the attack. The prediction stands over the label of the image.

        Args:
            attack_examples: The attacks.
            classes: Names of the classes.
            epoch: Number of the epoch, from 1.
        """
        labels = []
        for index in attack_examples.labels:
            labels.append(classes[index] if index >= 0 else "negative")
        columns = {}
        # Index 0 has the state before the attack, and index 1 the state after it.
        for index, name in enumerate(("before", "after")):
            images = attack_examples.images[index]
            captions = _captions(attack_examples.predictions[index], classes, labels)
            size = min(EXAMPLE, images.shape[-1])
            reduced = interpolate(images, size, mode="area")
            columns[name] = tiles_of(reduced, captions, EXAMPLE)
            basis = attack_examples.basis
            lights = attack_examples.lights[index]
            balls = (light_sphere(light, EXAMPLE // 2, basis=basis) for light in lights)
            columns[f"light {name}"] = tiles_of(balls)
        self._renders.mkdir(exist_ok=True)
        rows = [*zip(*columns.values(), strict=True)]
        grid = draw_grid(rows, [*columns])
        write_image(self._renders / f"attacks_{epoch:03d}.png", grid)


def _captions(
    probabilities: Tensor,
    classes: Sequence[str],
    labels: Sequence[str],
) -> list[tuple[str, str]]:
    """Write the two captions of each image.

    Args:
        probabilities: Probabilities of the classes, shape (N, classes).
        classes: Names of the classes.
        labels: Label of each image in words.

    Returns:
        For each image, the most probable class with its probability, such as
        "81% orange", and the label.
    """
    highest, predicted = torch.max(probabilities, dim=1)
    captions = []
    for value, index, label in zip(highest.tolist(), predicted.tolist(), labels, strict=True):
        captions.append((f"{value:.0%} {classes[index]}", label))
    return captions
