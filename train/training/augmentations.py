"""Augmentations of training batches.

The usual ones, with which training on renders is compared, are image transforms of torchvision and
adversarial attacks on pixels (PGD). "relight" shows the images in the light of a projector, and
"stripes" in that of a scanner.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from augment import distributed
from augment.attack_settings import AttackSettings, RelightingSettings, StepSettings
from augment.attacks.loop import minimize_from
from augment.attacks.objective import Objective, as_jpeg
from augment.attacks.optimizers import Gradient, NormBalls
from augment.photographs import RelitPhotographs
from augment.random_streams import generator, seeded, stream_seed
from augment.scene.patterns import draw_projected_light
from augment.tasks.classification import ClassCriterion, label_loss
from renderer.errors import MAX_SCALE
from renderer.image import decode, to_bytes, to_unit
from train.settings import LIGHTS, LOW_LIGHT, RELIGHT, RELIGHT_AND_LOW_LIGHT, STRIPES, TrainSettings

# Norm-ball and step size of the attack on pixels. Madry et al. (2018) use a radius of
# 8/255 on CIFAR-10.
PGD = StepSettings(norm="linf", radius=2 / 255, step="sign", step_size=1 / 255)
PGD_STEPS = 3
Images = UInt8[Tensor, "B 3 H W"]
# Fraction of the images under stripes that are gray, as those of many scanners.
GRAY = 0.4


def darken(images: Images, seed: int) -> Images:
    """Show images in low light of any color from one side, as the camera of a phone shows them.

    It smooths the noise, raises the contrast, and writes JPEG. At 224 pixels, the standard
    deviation of the smoothing is up to 2.5 pixels.
    """
    # These imports take a second, and most runs need no light.
    from torchvision.transforms import v2

    from augment.lighting import relight_photographs

    for light in ("color_temperature", "linear", "low_light"):
        images = relight_photographs(images, stream_seed(seed, light), lights=[light])
    widest = max(images.shape[2:]) / 90
    smooth = v2.GaussianBlur(2 * round(1.6 * widest) + 1, (0.04 * widest, widest))
    camera = v2.Compose([smooth, v2.ColorJitter(contrast=(1.0, 1.6))])
    with seeded(seed):
        # Only a CPU writes JPEG.
        developed = torch.stack([to_unit(camera(image)) for image in images.cpu()])
        qualities = torch.randint(60, 98, (len(images),)).tolist()
    return to_bytes(as_jpeg(developed, qualities)).to(images.device)


def relit(images: Images, seed: int, augmentation: str) -> Images:
    """Show images in random light of an augmentation.

    This is low light, the light of a scanner, or else that of a projector, which shows each image
    as a slide on itself.
    """
    from augment.lighting import relight_photographs

    if augmentation == LOW_LIGHT:
        return darken(images, seed)
    if augmentation == STRIPES:
        from torchvision.transforms.functional import rgb_to_grayscale

        shown = relight_photographs(images, seed, lights=[STRIPES])
        is_gray = torch.rand(len(images), generator=generator(seed, "gray")) < GRAY
        is_gray = is_gray.to(images.device).view(-1, 1, 1, 1)
        return torch.where(is_gray, rgb_to_grayscale(shown, 3), shown)
    shown = relight_photographs(images, seed, slides=images)
    if augmentation == RELIGHT_AND_LOW_LIGHT:
        shown[1::2] = darken(images, seed)[1::2]
    return shown


@dataclass
class Augmentation:
    """Augmentation of training images that `settings.augmentation` names.

    A name that is not handled here is a transform of torchvision.

    Attributes:
        model: Network in training.
        teacher: Network before the training, or None. With `settings.relight_steps`, light is
            searched that changes its predictions.
        absent: Classes that images with a complementary label do not show, either.
    """

    settings: TrainSettings
    model: nn.Module
    teacher: nn.Module | None = None
    seed: int = 0
    absent: Sequence[int] = ()

    def apply(self, images: Images, labels: Tensor, step: int) -> Images:
        """Augment the images of a batch. Only "pgd" needs `labels`, which are of classes then.

        The random numbers for an image depend on the seed, the step and the index of the image in
        the batch.
        """
        name = self.settings.augmentation
        if name == "none":
            return images
        if name == "pgd":
            return self._attack_pixels(images, labels, step)
        if name == RELIGHT:
            return self._relight(images, step)
        if name in LIGHTS:
            seed = stream_seed(self.seed, step, "low light", distributed.rank())
            shown = relit(images, seed, STRIPES if name == STRIPES else LOW_LIGHT)
            if name == RELIGHT_AND_LOW_LIGHT:
                # Half of the images are relit, and the others stay dark.
                shown[::2] = self._relight(images, step)[::2]
            return shown
        # A transform of torchvision draws the same random numbers for all images of a batch, from
        # the global generator. So it is called for each image, with a seed of its own.
        transformed = []
        with torch.random.fork_rng(devices=[images.device] if images.is_cuda else []):
            # Each process has a part of the batch. This is the index of its first image.
            for index, image in enumerate(images, distributed.rank() * len(images)):
                torch.manual_seed(stream_seed(self.seed, step, index, "distortion"))
                transformed.append(self._transform(image))
        return torch.stack(transformed)

    @cached_property
    def _transform(self) -> Any:
        """Transform of torchvision with the name of the augmentation."""
        # This import takes a second, and most runs need no transform.
        from torchvision.transforms import v2

        jitter = v2.ColorJitter(brightness=0.4, contrast=0.4, saturation=0.4, hue=0.1)
        transforms = {"color_jitter": jitter, "trivial_augment": v2.TrivialAugmentWide()}
        # Brightness from 0.05 to 2 times, also contrast, saturation and hue.
        transforms["exposure_jitter"] = v2.ColorJitter((0.05, 2.0), 0.4, 0.4, 0.1)
        transforms["augmix"] = v2.AugMix()
        transforms["color_jitter+augmix"] = v2.Compose([jitter, v2.AugMix()])
        return transforms[self.settings.augmentation]

    def _relight(self, images: Images, step: int) -> Images:
        """Show the images of a batch in the light of a projector, each in a light of its own.

        A slide is the picture that the projector shows. It is a random pattern or another image of
        the batch, and each of its color channels is multiplied by smooth factors. The factors are
        random, or are changed by gradient descent until the network predicts another class than
        the teacher predicts for the unchanged image.
        """
        # The random numbers differ between steps, and between the processes of a run.
        draws = generator(self.seed, step, "relight", distributed.rank())
        count, _, size, _ = images.shape
        light = draw_projected_light(count, size, draws, images).to(images.device)
        unit = to_unit(images)
        # The linear colors of an image stand for the albedo of what it shows.
        albedo = decode(unit, "srgb")
        steps = self.settings.relight_steps
        # A pass for the start, and two for each step: forward and backward.
        relighting = RelightingSettings(self.settings.relight_gain, passes=2 * steps + 1)
        problem = RelitPhotographs(albedo, light, relighting)
        values = problem.sample(draws)
        if steps and relighting.radius and self.teacher is not None:
            with torch.no_grad():
                criterion = ClassCriterion(self.teacher(unit).argmax(1)[:, None])
            values = self._descend(problem, values, criterion, steps)
        with torch.no_grad():
            return to_bytes(light.expose(albedo, problem.log_gain(values)))

    def _attack_pixels(self, images: Images, labels: Int[Tensor, " B"], step: int) -> Images:
        """Attack images by projected gradient descent from a random start (Madry et al. 2018).

        All PGD_STEPS steps are taken, also if an image is misclassified earlier. A negative label
        is complementary: the image shows neither this class nor the classes `absent`.
        """
        draws = generator(self.seed, step, "pgd", distributed.rank())
        problem = _Pixels(images)
        criterion = _LossOfLabels(labels[:, None], absent=self.absent)
        values = self._descend(problem, problem.sample(draws), criterion, PGD_STEPS)
        return to_bytes(values.view(images.shape))

    def _descend(
        self, problem: Any, start: Float[Tensor, "B D"], criterion: ClassCriterion, steps: int
    ) -> Float[Tensor, "B D"]:
        """Return the values that gradient descent finds. With this margin, no attack ends early."""
        count = len(start)
        options: dict[str, Any] = {"margin": MAX_SCALE, "quantized": False, "sensor_noise": 0.0}
        settings = AttackSettings(max_steps=steps, batch_size=count, **options)
        objective = Objective(self.model, criterion, settings)
        optimizer = Gradient(problem, settings, seed=0)
        rows = torch.arange(count, device=start.device)
        return minimize_from(start, optimizer, objective, rows, scores_last=False).values


class _Pixels(NormBalls):
    """Pixels of images as attacked values, in balls around the images."""

    box = (0, 1)

    def __init__(self, images: Images):
        super().__init__(PGD, to_unit(images).flatten(1))
        self.group_size = len(images)
        self._shape = images.shape[1:]

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        """Return the images (A, 1, 3, H, W) that consist of the values."""
        return values.unflatten(1, self._shape)[:, None]


@dataclass(frozen=True)
class _LossOfLabels(ClassCriterion):
    """Criterion that raises the loss of labels, which may be complementary, and is never reached.

    Attributes:
        absent: Classes that images with a complementary label do not show, either.
    """

    absent: Sequence[int] = ()

    def cost(self, logits: Tensor) -> Tensor:
        """Return the negative loss of each image."""
        return -label_loss(logits, self.source, absent=self.absent)

    def gap(self, logits: Tensor) -> Tensor:
        """Return a gap of −∞, with which no attack ends."""
        return torch.full_like(logits[..., 0], -torch.inf)
