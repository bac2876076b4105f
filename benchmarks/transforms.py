"""Images per second of random light beside Albumentations and Kornia, in one process and thread.

    pip install albumentations==2.0.8 kornia numba
    python -m benchmarks.transforms

Images have 256 × 256 pixels of 8 bits. Each gets a light of its own. Kornia gets the same images as
32-bit numbers in [0, 1], as its transforms need. The transforms take turns, and the table has
medians and quartiles over the rounds. Seconds are those in which the thread runs.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.util import find_spec
from unittest.mock import patch

import torch
from torch import Tensor

import norm_balls as nb
from augment.lighting import RandomLighting
from augment.scene import lights
from augment.scene.lights import MODELS
from benchmarks.scene import Contender, Result, View

# Our models that have a counterpart in the other libraries, and its names there.
COUNTERPARTS = {
    "cast_shadow": ("RandomShadow", "albumentations"),
    "linear": ("Illumination", "RandomLinearIllumination"),
    "fractal": ("PlasmaShadow", "RandomPlasmaShadow"),
    "point": ("Illumination gaussian", "RandomGaussianIllumination"),
    "color_temperature": ("PlanckianJitter", "RandomPlanckianJitter"),
}
# Images, each in a light of its own, over which the errors of random light are computed.
LIT_IMAGES = 16


def measure(call: Callable[[], object], repeats: int) -> float:
    """Return the number of calls in a second of the thread, which other programs may interrupt."""
    start = time.thread_time()
    for _ in range(repeats):
        call()
    return repeats / (time.thread_time() - start)


def quartiles(values: list[float], decimals: int) -> str:
    """Return the median and the quartiles of values as text."""
    first, median, third = (f"{value:.{decimals}f}" for value in statistics.quantiles(values, n=4))
    return f"{median} [{first}, {third}]"


def transforms(size: int) -> dict[str, Callable[[], object]]:
    """Return a call of each transform for one image, by its name."""
    image = torch.randint(0, 256, (3, size, size), dtype=torch.uint8)
    array = image.permute(1, 2, 0).contiguous().numpy()
    unit = image[None].float() / 255
    calls: dict[str, Callable[[], object]] = {}
    for name in MODELS:
        calls[name] = partial(RandomLighting(name).__call__, image)
    calls["any model"] = partial(RandomLighting().__call__, image)
    if find_spec("albumentations"):
        os.environ["NO_ALBUMENTATIONS_UPDATE"] = "1"
        import albumentations

        theirs = {
            "RandomShadow": albumentations.RandomShadow(p=1),
            "Illumination": albumentations.Illumination(mode="linear", p=1),
            "PlasmaShadow": albumentations.PlasmaShadow(p=1),
            "Illumination gaussian": albumentations.Illumination(mode="gaussian", p=1),
            "PlanckianJitter": albumentations.PlanckianJitter(p=1),
        }
        for name, transform in theirs.items():
            calls[f"Albumentations {name}"] = partial(transform, image=array)
    if find_spec("kornia"):
        import kornia.augmentation

        for name in sorted({name for _, name in COUNTERPARTS.values()} - {"albumentations"}):
            module = getattr(kornia.augmentation, name)(p=1.0)
            calls[f"Kornia {name}"] = partial(module, unit)
    return calls


def random_lights(view: View) -> Iterator[Contender]:
    """Yield each model of random light on images of each type of numbers, of the view's size."""
    generator = torch.Generator().manual_seed(0)
    shape = LIT_IMAGES, 3, view.size, view.size
    images = torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator).to(view.device)
    typed = {"uint8": images, "float32": images.float() / 255, "float64": images.double() / 255}
    for name in MODELS:
        transform = RandomLighting(name)
        exact = light_images(transform, typed["float64"])
        for dtype, batch in typed.items():
            step = partial(light_images, transform, batch)
            call = partial(transform, batch[0])
            yield Contender(f"{name} ({dtype})", None, None, step, call, exact)


def light_images(transform: RandomLighting, images: Tensor) -> Result:
    """Light images (N, 3, H, W), and return all their pixels, each in the same light every time."""

    def normal_noise(like: Tensor, seeds: Sequence[int]) -> Tensor:
        """Draw the same noise for numbers of 64 bits as for those of 32."""
        return float_noise(like.float(), seeds).to(like)

    float_noise = lights.normal_noise
    torch.manual_seed(0)
    drawn = transform.make_params([images])
    with patch.object(lights, "normal_noise", normal_noise):
        lit = transform.apply(images, drawn)
    values = lit / 255 if lit.dtype == torch.uint8 else lit
    radiance = values.transpose(0, 1).flatten(1)
    pixels = torch.arange(radiance.shape[1], device=radiance.device)
    return Result(pixels, radiance, gradient=torch.empty(0))


def main() -> None:
    """Print medians and quartiles of the rates, and of the ratio to the faster counterpart."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--repeats", type=int, default=20, help="images per round")
    options = parser.parse_args()
    torch.set_num_threads(1)
    calls = transforms(options.size)
    if "Albumentations RandomShadow" in calls:
        import cv2

        cv2.setNumThreads(1)
    for call in calls.values():
        measure(call, 3)  # Compilation and tables.
    rates: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(options.rounds):
        for name, call in calls.items():
            rates[name].append(measure(call, options.repeats))
    print(
        f"version {nb.__version__}, torch {torch.__version__}, load average "
        f"{os.getloadavg()[0]:.1f}\n\n| transform | images/s | ratio |"
    )
    print("|-|-|-|")
    for name, values in rates.items():
        rivals = [
            rates[f"{library} {other}"]
            for other in COUNTERPARTS.get(name, ())
            for library in ("Albumentations", "Kornia")
            if f"{library} {other}" in rates
        ]
        ratio = ""
        if rivals:
            # Rounds are compared one by one, because other programs share the machine.
            pairs = zip(values, max(rivals, key=statistics.median), strict=True)
            ratio = quartiles([ours / theirs for ours, theirs in pairs], 2)
        print(f"| {name} | {quartiles(values, 0)} | {ratio} |")


if __name__ == "__main__":
    main()
