"""Render the views of a scene: with transfer operators, or directly.

`OperatorRenderer` renders unchanged objects in changing light. A transfer operator is a matrix that
maps the coefficients of the light to the pixels of one view. The objects are rasterized once, and
each further light costs a matrix product.

`DirectRenderer` renders objects whose vertices, colors, gloss or lamps change, several small views
at a time if no rays are cast. Each view of moved vertices is rasterized again. The shadows and
bounces of environment light take long to compute. `FrozenTransport` keeps them for one shape, and
they are used again while the vertices are within `NEAR` of this shape. The shadows of projector and
lamps are always those of the moved shape itself (`renderer.operators.rays`).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from augment.progress import progress
from augment.scene.objects import Conditions, SceneObject
from augment.scene.truth import COVERED
from renderer.camera import Camera
from renderer.errors import require_memory
from renderer.image import background_term
from renderer.light.basis import Basis, split_light
from renderer.mesh import Mesh
from renderer.operators.apply import TransferOperator
from renderer.operators.rays import LocalLightView, Rays, Surface
from renderer.operators.shadows import build_transport
from renderer.operators.stack import PIXELS_PER_STACK, OperatorStack, Rows
from renderer.settings import ImageSettings
from renderer.shaded_view import PixelRadiance, ShadedView
from renderer.surface.albedo import paint_faces, surface_albedo
from renderer.surface.gloss import Gloss
from renderer.visibility import Rasterizer
from renderer.visibility.fragments import Fragments, build_fragments


class Layer(NamedTuple):
    """Radiance of B images of a batch at the P pixels that their objects may cover.

    Attributes:
        rows: Indices of the B images in the batch: a slice, or a tensor (B,) on the device of the
            radiance.
        pixels: Row-major index of each of the P pixels in an image.
        composite: Linear radiance of the objects in front of the backgrounds.
    """

    rows: Rows
    pixels: Int[Tensor, " P"]
    composite: Float[Tensor, "B 3 P"]


class _BuiltStack(NamedTuple):
    """A stack of transfer operators, and the backgrounds of the M images that it renders.

    A transfer operator is a matrix from light to the pixels of one view.

    Attributes:
        operators: The stack, which covers P pixels of an image.
        image_to_stack_image: For each of the N images of the scene, its index among the M images of
            this stack. Images of other stacks have arbitrary values.
        background_terms: Linear radiance that the backgrounds add to the M images at the P pixels,
            in C = 1 or 3 channels.
    """

    operators: OperatorStack
    image_to_stack_image: Int[Tensor, " N"]
    background_terms: Float[Tensor, "M C P"]


@dataclass(eq=False, repr=False)
class OperatorRenderer:
    """Render N images with transfer operators, which are matrices from light to image.

    Each image shows one object from one camera in front of one background.
    Images of the same object from the same camera share an operator. Operators
    are combined to stacks, which are built when they are first needed.

    Attributes:
        objects: The objects.
        views: Index of the object, and the camera, for each of the N images.
        image_to_background: Index of the background of each image.
        backgrounds: Image values of B backgrounds, in 1 or 3 channels.
        settings: Settings of the images.
        build: Function that builds the operators of several cameras. Its arguments are a mesh,
            cameras and `albedo_scale`.
        attack_bytes: Bytes that an attack needs in addition to the operators.
    """

    objects: Sequence[SceneObject]
    views: Sequence[tuple[int, Camera]]
    image_to_background: Int[Tensor, " N"]
    backgrounds: Float[Tensor, "B _ P"]
    settings: ImageSettings
    build: Callable[..., Sequence[TransferOperator]]
    attack_bytes: int = 0

    def __post_init__(self) -> None:
        """Assign a transfer operator to each image, and a stack to each operator.

        Images of the same object from the same camera share an operator. A
        stack has as many operators as fit into `PIXELS_PER_STACK`.
        """
        # Object and camera of each operator. Sort them by the object, so that the operators of
        # one object are in few stacks.
        self._views_of_operators = sorted(dict.fromkeys(self.views), key=itemgetter(0))
        operator_of_view = {view: index for index, view in enumerate(self._views_of_operators)}
        # Index of the transfer operator that renders each image, shape (N,).
        self._operator_of_image = torch.tensor([operator_of_view[view] for view in self.views])
        self._operators_per_stack = max(1, PIXELS_PER_STACK // self.settings.pixel_count)
        # Index of the stack of operators that renders each image, shape (N,).
        self._stack_of_image = self._operator_of_image // self._operators_per_stack
        # Stacks of transfer operators that were built so far, by their indices.
        self.built: dict[int, _BuiltStack] = {}

    def layers(self, light: Float[Tensor, "A _ 3"], images: Int[Tensor, " A"]) -> Iterator[Layer]:
        """Compute the radiance of a batch of images, differentiable in the light.

        `images` are indices on the CPU.
        """
        # Index of the stack of each image of the batch, shape (A,).
        row_to_stack = self._stack_of_image[images]
        needed_stacks = row_to_stack.unique().tolist()
        self._build_missing(needed_stacks)
        for index in needed_stacks:
            built = self.built[index]
            row_indices = torch.nonzero(row_to_stack == index).squeeze(1)
            rows: Rows = row_indices.to(light.device, non_blocking=True)
            first, end = int(row_indices[0]), int(row_indices[-1]) + 1
            if end - first == len(row_indices):
                # Consecutive rows are a slice, which is faster.
                rows = slice(first, end)
            # Indices of these images of the batch among the images of the stack.
            stack_images = built.image_to_stack_image[images[row_indices]]
            stack_images_on_device = stack_images.to(light.device, non_blocking=True)
            radiance = built.operators.radiance(light[rows], stack_images)
            composite = radiance + built.background_terms[stack_images_on_device]
            yield Layer(rows, built.operators.pixels, composite)

    def _build_missing(self, indices: Iterable[int]) -> None:
        """Build the stacks of transfer operators with the given indices that do not exist yet."""
        missing = [index for index in indices if index not in self.built]
        for index in progress(missing, "rendering views") if missing else ():
            built = self.built[index] = self._build_stack(index)
            if len(self.built) == 1:
                # All other stacks must fit in memory, if each is as large as the first one.
                tensors = (built.operators.transfer, built.operators.albedo, built.background_terms)
                stack_bytes = sum(tensor.nbytes for tensor in tensors)
                needed = int(self._stack_of_image.max()) * stack_bytes + self.attack_bytes
                height, width = self.settings.shape
                name = f"{len(self._views_of_operators)} views of {height} × {width} pixels (views)"
                require_memory(name, needed, self.backgrounds.device)

    def _build_stack(self, index: int) -> _BuiltStack:
        """Build a stack of transfer operators, and the backgrounds of its images."""
        first_operator = index * self._operators_per_stack
        views = self._views_of_operators[first_operator:][: self._operators_per_stack]
        operators: list[TransferOperator] = []
        for object_index, pairs in groupby(views, key=itemgetter(0)):
            item = self.objects[object_index]
            cameras = [camera for _, camera in pairs]
            operators += self.build(item.mesh, cameras, albedo_scale=item.albedo_scale)
        # Mask of the images whose operators are in this stack, shape (N,). M of them are True.
        is_in_stack = self._stack_of_image == index
        # Index of the operator of each of these images in the stack, shape (M,).
        operator_of_image = (self._operator_of_image[is_in_stack] - first_operator).cpu()
        stack = OperatorStack(operators, operator_of_image, self.backgrounds.device)
        backgrounds = self.backgrounds.index_select(2, stack.pixels)
        backgrounds = backgrounds[self.image_to_background[is_in_stack]]
        coverage = stack.coverage[stack.shown]
        background_terms = background_term(coverage, backgrounds, self.settings.encoding)
        # Number the images of the stack in their order: 0 for the first True of the mask, and so
        # on.
        return _BuiltStack(stack, is_in_stack.cumsum(0) - 1, background_terms)


# Largest number of samples of the rasterized views that are kept, which take about a gigabyte.
KEPT_SAMPLES = 2**24
# Shadows and bounces are computed again if a coordinate of a vertex has changed by more than this
# distance in world units.
NEAR = 0.001


# Largest number of samples along one side of a pixel in a draft of moved vertices.
DRAFT_SAMPLES = 2


# What shadows and bounces add to one view of a mesh: the radiance of each channel and pixel, for
# each of the K harmonic coefficients of the light, and the sum of the albedo of the samples of
# each pixel with which it was computed.
FrozenView = tuple[Float[Tensor, "3 K P"], Float[Tensor, "3 P"]]
# Example and camera of a view, and whether it is a draft. The example is None if the view is kept
# for all examples and lights.
ViewKey = tuple[int | None, Camera, bool]


class Group(NamedTuple):
    """N views that are rasterized together.

    Attributes:
        rows: Row of the conditions of each view.
        views: Number of each view among those of its example.
        object: Index of the object.
        cameras: Camera of each view.
        changed: Conditions of the rows, which differ in the light only. If there are several rows,
            each view has a light, shape (N, K, 3).
    """

    rows: tuple[int, ...]
    views: tuple[int, ...]
    object: int
    cameras: tuple[Camera, ...]
    changed: Conditions


class FrozenTransport:
    """Radiance that shadows and bounces of environment light add to views of a mesh.

    It is computed once, and approximates that of shapes that differ little from
    the mesh: the added radiance of a pixel stays the same, except that it is
    scaled with the albedo of the pixel.

    Attributes:
        mesh: The mesh that casts the shadows.
        views: Added radiance for each view. None if shadows and bounces add nothing.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis):
        """Trace the paths of light between the faces of a mesh."""
        self.mesh = mesh
        self.views: dict[ViewKey, FrozenView | None] = {}
        self._settings = settings
        self._transport = build_transport(mesh, settings, albedo_scale, basis)

    def is_near(self, vertices: Float[np.ndarray, "V 3"]) -> bool:
        """Return whether a shape is so close to the mesh that shadows and bounces are the same."""
        return bool(np.abs(vertices - self.mesh.vertices).max() <= NEAR)

    def add(
        self, key: ViewKey, fragments: Fragments, albedo: Float[Tensor, "S 3"], light: Tensor | None
    ) -> None:
        """Compute and keep the radiance that shadows and bounces add to a view of the mesh.

        With a light, only the radiance in this light is kept.
        """
        assert self._transport is not None  # Only views in environment light are added.
        # None says that shadows and bounces add nothing to the view.
        self.views[key] = None
        surface = Surface(self.mesh, fragments.to("cpu"), self._settings)
        if light is not None:
            light = light.cpu().double()
        # Added radiance for each of the K harmonic coefficients of the light, or only their sum,
        # in the P pixels that the mesh covers, shape (3, K or 1, P).
        added_transfer = self._transport.change(surface, albedo.cpu().double(), light, key[2])
        if added_transfer is None:
            return
        # A slightly different shape may cover other pixels, so expand the radiance to all pixels
        # of the image, shape (3, K, height · width).
        all_pixels = added_transfer.new_zeros(*added_transfer.shape[:2], math.prod(fragments.shape))
        all_pixels[..., surface.fragments.pixels] = added_transfer
        # The method `radiance` scales the added radiance of a pixel by the ratio of its new albedo
        # to this albedo.
        self.views[key] = all_pixels.to(albedo), _sum_by_pixel(fragments, albedo)

    def radiance(
        self, view: ViewKey, fragments: Fragments, albedo: Float[Tensor, "S 3"], light: Tensor
    ) -> Float[Tensor, "3 P"]:
        """Compute the radiance that shadows and bounces add to a view of a shape.

        It is differentiable in albedo and light, unless the light was given before. `add` has been
        called for the view, and the shape may differ a little from the mesh. There are S samples in
        P pixels.
        """
        kept = self.views[view]
        if kept is None:
            return light.new_zeros(3, len(fragments.pixels))
        added_transfer, old_sums = (part[..., fragments.pixels] for part in kept)
        new_sums = _sum_by_pixel(fragments, albedo)[:, fragments.pixels]
        # Radiance with the albedo of the mesh, shape (3, P).
        added = added_transfer.to(light)
        example, _, _ = view
        added = torch.einsum("ckp,kc->cp", added, light) if example is None else added[:, 0]
        # Scale the radiance by the ratio of new to old albedo. Where the old albedo is 0, there
        # is no ratio, and the radiance is not scaled.
        ratios = new_sums / old_sums.masked_fill(old_sums == 0, 1)
        return added * torch.where(old_sums > 0, ratios, 1).to(light)


def _sum_by_pixel(fragments: Fragments, albedo: Float[Tensor, "S 3"]) -> Float[Tensor, "3 pixels"]:
    """Sum the albedo of the samples in each pixel of an image."""
    # Row-major index of the pixel in which each sample lies, shape (S,).
    pixel_of_sample = fragments.pixels[fragments.sample_to_pixel]
    return albedo.new_zeros(3, math.prod(fragments.shape)).index_add(1, pixel_of_sample, albedo.T)


@dataclass(eq=False, repr=False)
class DirectRenderer:
    """Render objects directly, without precomputed matrices from light to image.

    Attributes:
        objects: The objects, which methods select by the argument `object_index`.
        settings: Settings of the images.
        rasterizer: The rasterizer.
        basis: Basis of the lights.
        like: A tensor with the dtype and the device of the images.
        one_light: Whether each example is rendered in one light only.
    """

    objects: Sequence[SceneObject]
    settings: ImageSettings
    rasterizer: Rasterizer
    basis: Basis
    like: Tensor
    one_light: bool = False

    def __post_init__(self) -> None:
        """Create empty caches."""
        # Rasterized views of unmoved objects. A key has the index of the object, and the cameras.
        self._views: dict[tuple[int, tuple[Camera, ...]], tuple[Fragments, Tensor]] = {}
        # Views of unmoved objects that were prepared for the light of projector and lamps.
        self._local_views: dict[tuple[int, Camera], LocalLightView] = {}
        # Ray tracers of unmoved objects by their indices.
        self._rays = [Rays(item.mesh) for item in self.objects]
        # Shadows and bounces: of unmoved objects by their indices, and of moved shapes by those of
        # their examples and objects. Scenes with other examples of the same objects may share this
        # renderer.
        self._transports: dict[int | tuple[int, int], FrozenTransport] = {}

    @cached_property
    def vertices(self) -> list[Tensor]:
        """Return the vertices of each object before any change, each of shape (V, 3)."""
        return [torch.from_numpy(item.mesh.vertices).to(self.like) for item in self.objects]

    def view(self, object_index: int, *cameras: Camera) -> tuple[Fragments, Tensor]:
        """Rasterize an object whose vertices have not moved.

        Return the S samples that the cameras see, and the albedo at the samples, shape (S, 3).
        """
        key = (object_index, cameras)
        if key not in self._views:
            if sum(len(albedo) for _, albedo in self._views.values()) > KEPT_SAMPLES:
                self._views.clear()
            mesh = self.objects[object_index].mesh
            vertices = torch.as_tensor(mesh.vertices, device=self.like.device)
            self._views[key] = self._rasterize(object_index, cameras, vertices, self.settings)
        return self._views[key]

    def local_view(self, object_index: int, camera: Camera) -> LocalLightView:
        """Prepare a view of an unmoved object for the light of projector and lamps.

        The result is computed once for each object and camera.
        """
        key = (object_index, camera)
        if key not in self._local_views:
            fragments, _ = self.view(object_index, camera)
            surface = Surface(self.objects[object_index].mesh, fragments.to("cpu"), self.settings)
            self._local_views[key] = LocalLightView(self._rays[object_index], surface)
        return self._local_views[key]

    def masks(self, group: Group) -> tuple[Bool[Tensor, "N O height width"], Float[Tensor, "N O"]]:
        """Find the pixels of which the visible part of each object covers COVERED or more.

        Return also the fraction of each object that nothing hides. It is 0 outside of the view.
        """
        item = self.objects[group.object]
        mesh, seen = self._seen(group)
        # `item.ends` has the index after the last face of each object.
        # Index of the object that each sample shows. The table comes after the objects.
        ends = torch.tensor(item.ends, device=seen.faces.device)
        owner = torch.searchsorted(ends, seen.faces, right=True)[seen.sample_to_seen_face]
        # Count the samples of each pair of an object and a pixel, shape (O, N, height, width).
        shape = len(ends) + 1, len(seen.cameras), *self.settings.shape
        keys = owner * math.prod(shape[1:]) + seen.pixels[seen.sample_to_pixel]
        counts = torch.bincount(keys, minlength=math.prod(shape)).view(shape)[:-1]
        visible_counts = counts.sum((2, 3))
        counts_alone = visible_counts  # All samples show the only object.
        if item.own is not None:
            # Rasterize each object by itself, to count its samples if nothing hides it.
            parts = np.split(mesh.faces, item.ends)[:-1]
            shown = seen.cameras, self.settings, self.rasterizer
            alone = [build_fragments(mesh.vertices, faces, *shown) for faces in parts]
            counts_alone = torch.tensor([[len(each.sample_numbers) for each in of] for of in alone])
        visible = visible_counts / counts_alone.to(ends.device).clamp(min=1)
        masks = counts >= COVERED * self.settings.samples**2
        # A pixel that two objects share equally belongs to the first.
        masks &= masks.cumsum(0) == 1
        return masks.transpose(0, 1), visible.T

    def surface_maps(self, group: Group) -> Float[Tensor, "N 4 height width"]:
        """Find depth and unit normal of the nearest sample in pixels of coverage >= COVERED.

        The depth is the distance from the camera along the viewing direction in world units, and
        normals are along the axes right, up and back of the camera. Both are 0 in other pixels.
        """
        mesh, seen = self._seen(group)
        fragments = seen.to("cpu")
        # Columns of a pose are the axes right, up and back of the camera, and its position.
        poses = torch.from_numpy(np.stack([camera.pose()[:3] for camera in seen.cameras]))
        pose = poses[fragments.view_of_face]
        from_camera = pose[:, None, :, 3] - torch.from_numpy(mesh.vertices)[fragments.corners]
        depths = fragments.interpolate(from_camera @ pose[:, :, 2:3])[:, 0]
        # The nearest sample of each pixel, and the first of equally near ones.
        pixel, count = fragments.sample_to_pixel, len(fragments.pixels)
        depth = depths.new_full((count,), math.inf).scatter_reduce_(0, pixel, depths, "amin")
        numbers = torch.arange(len(pixel)).masked_fill(depths > depth[pixel], len(pixel))
        nearest = torch.full((count,), len(pixel)).scatter_reduce_(0, pixel, numbers, "amin")
        seen_face = fragments.sample_to_seen_face[nearest]
        is_smooth = self.settings.normals == "smooth"
        in_world = mesh.corner_normals if is_smooth else mesh.face_normals()[:, None]
        corner_normals = torch.from_numpy(in_world)[fragments.faces[seen_face]]
        corner_normals = corner_normals @ pose[seen_face, :, :3]
        normals = (fragments.barycentric[nearest][:, :, None] * corner_normals).sum(1)
        # `facing` turns the normals of faces that are seen from behind.
        normals = normalize(normals, dim=1) * fragments.facing[seen_face]
        # Depth and the three components of the normal, shape (4, P).
        at_pixels = torch.cat([depth[None], normals.T])
        maps = torch.zeros(4, len(seen.cameras) * self.settings.pixel_count, dtype=torch.float32)
        is_covered = fragments.coverage >= COVERED
        maps[:, fragments.pixels[is_covered]] = at_pixels[:, is_covered].float()
        return maps.view(4, -1, *self.settings.shape).transpose(0, 1)

    def _seen(self, group: Group) -> tuple[Mesh, Fragments]:
        """Return the mesh of a group, and what its cameras see."""
        mesh = _moved(self.objects[group.object].mesh, group.changed.vertices)
        return mesh, self._rasterized(group, self.settings)[0]

    def radiance(
        self, example: int, group: Group, background: Float[Tensor, "_ pixels"], is_draft: bool
    ) -> PixelRadiance:
        """Render the views of a group, of an object with changed shape, colors, gloss or lamps.

        Their images are one tall image. All views have the same light or, if the object is matte,
        each may have its own. The result is differentiable in the light and in all changes. With
        `settings.silhouettes`, it is also differentiable in fields of the camera that are tensors.
        A draft of moved vertices with shadows or bounces has fewer samples and rays.
        """
        _, _, object_index, cameras, changed = group
        item = self.objects[object_index]
        fixed_cameras = tuple(camera.fixed() for camera in cameras)
        # Only views that are rendered alone need their camera.
        camera, fixed_camera = cameras[0], fixed_cameras[0]
        moved = changed.vertices
        # Without shadows, the images of a search are not rendered again, so they are no drafts.
        has_draft = is_draft and moved is not None and self.settings.global_illumination
        settings = self.settings
        if has_draft:
            settings = replace(settings, samples=min(settings.samples, DRAFT_SAMPLES))
        rasterized = self._rasterized(group, settings)
        fragments, albedo = rasterized
        if changed.albedo is not None:
            of_view = (item.mesh, fragments, settings.encoding, item.albedo_scale)
            albedo = paint_faces(*of_view, changed.albedo, changed.hue)
        gloss = None if changed.gloss is None else Gloss(*changed.gloss.unbind(1), textured=True)
        split = split_light(self.basis, changed.light)
        # Projector and lamps need rays for their shadows. For an unmoved object with its own
        # gloss, the view is prepared once.
        lamp_view = None
        if split.local_lights and moved is None and gloss is None:
            lamp_view = self.local_view(object_index, fixed_camera)
        elif split.local_lights:
            rays = self._rays[object_index] if moved is None else Rays(_moved(item.mesh, moved))
            surface = Surface(item.mesh, fragments.to("cpu"), settings, moved, gloss)
            lamp_view = LocalLightView(rays, surface)

        def indirect(albedo: Float[Tensor, "S 3"], light: Float[Tensor, "K 3"]) -> Tensor:
            """Compute the radiance that shadows and bounces of environment light add."""
            positions = _moved(item.mesh, moved).vertices
            frozen = self._transport(example, object_index, positions)
            view = (example if self.one_light else None, fixed_camera, has_draft)
            if view not in frozen.views:
                shown = rasterized
                if not np.array_equal(frozen.mesh.vertices, positions):
                    vertices = torch.as_tensor(frozen.mesh.vertices, device=self.like.device)
                    shown = self._rasterize(object_index, fixed_cameras, vertices, settings)
                frozen.add(view, *shown, light if self.one_light else None)
            added = frozen.radiance(view, fragments, albedo, light)
            # A camera whose fields are tensors is attacked, so it differs in each call. Its views
            # are not kept. `fixed` returns the same camera if no field is a tensor.
            if camera is not fixed_camera:
                del frozen.views[view]
            return added

        shown = ShadedView(
            mesh=item.mesh,
            fragments=fragments,
            settings=settings,
            vertices=self.vertices[object_index] if moved is None else moved,
            albedo=albedo,
            light=split,
            is_moved=moved is not None or camera is not fixed_camera,
            gloss=gloss,
            lamp_view=lamp_view,
            indirect=indirect if settings.global_illumination else None,
            lamp_positions=changed.positions,
        )
        return shown.pixel_radiance(camera, background)

    def _transport(self, example: int, object_index: int, positions: np.ndarray) -> FrozenTransport:
        """Return the shadows and bounces of a shape that is near the given one.

        One shape is kept for each example, in addition to the unmoved objects. If the unmoved mesh
        is not close to the shape, the shape that was kept for the example is tried. If that is not
        close either, shadows and bounces of the new shape are computed.
        """
        item, kept = self.objects[object_index], self._transports

        def traced(key: int | tuple[int, int], mesh: Mesh) -> FrozenTransport:
            if key not in kept or not kept[key].is_near(mesh.vertices):
                kept[key] = FrozenTransport(mesh, self.settings, item.albedo_scale, self.basis)
            return kept[key]

        # The light paths of the unmoved mesh are traced once.
        unmoved = traced(object_index, item.mesh)
        if unmoved.is_near(positions):
            return unmoved
        return traced((example, object_index), replace(item.mesh, vertices=positions))

    def _rasterized(self, group: Group, settings: ImageSettings) -> tuple[Fragments, Tensor]:
        """Find the samples that the cameras of a group see, and their albedo (S, 3)."""
        cameras = tuple(camera.fixed() for camera in group.cameras)
        if group.changed.vertices is None:
            return self.view(group.object, *cameras)
        return self._rasterize(group.object, cameras, group.changed.vertices, settings)

    def _rasterize(
        self,
        object_index: int,
        cameras: Sequence[Camera],
        vertices: Float[Tensor, "V 3"],
        settings: ImageSettings,
    ) -> tuple[Fragments, Tensor]:
        """Find the samples that show an object with given vertices, and their albedo (S, 3)."""
        item = self.objects[object_index]
        shown = (vertices, item.mesh.faces, cameras, settings, self.rasterizer)
        # A large change of the shape can turn faces toward the camera that were seen from behind.
        is_closed = item.mesh.closed and _moved(item.mesh, vertices).closed
        [fragments] = build_fragments(*shown, is_closed, at_once=len(cameras))
        fragments = fragments.to(self.like.device)
        albedo = surface_albedo(item.mesh, fragments, settings.encoding)
        return fragments, (albedo * item.albedo_scale).to(self.like)


def _moved(mesh: Mesh, vertices: Float[Tensor, "V 3"] | None) -> Mesh:
    """Return a mesh with other vertices, if they are given."""
    if vertices is None:
        return mesh
    return replace(mesh, vertices=vertices.detach().cpu().double().numpy())
