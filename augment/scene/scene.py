"""The scene: examples of objects, cameras and backgrounds, rendered under conditions that an attack may change."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from augment.memory import attack_bytes, require_memory
from augment.progress import progress
from augment.scene.objects import SceneObject
from augment.scene.relighting import Layer, Relighting
from augment.scene.reshading import Reshading
from renderer.camera import Camera
from renderer.errors import InputError, describe, require_bounded
from renderer.geometry.mesh import Mesh
from renderer.image import background_term, clamp, encode
from renderer.light.basis import HARMONICS, Basis
from renderer.settings import ImageSettings
from renderer.transport.operator_stacks import InPlace, OperatorStack
from renderer.transport.operators import build_operators
from renderer.validation import as_integers, as_list, as_tensor, require_kind
from renderer.visibility.rasterizers import Rasterizer

if TYPE_CHECKING:
    from jaxtyping import Float, Int

AT_ONCE = 2**24  # pixels of the images that are rendered at once


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
    linear albedo. pixels: added to the values of the V images. positions: of the lamps, None for those of the basis.
    cameras: what is added to the polar angle, the azimuth and the logarithm of the distance of all V cameras. gloss:
    roughness, metallic and strength, which gloss textures multiply. hue: by which a changed albedo is turned, radians.
    N and F are the largest mesh's; a smaller mesh has the first of them.
    """

    light: Float[Tensor, "A coefficients 3"]
    vertices: Float[Tensor, "A N 3"] | None = None
    albedo: Float[Tensor, "A F 3"] | None = None
    pixels: Float[Tensor, "A V 3 size size"] | None = None
    positions: Float[Tensor, "A L 3"] | None = None
    cameras: Float[Tensor, "A 3"] | None = None
    gloss: Float[Tensor, "A F 3"] | Float[Tensor, "A 1 3"] | None = None
    hue: Float[Tensor, "A F"] | None = None

    def __post_init__(self) -> None:
        for name, values in vars(self).items():
            if values is not None and not isinstance(values, Tensor):
                object.__setattr__(self, name, as_tensor(name, values))

    def row(self, index: int, mesh: Mesh) -> Conditions:
        """One row as it is for its mesh, without the first dimension."""
        counts = {"vertices": len(mesh.vertices), **dict.fromkeys(("albedo", "gloss", "hue"), len(mesh.faces))}
        given = {name: values for name, values in vars(self).items() if values is not None}
        return Conditions(**{name: values[index, : counts.get(name)] for name, values in given.items()})


@dataclass(eq=False, repr=False)
class Scene:
    """E examples of V views each, over backgrounds (B, 3 or 1, size, size) of values in [0, 1].

    While the light alone changes, nothing is rasterized after the first time: the transfer operators of many views are
    stacked (`Relighting`). Where vertices move, a view is rasterized each time (`Reshading`). lights: (E, size, 3), or
    (size, 3) for all, where attacks begin; images have their dtype and device. basis: of the lights'
    coefficients, by default 49 harmonics. camera_effects: a differentiable function of rendered images (A, V, 3, size,
    size) and their examples (A,); see `draw_camera_effects`. one_light: without operators, for views shown once.
    lights_of_degree: the basis and the lights (size, 3) of another degree, and for gloss of a roughness, where a name
    tells what they are.

    >>> from augment.scene.build import build_scene
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
    basis: Basis = HARMONICS
    camera_effects: Callable[[Tensor, Tensor], Tensor] | None = None
    one_light: bool = False
    lights_of_degree: Callable[[int, float | None], tuple[Basis, Tensor]] | None = None

    def __post_init__(self) -> None:
        require_kind("settings", self.settings, ImageSettings, "renderer.ImageSettings(size)")
        require_kind("basis", self.basis, Basis, "a basis of light, such as Harmonics(degree)")
        require_kind("camera_effects", self.camera_effects, Callable | None, "a function of images and examples")
        if not hasattr(self.rasterizer, "rasterize"):
            advice = "give renderer.visibility.rasterizers.choose(name)"
            raise InputError(f"rasterizer is {describe(self.rasterizer)}: {advice}")
        self.objects = as_list("objects", self.objects, SceneObject, "a list of scene objects")
        self.examples = as_list("examples", self.examples, Example, "a list of examples")
        self.lights = as_tensor("lights", self.lights)
        self.backgrounds = as_tensor("backgrounds", self.backgrounds)
        require_bounded(lights=self.lights)
        size, device = self.settings.size, self.lights.device
        if not self.examples:
            raise InputError("examples is empty: give at least one mesh, one view and one background")
        if max(example.object for example in self.examples) >= len(self.objects):
            raise InputError(f"objects holds {len(self.objects)}: give all that the examples name")
        if self.lights.shape[-2:] != (self.basis.size, 3):
            raise InputError(f"lights has shape {tuple(self.lights.shape)}: give {self.basis.size} rows")
        fit = self.backgrounds.shape[1:] in ((1, size, size), (3, size, size))
        if not (fit and self.backgrounds.min() >= 0 and self.backgrounds.max() <= 1):
            raise InputError(f"backgrounds: give (B, 3, {size}, {size}) of values in [0, 1]")
        radii = [item.radius for item in self.objects]  # a camera's depth range holds the whole object
        cameras = [tuple(camera.seeing(radii[row.object]) for camera in row.cameras) for row in self.examples]
        self.examples = [replace(row, cameras=views) for row, views in zip(self.examples, cameras, strict=True)]
        self.backgrounds = self.backgrounds.to(self.lights)
        self.lights = self.lights.expand(len(self.examples), *self.lights.shape[-2:])
        self.views = len(self.examples[0].cameras)  # per example
        self.object_of = torch.tensor([example.object for example in self.examples], device=device)  # (E,)
        self._background = torch.tensor([example.background for example in self.examples], device=device)
        exposures = torch.tensor([example.exposure for example in self.examples])
        self._exposure = exposures.to(self.lights)[:, None, None]
        views = [(example.object, camera) for example in self.examples for camera in example.cameras]
        self.at_once = max(1, AT_ONCE // (self.views * size**2))  # examples
        renders = f"{len(views)} renders of {size} pixels per side (meshes × views × backgrounds)"
        pixels_per_example = self.views * size**2
        self.attack_bytes = attack_bytes(
            pixels=len(self) * pixels_per_example,
            pixels_at_once=min(len(self), self.at_once) * pixels_per_example,
            lights=self.lights,
            camera_effects=self.camera_effects is not None,
        )
        require_memory(renders, self.attack_bytes, device)
        shading: dict[str, Any] = {"settings": self.settings, "rasterizer": self.rasterizer, "basis": self.basis}
        # no method of `self`, which every epoch replaces: a cycle would keep old scenes in memory
        build = partial(build_operators, **shading, dtype=self.lights.dtype)
        behind, backgrounds = self._background.repeat_interleave(self.views), self.backgrounds.flatten(2)
        self._relighting = Relighting(self.objects, views, behind, backgrounds, self.settings, build, self.attack_bytes)
        self._reshading = Reshading(self.objects, like=self.lights, cached=not self.one_light, **shading)

    @classmethod
    def grid(
        cls,
        objects: Sequence[SceneObject],
        cameras: Sequence[Camera],
        backgrounds: Tensor,
        *of_scene: Any,
        shared: bool = False,
        **options: Any,
    ) -> Scene:
        """Every object from every camera over every background, in that order; or with `shared`, where the views share
        one light or shape, every object over every background from all cameras. of_scene, options: of `Scene`."""
        views = [tuple(cameras)] if shared else [(camera,) for camera in cameras]
        examples = [Example(*row) for row in product(range(len(objects)), views, range(len(backgrounds)))]
        return cls(objects, examples, backgrounds, *of_scene, **options)

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
        return self.basis if conditions.positions is None else self.basis.moved(conditions.positions[row].detach())

    def cameras_under(self, conditions: Conditions, row: int, example: int) -> tuple[Camera, ...]:
        """The cameras of an example under a row of conditions."""
        cameras = self.cameras[example]
        if conditions.cameras is None:
            return cameras
        radius = 0.0 if conditions.vertices is None else float(conditions.vertices[row].detach().norm(dim=1).max())
        return tuple(camera.moved(*conditions.cameras[row]).seeing(radius) for camera in cameras)

    def conditions(self, examples: Int[Tensor, " A"]) -> Conditions:
        """The unattacked conditions of some examples. InputError: indices that are not there."""
        return Conditions(self.lights[self._as_examples(examples)])

    def render(self, conditions: Conditions, examples: Int[Tensor, " A"]) -> Float[Tensor, "A V 3 size size"]:
        """Images in [0, 1] of examples from their V views, differentiable in the conditions.

        InputError: NaN, other examples than the conditions are of.
        """
        require_kind("conditions", conditions, Conditions, "conditions, such as scene.conditions(examples)")
        if conditions.light.shape[1:] != (self.basis.size, 3):
            shape, expected = tuple(conditions.light.shape), (len(self), self.basis.size, 3)
            raise InputError(f"conditions: light has shape {shape}, give one of each example, such as {expected}")
        examples = self._as_examples(examples, len(conditions.light))
        layers = list(self._layers(conditions, examples))
        canvas = self.backgrounds.flatten(2).index_select(0, self._background[examples].repeat_interleave(self.views))
        covered = [encode(clamp(layer.composite), self.settings.encoding) for layer in layers]
        targets = [(layer.rows, layer.pixels) for layer in layers]
        images = InPlace.apply(canvas.expand(-1, 3, -1).contiguous(), targets, *covered)
        images = images.view(len(examples), self.views, 3, self.settings.size, self.settings.size)
        images = self.camera_effects(images, examples) if self.camera_effects else images
        return images if conditions.pixels is None else clamp(images + conditions.pixels)

    def _as_examples(self, examples: object, count: int | None = None) -> Tensor:
        """Convert `count` indices of examples; InputError for others. On a GPU, the range of a tensor goes unchecked,
        since the host would wait for it."""
        indices = as_integers("examples", examples)
        if indices.ndim != 1 or count not in (None, len(indices)):
            advice = f"give {'a list of' if count is None else count} indices, one for each light"
            raise InputError(f"examples has shape {tuple(indices.shape)}: {advice}")
        if (
            indices.device.type == "cpu"
            and len(indices)
            and not 0 <= int(indices.min()) <= int(indices.max()) < len(self)
        ):
            raise InputError(f"examples names some that are not there: give indices from 0 to {len(self) - 1}")
        return indices.to(self.lights.device)

    def _layers(self, conditions: Conditions, examples: Tensor) -> Iterator[Layer]:
        require_bounded(light=conditions.light)
        light = conditions.light * self._exposure[examples]
        if self.one_light or not (conditions.vertices is conditions.albedo is conditions.gloss is None):
            return self._reshaded(light, conditions, examples)
        if conditions.positions is not None:
            return self._under_moved_lamps(light, conditions.positions, examples)
        return self._relit(light, examples)

    def _relit(self, light: Tensor, examples: Tensor) -> Iterator[Layer]:
        """One product per stack of operators."""
        views = torch.arange(self.views, device=examples.device)
        images = (examples[:, None] * self.views + views).flatten()
        return self._relighting.layers(light.repeat_interleave(self.views, dim=0) if self.views > 1 else light, images)

    def _under_moved_lamps(self, light: Tensor, positions: Tensor, examples: Tensor) -> Iterator[Layer]:
        """The same products for all other light, and the lamps image by image."""
        where, lamps = next(part for part in self.basis.local_lights if part.basis.is_movable)
        rest = light.clone()
        rest[:, where] = 0
        for rows, pixels, composite in self._relit(rest, examples):
            added = []
            for image in torch.arange(len(light) * self.views, device=light.device)[rows].tolist():
                row, view = divmod(image, self.views)
                example = self.examples[int(examples[row])]
                shown = example.object, example.cameras[view]
                view_in_lamps, (fragments, albedo) = self._reshading.local_view(*shown), self._reshading.view(*shown)
                radiance = view_in_lamps.radiance(lamps, albedo, light[row, where], positions[row])
                covered = torch.searchsorted(pixels, fragments.pixels)
                added.append(radiance.new_zeros(3, len(pixels)).index_copy(1, covered, radiance))
            yield Layer(rows, pixels, composite + torch.stack(added))

    def _reshaded(self, light: Tensor, conditions: Conditions, examples: Tensor) -> Iterator[Layer]:
        views = [*product(range(len(examples)), range(self.views))]
        counted = progress(views, "rendering views") if len(views) > 8 else views  # a bar costs a step of few views 4 %
        for image, (row, view) in enumerate(counted):
            index = int(examples[row])
            example, changed = self.examples[index], conditions.row(row, self.mesh(index))
            cameras = self.cameras_under(conditions, row, index)
            shown, behind = (index, example.object, cameras[view]), self.backgrounds[example.background].flatten(1)
            pixels, coverage, radiance = self._reshading.radiance(*shown, light[row], changed, behind)
            term = background_term(coverage[None], behind.index_select(1, pixels), self.settings.encoding)
            yield Layer(slice(image, image + 1), pixels, (radiance + term)[None])
