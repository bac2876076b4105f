"""Several kinds of parameters of one scene as the one problem that an attack descends on."""

from collections.abc import Sequence

import torch
from torch import Tensor

from augment.kind import Kind
from augment.scene import Conditions, Scene


class Perturbation:
    """Kinds side by side: values (E, D) are theirs, one after the other. See `augment.descent.Problem`."""

    def __init__(self, scene: Scene, kinds: Sequence[Kind]):
        self.scene, self.kinds = scene, kinds
        self.start = torch.cat([kind.start.to(scene.lights) for kind in kinds], dim=1)
        self.everything = torch.arange(len(scene), device=self.start.device)
        self._sizes = [kind.start.shape[1] for kind in kinds]

    def conditions(self, values: Tensor, examples: Tensor) -> Conditions:
        """What values (A, D) make of the scene of examples (A,)."""
        conditions = self.scene.conditions(examples)
        for kind, part in zip(self.kinds, self.split(values), strict=True):
            conditions = kind.apply(part, conditions, examples)
        return conditions

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        return self.scene.render(self.conditions(values, examples), examples)

    @torch.no_grad()
    def images(self, values: Tensor) -> Tensor:
        """(E, V, 3, size, size) of values (E, D), rendered by parts, so that little memory beside theirs is used."""
        size = self.scene.settings.size
        images = values.new_empty(len(values), self.scene.views, 3, size, size)
        for part in self.everything.split(self.scene.at_once):
            images[part] = self.render(values[part], part)
        return images

    def step(self, gradient: Tensor) -> Tensor:
        parts = zip(self.kinds, self.split(gradient), strict=True)
        return torch.cat([kind.step(part) for kind, part in parts], dim=1)

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        parts = zip(self.kinds, self.split(values), strict=True)
        return torch.cat([kind.project(part, examples) for kind, part in parts], dim=1)

    def sample(self, generator: torch.Generator) -> Tensor:
        """Uniform draws (E, D) from every kind's ball around its start, within its domain."""
        drawn = [kind.sample(generator, self.everything).to(self.start) for kind in self.kinds]
        return torch.cat(drawn, dim=1)

    def sample_as_far(self, values: Tensor, generator: torch.Generator) -> Tensor:
        """Draws (E, D) as far as values went: uniform in a kind's ball where it has a radius, else in a random
        direction at the values' own L2 distance from the start."""
        parts = zip(self.kinds, self.split(values), strict=True)
        drawn = [kind.sample_as_far(part, generator, self.everything).to(self.start) for kind, part in parts]
        return torch.cat(drawn, dim=1)

    def split(self, values: Tensor) -> tuple[Tensor, ...]:
        """Each kind's part (A, D_k) of values (A, D)."""
        return values.split(self._sizes, dim=1)
