"""The picture of README.md: an orange, a projector's pattern, the orange under it, and bars of runs before and after.

    python -m benchmarks.headline --attack FOLDER --mesh orange_sketchfab.glb --runs runs/demo/0 runs/demo/1 runs/demo/2

FOLDER gets before.png, pattern.png and after.png; where it has them, nothing is attacked. The pattern is rounded to 8
bits before the orange is rendered under it, and the predictions are those for the PNG files, read again.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import torch
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from PIL import Image

import augment
from augment.scene.conditions import Conditions
from renderer.image import to_bytes, to_unit
from renderer.io.images import read_image
from renderer.light.basis import parts_of
from train.evaluation.scores.metrics import RANKED, metric_title, read_metric

BEFORE, PATTERN, AFTER = "before.png", "pattern.png", "after.png"
PIXELS, INK, GRAY, BLUE, GREEN, RED = 16, "#1f2328", "#6e7781", "#0072B2", "#1a7f37", "#b42318"
TITLES = ("An orange in plain light", "A projector's 16 × 16 pixels", "The same orange under it")


def attack_orange(classifier: augment.Classifier, mesh: str, folder: Path) -> None:
    """Write the three files: what a projector beside the camera must show for the orange to become a balloon."""
    orange = augment.ObjectSettings(mesh, "orange", albedo_scale=3.0)
    scene = augment.build_scene(
        [orange], classifier.size, polar=62.0, azimuth=270.0, width=2.3, fov=40.0, light="grace",
        exposure=1.6, ground=[0.38, 0.38, 0.36], encoding="srgb", shadows=True,
        projector=augment.ProjectorSettings(PIXELS, polar=50.0, azimuth=290.0, power=2.0),
    )  # fmt: skip
    settings = augment.AttackSettings(projector=augment.StepSettings(step_size=1.0), max_steps=60, margin=8.0)
    result = augment.attack(classifier, scene, "balloon", settings)
    (rows, projector), light = parts_of(scene.basis)[1], result.conditions.light.clone()
    pattern = to_bytes(light[0, rows] / projector.power)
    light[0, rows] = to_unit(pattern) * projector.power
    after = scene.render(Conditions(light), torch.arange(1))
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in ((BEFORE, result.images_before), (AFTER, after)):
        Image.fromarray(to_bytes(image[0, 0]).permute(1, 2, 0).numpy()).save(folder / name)
    Image.fromarray(pattern.view(PIXELS, PIXELS, 3).numpy()).save(folder / PATTERN)


def draw_attack(card: Figure, classifier: augment.Classifier, folder: Path) -> None:
    """The three files, and beneath them the predictions for two of them."""
    for index, (name, title) in enumerate(zip((BEFORE, PATTERN, AFTER), TITLES, strict=True)):
        axes = card.add_axes((0.028 + 0.22 * index, 0.2, 0.20625, 0.66))
        axes.imshow(Image.open(folder / name), interpolation="nearest" if name == PATTERN else "lanczos")
        axes.set_axis_off()
        axes.set_title(title, fontsize=17, color=INK, pad=9)
        text, color = "thrown from beside the camera", GRAY
        if name != PATTERN:
            probabilities = classifier(read_image(folder / name, classifier.size)[None]).softmax(1)[0].detach()
            best = int(probabilities.argmax())
            text, color = f"{classifier.classes[best]}, {probabilities[best]:.1%}", RED if name == AFTER else GREEN
            print(f"{name}: {text}; orange {probabilities[classifier.label('orange')]:.5%}")
        place = {"transform": axes.transAxes, "ha": "center", "va": "top", "fontsize": 16 if color == GRAY else 25}
        axes.text(0.5, -0.055, text, color=color, fontweight="normal" if color == GRAY else "bold", **place)


def draw_bars(card: Figure, runs: Sequence[Path]) -> None:
    """AUC and recall at three false-positive rates, of the network that all runs began with, with its 95 % interval,
    and of their own: mean and range."""
    folders = [runs[0] / "before", *runs]
    before, *after = (json.loads((folder / "laboratory" / "summary.json").read_text()) for folder in folders)
    axes, metrics = card.add_axes((0.785, 0.15, 0.2, 0.64)), (*RANKED[1:], RANKED[0])
    for row, metric in enumerate(metrics):
        begun = read_metric(before, metric)
        seeds = [read_metric(summary, metric).value for summary in after]
        bars = [(begun.value, begun.low, begun.high), (fmean(seeds), min(seeds), max(seeds))]
        for (value, low, high), offset, color in zip(bars, (-0.19, 0.19), ("#b1bac4", BLUE), strict=True):
            axes.barh(row + offset, value, 0.36, color=color)
            axes.plot([low, high], [row + offset] * 2, color=INK, linewidth=1.6)
            axes.text(max(value, high) + 0.02, row + offset, f"{value:.2f}", va="center", fontsize=15, color=INK)
    axes.set(xlim=(0, 1.14), ylim=(3.5, -0.5), xticks=[])
    axes.set_yticks(range(4), [metric_title(name).replace(" at ", "\nat ") for name in metrics])
    axes.tick_params(axis="y", length=0, labelsize=15, labelcolor=INK)
    axes.spines[["top", "right", "bottom"]].set_visible(False)
    small = {"transform": axes.transAxes, "va": "bottom", "fontsize": 13.5, "color": GRAY}
    axes.text(-0.4, 1.13, "Another network, hardened", **small | {"fontsize": 17, "color": INK})
    axes.text(
        -0.4, 1.035, "on {positives} path-traced oranges, {negatives} other things".format(**before["n"]), **small
    )
    for x, text, color in ((-0.4, "■ before, 95 %", GRAY), (0.2, f"■ after, {len(after)} seeds", BLUE)):
        axes.text(x, -0.13, text, **small | {"color": color})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/headline.png"))
    parser.add_argument("--attack", type=Path, required=True, help="the folder of the three files")
    parser.add_argument("--runs", type=Path, nargs="+", required=True, help="of the demonstration")
    parser.add_argument("--mesh", help="of an orange", default="orange_sketchfab.glb")
    options = parser.parse_args()
    classifier = augment.load_classifier("efficientnet_lite0")
    if not (options.attack / PATTERN).is_file():
        attack_orange(classifier, options.mesh, options.attack)
    card = Figure(figsize=(16, 5), dpi=100)
    style = {"fc": "white", "ec": "#d0d7de", "zorder": -1, "transform": card.dpi_scale_trans}
    card.add_artist(FancyBboxPatch((0.1, 0.1), 15.8, 4.8, "round,pad=0,rounding_size=0.25", **style))
    draw_attack(card, classifier, options.attack)
    draw_bars(card, options.runs)
    card.savefig(options.out, facecolor="none")


if __name__ == "__main__":
    main()
