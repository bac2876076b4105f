"""The picture of README.md.

It shows an orange, a projector's pattern, and the orange under the pattern, and
bars of the scores of runs before and after hardening.

    python -m benchmarks.headline --attack FOLDER --mesh orange_sketchfab.glb \\
        --runs runs/demo/0 runs/demo/1 runs/demo/2

FOLDER gets before.png, pattern.png and after.png. If it has them already,
nothing is attacked. The pattern is rounded to 8 bits before the orange is
rendered under it, and the predictions are those for the PNG files, read again.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from PIL import Image
from torch import Tensor

import augment
from augment.scene.conditions import Conditions
from renderer.image import to_bytes, to_unit
from renderer.io.images import read_image
from renderer.light.basis import parts_of
from train.evaluation.scores.metrics import RANKED, metric_title, read_metric
from train.evaluation.tables import Estimate

BEFORE = "before.png"
PATTERN = "pattern.png"
AFTER = "after.png"
TITLES = {
    BEFORE: "An orange in plain light",
    PATTERN: "A projector's 16 × 16 pixels",
    AFTER: "The same orange under it",
}
# Pixels per side of the projector's pattern.
PIXELS = 16

INK = "#1f2328"
GRAY = "#6e7781"
BLUE = "#0072B2"
GREEN = "#1a7f37"
RED = "#b42318"
BORDER = "#d0d7de"
GRAY_BAR = "#b1bac4"


def attack_orange(classifier: augment.Classifier, mesh: str, folder: Path) -> None:
    """Find the pattern of a projector that makes an orange a balloon, and write the images.

    Args:
        classifier: Classifier to attack.
        mesh: File of the orange.
        folder: Folder of the three images.
    """
    scene = augment.build_scene(
        [augment.ObjectSettings(mesh, "orange", albedo_scale=3.0)],
        classifier.size,
        polar=62.0,
        azimuth=270.0,
        width=2.3,
        fov=40.0,
        light="grace",
        exposure=1.6,
        ground=[0.38, 0.38, 0.36],
        encoding="srgb",
        shadows=True,
        projector=augment.ProjectorSettings(
            PIXELS,
            polar=50.0,
            azimuth=290.0,
            power=2.0,
        ),
    )
    settings = augment.AttackSettings(
        projector=augment.StepSettings(step_size=1.0),
        max_steps=60,
        margin=8.0,
    )
    result = augment.attack(classifier, scene, "balloon", settings)

    # The basis has two parts: the environment light, and then the projector.
    pattern_rows, projector = parts_of(scene.basis)[1]
    light = result.conditions.light.clone()
    pattern = to_bytes(light[0, pattern_rows] / projector.power)
    light[0, pattern_rows] = to_unit(pattern) * projector.power
    images_after = scene.render(Conditions(light), torch.arange(1))
    folder.mkdir(parents=True, exist_ok=True)
    save_image(result.images_before[0, 0], folder / BEFORE)
    save_image(images_after[0, 0], folder / AFTER)
    Image.fromarray(pattern.view(PIXELS, PIXELS, 3).numpy()).save(folder / PATTERN)


def save_image(image: Tensor, path: Path) -> None:
    """Write an image, shape (3, size, size), as 8 bits."""
    Image.fromarray(to_bytes(image).permute(1, 2, 0).numpy()).save(path)


def draw_attack(card: Figure, classifier: augment.Classifier, folder: Path) -> None:
    """Draw the three images, with the predictions below two of them.

    Args:
        card: Figure to draw on.
        classifier: Classifier of the predictions.
        folder: Folder of the three images.
    """
    for index, (name, title) in enumerate(TITLES.items()):
        axes = card.add_axes((0.028 + 0.22 * index, 0.2, 0.20625, 0.66))
        interpolation = "nearest" if name == PATTERN else "lanczos"
        axes.imshow(Image.open(folder / name), interpolation=interpolation)
        axes.set_axis_off()
        axes.set_title(title, fontsize=17, color=INK, pad=9)
        if name == PATTERN:
            draw_caption(axes, "thrown from beside the camera", GRAY, 16, "normal")
        else:
            color = RED if name == AFTER else GREEN
            draw_caption(axes, predict(classifier, folder / name), color, 25, "bold")


def draw_caption(axes: Axes, text: str, color: str, size: float, weight: str) -> None:
    """Write a text below an image."""
    axes.text(
        0.5,
        -0.055,
        text,
        color=color,
        fontsize=size,
        fontweight=weight,
        transform=axes.transAxes,
        ha="center",
        va="top",
    )


def predict(classifier: augment.Classifier, path: Path) -> str:
    """Return the predicted class of an image file with its probability, and print it.

    Args:
        classifier: Classifier of the image.
        path: Image file.
    """
    image = read_image(path, classifier.size)[None]
    probabilities = classifier(image).softmax(1)[0].detach()
    best = int(probabilities.argmax())
    prediction = f"{classifier.classes[best]}, {probabilities[best]:.1%}"
    orange = probabilities[classifier.label("orange")]
    print(f"{path.name}: {prediction}; orange {orange:.5%}")
    return prediction


@dataclass(frozen=True)
class Bar:
    """A bar with a line for its interval.

    Attributes:
        offset: Height of its center below the tick of its metric.
        color: Color of the bar.
        estimate: Length of the bar, and the ends of its line.
    """

    offset: float
    color: str
    estimate: Estimate


def draw_bars(card: Figure, runs: Sequence[Path]) -> None:
    """Draw AUC and recall at three false-positive rates, before and after hardening.

    Each metric has two bars. The gray bar is the network that all runs started
    from, with its 95% interval. The blue bar is the mean of the runs, with their
    lowest and highest value.

    Args:
        card: Figure to draw on.
        runs: Folders of the runs.
    """
    before = read_summary(runs[0] / "before")
    after = [read_summary(run) for run in runs]
    axes = card.add_axes((0.785, 0.15, 0.2, 0.64))
    auc, *recalls = RANKED
    metrics = [*recalls, auc]
    for row, metric in enumerate(metrics):
        values = [read_metric(summary, metric).value for summary in after]
        mean_after = Estimate(fmean(values), min(values), max(values))
        draw_bar(axes, row, Bar(-0.19, GRAY_BAR, read_metric(before, metric)))
        draw_bar(axes, row, Bar(0.19, BLUE, mean_after))
    axes.set(xlim=(0, 1.14), ylim=(3.5, -0.5), xticks=[])
    titles = [metric_title(name).replace(" at ", "\nat ") for name in metrics]
    axes.set_yticks(range(len(titles)), titles)
    axes.tick_params(axis="y", length=0, labelsize=15, labelcolor=INK)
    axes.spines[["top", "right", "bottom"]].set_visible(False)
    write_legend(axes, before["n"], len(after))


def write_legend(axes: Axes, counts: dict[str, int], seed_count: int) -> None:
    """Write a title above the bars, and what their colors mean below them."""
    positives = counts["positives"]
    negatives = counts["negatives"]
    images = f"on {positives} path-traced oranges, {negatives} other things"
    label(axes, -0.4, 1.13, "Another network, hardened", INK, size=17)
    label(axes, -0.4, 1.035, images, GRAY)
    label(axes, -0.4, -0.13, "■ before, 95 %", GRAY)
    label(axes, 0.2, -0.13, f"■ after, {seed_count} seeds", BLUE)


def read_summary(run: Path) -> dict:
    """Read the scores of a run on path-traced renders."""
    return json.loads((run / "laboratory" / "summary.json").read_text())


def draw_bar(axes: Axes, row: int, bar: Bar) -> None:
    """Draw a bar, its interval and its value."""
    y = row + bar.offset
    value = bar.estimate.value
    ends = [bar.estimate.low, bar.estimate.high]
    axes.barh(y, value, 0.36, color=bar.color)
    axes.plot(ends, [y, y], color=INK, linewidth=1.6)
    text_x = max(value, *ends) + 0.02
    axes.text(text_x, y, f"{value:.2f}", va="center", fontsize=15, color=INK)


def label(axes: Axes, x: float, y: float, text: str, color: str, size: float = 13.5) -> None:
    """Write a text at a place in fractions of the axes."""
    axes.text(x, y, text, transform=axes.transAxes, va="bottom", fontsize=size, color=color)


def main() -> None:
    """Attack the orange if its images are missing, and draw the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("docs/headline.png"))
    add("--attack", type=Path, required=True, help="folder of the three images")
    add("--runs", type=Path, nargs="+", required=True, help="runs of the demonstration")
    add("--mesh", help="mesh of an orange", default="orange_sketchfab.glb")
    options = parser.parse_args()
    classifier = augment.load_classifier("efficientnet_lite0")
    if not (options.attack / PATTERN).is_file():
        attack_orange(classifier, options.mesh, options.attack)
    card = Figure(figsize=(16, 5), dpi=100)
    frame = FancyBboxPatch(
        (0.1, 0.1),
        15.8,
        4.8,
        "round,pad=0,rounding_size=0.25",
        fc="white",
        ec=BORDER,
        zorder=-1,
        transform=card.dpi_scale_trans,
    )
    card.add_artist(frame)
    draw_attack(card, classifier, options.attack)
    draw_bars(card, options.runs)
    card.savefig(options.out, facecolor="none")


if __name__ == "__main__":
    main()
