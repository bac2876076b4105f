"""Examples of objects, cameras and backgrounds, rendered under conditions that attacks change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from inspect import signature
from itertools import product
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from augment.memory import attack_bytes, require_memory
from augment.progress import progress
from augment.scene.conditions import Conditions, Example
from augment.scene.direct_rendering import DirectRenderer
from augment.scene.objects import SceneObject
from augment.scene.relighting import Layer, Relighting
from renderer.camera import Camera
from renderer.errors import InputError, describe, require_bounded
from renderer.geometry.mesh import Mesh
from renderer.image import background_term, clamp, encode
from renderer.light.basis import HARMONICS, Basis
from renderer.settings import ImageSettings
from renderer.transport.operator_stacks import OperatorStack, ScatterLayers
from renderer.transport.operators import build_operators
from renderer.validation import as_integers, as_list, as_tensor, require_kind
from renderer.visibility.rasterizers import Rasterizer

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Number of pixels, over all views, of the images that are rendered at a time. It decides
# `Scene.group_size`.
AT_ONCE = 2**24
# Direct rendering shows its progress if it renders more views than this. For fewer views,
# showing the progress would make a step of an attack 4 % slower.
UNCOUNTED_VIEWS = 8


class Scene:
    """E examples with V views each, in front of B backgrounds.

    While only the light changes, each view is rasterized once. After that, its transfer operator
    gives the image under each light (see `Relighting`). A view whose vertices move is rasterized
    each time (see `DirectRenderer`).

    Args:
        objects: The objects.
        examples: The examples, which have the same number of views.
        backgrounds: The backgrounds, with values in [0, 1], shape (B, 3, size, size) or
            (B, 1, size, size).
        lights: The lights where attacks begin, shape (E, coefficients, 3), or (coefficients, 3)
            for all examples. Images have the dtype and the device of the lights.
        settings: The settings of the images.
        rasterizer: The rasterizer.
        basis: The basis of the lights' coefficients, by default 49 harmonics.
        camera_effects: A differentiable function of rendered images (A, V, 3, size, size) and
            of the indices of these A examples, shape (A,). It returns the changed images. See
            `draw_camera_effects`.
        one_light: Whether each view is rendered under one light only. No transfer operators are
            built then, because direct rendering takes less time.
        lights_of_degree: A function of a degree and of the roughness of the smoothest gloss,
            which is None without gloss. It returns the basis of this degree, and the scene's
            lighting as coefficients (coefficients, 3) of this basis. None if only the
            coefficients `lights` are known.

    Attributes:
        views: The number of views of an example.
        object_of: The index of the object of each example, shape (E,).
        group_size: The number of examples that are rendered at a time.
        attack_bytes: The memory that an attack on the light needs beside the operators.

    Raises:
        InputError: If an argument is of another kind, shape or range, or memory is too small.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> scene = nb.build_scene([("solid:orange", "orange")], size=8, views=2)
        >>> examples = torch.arange(len(scene))
        >>> scene.render(scene.conditions(examples), examples).shape
        torch.Size([2, 1, 3, 8, 8])
    """

    def __init__(
        self,
        objects: Sequence[SceneObject],
        examples: Sequence[Example],
        backgrounds: Tensor,
        lights: Tensor,
        settings: ImageSettings,
        rasterizer: Rasterizer,
        basis: Basis = HARMONICS,
        camera_effects: Callable[[Tensor, Tensor], Tensor] | None = None,
        one_light: bool = False,
        lights_of_degree: Callable[[int, float | None], tuple[Basis, Tensor]] | None = None,
    ):
        require_kind("settings", settings, ImageSettings, "nb.ImageSettings(size)")
        require_kind("basis", basis, Basis, "a basis of light, such as Harmonics(degree)")
        effects = "a function of images and examples"
        require_kind("camera_effects", camera_effects, Callable | None, effects)
        if not hasattr(rasterizer, "rasterize"):
            raise InputError(
                f"rasterizer is {describe(rasterizer)}: "
                "give renderer.visibility.rasterizers.choose(name)",
            )
        self.objects = as_list("objects", objects, SceneObject, "a list of scene objects")
        examples = as_list("examples", examples, Example, "a list of examples")
        lights = as_tensor("lights", lights)
        backgrounds = as_tensor("backgrounds", backgrounds)
        _require_examples(examples, self.objects)
        _require_lights(lights, basis)
        _require_backgrounds(backgrounds, settings.size)

        self.settings = settings
        self.rasterizer = rasterizer
        self.basis = basis
        self.camera_effects = camera_effects
        self.one_light = one_light
        self.lights_of_degree = lights_of_degree
        # The depth range of a camera holds the whole object.
        self.examples = [self._with_clip_ranges(example) for example in examples]
        self.backgrounds = backgrounds.to(lights)
        self.lights = lights.expand(len(examples), *lights.shape[-2:])
        self.views = len(examples[0].cameras)
        device = lights.device
        self.object_of = torch.tensor([row.object for row in examples], device=device)
        self._background = torch.tensor([row.background for row in examples], device=device)
        exposures = torch.tensor([row.exposure for row in examples])
        self._exposure = exposures.to(lights)[:, None, None]

        pixels_per_example = self.views * settings.size**2
        self.group_size = max(1, AT_ONCE // pixels_per_example)
        self.attack_bytes = attack_bytes(
            pixels=len(self) * pixels_per_example,
            pixels_at_once=min(len(self), self.group_size) * pixels_per_example,
            lights=self.lights,
            camera_effects=camera_effects is not None,
        )
        count = f"{len(self) * self.views} renders of {settings.size} pixels per side"
        require_memory(f"{count} (meshes × views × backgrounds)", self.attack_bytes, device)
        self._relighting = self._build_relighting()
        self._direct_renderer = DirectRenderer(
            self.objects, settings, rasterizer, basis, like=self.lights, cached=not one_light
        )

    def _with_clip_ranges(self, example: Example) -> Example:
        """Return an example whose cameras have a depth range that holds the whole object."""
        radius = self.objects[example.object].radius
        return replace(
            example, cameras=tuple(camera.with_clip_range(radius) for camera in example.cameras)
        )

    def _build_relighting(self) -> Relighting:
        """Prepare rendering with transfer operators of all views of all examples.

        The operators themselves are built when an image first needs them.

        Returns:
            The renderer of E · V images. Image e · V + v is view v of example e.
        """
        views = [
            (example.object, camera) for example in self.examples for camera in example.cameras
        ]
        # `build` must not refer to `self`. Python would otherwise free the scenes of earlier
        # epochs late, because of the circular reference.
        build = partial(
            build_operators,
            settings=self.settings,
            rasterizer=self.rasterizer,
            basis=self.basis,
            dtype=self.lights.dtype,
        )
        # Index of the background of each image, shape (E · V,).
        image_to_background = self._background.repeat_interleave(self.views)
        return Relighting(
            self.objects,
            views,
            image_to_background,
            self.backgrounds.flatten(2),
            self.settings,
            build,
            self.attack_bytes,
        )

    @classmethod
    def grid(
        cls,
        objects: Sequence[SceneObject],
        cameras: Sequence[Camera],
        backgrounds: Tensor,
        *of_scene: Any,
        shared: bool = False,
        placed: bool = False,
        **options: Any,
    ) -> Scene:
        """Build a scene of every object from every camera in front of every background.

        The backgrounds change fastest from example to example, and the objects slowest.

        Args:
            objects: The objects.
            cameras: The cameras.
            backgrounds: The backgrounds, shape (B, 3, size, size) or (B, 1, size, size).
            of_scene: Further arguments of `Scene`, by position.
            shared: Whether the cameras are the views of one example, which share one light and
                one shape. Otherwise each camera makes an example of its own.
            placed: Whether the cameras see each object where its mesh was given, and not as it is
                after normalization. They are then moved and scaled with each object.
            options: Further arguments of `Scene`, by name.

        Returns:
            The scene.
        """
        # The cameras of each example that shows the same object and background.
        camera_groups = [tuple(cameras)] if shared else [(camera,) for camera in cameras]
        examples = []
        for object_index, given_cameras, background_index in product(
            range(len(objects)), camera_groups, range(len(backgrounds))
        ):
            moved_cameras = given_cameras
            if placed:
                moved_cameras = objects[object_index].move_cameras(given_cameras)
            examples.append(Example(object_index, moved_cameras, background_index))
        return cls(objects, examples, backgrounds, *of_scene, **options)

    def changed(self, **arguments: Any) -> Scene:
        """Return a scene with some other arguments.

        Args:
            arguments: Arguments of `Scene` that are replaced, by name.

        Returns:
            The scene.
        """
        arguments_of_self = {name: getattr(self, name) for name in _ARGUMENTS}
        return Scene(**arguments_of_self | arguments)

    def __len__(self) -> int:
        return len(self.examples)

    @cached_property
    def cameras(self) -> list[tuple[Camera, ...]]:
        """Return the V cameras of each example."""
        return [example.cameras for example in self.examples]

    @cached_property
    def labels(self) -> list[str]:
        """Return the class name of each example."""
        return [self.objects[example.object].label for example in self.examples]

    @cached_property
    def vertices(self) -> Tensor:
        """Return the vertices of the M objects, shape (M, N, 3).

        N is the number of vertices of the largest mesh. Smaller meshes are padded with zeros.
        """
        return torch.nn.utils.rnn.pad_sequence(self._direct_renderer.vertices, batch_first=True)

    @property
    def stacks(self) -> list[OperatorStack]:
        """Return the stacked transfer operators of all views, and build missing ones."""
        return self._relighting.stacks

    def mesh(self, example: int) -> Mesh:
        """Return the mesh of an example, which is given by its index."""
        return self.objects[self.examples[example].object].mesh

    def basis_under(self, conditions: Conditions, row: int) -> Basis:
        """Return the basis of the light under some conditions.

        Args:
            conditions: The conditions.
            row: The row of the conditions.

        Returns:
            The basis, with lamps at the positions of the row.
        """
        if conditions.positions is None:
            return self.basis
        return self.basis.moved(conditions.positions[row].detach())

    def cameras_under(self, conditions: Conditions, row: int, example: int) -> tuple[Camera, ...]:
        """Return the cameras of an example under some conditions.

        Args:
            conditions: The conditions.
            row: The row of the conditions.
            example: The index of the example.

        Returns:
            The V cameras.
        """
        cameras = self.cameras[example]
        if conditions.cameras is None:
            return cameras
        # The depth range of the cameras must hold vertices that have moved away from the origin.
        radius = 0.0
        if conditions.vertices is not None:
            radius = float(conditions.vertices[row].detach().norm(dim=1).max())
        # Changes of the polar angle, the azimuth and the logarithm of the distance.
        camera_changes = conditions.cameras[row]
        return tuple(camera.moved(*camera_changes).with_clip_range(radius) for camera in cameras)

    def conditions(self, examples: Int[Tensor, " A"]) -> Conditions:
        """Return the conditions of some examples before any attack.

        Args:
            examples: The indices of the examples, shape (A,).

        Returns:
            The conditions.

        Raises:
            InputError: If there is no such example.
        """
        return Conditions(self.lights[self._as_examples(examples)])

    def render(
        self, conditions: Conditions, examples: Int[Tensor, " A"]
    ) -> Float[Tensor, "A V 3 size size"]:
        """Render examples from their views, differentiable in the conditions.

        Args:
            conditions: The light, shape and colors of each example.
            examples: The indices of the examples, shape (A,).

        Returns:
            The images, with values in [0, 1], shape (A, V, 3, size, size).

        Raises:
            InputError: If there is no such example, if the conditions belong to other examples, or
                if they contain NaN.
        """
        expected = "conditions, such as scene.conditions(examples)"
        require_kind("conditions", conditions, Conditions, expected)
        if conditions.light.shape[1:] != (self.basis.size, 3):
            raise InputError(
                f"conditions.light has shape {tuple(conditions.light.shape)}: "
                f"use one light for each example, such as {(len(self), self.basis.size, 3)}",
            )
        examples = self._as_examples(examples, len(conditions.light))
        layers = list(self._layers(conditions, examples))
        # The images are the backgrounds, in which the pixels of the layers are overwritten.
        image_to_background = self._background[examples].repeat_interleave(self.views)
        # Shape (A · V, 3 or 1, size²).
        canvas = self.backgrounds.flatten(2).index_select(0, image_to_background)
        new_values = [encode(clamp(layer.composite), self.settings.encoding) for layer in layers]
        targets = [(layer.rows, layer.pixels) for layer in layers]
        images = ScatterLayers.apply(canvas.expand(-1, 3, -1).contiguous(), targets, *new_values)
        size = self.settings.size
        images = images.view(len(examples), self.views, 3, size, size)
        if self.camera_effects:
            images = self.camera_effects(images, examples)
        if conditions.pixels is not None:
            images = clamp(images + conditions.pixels)
        return images

    def _as_examples(self, examples: object, count: int | None = None) -> Tensor:
        """Convert indices of examples to an integer tensor on the device of the lights.

        The range of indices on a GPU is not checked, because the CPU would wait for the GPU.

        Args:
            examples: The indices, as a list, an array or a tensor, shape (A,).
            count: The number A of indices that the caller needs. None for any number.

        Returns:
            The indices, shape (A,).

        Raises:
            InputError: If the indices have another shape or are out of range.
        """
        indices = as_integers("examples", examples)
        if indices.ndim != 1 or count not in (None, len(indices)):
            number = "a list of" if count is None else str(count)
            raise InputError(
                f"examples has shape {tuple(indices.shape)}: "
                f"give {number} indices, one for each light",
            )
        if indices.device.type != "cpu" or not len(indices):
            return indices.to(self.lights.device)
        if int(indices.min()) < 0 or int(indices.max()) >= len(self):
            raise InputError(
                f"examples names some that are not there: give indices from 0 to {len(self) - 1}",
            )
        return indices.to(self.lights.device)

    def _layers(self, conditions: Conditions, examples: Tensor) -> Iterator[Layer]:
        """Render the covered pixels of all images, by the fastest method that is exact.

        - If the shape, the albedo or the gloss changed, the images are rendered without
          transfer operators. So are the images of a scene with `one_light`.
        - If lamps moved, transfer operators render all other light. The light of the lamps
          is computed for each image and added.
        - If only the light changed, transfer operators render all of it.

        Args:
            conditions: Light, shape and colors of A examples.
            examples: Indices of the A examples, shape (A,).

        Yields:
            Layers of the A · V images. Image a · V + v is view v of example `examples[a]`.
        """
        require_bounded(light=conditions.light)
        light = conditions.light * self._exposure[examples]
        surface_changes = (conditions.vertices, conditions.albedo, conditions.gloss)
        is_surface_changed = any(values is not None for values in surface_changes)
        if self.one_light or is_surface_changed:
            return self._reshaded(light, conditions, examples)
        if conditions.positions is not None:
            return self._under_moved_lamps(light, conditions.positions, examples)
        return self._relit(light, examples)

    def _relit(self, light: Tensor, examples: Tensor) -> Iterator[Layer]:
        """Render images with transfer operators, one matrix product for each stack of operators.

        Args:
            light: Coefficients of all lights, times the exposure, shape (A, K, 3).
            examples: Indices of the A examples, shape (A,).

        Yields:
            One layer for each stack. A layer has those of the A · V images whose operators are
            in the stack.
        """
        views = torch.arange(self.views, device=examples.device)
        # `Relighting` has an index for each view of each example of the scene, shape (A · V,).
        images = (examples[:, None] * self.views + views).flatten()
        if self.views > 1:
            # All views of an example have the same light, shape (A · V, K, 3).
            light = light.repeat_interleave(self.views, dim=0)
        return self._relighting.layers(light, images)

    def _under_moved_lamps(
        self, light: Tensor, positions: Tensor, examples: Tensor
    ) -> Iterator[Layer]:
        """Render images with transfer operators, and add the light of moved lamps to each image.

        Args:
            light: Coefficients of all lights, times the exposure, shape (A, K, 3).
            positions: Positions of the L lamps, shape (A, L, 3).
            examples: Indices of the A examples, shape (A,).

        Yields:
            One layer for each stack of operators.
        """
        movable_light = self.basis.movable_light
        assert movable_light is not None
        # Rows of the lamps among the K coefficients, and the basis of the lamps.
        lamp_rows, lamps = movable_light
        other_light = light.clone()
        other_light[:, lamp_rows] = 0
        batch_images = torch.arange(len(light) * self.views, device=light.device)
        for rows, pixels, composite in self._relit(other_light, examples):
            lamp_radiances = []
            for image in batch_images[rows].tolist():
                row, view = divmod(image, self.views)
                example = self.examples[int(examples[row])]
                camera = example.cameras[view]
                view_in_lamps = self._direct_renderer.local_view(example.object, camera)
                fragments, albedo = self._direct_renderer.view(example.object, camera)
                radiance = view_in_lamps.radiance(
                    lamps, albedo, light[row, lamp_rows], positions[row]
                )
                # Where the pixels that the object covers are among the layer's pixels.
                covered = torch.searchsorted(pixels, fragments.pixels)
                canvas = radiance.new_zeros(3, len(pixels))
                lamp_radiances.append(canvas.index_copy(1, covered, radiance))
            yield Layer(rows, pixels, composite + torch.stack(lamp_radiances))

    def _reshaded(self, light: Tensor, conditions: Conditions, examples: Tensor) -> Iterator[Layer]:
        """Render each view without transfer operators.

        Args:
            light: Coefficients of all lights, times the exposure, shape (A, K, 3).
            conditions: Conditions of the A examples. Their light is not used.
            examples: Indices of the A examples, shape (A,).

        Yields:
            One layer for each of the A · V images.
        """
        row_and_view = [*product(range(len(examples)), range(self.views))]
        counted: Iterable[tuple[int, int]] = row_and_view
        if len(row_and_view) > UNCOUNTED_VIEWS:
            counted = progress(row_and_view, "rendering views")
        for image, (row, view) in enumerate(counted):
            example_index = int(examples[row])
            example = self.examples[example_index]
            camera = self.cameras_under(conditions, row, example_index)[view]
            background = self.backgrounds[example.background].flatten(1)
            pixels, coverage, radiance = self._direct_renderer.radiance(
                example_index,
                example.object,
                camera,
                light[row],
                conditions.row(row, self.mesh(example_index)),
                background,
            )
            background_pixels = background.index_select(1, pixels)
            term = background_term(coverage[None], background_pixels, self.settings.encoding)
            yield Layer(slice(image, image + 1), pixels, (radiance + term)[None])


# Names of the arguments of `Scene`. A scene keeps each argument in the attribute of this name,
# from which `Scene.changed` reads it.
_ARGUMENTS = tuple(name for name in signature(Scene).parameters)


def _require_examples(examples: Sequence[Example], objects: Sequence[SceneObject]) -> None:
    """Raise InputError if there are no examples, or if an example names an absent object."""
    if not examples:
        raise InputError("examples is empty: give at least one mesh, one view and one background")
    if max(example.object for example in examples) >= len(objects):
        raise InputError(f"objects holds {len(objects)}: give all that the examples name")


def _require_lights(lights: Tensor, basis: Basis) -> None:
    """Raise InputError unless lights (..., coefficients, 3) are finite and fit the basis."""
    require_bounded(lights=lights)
    if lights.shape[-2:] != (basis.size, 3):
        raise InputError(f"lights has shape {tuple(lights.shape)}: give {basis.size} rows")


def _require_backgrounds(backgrounds: Tensor, size: int) -> None:
    """Raise InputError unless backgrounds have shape (B, 3 or 1, size, size), values in [0, 1]."""
    is_image = backgrounds.shape[1:] in ((1, size, size), (3, size, size))
    if not (is_image and backgrounds.min() >= 0 and backgrounds.max() <= 1):
        raise InputError(f"backgrounds: give (B, 3, {size}, {size}) of values in [0, 1]")
