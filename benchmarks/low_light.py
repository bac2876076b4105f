"""Harden FastestDet for low light with unlabeled photographs, and score it on real photographs.

Run it as a module in the root of the repository, after `pip install ".[ecosystem]"`:

    python -m benchmarks.low_light --data DATA --out OUT

DATA has weights/ (fastestdet_coco.onnx, coco.names), photographs of anything for the training
(imagenet_samples/ and photos/), and for the scores alone real_light/low_light_detection/ with boxes
in a COCO file. Of imagenet_samples, every tenth photograph is held out: the network should find
there what the original finds. The folder --objects has further photographs for the training, which
show the objects in ordinary light. The trained network sees dim images alone.
"""

import argparse
import resource
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import nn

import norm_balls as nb
from augment.exposure import IsDim, with_normalized_light
from augment.switch import Switch
from benchmarks.common import machine
from benchmarks.detectors import SIZE, FastestDet, decode
from renderer.io.images import crop_center, read_rgb
from train.data.sets import Split
from train.results.annotated_scores import DetectionScores
from train.results.tables import format_interval
from train.training.detection import validate

TASK = nb.Detection(decode=decode)
LIGHTS = ("plain", "low_light", "motion_blur")
CLASSES = ("apple", "banana", "orange")
# Single photographs mostly show one large object, so there are also mosaics of 2 × 2.
MOSAICS = 600


def square(path: Path, size: int) -> np.ndarray:
    """Read the central square of a photograph."""
    return np.asarray(crop_center(read_rgb(path, size), size))


def split(data: Path) -> tuple[list[Path], list[Path]]:
    """Return the photographs of the training, and those held out."""
    samples = sorted((data / "imagenet_samples").glob("*.jpg"))
    is_held_out = [int(path.name.split("_")[0]) % 10 == 0 for path in samples]
    held_out = [path for path, held in zip(samples, is_held_out, strict=True) if held]
    # Those of the source "tiny" have 64 pixels per side.
    photos = (path for path in (data / "photos").glob("*/*.*") if "tiny_" not in path.name)
    return sorted({*samples, *photos} - {*held_out}), held_out


def write_photographs(others: Sequence[Path], objects: Sequence[Path], folder: Path) -> None:
    """Write the training images: all photographs, and mosaics of random ones.

    Every second tile of a mosaic shows an object.
    """
    folder.mkdir(parents=True)
    for index, path in enumerate([*others, *objects]):
        Image.fromarray(square(path, SIZE)).save(folder / f"photograph_{index:04}.png")
    draws = np.random.default_rng(0)
    for index in range(MOSAICS):
        sources = [list(objects) or others, others] * 2
        tiles = [square(paths[draws.integers(len(paths))], SIZE // 2) for paths in sources]
        mosaic = np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[3:1:-1])])
        Image.fromarray(mosaic).save(folder / f"mosaic_{index:04}.png")


def main(arguments: Sequence[str] | None = None) -> None:
    """Train the networks that have no weights yet, and write the table of all networks."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder of the data")
    add("--objects", type=Path, help="folder of photographs of the objects")
    add("--out", type=Path, required=True, help="folder of the weights and of table.md")
    add("--epochs", type=int, default=24, help="epochs of 400 images")
    add("--seeds", type=int, nargs="*", default=[0])
    options = parser.parse_args(arguments)
    weights = options.data / "weights"
    names = (weights / "coco.names").read_text().splitlines()
    given = {"classes": names, "size": SIZE, "task": TASK}
    original = FastestDet(weights / "fastestdet_coco.onnx").eval()
    others, held_out = split(options.data)
    objects = sorted(options.objects.glob("*.*")) if options.objects else []
    photographs = options.out / "photographs"
    if not photographs.exists():
        write_photographs(others, objects, photographs)

    def for_dim(network: nn.Module) -> nn.Module:
        # Outside of `Sequential`, outputs of a switch count as decoded.
        switch = Switch(original, with_normalized_light(network, True), IsDim())
        return nn.Sequential(switch).eval()

    networks = {"original": original, "normalized light": with_normalized_light(original, True)}
    networks["normalized light, dim images alone"] = for_dim(original)
    for seed in options.seeds:
        path = options.out / f"{seed}.pt"
        network: nn.Module = FastestDet(weights / "fastestdet_coco.onnx").eval()
        if path.exists():
            network.load_state_dict(torch.load(path))
        else:
            train = {"epochs": options.epochs, "augmentation": "low_light", "resume": True}
            train["distillation_weight"] = 0.0
            start = resource.getrusage(resource.RUSAGE_SELF).ru_utime
            run = {"train": train, "data": {"workers": 0}, "seed": seed}
            run |= {"out": options.out / f"run{seed}", "normalize_light": True}
            network = nb.harden(network, [], photographs, **given, **run)
            seconds = resource.getrusage(resource.RUSAGE_SELF).ru_utime - start
            print(f"seed {seed}: {seconds / 60:.0f} minutes of one core")
            torch.save(network.state_dict(), path)
        networks[f"trained for dim images, seed {seed}"] = for_dim(network)
    images = np.stack([square(path, SIZE) for path in held_out])
    kept = Split(torch.tensor(images).permute(0, 3, 1, 2), torch.zeros(len(images)).long())
    columns = [f"{name}, {light}" for light in LIGHTS for name in (*CLASSES, "false")]
    lines = [f"|network|{'|'.join(columns)}|kept|", "|-|" + "-|" * (len(columns) + 1)]
    for name, network in networks.items():
        photos = options.data / "real_light" / "low_light_detection"
        scores = nb.evaluate(network, photos, fit="stretch", **given)
        assert isinstance(scores, DetectionScores)
        cells = []
        for kind in LIGHTS:
            of_light = scores.by_source[kind]
            cells += [format_interval(of_light[label].recall) for label in CLASSES]
            cells.append(format_interval(of_light["all"].false_per_image))
        with torch.no_grad():
            agreement = validate(network, original, TASK, kept)
        lines.append(f"|{name}|{'|'.join(cells)}|{agreement['accuracy']:.3f}|")
        print(lines[-1], flush=True)
    (options.out / "table.md").write_text("\n".join(lines) + f"\n\n{machine()}\n")


if __name__ == "__main__":
    main()
