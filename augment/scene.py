"""The scene: examples of objects, cameras and backgrounds, rendered under conditions that an attack may change."""

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
    """A row of a scene: an object from V cameras before a background.

    object, background: indices into the scene's lists. exposure: multiplies the light.
    """

    object: int
    cameras: tuple[Camera, ...]
    background: int
    exposure: float = 1.0


@dataclass(frozen=True)
class Conditions:
    """The light, shape and colors that A examples are rendered with.

    light: coefficients of the scene's basis. vertices: None for those of the meshes. albedo: added to each face's
    linear albedo. pixels: added to the values of the V images. positions: of the lamps, None for those of the basis. N
    and F are the largest mesh's; a smaller mesh has the first of them.
    """

    light: Float[Tensor, "A coefficients 3"]
    vertices: Float[Tensor, "A N 3"] | None = None
    albedo: Float[Tensor, "A F 3"] | None = None
    pixels: Float[Tensor, "A V 3 size size"] | None = None
    positions: Float[Tensor, "A L 3"] | None = None


@dataclass(eq=False, repr=False)
class Scene:
    """E examples of V views each, over backgrounds (B, 3 or 1, size, size) of values in [0, 1].

    While the light alone changes, nothing is rasterized after the first time: the transfer operators of many views are
    stacked (`Relighting`). Where vertices move, a view is rasterized each time (`Reshading`). lights: (E, size, 3), or
    (size, 3) for all, where attacks begin; images have their dtype and device. operators: the cache of rendered views.
    basis: of the lights' coefficients, by default 49 harmonics. camera_effects: a differentiable function of rendered
    images (A, V, 3, size, size) and their examples (A,); see `CameraEffects`.

    >>> from augment.build import build_scene
    >>> scene = build_scene([("solid:orange", "orange")], size=8, views=2)
    >>> examples = torch.arange(len(scene))
    >>> scene.render(scene.conditions(examples), examples).shape
    torch.Size([2, 1, 3, 8, 8])
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
        self.examples = [self._with_whole_object(example) for example in self.examples]
        self.backgrounds = self.backgrounds.to(self.lights)
        self.lights = self.lights.expand(len(self.examples), *self.lights.shape[-2:])
        self.views = len(self.examples[0].cameras)  # per example
        self.object_of = self._column(example.object for example in self.examples)  # (E,)
        self._background = self._column(example.background for example in self.examples)
        exposures = torch.tensor([example.exposure for example in self.examples])
        self._exposure = exposures.to(self.lights)[:, None, None]
        size, images = self.settings.size, len(self.examples) * self.views
        self.at_once = max(1, AT_ONCE // (self.views * size**2))  # examples
        renders = f"{images} renders of {size} pixels per side (meshes × views × backgrounds)"
        require_memory(renders, 24 * images * size**2, self.lights.device)
        self._relighting = self._relit_views()
        self._reshading = Reshading(self.objects, self.settings, self.rasterizer, self.basis, self.lights)

    def _require_consistent(self) -> None:
        if not self.examples:
            raise InputError("examples is empty: give at least one mesh, one view and one background")
        if self.lights.shape[-2:] != (self.basis.size, 3):
            raise InputError(
                f"lights has shape {tuple(self.lights.shape)}: give {self.basis.size} rows, for {self.basis}"
            )
        behind, size = self.backgrounds, self.settings.size
        if not (behind.is_floating_point() and behind.shape[1:] in ((1, size, size), (3, size, size))):
            raise InputError(
                f"backgrounds has {behind.dtype} {tuple(behind.shape)}: give images (B, 3, {size}, {size})"
            )
        if not (behind.min() >= 0 and behind.max() <= 1):
            raise InputError("backgrounds: give values in [0, 1]")
        for name, items in (("object", self.objects), ("background", behind)):
            if not all(0 <= getattr(example, name) < len(items) for example in self.examples):
                raise InputError(f"examples: an index of {name}s is not below {len(items)}")

    def _relit_views(self) -> Relighting:
        # a closure without `self`, which every epoch replaces: a cycle would keep old scenes in memory
        cache, settings, rasterizer = self.operators, self.settings, self.rasterizer
        basis, dtype = self.basis, self.lights.dtype

        def build(item: SceneObject, cameras: Sequence[Camera]) -> Sequence[TransferOperator]:
            return cache.operators(item.mesh, cameras, settings, rasterizer, item.albedo_scale, basis, dtype)

        views = [(example.object, camera) for example in self.examples for camera in example.cameras]
        behind = self._background.repeat_interleave(self.views)
        return Relighting(self.objects, views, behind, self.backgrounds.flatten(2), settings, build)

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
        """Every object from every camera over every background, in that order; or with `shared`, where the views share
        one light or shape, every object over every background from all cameras."""
        views = [tuple(cameras)] if shared else [(camera,) for camera in cameras]
        examples = [Example(*row) for row in product(range(len(objects)), views, range(len(backgrounds)))]
        return cls(objects, examples, backgrounds, light, settings, rasterizer, operators or OperatorCache(), basis)

    def __len__(self) -> int:
        return len(self.examples)

    @cached_property
    def cameras(self) -> list[tuple[Camera, ...]]:
        """The V cameras of each example."""
        return [example.cameras for example in self.examples]

    @cached_property
    def labels(self) -> list[str]:
        """The class name of each example."""
        return [self.objects[example.object].label for example in self.examples]

    @cached_property
    def vertices(self) -> Tensor:
        """(M, N, 3) of each object; those of smaller meshes end in zeros."""
        return torch.nn.utils.rnn.pad_sequence(self._reshading.vertices, batch_first=True)

    @property
    def stacks(self) -> list[OperatorStack]:
        """The stacked transfer operators of all views, built where they are missing."""
        return self._relighting.stacks

    def mesh(self, example: int) -> Mesh:
        """The mesh of an example."""
        return self.objects[self.examples[example].object].mesh

    def basis_under(self, conditions: Conditions, row: int) -> Basis:
        """The light's basis for a row of conditions, with lamps at its positions."""
        return self.basis if conditions.positions is None else moved(self.basis, conditions.positions[row].detach())

    def conditions(self, examples: Int[Tensor, " A"]) -> Conditions:
        """The unattacked conditions of some examples."""
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
        """(A,) the fraction of its covered pixels' values that the clamp changes."""
        counts_of_images = self.lights.new_zeros(2, len(examples) * self.views)
        for layer in self._layers(conditions, examples):
            covered = (layer.coverage[layer.shown] > 0).expand_as(layer.composite)
            counts = torch.stack([clamped(layer.composite) & covered, covered]).sum((2, 3)).to(counts_of_images)
            counts_of_images[:, slice(None) if layer.rows is None else layer.rows] += counts
        changed, covered = counts_of_images.unflatten(1, (-1, self.views)).sum(2)
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
        """One product per stack of operators."""
        views = torch.arange(self.views, device=examples.device)
        images = (examples[:, None] * self.views + views).flatten()
        return self._relighting.layers(light.repeat_interleave(self.views, dim=0) if self.views > 1 else light, images)

    def _under_moved_lamps(self, light: Tensor, positions: Tensor, examples: Tensor) -> Iterator[Layer]:
        """The same products for all other light, and the lamps image by image."""
        where, lamps = next((where, part) for where, part in parts_of(self.basis) if isinstance(part, Lamps))
        rest = torch.cat([light[:, : where.start], torch.zeros_like(light[:, where]), light[:, where.stop :]], dim=1)
        for layer in self._relit(rest, examples):
            added = []
            for image in range(len(layer.composite)) if layer.rows is None else layer.rows:
                row, view = divmod(image, self.views)
                example = self.examples[int(examples[row])]
                shown = example.object, example.cameras[view]
                view_in_lamps, (fragments, albedo) = self._reshading.local_view(*shown), self._reshading.view(*shown)
                radiance = view_in_lamps.radiance(lamps, albedo, light[row, where], positions[row])
                covered = torch.searchsorted(layer.pixels, fragments.pixels)
                added.append(radiance.new_zeros(3, len(layer.pixels)).index_copy(1, covered, radiance))
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
            fragments, radiance = self._reshading.radiance(*shown, light[row], vertices, added, positions)
            coverage = fragments.coverage.to(radiance)[None]
            behind = self.backgrounds[example.background].flatten(1).index_select(1, fragments.pixels)
            composite = radiance + background_term(coverage, behind, self.settings.encoding)
            yield Layer([image], fragments.pixels, composite[None], coverage[None], [0])

    def _with_whole_object(self, row: Example) -> Example:
        """The row with cameras whose depth range holds the whole object."""
        radius = self.objects[row.object].radius
        return replace(row, cameras=tuple(camera.seeing(radius) for camera in row.cameras))

    def _column(self, values: Iterable[int]) -> Tensor:
        return torch.tensor(list(values), device=self.lights.device)
