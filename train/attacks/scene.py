"""What an attack's configuration shows of one mesh."""

import torch

from augment.build import build_scene
from augment.objects import ObjectSettings
from augment.scene import Scene
from train.attacks.settings import AttackExperimentSettings


def scene_of(item: ObjectSettings, settings: AttackExperimentSettings, size: int, device: torch.device) -> Scene:
    """Views × backgrounds at `size` pixels per side, as an example each, or where views share what is attacked, an
    example per background."""
    return build_scene(
        [item],
        size,
        settings.scene.views,
        shared=settings.attack.shared,
        **settings.scene.choices,
        **settings.renderer.choices,
        device=device,
    )
