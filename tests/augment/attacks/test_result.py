import io

import numpy as np
import pytest
from PIL import Image, ImageSequence

import augment
import renderer
from augment.attacks.result import SIDE
from renderer.io.images import MARGIN
from tests.helpers import bright_or_dark

SIZE = 8


@pytest.fixture(scope="module")
def result() -> augment.AttackResult:
    classifier = augment.Classifier(bright_or_dark, SIZE, ["orange", "other"])
    scene = augment.build_scene([("solid:orange", "orange")], SIZE, views=2)
    settings = augment.AttackSettings(lighting=augment.StepSettings(step_size=0.5), max_steps=2)
    return augment.attack(classifier, scene, settings=settings, force=True)


def test_a_plot_shows_the_images_the_light_and_the_probabilities_of_its_example(result):
    before, light, after, bars = result.plot(example=1).axes
    ball = renderer.light_sphere(result.conditions.light[1], 96)
    expected = (result.images_before[1], ball, result.images[1])
    for axes, image in zip((before, light, after), expected, strict=True):
        shown = axes.images[0].get_array()
        np.testing.assert_allclose(shown, image.permute(1, 2, 0).clamp(0, 1), atol=1e-6)
    rows = [result.classifier.label(name.get_text()) for name in bars.get_yticklabels()]
    expected = [result.logits_before[1].softmax(0), result.logits[1].softmax(0)]
    for container, probabilities in zip(bars.containers, expected, strict=True):
        widths = [bar.get_width() for bar in container]
        np.testing.assert_allclose(widths, probabilities[rows], atol=1e-6)
    assert Image.open(io.BytesIO(result._repr_png_())).format == "PNG"  # for notebooks


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_an_animation_shows_the_images_from_before_to_after(result, tmp_path, suffix):
    """The means of the images are compared, since the formats compress with a loss."""
    path = tmp_path / f"attack.{suffix}"
    result.save_animation(path, example=1, frame_count=5)
    means = []
    with Image.open(path) as animation:
        for frame in ImageSequence.Iterator(animation):
            pixels = np.asarray(frame.convert("RGB"), dtype=float) / 255
            means.append(pixels[MARGIN : MARGIN + SIDE, MARGIN : MARGIN + SIDE].mean())
    assert len(means) == 5
    expected = [float(image.mean()) for image in [result.images_before[1], result.images[1]]]
    assert [means[0], means[-1]] == pytest.approx(expected, abs=0.01)
    # The light is interpolated linearly, and so is an image in light alone.
    assert means[2] == pytest.approx((means[0] + means[4]) / 2, abs=0.02)
