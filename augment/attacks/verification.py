"""Whether adversaries fool outside of the floats that they were found in: rounded, compressed, rendered from files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.attacks.adversary import Adversary
from augment.attacks.adversary_folder import MITSUBA, read_adversary
from augment.attacks.observation import as_jpeg
from augment.attacks.run import Attacked, answers, logits_of
from renderer.errors import require_choice
from renderer.files.mitsuba_scene import SCENE, mitsuba, render_mitsuba_scene
from renderer.image import behind, clamp, develop_composite, to_bytes, to_unit
from renderer.visibility import Backend

JPEG_QUALITY = 90
RENDERERS = ("reload", "mitsuba")


@dataclass(frozen=True)
class Verdict:
    """What a classifier makes of another version of E examples' images after an attack.

    logits: (E, V, C). fooled: (E,) bool, in every view. largest, mean: (E,) absolute differences of values.
    """

    version: str
    logits: Tensor
    fooled: Tensor
    largest: Tensor
    mean: Tensor

    def of(self, example: int, classes: Sequence[str]) -> dict[str, Any]:
        """One example's numbers."""
        return {
            "fooled": bool(self.fooled[example]),
            **answers(self.logits[example], classes),
            "largest_difference": float(self.largest[example]),
            "mean_difference": float(self.mean[example]),
        }


def require_renderers(names: Sequence[str]) -> None:
    """InputError unless each is known and installed."""
    for name in names:
        require_choice("attack.verify", name, RENDERERS)
    if MITSUBA in names:
        with mitsuba():
            pass


def verify(attacked: Attacked, folders: Sequence[Path], renderers: Sequence[str]) -> list[Verdict]:
    """A verdict on the images as floats, rounded to 8 bits, as JPEG, and on what each renderer makes of the folders.

    renderers: "reload", ours; "mitsuba", Mitsuba's direct illumination, in which concave meshes shade themselves.
    """
    images = attacked.images.cpu()
    rounded = to_unit(to_bytes(images))
    versions = {"float": images, "8 bits": rounded, f"JPEG {JPEG_QUALITY}": as_jpeg(images, JPEG_QUALITY)}
    anew = [rendered(folder, renderers, attacked.problem.scene.backend) for folder in folders if renderers]
    versions |= {name: torch.stack([each[name] for each in anew]) for name in renderers}
    return [_verdict(attacked, name, seen.to(attacked.images)) for name, seen in versions.items()]


def rendered(folder: Path, renderers: Sequence[str], backend: Backend) -> dict[str, Tensor]:
    """(V, 3, size, size) by each renderer, from an adversary's files alone, which are read once."""
    adversary = read_adversary(folder)
    by = {
        "reload": lambda: adversary.render(backend),
        "mitsuba": lambda: _by_mitsuba(adversary, folder / MITSUBA / SCENE),
    }
    return {name: by[name]() for name in renderers}


def _by_mitsuba(adversary: Adversary, scene: Path) -> Tensor:
    seen = render_mitsuba_scene(scene, len(adversary.cameras))
    encoding = adversary.settings.encoding
    images = develop_composite(seen[:, :3] + behind(seen[:, 3:], adversary.background, encoding), encoding)
    return images if adversary.pixels is None else clamp(images + adversary.pixels)


def _verdict(attacked: Attacked, version: str, images: Tensor) -> Verdict:
    logits = logits_of(attacked.classifier, images, attacked.settings.batch_size)
    off = (images - attacked.images).abs().flatten(1)
    return Verdict(version, logits, attacked.goal.reached(logits.argmax(2)), off.amax(1), off.mean(1))
