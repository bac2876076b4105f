"""Train the published detector on renders of generated solids in natural light.

Run it as a module in the root of the repository:

    python -m benchmarks.detector_training --out runs/detector

Hard negatives are in the images, but have no label. The detector is tested on solids with other
seeds. A stopped run goes on at its last checkpoint.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import OneCycleLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import norm_balls as nb
from renderer.solids import HARD_NEGATIVES
from train.checkpoints import write_published
from train.detectors import small_detector
from train.networks import DETECTOR, VERSION
from train.results.detections import Found, Marked, join, match_image, score

# Pixels per side of the images.
SIZE = 128
LABELED = ("orange", "sweet_pepper", "mushroom", "cup", "bottle")
# Class 0 is the background, as in torchvision.
CLASSES = ("background", *LABELED)
# Kinds from which the solids of an image are drawn, labeled ones twice as often as others.
KINDS = (*LABELED, *LABELED, *HARD_NEGATIVES, "apple", "pear")
# Solids of the test have seeds from here on, those of the training have smaller ones.
FIRST_TEST_SEED = 1000
TRAINING_SETS = 10
ENTRIES_PER_SET = 64
# Rate at which 1, 2 and 3 solids occur in an image.
COUNT_RATES = (0.5, 0.3, 0.2)
VARY = nb.VariationSettings(
    shift=0.2,
    scale=[0.5, 1.2],
    exposure=[0.6, 1.5],
    azimuth=30.0,
    rotation=20.0,
    environments=["grace", "eucalyptus", "st_peters", "uniform"],
    directional_fraction=0.4,
    fill_light=[0.2, 0.8],
    lit_background=True,
    background_saturation=0.4,
)
BATCH = 16
STEPS_PER_CHECKPOINT = 100
# Images (N, 3, SIZE, SIZE) as bytes, and the boxes and labels of each.
Images = tuple[Tensor, list[dict[str, Tensor]]]


def render(path: Path, number: int, first_seed: int) -> Images:
    """Render a set of images with random solids in random light, or read it if it is there."""
    if not path.is_file():
        rng = np.random.default_rng([first_seed, number])
        entries = [
            [
                nb.ObjectSettings(
                    f"solid:{kind}:{first_seed + rng.integers(FIRST_TEST_SEED)}",
                    label=kind if kind in LABELED else "",
                    azimuth=rng.uniform(0, 360),
                    scale=rng.uniform(0.6, 1.3) if position else 1.0,
                )
                for position, kind in enumerate(
                    rng.choice(KINDS, 1 + rng.choice(len(COUNT_RATES), p=COUNT_RATES)).tolist()
                )
            ]
            for _ in range(ENTRIES_PER_SET)
        ]
        settings = nb.AugmentationSettings(
            mode="random", vary=VARY, random_light=nb.RandomLightSettings(radius=0.3)
        )
        # Every second set has tables.
        ground = rng.uniform(0.2, 0.9, 3).tolist() if number % 2 else None
        looks = {"views": 4, "width": 3.2, "polar": rng.uniform(45, 80), "ground": ground}
        looks |= {
            "samples": 2,
            "normals": "smooth",
            "encoding": "srgb",
            "backgrounds": [rng.uniform(0.25, 1)],
        }
        service = nb.AugmentationService.from_meshes(
            entries, SIZE, settings, seed=number, task=nb.Detection(), classes=CLASSES, **looks
        )
        renders = service.regenerate(small_detector(len(CLASSES), SIZE), 0)
        targets = [
            {key: item[key] for key in ("boxes", "labels")} for item in renders.targets or ()
        ]
        torch.save(((255 * renders.images).round().byte(), targets), path)
    images, targets = torch.load(path, weights_only=True)
    return images, targets


def draw(rng: np.random.Generator, sets: Sequence[Images]) -> tuple[Tensor, dict[str, Tensor]]:
    """Draw an image, mirror it in half of the cases, and change its colors a little."""
    images, targets = sets[int(rng.integers(len(sets)))]
    index = rng.integers(len(images))
    gain = torch.tensor(rng.uniform(0.85, 1.15) + rng.uniform(-0.04, 0.04, (3, 1, 1))).float()
    image, target = images[index] / 255 * gain, targets[index]
    if rng.random() < 0.5:
        left, top, right, bottom = target["boxes"].unbind(1)
        mirrored = torch.stack([SIZE - right, top, SIZE - left, bottom], 1)
        image, target = image.flip(-1), target | {"boxes": mirrored}
    return image.clamp(0, 1), target


def train(out: Path, sets: Sequence[Images], steps: int, seed: int) -> nn.Module:
    """Train the detector, and return the average of its weights over the last steps."""
    torch.manual_seed(seed)
    network = small_detector(len(CLASSES), SIZE).to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(network.parameters(), 1.5e-3, weight_decay=0.02)
    schedule = OneCycleLR(optimizer, 1.5e-3, steps, pct_start=0.1)
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(0.995), use_buffers=True)
    parts = {"network": network, "optimizer": optimizer, "schedule": schedule, "average": average}
    checkpoint, first = out / "checkpoint.pt", 0
    if checkpoint.is_file():
        stored = torch.load(checkpoint, weights_only=True)
        first = stored.pop("step")
        for name, part in parts.items():
            part.load_state_dict(stored[name])
    for step in range(first + 1, steps + 1):
        rng = np.random.default_rng([seed, step])
        images, targets = zip(*(draw(rng, sets) for _ in range(BATCH)), strict=True)
        losses = network([*images], [*targets])
        optimizer.zero_grad()
        sum(losses.values()).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        average.update_parameters(network)
        if step % STEPS_PER_CHECKPOINT == 0 or step == steps:
            print(step, {name: round(loss.item(), 3) for name, loss in losses.items()}, flush=True)
            states = {name: part.state_dict() for name, part in parts.items()}
            torch.save({"step": step, **states}, checkpoint)
    return average.module.eval()


@torch.no_grad()
def test(network: nn.Module, images: Tensor, targets: list[dict[str, Tensor]]) -> dict[str, object]:
    """Score the detector on images. The intervals are over images."""
    outputs = [item for batch in images.split(BATCH) for item in network([*(batch / 255)])]
    found = [
        Found(*(item[key].numpy() for key in ("boxes", "labels", "scores"))) for item in outputs
    ]
    marked = [
        Marked(item["boxes"].numpy(), item["labels"].numpy(), item["labels"].numpy() < 0)
        for item in targets
    ]
    matches = join([*map(match_image, found, marked)])
    every = range(1, len(CLASSES))
    scored = {"all": [*every], **{CLASSES[label]: [label] for label in every}}
    threshold = nb.Detection().threshold
    return {name: asdict(score(matches, of, threshold)) for name, of in scored.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, train, test and publish the detector."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    parser.add_argument("--steps", type=int, default=2400, help="training steps of 16 images")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    sets = [render(options.out / f"set_{i}.pt", i, 0) for i in range(TRAINING_SETS)]
    network = train(options.out, sets, options.steps, options.seed)
    held_out = [render(options.out / f"test_{i}.pt", i, FIRST_TEST_SEED) for i in range(2)]
    scores = {
        "held_out": test(
            network,
            torch.cat([images for images, _ in held_out]),
            [item for _, targets in held_out for item in targets],
        )
    }
    print(json.dumps(scores, indent=1))
    facts = {"version": VERSION, "name": DETECTOR, "classes": list(CLASSES), "size": SIZE}
    state = {"architecture": facts, "model": network.state_dict(), "scores": scores}
    write_published(options.out / "model.safetensors", state)


if __name__ == "__main__":
    main()
