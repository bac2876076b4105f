"""The one scene: rows of what is shown, rendered under conditions that an attack may change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from augment.objects import SceneObject
from augment.relighting import Layer, OperatorStack, Relighting, in_place
from augment.reshading import Reshading
from augment.utils import require_memory
from renderer.cache import OperatorCache
from renderer.camera import Camera
from renderer.errors import InputError, require_bounded
from renderer.image import ImageSettings, background_term, clamp, clamped, tonemap_composite
from renderer.light.basis import HARMONICS, Basis, parts_of
from renderer.light.local import Lamps, moved
from renderer.mesh import Mesh
from renderer.rasterizer import Rasterizer
from renderer.transfer import TransferOperator

if TYPE_CHECKING:
    from jaxtyping import Float, Int

AT_ONCE = 2**24  # pixels of the images that are rendered at once: some 2 GB, with what a gradient needs of them


@dataclass(frozen=True)
class Example:
    """A row of a scene: which object, from V cameras, before which background.

    object, background: indices into the scene's. exposure: multiplies the light.
    """

    object: int
    cameras: tuple[Camera, ...]
    background: int
    exposure: float = 1.0


@dataclass(frozen=True)
class Conditions:
    """What A examples are rendered under.

    light: of the scene's basis. vertices: None where they are the meshes'. albedo: added to each face's linear albedo.
    pixels: added to the values of the V images. positions: of the lamps, None where they are the basis'. Where meshes
    differ in size, N and F are the largest's, and a smaller mesh has the first of them.
    """

    light: Float[Tensor, "A coefficients 3"]
    vertices: Float[Tensor, "A N 3"] | None = None
    albedo: Float[Tensor, "A F 3"] | None = None
    pixels: Float[Tensor, "A V 3 size size"] | None = None
    positions: Float[Tensor, "A L 3"] | None = None


@dataclass(eq=False, repr=False)
class Scene:
    """E examples of V views each, over backgrounds (B, 3 or 1, size, size) of values in [0, 1].

    Under a change of light alone nothing is rasterized after the first time: the operators of many views are stacked
    (`Relighting`). Where vertices move, their view is rasterized anew each time (`Reshading`). lights: (E, size, 3), or
    (size, 3) for all, where attacks begin; their dtype and device are those of the images. operators: where rendered
    views are kept. basis: what lights are coefficients of; 49 harmonics, unless another is given. camera_effects: what
    a camera makes of rendered images (A, V, 3, size, size) of examples (A,), differentiable; see `CameraEffects`.
    """

    objects: Sequence[SceneObject]
    examples: Sequence[Example]
    backgrounds: Tensor
    lights: Tensor
    settings: ImageSettings
    rasterizer: Rasterizer
    operators: OperatorCache = field(default_factory=OperatorCache)
    basis: Basis = HARMONICS
    camera_effects: Callable[[Tensor, Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        self._require_consistent()
        self.examples = [self._seen_whole(example) for example in self.examples]
        self.backgrounds = self.backgrounds.to(self.lights)
        self.lights = self.lights.expand(len(self.examples), *self.lights.shape[-2:])
        self.views = len(self.examples[0].cameras)  # per example
        self.object_of = self._column(example.object for example in self.examples)  # (E,)
        self._background = self._column(example.background for example in self.examples)
        exposures = torch.tensor([example.exposure for example in self.examples])
        self._exposure = exposures.to(self.lights)[:, None, None]
        size, images = self.settings.size, len(self.examples) * self.views
        self.at_once = max(1, AT_ONCE // (self.views * size**2))  # examples
        asked = f"{images} renders of {size} pixels per side (augment.examples, scene.views, scene.backgrounds)"
        require_memory(asked, 24 * images * size**2, self.lights.device)
        self._relighting = self._relit_views()
        self._reshading = Reshading(self.objects, self.settings, self.rasterizer, self.basis, self.lights)

    def _require_consistent(self) -> None:
        if not self.examples:
            raise InputError("nothing is to be rendered: name one mesh, one view and one background or more")
        if self.lights.shape[-2:] != (self.basis.size, 3):
            raise InputError(
                f"lights of shape {tuple(self.lights.shape)} is not of {self.basis}: give {self.basis.size} rows"
            )
        behind, size = self.backgrounds, self.settings.size
        if not (behind.is_floating_point() and behind.shape[1:] in ((1, size, size), (3, size, size))):
            raise InputError(f"backgrounds of {behind.dtype} {tuple(behind.shape)}: give images (B, 3, {size}, {size})")
        if not (behind.min() >= 0 and behind.max() <= 1):
            raise InputError("scene.backgrounds: give values in [0, 1]")
        for name, given in (("object", self.objects), ("background", behind)):
            if not all(0 <= getattr(example, name) < len(given) for example in self.examples):
                raise InputError(f"examples name a {name} that is not among the {len(given)} of {name}s")

    def _relit_views(self) -> Relighting:
        # without the scene, which each epoch replaces, tied to itself
        cache, settings, rasterizer = self.operators, self.settings, self.rasterizer
        basis, dtype = self.basis, self.lights.dtype

        def build(item: SceneObject, cameras: Sequence[Camera]) -> Sequence[TransferOperator]:
            return cache.operators(item.mesh, cameras, settings, rasterizer, item.albedo_scale, basis, dtype)

        seen = [(example.object, camera) for example in self.examples for camera in example.cameras]
        behind_images = self._background.repeat_interleave(self.views)
        return Relighting(self.objects, seen, behind_images, self.backgrounds.flatten(2), settings, build)

    @classmethod
    def grid(
        cls,
        objects: Sequence[SceneObject],
        cameras: Sequence[Camera],
        backgrounds: Tensor,
        light: Tensor,
        settings: ImageSettings,
        rasterizer: Rasterizer,
        operators: OperatorCache | None = None,
        *,
        shared: bool = False,
        basis: Basis = HARMONICS,
    ) -> Scene:
        """Every object from every camera over every background, in that order; or, where the views share what is
        attacked, every object over every background from all cameras."""
        views = [tuple(cameras)] if shared else [(camera,) for camera in cameras]
        examples = [Example(*row) for row in product(range(len(objects)), views, range(len(backgrounds)))]
        return cls(objects, examples, backgrounds, light, settings, rasterizer, operators or OperatorCache(), basis)

    def __len__(self) -> int:
        return len(self.examples)

    @cached_property
    def cameras(self) -> list[tuple[Camera, ...]]:
        """The V of each example."""
        return [example.cameras for example in self.examples]

    @cached_property
    def labels(self) -> list[str]:
        """Of each example."""
        return [self.objects[example.object].label for example in self.examples]

    @cached_property
    def vertices(self) -> Tensor:
        """(M, N, 3) of each object; those of smaller meshes end in zeros."""
        return torch.nn.utils.rnn.pad_sequence(self._reshading.vertices, batch_first=True)

    @property
    def stacks(self) -> list[OperatorStack]:
        """All operators, of which those that are missing are built now."""
        return self._relighting.stacks

    def mesh(self, example: int) -> Mesh:
        """What an example shows."""
        return self.objects[self.examples[example].object].mesh

    def basis_under(self, conditions: Conditions, row: int) -> Basis:
        """What the light of a row of conditions is of: lamps are where the conditions have them."""
        return self.basis if conditions.positions is None else moved(self.basis, conditions.positions[row].detach())

    def conditions(self, examples: Int[Tensor, " A"]) -> Conditions:
        """The scene's own, for some examples."""
        return Conditions(self.lights[examples])

    def render(self, conditions: Conditions, examples: Int[Tensor, " A"]) -> Float[Tensor, "A V 3 size size"]:
        """Images in [0, 1] of examples from their V views, differentiable in the conditions.

        InputError: NaN.
        """
        layers = list(self._layers(conditions, examples))
        canvas = self.backgrounds.flatten(2).index_select(0, self._background[examples].repeat_interleave(self.views))
        canvas = canvas.expand(-1, 3, -1).contiguous()
        covered = [tonemap_composite(layer.composite, self.settings.encoding) for layer in layers]
        images = in_place(canvas, layers, covered)
        images = images.view(len(examples), self.views, 3, self.settings.size, self.settings.size)
        images = images if self.camera_effects is None else self.camera_effects(images, examples)
        return images if conditions.pixels is None else clamp(images + conditions.pixels)

    @torch.no_grad()
    def clamped_fraction(self, conditions: Conditions, examples: Int[Tensor, " A"]) -> Float[Tensor, " A"]:
        """Per example, the share of its covered pixels' values that the clamp changes."""
        shares = self.lights.new_zeros(2, len(examples) * self.views)
        for layer in self._layers(conditions, examples):
            covered = (layer.coverage[layer.shown] > 0).expand_as(layer.composite)
            counts = torch.stack([clamped(layer.composite) & covered, covered]).sum((2, 3)).to(shares)
            shares[:, slice(None) if layer.rows is None else layer.rows] += counts
        changed, covered = shares.unflatten(1, (-1, self.views)).sum(2)
        return changed / covered.clamp(min=1)

    def _layers(self, conditions: Conditions, examples: Tensor) -> Iterator[Layer]:
        require_bounded(light=conditions.light)
        light = conditions.light * self._exposure[examples]
        if conditions.vertices is None and conditions.albedo is None:
            if conditions.positions is None:
                return self._relit(light, examples)
            return self._under_moved_lamps(light, conditions.positions, examples)
        return self._reshaded(light, conditions, examples)

    def _relit(self, light: Tensor, examples: Tensor) -> Iterator[Layer]:
        """By one product per stack of operators."""
        views = torch.arange(self.views, device=examples.device)
        images = (examples[:, None] * self.views + views).flatten()
        return self._relighting.layers(light.repeat_interleave(self.views, dim=0) if self.views > 1 else light, images)

    def _under_moved_lamps(self, light: Tensor, positions: Tensor, examples: Tensor) -> Iterator[Layer]:
        """By the same products for all other light, and by the lamps' image after image."""
        where, lamps = next((where, part) for where, part in parts_of(self.basis) if isinstance(part, Lamps))
        rest = torch.cat([light[:, : where.start], torch.zeros_like(light[:, where]), light[:, where.stop :]], dim=1)
        for layer in self._relit(rest, examples):
            added = []
            for image in range(len(layer.composite)) if layer.rows is None else layer.rows:
                row, view = divmod(image, self.views)
                example = self.examples[int(examples[row])]
                shown = example.object, example.cameras[view]
                placed, (fragments, albedo) = self._reshading.placed_view(*shown), self._reshading.own(*shown)
                seen = placed.radiance(lamps, albedo, light[row, where], positions[row])
                covered = torch.searchsorted(layer.pixels, fragments.pixels)
                added.append(seen.new_zeros(3, len(layer.pixels)).index_copy(1, covered, seen))
            yield replace(layer, composite=layer.composite + torch.stack(added))

    def _reshaded(self, light: Tensor, conditions: Conditions, examples: Tensor) -> Iterator[Layer]:
        """View by view."""
        views = [(row, index, view) for row, index in enumerate(examples.tolist()) for view in range(self.views)]
        for image, (row, index, view) in enumerate(views):
            example = self.examples[index]
            mesh, shown = self.mesh(index), (index, example.object, example.cameras[view])
            vertices = None if conditions.vertices is None else conditions.vertices[row, : len(mesh.vertices)]
            added = None if conditions.albedo is None else conditions.albedo[row, : len(mesh.faces)]
            positions = None if conditions.positions is None else conditions.positions[row]
            fragments, seen = self._reshading.radiance(*shown, light[row], vertices, added, positions)
            coverage = fragments.coverage.to(seen)[None]
            there = self.backgrounds[example.background].flatten(1).index_select(1, fragments.pixels)
            composite = seen + background_term(coverage, there, self.settings.encoding)
            yield Layer([image], fragments.pixels, composite[None], coverage[None], [0])

    def _seen_whole(self, row: Example) -> Example:
        """The row, whose cameras see all of its object, near and far."""
        radius = self.objects[row.object].radius
        return replace(row, cameras=tuple(camera.seeing(radius) for camera in row.cameras))

    def _column(self, values: Iterable[int]) -> Tensor:
        return torch.tensor(list(values), device=self.lights.device)
