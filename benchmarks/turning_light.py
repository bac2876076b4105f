"""The moving picture of README.md: the light turns, and the label flips.

A generated lemon stands in the environment lighting `grace`, which turns about
the vertical axis. Then an attack changes the lighting within an L2 norm-ball,
and the changed lighting turns as well. Each frame shows the image that
EfficientNet-Lite0 classifies, a white ball in the same lighting, and the most
probable classes.

    python -m benchmarks.turning_light --out docs/lighting.gif
"""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

import norm_balls as nb
from renderer.image import to_bytes, to_unit

LABEL = "lemon"
LIGHT = "grace"
RADIUS = 0.5
TURN_FRAMES = 24  # Frames of one turn.
CHANGE_FRAMES = 8  # Frames in which one lighting changes into the other.
FRAME_MS = 110
COLORS = 256  # Colors of the file's palette.

GAP = 16
TEXT_WIDTH = 236
TITLE_HEIGHT = 34
BAR_HEIGHT = 5
SHOWN_CLASSES = 4

WHITE = "#ffffff"
INK = "#1f2328"
GRAY = "#6e7781"
BLUE = "#0072B2"
ORANGE = "#D55E00"


@dataclass(frozen=True)
class Frame:
    """One frame: a lighting, the image in it and the prediction for this image.

    Attributes:
        image: Image of 8 bits, shape (3, size, size).
        ball: Image of a white ball, shape (3, size, size).
        probabilities: Probability of each class, shape (C,).
    """

    image: Tensor
    ball: Tensor
    probabilities: Tensor


def rotation_about_z(degrees: float) -> Tensor:
    """Return the matrix of a rotation about the vertical axis."""
    angle = math.radians(degrees)
    cosine, sine = math.cos(angle), math.sin(angle)
    return torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def turn_lights(natural: Tensor, adversarial: Tensor) -> list[Tensor]:
    """List the lighting of each frame.

    Each lighting makes one turn. In between, they are mixed, and the mixture
    keeps turning.

    Args:
        natural: SH coefficients before the attack, shape (K, 3).
        adversarial: SH coefficients after the attack, shape (K, 3).
    """
    change = [(i + 1) / (CHANGE_FRAMES + 1) for i in range(CHANGE_FRAMES)]
    back = [1.0 - weight for weight in change]
    weights = TURN_FRAMES * [0.0] + change + TURN_FRAMES * [1.0] + back
    lights = []
    for index, weight in enumerate(weights):
        mixture = torch.lerp(natural, adversarial, weight)
        turned = nb.harmonics.rotate(mixture, rotation_about_z(360 * index / TURN_FRAMES))
        lights.append(turned)
    return lights


def render_frame(classifier: nb.Classifier, scene: nb.Scene, light: Tensor) -> Frame:
    """Render one frame and classify its image, rounded to 8 bits.

    Args:
        classifier: Classifier of the image.
        scene: Scene of one example.
        light: SH coefficients, shape (K, 3).
    """
    images = scene.render(nb.Conditions(light[None]), torch.arange(1))[0]
    image = to_bytes(images[0])
    with torch.no_grad():
        logits = classifier(to_unit(image)[None])[0]
    ball = to_bytes(nb.light_sphere(light, classifier.size // 2))
    return Frame(image, ball, logits.softmax(0))


def draw_frame(frame: Frame, classes: list[str], font: Path) -> Image.Image:
    """Draw the image, the ball, and the most probable classes as bars.

    Args:
        frame: The frame.
        classes: Names of the classes.
        font: Font file of the text.
    """
    size = frame.image.shape[-1]
    ball_size = frame.ball.shape[-1]
    text_left = 2 * GAP + size
    width = text_left + TEXT_WIDTH + GAP
    picture = Image.new("RGB", (width, size + 2 * GAP), WHITE)
    picture.paste(as_picture(frame.image), (GAP, GAP))
    picture.paste(as_picture(frame.ball), (width - GAP - ball_size, size + GAP - ball_size))

    draw = ImageDraw.Draw(picture)
    values, indices = frame.probabilities.topk(SHOWN_CLASSES)
    best = classes[int(indices[0])]
    color = BLUE if best == LABEL else ORANGE
    draw.text((text_left, GAP - 4), best, color, ImageFont.truetype(font, 24))
    small = ImageFont.truetype(font, 12)
    top = GAP + TITLE_HEIGHT
    for value, index in zip(values.tolist(), indices.tolist(), strict=True):
        bar_color = BLUE if classes[index] == LABEL else ORANGE
        draw.text((text_left, top), f"{classes[index]} {value:.0%}", INK, small)
        bar_top = top + 17
        right = text_left + 1 + value * (TEXT_WIDTH - 2)
        draw.rectangle((text_left, bar_top, right, bar_top + BAR_HEIGHT), bar_color)
        top += 28
    caption = "a white ball\nin this light"
    draw.multiline_text((text_left, size + GAP - 34), caption, GRAY, small)
    return picture


def as_picture(image: Tensor) -> Image.Image:
    """Convert an image of 8 bits, shape (3, H, W)."""
    return Image.fromarray(image.permute(1, 2, 0).numpy())


def main() -> None:
    """Attack the lighting of the lemon, and write the frames as a GIF file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("docs/lighting.gif"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    classifier = nb.load_classifier("efficientnet_lite0")
    scene = nb.build_scene(
        [("solid:lemon:1", LABEL)], classifier.size, light=LIGHT, width=2.6, encoding="srgb"
    )
    step = nb.StepSettings("l2", radius=RADIUS)
    settings = nb.AttackSettings(lighting=step, max_steps=40, margin=3.0)
    result = nb.attack(classifier, scene, settings=settings)
    lights = turn_lights(scene.lights[0], result.conditions.light[0])
    frames = [render_frame(classifier, scene, light) for light in lights]
    names = [classifier.classes[int(frame.probabilities.argmax())] for frame in frames]
    print("natural:", names[:TURN_FRAMES].count(LABEL), "of", TURN_FRAMES, LABEL)
    changed = names[TURN_FRAMES + CHANGE_FRAMES :][:TURN_FRAMES]
    print("adversarial:", {name: changed.count(name) for name in changed})

    font = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    pictures = [draw_frame(frame, classifier.classes, font) for frame in frames]
    first, *others = [picture.quantize(COLORS) for picture in pictures]
    first.save(
        options.out, save_all=True, append_images=others, duration=FRAME_MS, loop=0, optimize=True
    )
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
