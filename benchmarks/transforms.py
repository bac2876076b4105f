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
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

import torch

import norm_balls as nb
from augment.lighting import RandomLighting
from augment.scene.lights import MODELS

# Our models that have a counterpart in the other libraries, and its names there.
COUNTERPARTS = {
    "cast_shadow": ("RandomShadow", "albumentations"),
    "linear": ("Illumination", "RandomLinearIllumination"),
    "fractal": ("PlasmaShadow", "RandomPlasmaShadow"),
}


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
        }
        for name, transform in theirs.items():
            calls[f"Albumentations {name}"] = partial(transform, image=array)
    if find_spec("kornia"):
        import kornia.augmentation

        for name in ("RandomLinearIllumination", "RandomPlasmaShadow"):
            module = getattr(kornia.augmentation, name)(p=1.0)
            calls[f"Kornia {name}"] = partial(module, unit)
    return calls


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
