"""The examples of a scene: objects, cameras and backgrounds, rendered in light that can change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import cycle, groupby, islice, product
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from augment.network import say_once
from augment.progress import progress
from augment.scene.objects import Conditions, Example, SceneObject
from augment.scene.render import DirectRenderer, Group, Layer, OperatorRenderer
from augment.scene.truth import LEAST_VISIBLE, NO_OBJECT, Truth, boxes_of
from renderer import errors
from renderer.camera import Camera
from renderer.image import background_term, clamp, encode
from renderer.light.basis import HARMONICS, Basis
from renderer.mesh import Mesh
from renderer.modes import without_autocast
from renderer.operators.build import build_operators
from renderer.operators.stack import ScatterLayers
from renderer.settings import ImageSettings
from renderer.visibility import Rasterizer
from renderer.visibility.fragments import split_views, views_at_once

# Largest total number of pixels of the images that are rendered at a time.
AT_ONCE = 2**24
# A progress bar is shown if more views than this are rendered one by one. For fewer views, the bar
# would make a step of an attack 4 % slower.
MAX_VIEWS_WITHOUT_PROGRESS = 8


@dataclass(eq=False, repr=False)
class Scene:
    """E examples, each of which shows an object from V cameras in front of a background.

    If only the light changes, each view is rasterized once into a transfer operator, a matrix
    from light to image (see `OperatorRenderer`). If vertices, colors or gloss change, each view is
    rasterized each time (see `DirectRenderer`).

    Args:
        objects: The objects.
        examples: The E examples, each with V cameras.
        backgrounds: B backgrounds with values in [0, 1], shape (B, 3, height, width) or
            (B, 1, height, width).
        lights: RGB coefficients of the light before any attack, shape (E, coefficients, 3), or
            (coefficients, 3) for all examples. Images have the dtype and the device of the
            lights.
        settings: Settings of the images.
        rasterizer: The rasterizer.
        basis: Basis of the coefficients. By default, these are 49 spherical harmonics.
        camera_effects: A differentiable function that changes rendered images, such as one of
            `draw_camera_effects`. Its arguments are the images of A examples, shape
            (A, V, 3, height, width), and the indices of these examples, shape (A,). None for no
            effects.
        one_light: Whether each view is rendered in one light only. Then no transfer operators
            are built, because direct rendering takes less time, and shadows and bounces stay those
            of the first light.
        lights_of_degree: A function that loads the lighting with another degree of harmonics.
            Its arguments are the degree, and the roughness of the smoothest surface (None if no
            surface has gloss). It returns the basis, and RGB coefficients of the light, shape
            (coefficients, 3). None if the lighting cannot be loaded again.
        exposure: Factor that the environment light of `lights` includes. Lighting that
            replaces it is multiplied by this factor.

    Attributes:
        views: Number V of views of an example.
        object_of: Index of the object of each example, shape (E,).
        group_size: Largest number of examples that are rendered at a time.
        attack_bytes: Bytes that an attack on the light needs in addition to the operators.

    Raises:
        InputError: If an argument has a wrong type, shape or range, or if memory is too small.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> scene = nb.build_scene([("solid:orange", "orange")], size=8, views=2)
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
    exposure: float = 1.0

    def __post_init__(self) -> None:
        """Check the arguments, and prepare the renderers."""
        settings, basis = self.settings, self.basis
        kind = "a list of scene objects"
        self.objects = errors.as_list("objects", self.objects, SceneObject, kind)
        examples = errors.as_list("examples", self.examples, Example, "a list of examples")
        lights = errors.as_tensor("lights", self.lights)
        backgrounds = errors.as_tensor("backgrounds", self.backgrounds)
        effects = "a function of images and examples"
        errors.require_kind("settings", settings, ImageSettings, "nb.ImageSettings(size)")
        errors.require_kind("basis", basis, Basis, "a basis of light, such as Harmonics(degree)")
        errors.require_kind("camera_effects", self.camera_effects, Callable | None, effects)
        chosen_by = "renderer.visibility.choose(name)"
        errors.require_kind("rasterizer", self.rasterizer, Rasterizer, chosen_by)
        self._require_fit(examples, lights, backgrounds)
        # The depth range of each camera must contain the whole object.
        self.examples = []
        for example in examples:
            radius = self.objects[example.object].radius
            cameras = tuple(camera.with_clip_range(radius) for camera in example.cameras)
            self.examples.append(replace(example, cameras=cameras))
        self.backgrounds = backgrounds.to(lights)
        self.lights = lights.expand(len(examples), *lights.shape[-2:])
        self.views = len(examples[0].cameras)
        device = lights.device
        self.object_of = torch.tensor([example.object for example in examples], device=device)
        self._background = torch.tensor([example.background for example in examples], device=device)
        exposures = torch.tensor([example.exposure for example in examples])
        # Factors of the coefficients. Those of projectors and lamps have limits, so they stay.
        self._exposure = torch.ones_like(self.lights[..., :1])
        if basis.environment is not None:
            self._exposure[:, basis.environment.rows] = exposures.to(lights)[:, None, None]

        self.group_size = max(1, AT_ONCE // (self.views * settings.pixel_count))
        self.attack_bytes = self._count_attack_bytes()
        # Images are numbered by example and then by view: e · V + v.
        built_with: dict[str, Any] = {"rasterizer": self.rasterizer, "basis": basis}
        # On devices other than CUDA, operators are computed on the CPU, and their stacks are moved.
        built_with["device"] = device if device.type == "cuda" else "cpu"
        self._operator_renderer = OperatorRenderer(
            self.objects,
            [(item.object, camera) for item in self.examples for camera in item.cameras],
            self._background.repeat_interleave(self.views),
            self.backgrounds.flatten(2),
            settings,
            # `build` must not refer to `self`. Python frees objects with circular references late.
            partial(build_operators, settings=settings, dtype=lights.dtype, **built_with),
            attack_bytes=self.attack_bytes,
        )
        shown = self.objects, settings, self.rasterizer, basis, self.lights, self.one_light
        self._direct_renderer = DirectRenderer(*shown)

    def require_memory(self) -> None:
        """Check that there is memory for an attack on all examples."""
        height, width = self.settings.shape
        count = f"{len(self) * self.views} renders of {height} × {width} pixels"
        name = f"{count} (meshes × views × backgrounds)"
        errors.require_memory(name, self.attack_bytes, self.lights.device)

    def _count_attack_bytes(self) -> int:
        """Estimate the memory of an attack on all examples."""
        # An attack on the light keeps about so many numbers for each pixel of the images that are
        # rendered at the same time. Effects of a camera, such as blur and noise, need more.
        per_rendered_pixel = 48 if self.camera_effects else 16
        pixels_per_example = self.views * self.settings.pixel_count
        # It also keeps so many for each pixel of all images.
        numbers = 8 * len(self) * pixels_per_example
        numbers += per_rendered_pixel * min(len(self), self.group_size) * pixels_per_example
        # And it keeps so many for each coefficient of the light of each example.
        numbers += 12 * self.lights.numel()
        return self.lights.element_size() * numbers

    def _require_fit(self, examples: list[Example], lights: Tensor, backgrounds: Tensor) -> None:
        """Check that examples, lights and backgrounds fit the objects, the basis and the size."""
        if not examples:
            raise errors.InputError("examples is empty: give a mesh, a view and a background")
        highest = max(example.object for example in examples)
        if highest >= len(self.objects):
            reason = f"objects has {len(self.objects)} objects"
            advice = "give an object for each index"
            raise errors.InputError(f"{reason}, but an example refers to index {highest}: {advice}")
        errors.require_bounded(lights=lights)
        errors.require_shape("lights", lights, "...", self.basis.size, 3)
        shape = self.settings.shape
        is_image = backgrounds.shape[1:] in ((1, *shape), (3, *shape))
        if not (is_image and backgrounds.min() >= 0 and backgrounds.max() <= 1):
            given = f"shape {tuple(backgrounds.shape)}, or values outside of [0, 1]"
            advice = f"give images (count, 3, {shape[0]}, {shape[1]}) with values in [0, 1]"
            raise errors.InputError(f"backgrounds has {given}: {advice}")

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

        The examples are sorted by object, then by camera, then by background.

        Args:
            objects: The objects.
            cameras: The cameras.
            backgrounds: The backgrounds, shape (B, 3, height, width) or (B, 1, height, width).
            of_scene: Further arguments of `Scene`, by position.
            shared: Whether all cameras are the views of one example, so that they share one light
                and one shape. By default, each camera makes an example of its own.
            placed: Whether the cameras belong to the meshes before their normalization. They are
                then moved and scaled in the same way as each mesh.
            options: Further arguments of `Scene`, by name.
        """
        # Cameras of the examples of an object in front of a background: one tuple per example.
        camera_groups = [tuple(cameras)] if shared else [(camera,) for camera in cameras]
        examples = []
        for index, item in enumerate(objects):
            groups = [*map(item.move_cameras, camera_groups)] if placed else camera_groups
            examples += [Example(index, *pair) for pair in product(groups, range(len(backgrounds)))]
        return cls(objects, examples, backgrounds, *of_scene, **options)

    def changed(self, **arguments: Any) -> Scene:
        """Return a copy of the scene with some other arguments.

        Args:
            arguments: Arguments of `Scene` that differ in the copy, by name.
        """
        copy = replace(self, **arguments)
        kinds = [(lights.dtype, lights.device) for lights in (copy.lights, self.lights)]
        if arguments.keys() == {"lights"} and kinds[0] == kinds[1]:
            # Operators, with their shadows, are the same in any light, so they are built once.
            copy._operator_renderer = self._operator_renderer
        # Views that are rendered directly have no number, so the same ones may be in any order.
        has_same_views = {*map(_view_of, copy.examples)} <= {*map(_view_of, self.examples)}
        is_same = arguments.keys() <= {"lights", "examples"} and kinds[0] == kinds[1]
        # With `one_light`, the renderer keeps the shadows of the light of each example.
        keeps_light = self.one_light and self.settings.global_illumination
        if is_same and has_same_views and not keeps_light:
            copy._direct_renderer = self._direct_renderer
        return copy

    def with_count(self, count: int) -> Scene:
        """Return a copy with `count` examples, as many of each object as possible.

        The first objects get one more if the number does not divide. The examples of an object
        are repeated if there are too few.
        """
        rows: list[int] = []
        for index in range(len(self.objects)):
            share = count // len(self.objects) + (index < count % len(self.objects))
            rows += islice(cycle(self.rows_of(index)), share)
        if rows == [*range(len(self))]:
            return self
        return self.changed(examples=[self.examples[row] for row in rows], lights=self.lights[rows])

    def rows_of(self, item: int) -> list[int]:
        """Return the indices of the examples that show an object."""
        return (self.object_of == item).nonzero()[:, 0].tolist()

    def __len__(self) -> int:
        return len(self.examples)

    @cached_property
    def cameras(self) -> list[tuple[Camera, ...]]:
        """Return the V cameras of each of the E examples."""
        return [example.cameras for example in self.examples]

    @cached_property
    def labels(self) -> list[str | int]:
        """Return the name or the index of the class of each example."""
        return [self.objects[example.object].label for example in self.examples]

    @cached_property
    def vertices(self) -> Tensor:
        """Return the vertices of all objects before any attack, shape (objects, N, 3).

        N is the number of vertices of the largest mesh. Smaller meshes are padded with zeros.
        """
        return torch.nn.utils.rnn.pad_sequence(self._direct_renderer.vertices, batch_first=True)

    def mesh(self, example: int) -> Mesh:
        """Return the mesh of the example with the given index."""
        return self.objects[self.examples[example].object].mesh

    def basis_under(self, conditions: Conditions, row: int) -> Basis:
        """Return the basis of the light of an example, whose lamps may have moved.

        Args:
            conditions: Conditions of some examples, with the positions of the lamps.
            row: Index of the example in the first dimension of the conditions.
        """
        if conditions.positions is None:
            return self.basis
        return self.basis.moved(conditions.positions[row].detach())

    def cameras_under(self, conditions: Conditions, row: int, example: int) -> tuple[Camera, ...]:
        """Return the V cameras of an example, which may have moved, by a row of conditions."""
        cameras = self.cameras[example]
        if conditions.cameras is not None:
            # Changes of the polar angle, the azimuth and the logarithm of the distance. They are
            # read on the CPU, as numbers are: a GPU would be waited for at each.
            changes = conditions.cameras[row].cpu()
            cameras = tuple(camera.moved(*changes) for camera in cameras)
        if conditions.vertices is None:
            return cameras
        # The depth range of the cameras must contain vertices that have moved away from the origin.
        radius = float(conditions.vertices[row].detach().norm(dim=1).max())
        return tuple(camera.with_clip_range(radius) for camera in cameras)

    def conditions(self, examples: Int[Tensor, " A"]) -> Conditions:
        """Return the conditions of some examples before any attack.

        Conditions are the light, shape and colors with which examples are rendered.

        Args:
            examples: Index of each of A examples, shape (A,).

        Returns:
            Conditions with the light of the scene. Their other fields are None, because nothing
            else is changed.

        Raises:
            InputError: If there is no such example.
        """
        return Conditions(self.lights[self._as_examples(examples)])

    def exposed(
        self, light: Float[Tensor, "*batch K 3"], examples: Int[Tensor, " *batch"] | int
    ) -> Float[Tensor, "*batch K 3"]:
        """Multiply the environment light of examples by their exposures."""
        return light * self._exposure[examples].to(light.device)

    @without_autocast
    def render(
        self, conditions: Conditions, examples: Int[Tensor, " A"], is_draft: bool = False
    ) -> Float[Tensor, "A V 3 height width"]:
        """Render the V views of examples, differentiable in the conditions.

        Args:
            conditions: Light, shape and colors of each of A examples.
            examples: Index of each of the A examples, which are objects with their views, in the
                scene, shape (A,).
            is_draft: Whether images of moved vertices with shadows or bounces may have fewer
                samples and rays.

        Returns:
            Images with values in [0, 1], shape (A, V, 3, height, width).

        Raises:
            InputError: If there is no such example, if the conditions do not have one light for
                each example, or if they contain NaN.
        """
        expected = "conditions, such as scene.conditions(examples)"
        errors.require_kind("conditions", conditions, Conditions, expected)
        errors.require_shape("conditions.light", conditions.light, "examples", self.basis.size, 3)
        examples = self._as_examples(examples, len(conditions.light))
        layers = list(self.layers(conditions, examples, is_draft))
        # Start with the background of each image, shape (A · V, 3 or 1, height · width). Then
        # overwrite the pixels that objects cover.
        image_to_background = self._background[examples].repeat_interleave(self.views)
        canvas = self.backgrounds.flatten(2).index_select(0, image_to_background)
        new_values = [encode(clamp(layer.composite), self.settings.encoding) for layer in layers]
        targets = [(layer.rows, layer.pixels) for layer in layers]
        images = ScatterLayers.apply(canvas.expand(-1, 3, -1).contiguous(), targets, *new_values)
        images = images.view(len(examples), self.views, 3, *self.settings.shape)
        if self.camera_effects:
            images = self.camera_effects(images, examples)
        if conditions.pixels is not None:
            images = clamp(images + conditions.pixels)
        return images

    @torch.no_grad()
    def truth(
        self,
        index_of: Callable[[str | int], int],
        examples: Int[Tensor, " A"] | None = None,
        conditions: Conditions | None = None,
    ) -> Truth:
        """Find class, box and mask of the objects in the V views of examples.

        Args:
            index_of: Function from the label of an object to the index of its class, such as
                `Classifier.label`.
            examples: Indices of the A examples. None for all.
            conditions: Shape and pose of the A examples. None for those of the scene.

        Returns:
            The truth, with the first object of each example and all others that have a label.
            Objects of which a view shows less than LEAST_VISIBLE are left out of it, which is
            logged.
        """
        rows = torch.arange(len(self)) if examples is None else self._as_examples(examples)
        conditions = conditions or self.conditions(rows)
        items = [self.objects[self.examples[example].object] for example in rows.tolist()]
        # Indices among the objects of each example of those in the truth.
        kept = [[0, *(i for i, of in enumerate(item.labels) if i and of != "")] for item in items]
        # Examples with fewer objects than the one with most are padded with NO_OBJECT.
        labels = torch.full((len(rows), self.views, max(map(len, kept))), NO_OBJECT)
        size, device = self.settings.shape, self.lights.device
        masks = torch.zeros((*labels.shape, *size), dtype=torch.bool, device=device)
        visible = torch.zeros(labels.shape, device=device)
        for row, item in enumerate(items):
            names = [item.labels[i] for i in kept[row]]
            labels[row, :, : len(names)] = torch.tensor([*map(index_of, names)])
        for group in self._groups(conditions, rows.tolist()):
            # Masks and visible fractions of all objects of the views, of which some are kept.
            all_objects = self._direct_renderer.masks(group)
            of_group = kept[group.rows[0]]
            places = list(group.rows), list(group.views), slice(len(of_group))
            masks[places], visible[places] = (part[:, of_group] for part in all_objects)
        labels = labels.to(device)
        is_hidden = (labels != NO_OBJECT) & (visible < LEAST_VISIBLE)
        if is_hidden.any():
            row, _, kept_index = is_hidden.nonzero()[0].tolist()
            reason = f"views that show less than {LEAST_VISIBLE:.0%} of them"
            hidden = f"object {kept[row][kept_index]} of {items[row].name}"
            say_once(f"objects are left out of the truth of {reason}, such as {hidden}")
        labels[is_hidden] = NO_OBJECT
        masks[is_hidden] = False
        return Truth(labels, boxes_of(masks), masks, visible)

    @torch.no_grad()
    def surface_maps(
        self, conditions: Conditions, examples: Int[Tensor, " A"]
    ) -> Float[Tensor, "A V 4 height width"]:
        """Return the depth and the three components of normals in the views of examples."""
        maps = torch.zeros(len(examples), self.views, 4, *self.settings.shape, dtype=torch.float32)
        for group in self._groups(conditions, examples.tolist()):
            maps[list(group.rows), list(group.views)] = self._direct_renderer.surface_maps(group)
        return maps

    def _as_examples(self, examples: object, count: int | None = None) -> Int[Tensor, " A"]:
        """Convert indices of examples to an integer tensor on the device of the lights.

        The range of indices on a GPU is not checked, because the CPU would wait for the GPU. A
        count of None allows any number.
        """
        indices = errors.as_integers("examples", examples)
        errors.require_shape("examples", indices, "count" if count is None else count)
        if indices.device.type == "cpu" and len(indices):
            low, high = (int(end) for end in indices.aminmax())
            if low < 0 or high >= len(self):
                advice = f"give indices from 0 to {len(self) - 1}"
                raise errors.InputError(f"examples has indices from {low} to {high}: {advice}")
        return indices.to(self.lights.device)

    @property
    def needs_rays(self) -> bool:
        """Whether direct rendering traces rays for each view, which operators do once."""
        return bool(self.basis.local_lights) or self.settings.global_illumination

    def layers(
        self, conditions: Conditions, examples: Int[Tensor, " A"], is_draft: bool = False
    ) -> Iterator[Layer]:
        """Render the pixels that objects cover, by the fastest method that is exact.

        - If shape, albedo, gloss or cameras have changed, or if `one_light` is set, each view is
          rendered directly.
        - If lamps have moved, transfer operators (matrices from light to image) render all other
          light. The light of the lamps is computed for each view and added.
        - If only the light has changed, transfer operators render all of it.

        Image a · V + v of a layer is view v of the example with the index `examples[a]`.
        """
        errors.require_bounded(light=conditions.light)
        light = self.exposed(conditions.light, examples)
        changes = (conditions.vertices, conditions.albedo, conditions.gloss, conditions.cameras)
        if self.one_light or any(values is not None for values in changes):
            return self._render_directly(replace(conditions, light=light), examples, is_draft)
        if conditions.positions is not None:
            return self._render_with_moved_lamps(light, conditions.positions, examples)
        return self._render_with_operators(light, examples)

    def _render_with_operators(self, light: Tensor, examples: Int[Tensor, " A"]) -> Iterator[Layer]:
        """Render the V views of examples with transfer operators, which map light to images.

        The light is multiplied by the exposure already. There is one layer for each stack of
        operators.
        """
        # The renderer numbers the views of all examples of the scene, shape (A · V,).
        images = (_on_cpu(examples)[:, None] * self.views + torch.arange(self.views)).flatten()
        if self.views > 1:
            # All views of an example have the same light, shape (A · V, K, 3).
            light = light.repeat_interleave(self.views, dim=0)
        return self._operator_renderer.layers(light, images)

    def _render_with_moved_lamps(
        self, light: Tensor, positions: Float[Tensor, "A L 3"], examples: Int[Tensor, " A"]
    ) -> Iterator[Layer]:
        """Render views with transfer operators, and add the light of moved lamps to each view."""
        assert self.basis.movable_light is not None
        # Rows of the lamps in the K coefficients, and the basis of the lamps.
        lamp_rows, lamps = self.basis.movable_light
        # Operators are built for the lamps at their old places, so they render without the lamps.
        other_light = light.clone()
        other_light[:, lamp_rows] = 0
        batch_images = torch.arange(len(light) * self.views, device=light.device)
        numbers = _on_cpu(examples).tolist()
        for rows, pixels, composite in self._render_with_operators(other_light, examples):
            composites = []
            for image, other in zip(batch_images[rows].tolist(), composite, strict=True):
                # Image a · V + v is view v of row a.
                row, view = divmod(image, self.views)
                example = self.examples[numbers[row]]
                shown = (example.object, example.cameras[view])
                fragments, albedo = self._direct_renderer.view(*shown)
                local = self._direct_renderer.local_view(*shown)
                radiance = local.radiance(lamps, albedo, light[row, lamp_rows], positions[row])
                # Positions of the pixels that the object covers in the sorted list `pixels`.
                covered = torch.searchsorted(pixels, fragments.pixels)
                composites.append(other.index_add(1, covered, radiance))
            yield Layer(rows, pixels, torch.stack(composites))

    def _render_directly(
        self, conditions: Conditions, examples: Int[Tensor, " A"], is_draft: bool
    ) -> Iterator[Layer]:
        """Render views of examples by rasterization, without transfer operators.

        The light of the conditions is multiplied by the exposure already. There is one layer for
        each of the A · V images.
        """
        numbers = _on_cpu(examples).tolist()
        groups: Iterable[Group] = self._groups(conditions, numbers)
        if len(examples) * self.views > MAX_VIEWS_WITHOUT_PROGRESS:
            groups = progress(list(groups), "rendering views")
        for group in groups:
            rows = group.rows
            behind = [self.backgrounds[self.examples[numbers[row]].background] for row in rows]
            background = torch.stack(behind, dim=1).flatten(1)
            shown = numbers[rows[0]], group, background, is_draft
            pixels, coverage, radiance = self._direct_renderer.radiance(*shown)
            # Pixels at the border of the object show a part of the background.
            seen_background = background.index_select(1, pixels)
            term = background_term(coverage[None], seen_background, self.settings.encoding)
            parts = split_views(pixels, len(rows), self.settings.pixel_count, radiance + term)
            for row, view, part in zip(rows, group.views, parts, strict=True):
                image, (pixels_of_view, composite) = row * self.views + view, part
                yield Layer(slice(image, image + 1), pixels_of_view, composite[None])

    def _groups(self, conditions: Conditions, numbers: Sequence[int]) -> Iterator[Group]:
        """Yield groups of views that are rasterized together.

        `numbers` are the examples of the rows. Rows share a group if they show the same matte mesh
        and if nothing but their light changes.
        """
        changes = (conditions.vertices, conditions.albedo, conditions.gloss, conditions.cameras)
        is_unchanged = all(values is None for values in changes)
        cameras = [self.cameras_under(conditions, *each) for each in enumerate(numbers)]

        def shown(image: tuple[int, int]) -> tuple[int, int]:
            row, _ = image
            index = self.examples[numbers[row]].object
            is_shared = is_unchanged and self.objects[index].mesh.gloss is None
            return index, -1 if is_shared else row

        images = product(range(len(numbers)), range(self.views))
        is_single = self.needs_rays or self.settings.silhouettes
        at_once = views_at_once(self.settings, self.lights.device, is_single)
        for (index, _), of_mesh in groupby(sorted(images, key=shown), key=shown):
            while group := list(islice(of_mesh, at_once)):
                rows, views = zip(*group, strict=True)
                changed = conditions.row(rows[0], self.objects[index].mesh)
                if rows[0] != rows[-1]:
                    light = torch.stack([conditions.light[row] for row in rows])
                    changed = replace(changed, light=light)
                of_views = tuple(cameras[row][view] for row, view in group)
                yield Group(rows, views, index, of_views, changed)


def _on_cpu(indices: Tensor) -> Tensor:
    """Copy indices to the CPU, which waits for a GPU. The last copies are kept."""
    is_kept = indices.device.type != "cpu" and not indices.is_inference()
    return _copied(indices, indices._version) if is_kept else indices.cpu()


@lru_cache(maxsize=8)
def _copied(indices: Tensor, _version: int) -> Tensor:
    """Copy indices to the CPU. Tensors have equal keys if they are the same and unchanged."""
    return indices.cpu()


def _view_of(example: Example) -> tuple[int, tuple[Camera, ...]]:
    """Return what an example shows, in front of any background and at any exposure."""
    return example.object, example.cameras
