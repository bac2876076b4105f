"""The one scene: rows of what is shown, rendered under conditions that an attack may change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from augment.held_transport import HeldTransport, HeldTransports
from augment.memory import require_memory
from augment.objects import SceneObject
from augment.operator_stack import OperatorStack
from augment.placed_view import PlacedView
from augment.progress import progress
from renderer.albedo import painted_albedo, surface_albedo
from renderer.basis import HARMONICS, Basis, Placed, parts_of
from renderer.cache import OperatorCache
from renderer.camera import Camera
from renderer.errors import InputError, require_bounded
from renderer.fragments import Fragments, build_fragments
from renderer.image import ImageSettings, behind, clamp, clamped, develop_composite
from renderer.lamps import Lamps, moved
from renderer.mesh import Mesh
from renderer.rays import Rays
from renderer.shading import radiance
from renderer.visibility import Backend

if TYPE_CHECKING:
    from jaxtyping import Float, Int

AT_ONCE = 2**24  # pixels of the images that are rendered at once: some 2 GB, with what a gradient needs of them
STACKED = 2**16  # pixels of the images whose operators are multiplied at once; more would only be copied about


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
    pixels: added to the values of the V images. places: of the lamps, None where they are the basis'. Where meshes
    differ in size, N and F are the largest's, and a smaller mesh has the first of them.
    """

    light: Float[Tensor, "A coefficients 3"]
    vertices: Float[Tensor, "A N 3"] | None = None
    albedo: Float[Tensor, "A F 3"] | None = None
    pixels: Float[Tensor, "A V 3 size size"] | None = None
    places: Float[Tensor, "A L 3"] | None = None


@dataclass(frozen=True)
class _Layer:
    """Pixels (P,) that a mesh covers in B images, `rows` of all, None for all of them in order.

    composite: (B, 3, P) linear radiance and what is behind it. coverage: (O, 1, P) of the O views, of which each image
    has the one that `shown` (B,) says.
    """

    rows: list[int] | None
    pixels: Tensor
    composite: Tensor
    coverage: Tensor
    shown: Tensor | list[int]


class Scene:
    """E examples of V views each, over backgrounds (B, 3 or 1, size, size) of values in [0, 1].

    Under a change of light alone nothing is rasterised after the first time: the operators of many views are stacked
    (`OperatorStack`), equal views share one, and what a background adds to an image is kept. Where vertices move, their
    view is rasterised anew each time; shadows and bounces of distant light are those of a shape close by
    (`HeldTransport`), shadows of light from places are its own (`PlacedView`).
    light: (size, 3), or (E, size, 3), where attacks begin; its dtype and device are those of the images. basis: what
    lights are coefficients of; 49 harmonics, unless another is given. taken: what a camera makes of rendered images
    (A, V, 3, size, size) of examples (A,), differentiable; see `Snapshot`.
    """

    def __init__(
        self,
        objects: Sequence[SceneObject],
        examples: Sequence[Example],
        backgrounds: Tensor,
        light: Tensor,
        settings: ImageSettings,
        backend: Backend,
        operators: OperatorCache | None = None,
        basis: Basis = HARMONICS,
        taken: Callable[[Tensor, Tensor], Tensor] | None = None,
    ):
        if not examples:
            raise InputError("nothing is to be rendered: name one mesh, one view and one background or more")
        if light.shape[-2:] != (basis.size, 3):
            raise InputError(f"light of shape {tuple(light.shape)} is not of {basis}: give {basis.size} rows")
        if not (backgrounds.min() >= 0 and backgrounds.max() <= 1):
            raise InputError("scene.backgrounds: give values in [0, 1]")
        self.objects, self.examples = list(objects), list(examples)
        self.settings, self.backend, self.basis, self._taken = settings, backend, basis, taken
        self.backgrounds = backgrounds.flatten(2).to(light)
        self.lights = light.expand(len(examples), *light.shape[-2:])
        self.views = len(self.examples[0].cameras)  # per example
        self._cache = operators or OperatorCache()
        self.object_of = self._column(example.object for example in examples)  # (E,)
        self._background = self._column(example.background for example in examples)
        self._exposure = torch.tensor([example.exposure for example in examples]).to(light)[:, None, None]
        seen = [(example.object, camera) for example in examples for camera in example.cameras]
        self._distinct = sorted(dict.fromkeys(seen), key=lambda view: view[0])  # (object, camera) of each operator
        number = {view: index for index, view in enumerate(self._distinct)}
        self._operator = self._column(number[view] for view in seen)  # (E × V,)
        pixels = settings.size**2
        self.at_once = max(1, AT_ONCE // (self.views * pixels))  # examples
        images = len(self.examples) * self.views
        asked = (
            f"{images} renders of {settings.size} pixels per side (augment.examples, scene.views, scene.backgrounds)"
        )
        require_memory(asked, 24 * images * pixels, self.lights.device)
        self._per_stack = max(1, STACKED // pixels)
        # What is kept of views; `functools.cache` would tie a scene that each epoch replaces to itself.
        self._stacks: dict[int, tuple[OperatorStack, Tensor, Tensor]] = {}
        self._fragments_of_meshes: dict[tuple[int, Camera], tuple[Fragments, Tensor]] = {}
        self._transports = HeldTransports(settings, basis)
        self._rays: dict[int, Rays] = {}
        self._placed_views: dict[tuple[int, Camera], PlacedView] = {}

    @classmethod
    def grid(
        cls,
        objects: Sequence[SceneObject],
        cameras: Sequence[Camera],
        backgrounds: Tensor,
        light: Tensor,
        settings: ImageSettings,
        backend: Backend,
        operators: OperatorCache | None = None,
        *,
        shared: bool = False,
        basis: Basis = HARMONICS,
    ) -> Scene:
        """Every object from every camera over every background, in that order; or, where the views share what is
        attacked, every object over every background from all cameras."""
        views = [tuple(cameras)] if shared else [(camera,) for camera in cameras]
        examples = [Example(*row) for row in product(range(len(objects)), views, range(len(backgrounds)))]
        return cls(objects, examples, backgrounds, light, settings, backend, operators, basis)

    @classmethod
    def of_mesh(
        cls,
        mesh: Mesh,
        cameras: Sequence[Sequence[Camera]],
        backgrounds: Tensor,
        light: Tensor,
        settings: ImageSettings,
        backend: Backend,
        gain: float = 1.0,
        operators: OperatorCache | None = None,
    ) -> Scene:
        """One mesh from cameras (E × V), each example before a background of its own (E, 3, size, size)."""
        examples = [Example(0, tuple(views), index) for index, views in enumerate(cameras)]
        return cls([SceneObject("", mesh, gain)], examples, backgrounds, light, settings, backend, operators)

    def with_rows(self, examples: Sequence[Example], **changed: Any) -> Scene:
        """Other rows, as many as before, of the same scene but for what is given: keywords are the constructor's."""
        same: dict[str, Any] = {
            "objects": self.objects,
            "backgrounds": self.images_behind,
            "light": self.lights,
            "settings": self.settings,
            "backend": self.backend,
            "operators": self._cache,
            "basis": self.basis,
            "taken": self._taken,
        }
        return Scene(examples=examples, **same | changed)

    def in_physical_light(self) -> Scene:
        """The same, in the nearest lights that something can emit."""
        return self.with_rows(self.examples, light=self.basis.nearest_physical(self.lights))

    def __len__(self) -> int:
        return len(self.examples)

    @property
    def images_behind(self) -> Tensor:
        """The backgrounds as they were given, (B, 3 or 1, size, size)."""
        return self.backgrounds.unflatten(2, (self.settings.size, -1))

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
        return self._padded([torch.from_numpy(item.mesh.vertices) for item in self.objects])

    @property
    def stacks(self) -> list[OperatorStack]:
        """All operators, of which those that are missing are built now."""
        return [self._stack(index)[0] for index in progress(range(self._stack_count), "views")]

    @property
    def _stack_count(self) -> int:
        return -(-len(self._distinct) // self._per_stack)

    def mesh(self, example: int) -> Mesh:
        """What an example shows."""
        return self.objects[self.examples[example].object].mesh

    def basis_under(self, conditions: Conditions, row: int) -> Basis:
        """What the light of a row of conditions is of: lamps are where the conditions have them."""
        return self.basis if conditions.places is None else moved(self.basis, conditions.places[row].detach())

    def conditions(self, examples: Int[Tensor, " A"]) -> Conditions:
        """The scene's own, for some examples."""
        return Conditions(self.lights[examples])

    def render(self, conditions: Conditions, examples: Int[Tensor, " A"]) -> Float[Tensor, "A V 3 size size"]:
        """Images in [0, 1] of examples from their V views, differentiable in the conditions.

        InputError: NaN.
        """
        layers = list(self._layers(conditions, examples))
        canvas = self.backgrounds.index_select(0, self._background[examples].repeat_interleave(self.views))
        canvas = canvas.expand(-1, 3, -1).contiguous()
        covered = [develop_composite(layer.composite, self.settings.encoding) for layer in layers]
        images = _Placed.apply(canvas, [(layer.rows, layer.pixels) for layer in layers], *covered)
        images = images.view(len(examples), self.views, 3, self.settings.size, self.settings.size)
        images = images if self._taken is None else self._taken(images, examples)
        return images if conditions.pixels is None else clamp(images + conditions.pixels)

    @torch.no_grad()
    def clamped_share(self, conditions: Conditions, examples: Int[Tensor, " A"]) -> Float[Tensor, " A"]:
        """Per example, the share of its covered pixels' values that the clamp changes."""
        shares = self.lights.new_zeros(2, len(examples) * self.views)
        for layer in self._layers(conditions, examples):
            covered = (layer.coverage[layer.shown] > 0).expand_as(layer.composite)
            counts = torch.stack([clamped(layer.composite) & covered, covered]).sum((2, 3)).to(shares)
            shares[:, slice(None) if layer.rows is None else layer.rows] += counts
        changed, covered = shares.unflatten(1, (-1, self.views)).sum(2)
        return changed / covered.clamp(min=1)

    def _layers(self, conditions: Conditions, examples: Tensor) -> Iterator[_Layer]:
        require_bounded(light=conditions.light)
        light = conditions.light * self._exposure[examples]
        if conditions.vertices is None and conditions.albedo is None:
            if conditions.places is None:
                return self._relit(light, examples)
            return self._under_moved_lamps(light, conditions.places, examples)
        return self._reshaded(light, conditions, examples)

    def _relit(self, light: Tensor, examples: Tensor) -> Iterator[_Layer]:
        """By one product per stack of operators."""
        views = torch.arange(self.views, device=examples.device)
        images = (examples[:, None] * self.views + views).flatten()
        if self.views > 1:
            light = light.repeat_interleave(self.views, dim=0)
        if len(self._distinct) <= self._per_stack:
            yield self._relit_layer(0, None, light, images)
            return
        stack = self._operator[images] // self._per_stack
        for index in stack.unique().tolist():
            rows = torch.nonzero(stack == index).squeeze(1)
            yield self._relit_layer(index, rows.tolist(), light[rows], images[rows])

    def _relit_layer(self, index: int, rows: list[int] | None, light: Tensor, images: Tensor) -> _Layer:
        stack, place, added = self._stack(index)
        images = place[images]
        seen = stack.radiance(light, images)
        return _Layer(rows, stack.pixels, seen + added[images], stack.coverage, stack.shown[images])

    def _under_moved_lamps(self, light: Tensor, places: Tensor, examples: Tensor) -> Iterator[_Layer]:
        """By the same products for all other light, and by the lamps' image after image."""
        where, lamps = next((where, part) for where, part in parts_of(self.basis) if isinstance(part, Lamps))
        rest = torch.cat([light[:, : where.start], torch.zeros_like(light[:, where]), light[:, where.stop :]], dim=1)
        for layer in self._relit(rest, examples):
            added = []
            for image in range(len(layer.composite)) if layer.rows is None else layer.rows:
                row, view = divmod(image, self.views)
                example = self.examples[int(examples[row])]
                shown = example.object, example.cameras[view]
                placed, (fragments, albedo) = self._placed_view(*shown), self._still(*shown)
                seen = placed.radiance(lamps, albedo, light[row, where], places[row])
                covered = torch.searchsorted(layer.pixels, fragments.pixels)
                added.append(seen.new_zeros(3, len(layer.pixels)).index_copy(1, covered, seen))
            yield replace(layer, composite=layer.composite + torch.stack(added))

    def _reshaded(self, light: Tensor, conditions: Conditions, examples: Tensor) -> Iterator[_Layer]:
        """View by view."""
        views = [(row, index, view) for row, index in enumerate(examples.tolist()) for view in range(self.views)]
        for image, (row, index, view) in enumerate(views):
            example = self.examples[index]
            fragments, seen = self._reshaded_view(index, example.cameras[view], light[row], conditions, row)
            coverage = fragments.coverage.to(seen)[None]
            there = self.backgrounds[example.background].index_select(1, fragments.pixels)
            composite = seen + behind(coverage, there, self.settings.encoding)
            yield _Layer([image], fragments.pixels, composite[None], coverage[None], [0])

    def _reshaded_view(
        self, index: int, camera: Camera, light: Tensor, conditions: Conditions, row: int
    ) -> tuple[Fragments, Tensor]:
        """What a camera sees of an example under the conditions of one row, with its radiance (3, P)."""
        number = self.examples[index].object
        mesh = self.objects[number].mesh
        if conditions.vertices is None:
            vertices, positions = self.vertices[number, : len(mesh.vertices)], mesh.vertices
            fragments, albedo = self._still(number, camera)
            placed = partial(self._placed_view, number, camera)
        else:
            vertices = conditions.vertices[row, : len(mesh.vertices)]
            positions = vertices.detach().cpu().double().numpy()
            fragments, albedo = self._fragments(number, camera, positions)
            rays = Rays(replace(mesh, vertices=positions))
            placed = partial(PlacedView, rays, mesh, fragments, self.settings, vertices)
        if conditions.albedo is not None:
            added, gain = conditions.albedo[row, : len(mesh.faces)], self.objects[number].gain
            albedo = painted_albedo(mesh, fragments, self.settings.encoding, gain, added)
        smooth_faces = self._faces[number] if self.settings.normals == "smooth" else None
        places = None if conditions.places is None else conditions.places[row]
        seen = vertices.new_zeros(3, len(fragments.pixels))
        for where, part in parts_of(self.basis):
            own = light[where]
            if isinstance(part, Placed):
                seen = seen + placed().radiance(part, albedo, own, places)
                continue
            seen = seen + radiance(fragments, vertices, own, albedo, smooth_faces)
            if self.settings.transport != "direct":
                seen = seen + self._held(index, camera, positions).radiance(camera, fragments, albedo, own)
        return fragments, seen

    def _stack(self, index: int) -> tuple[OperatorStack, Tensor, Tensor]:
        if index not in self._stacks:
            self._stacks[index] = stack, _, added = self._build_stack(index)
            if len(self._stacks) == 1:  # the others are as large
                kept = (self._stack_count - 1) * (stack.transfer.nbytes + stack.albedo.nbytes + added.nbytes)
                views = f"{len(self._distinct)} views of {self.settings.size} pixels per side (scene.views)"
                require_memory(views, kept, self.lights.device)
        return self._stacks[index]

    def _build_stack(self, index: int) -> tuple[OperatorStack, Tensor, Tensor]:
        """(some operators, (E × V,) each image's place among those that show them, what is behind these (N, C, P))."""
        first = index * self._per_stack
        views = self._distinct[first : first + self._per_stack]
        operators = []
        for number in dict.fromkeys(number for number, _ in views):
            item, cameras = self.objects[number], [camera for its, camera in views if its == number]
            operators += self._cache.operators(
                item.mesh, cameras, self.settings, self.backend, item.gain, self.basis, self.lights.dtype
            )
        here = self._operator // self._per_stack == index
        stack = OperatorStack(operators, (self._operator[here] - first).cpu(), self.lights.device)
        backgrounds = self.backgrounds.index_select(2, stack.pixels)
        which = self._background.repeat_interleave(self.views)[here]
        added = behind(stack.coverage[stack.shown], backgrounds[which], self.settings.encoding)
        return stack, here.cumsum(0) - 1, added

    def _still(self, number: int, camera: Camera) -> tuple[Fragments, Tensor]:
        view = number, camera
        if view not in self._fragments_of_meshes:
            self._fragments_of_meshes[view] = self._fragments(number, camera, self.objects[number].mesh.vertices)
        return self._fragments_of_meshes[view]

    def _placed_view(self, number: int, camera: Camera) -> PlacedView:
        """Of an object in its own shape."""
        view = number, camera
        if view not in self._placed_views:
            mesh, (fragments, _) = self.objects[number].mesh, self._still(*view)
            rays = self._rays.setdefault(number, Rays(mesh))
            self._placed_views[view] = PlacedView(rays, mesh, fragments, self.settings)
        return self._placed_views[view]

    def _held(self, index: int, camera: Camera, vertices: np.ndarray) -> HeldTransport:
        """Of a shape near the vertices of an example, and with the camera's view of it."""
        number = self.examples[index].object
        held = self._transports.near(index, number, self.objects[number], vertices)
        if not held.knows(camera):
            held.add(camera, *self._fragments(number, camera, held.mesh.vertices))
        return held

    def _fragments(self, number: int, camera: Camera, vertices: np.ndarray) -> tuple[Fragments, Tensor]:
        """What a camera sees of an object's moved vertices, and the albedo there (S, 3)."""
        item = self.objects[number]
        (fragments,) = build_fragments(
            vertices, item.mesh.faces, [camera], self.settings, self.backend, closed=item.mesh.closed
        )
        fragments = fragments.to(self.lights.device)
        return fragments, (surface_albedo(item.mesh, fragments, self.settings.encoding) * item.gain).to(self.lights)

    @cached_property
    def _faces(self) -> list[Tensor]:
        return [torch.from_numpy(item.mesh.faces).to(self.lights.device) for item in self.objects]

    def _column(self, values: Iterable[int]) -> Tensor:
        return torch.tensor(list(values), device=self.lights.device)

    def _padded(self, parts: Sequence[Tensor]) -> Tensor:
        return torch.nn.utils.rnn.pad_sequence(list(parts), batch_first=True).to(self.lights)


class _Placed(torch.autograd.Function):
    """Covered pixels (B, 3, P) in their places on canvases (N, 3, size²), which are overwritten."""

    @staticmethod
    def forward(
        ctx: Any, canvas: Tensor, places: Sequence[tuple[list[int] | None, Tensor]], *covered: Tensor
    ) -> Tensor:
        ctx.places = places
        for (rows, pixels), values in zip(places, covered, strict=True):
            if rows is None:
                canvas.index_copy_(2, pixels, values)
            else:
                for row, value in zip(rows, values, strict=True):
                    canvas[row].index_copy_(1, pixels, value)
        return canvas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *(_taken(upstream, *place) for place in ctx.places)


def _taken(images: Tensor, rows: list[int] | None, pixels: Tensor) -> Tensor:
    if rows is None:  # of two axes, torch selects ten times as fast as of three
        return images.flatten(0, 1).index_select(1, pixels).unflatten(0, (-1, 3))
    return torch.stack([images[row].index_select(1, pixels) for row in rows])


def count_views(examples: int | None, objects: int, backgrounds: int, views: int | None) -> int:
    """Views per mesh, so that meshes × views × backgrounds are the examples; either is derived where it is None.

    The paper's 100 examples are 2 meshes × 10 views × 5 backgrounds. InputError where no such product exists.
    """
    if not objects or not backgrounds:
        raise InputError("scene.meshes and scene.backgrounds must not be empty: name one mesh and one background")
    if examples is None:
        if views is None:
            raise InputError("augment.examples=null makes as many renders as scene.views says: set either")
        return views
    derived, rest = divmod(examples, objects * backgrounds)
    if rest or derived < 1:
        raise InputError(
            f"augment.examples={examples} is not a multiple of {objects} meshes × {backgrounds} backgrounds: "
            f"set it to a multiple of {objects * backgrounds}"
        )
    if views is not None and views != derived:
        raise InputError(
            f"augment.examples={examples} is not {objects} meshes × {views} views × {backgrounds} backgrounds = "
            f"{objects * views * backgrounds}: change one of them, or set scene.views=null to derive the views"
        )
    return derived
