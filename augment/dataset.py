"""Labeled renders one after another, such as for a data set on disk.

Renders are made in blocks of `BLOCK`, each with random numbers of its own. The render with an index
is therefore the same whichever others are made, in one process or in several.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from augment.attacks.objective import Values
from augment.attacks.problem import SceneProblem, source_labels
from augment.augmentation_settings import AugmentationSettings
from augment.classifier import TaskNetwork
from augment.progress import Phases
from augment.random_streams import generator
from augment.scene.build import MeshItem, build_scene, warn_of_exposure
from augment.scene.objects import SceneObject
from augment.scene.render import KEPT_SAMPLES
from augment.scene.scene import Scene
from augment.scene.truth import NO_OBJECT
from augment.service import AugmentationService
from renderer.camera import Camera
from renderer.errors import InputError, require_kind, require_whole
from renderer.image import to_bytes
from renderer.settings import Size, height_and_width

# Renders with consecutive indices are drawn together. Larger blocks would render more than
# is asked for, smaller ones would prepare scenes more often.
BLOCK = 32
# Passes in which a perspective camera is fitted to several objects.
FITTING_STEPS = 8
# Labels of objects without a class.
NAMELESS = ("", NO_OBJECT)


@dataclass(frozen=True)
class LabeledRender:
    """A render with the truth about it.

    Attributes:
        index: Index of the render in its data set.
        image: Image of 8 bits, uint8, shape (3, H, W).
        labels: Class of each of n visible objects, as `meshes` gives it.
        boxes: Left, top, right and bottom of their masks in pixels, float32,
            shape (n, 4). 0 for an object that covers half of no pixel.
        masks: Pixels of which each covers half or more, bool, shape (n, H, W).
        visible: Fraction of each object that nothing hides, shape (n,).
        depth: Distance from the camera along the viewing direction in world
            units, at the nearest sample of each pixel. 0 in pixels of which less
            than half is covered. Float32, shape (H, W). None without maps.
        normals: Unit normals there, along the axes right, up and back of the
            camera, and 0 in the same pixels. Float32, shape (3, H, W). None
            without maps.
        camera: Camera as numbers: "pose" (4 × 4, from the camera's axes right, up
            and back to the world), and "fx", "fy", "cx", "cy" in pixels, or
            "width" of an orthographic image in world units. `vary.rotation`
            turns the object in the world, which is not stored.
        light: RGB coefficients of the light, times the exposure, shape (K, 3).
        mesh: Name of the mesh, or of the first of several.
    """

    index: int
    image: UInt8[Tensor, "3 H W"]
    labels: Sequence[str | int]
    boxes: Float[Tensor, "n 4"]
    masks: Bool[Tensor, "n H W"]
    visible: Float[Tensor, " n"]
    depth: Float[Tensor, "H W"] | None
    normals: Float[Tensor, "3 H W"] | None
    camera: Mapping[str, Any]
    light: Float[Tensor, "K 3"]
    mesh: str


def render_dataset(
    meshes: Sequence[MeshItem | Sequence[MeshItem]],
    size: Size,
    count: int,
    *,
    first: int = 0,
    skip: Collection[int] = (),
    seed: int = 0,
    settings: AugmentationSettings | None = None,
    network: TaskNetwork | None = None,
    maps: bool = True,
    **of_scene: Any,
) -> Iterator[LabeledRender]:
    """Render labeled images one after another.

    The renders show the entries of `meshes` in turn. The pairs of a view and a
    background of each entry come in random order, and all before one comes
    again. `width` of the scene is that of the shorter side, at all objects of an
    entry, which together span [-1, 1]. What else differs is drawn at random, as
    `settings.vary` and `settings.random_light` say. A render with an index is the
    same whatever `first` and `count` are, so that several processes can share
    the work.

    Args:
        meshes: Entries of `build_scene`: pairs of a mesh and its class, or lists
            of them for several objects on the same ground.
        size: Pixels per side of the images, or (height, width).
        count: Number of renders.
        first: Index of the first render.
        skip: Indices of renders that are not needed.
        seed: Seed of all random draws.
        settings: What is drawn at random. None for random light only.
        network: Network for whose mistakes each render is attacked, as
            `nb.load_classifier` returns it. None for random light.
        maps: Whether depth and normals are computed.
        of_scene: Further arguments of `build_scene`, such as light, backgrounds
            and views.

    Yields:
        The renders with the indices `first` to `first + count - 1` that are not
        in `skip`.

    Raises:
        InputError: If an argument has the wrong type or range, or if
            `build_scene` refuses one.

    Example:
        >>> import norm_balls as nb
        >>> meshes = [("solid:orange", "orange"), ("solid:apple", "apple")]
        >>> for render in nb.render_dataset(meshes, size=32, count=2, fov=30.0):
        ...     print(render.labels, render.image.shape, render.boxes.shape)
        ['orange'] torch.Size([3, 32, 32]) torch.Size([1, 4])
        ['apple'] torch.Size([3, 32, 32]) torch.Size([1, 4])
    """
    for name, value in {"count": count, "first": first, "seed": seed}.items():
        require_whole(name, value)
    require_kind("network", network, TaskNetwork | None, "nb.load_classifier(...) or None")
    mode = "random" if network is None else "adversarial"
    settings = AugmentationSettings.or_default("settings", settings, mode=mode)
    if settings.mode != mode:
        missing = "gets none" if network is None else "gets one"
        raise InputError(f"mode={settings.mode} does not fit a data set that {missing}: set {mode}")
    scene = build_scene(meshes, size, attack=settings.attack, vary=settings.vary, **of_scene)
    # Cameras that the user gives stay as they are.
    if "cameras" not in of_scene:
        examples = []
        for example in scene.examples:
            item = scene.objects[example.object]
            cameras = tuple(_show_all(camera, item, size) for camera in example.cameras)
            examples.append(replace(example, cameras=cameras))
        scene = scene.changed(examples=examples)
    skipped = frozenset(skip)
    indices = [index for index in range(first, first + count) if index not in skipped]
    settings = replace(settings, examples=BLOCK)
    return _render_blocks(scene, settings, network, indices, seed, maps)


def _render_blocks(
    scene: Scene,
    settings: AugmentationSettings,
    network: TaskNetwork | None,
    indices: Sequence[int],
    seed: int,
    maps: bool,
) -> Iterator[LabeledRender]:
    """Yield renders with ascending indices, one block after another."""
    # Without a network, nothing asks for the classes.
    of_network: Any = {} if network is None else {"task": network.task, "classes": network.classes}
    # The examples of the scene are sorted by object, view and background.
    of_objects = torch.arange(len(scene)).view(len(scene.objects), -1)
    # In random order, so that each part of a data set shows all sides of the objects.
    order = torch.randperm(of_objects.shape[1], generator=generator(seed, "order"))
    in_turn = of_objects[:, order].T.flatten().tolist()
    for block, members in groupby(indices, lambda index: index // BLOCK):
        # The whole block is prepared even if few of its renders are needed, so that the random
        # numbers of a render do not depend on the others.
        every = range(block * BLOCK, (block + 1) * BLOCK)
        chosen = [in_turn[index % len(scene)] for index in every]
        examples = [scene.examples[example] for example in chosen]
        views = {(example.object, example.cameras) for example in examples}
        # A transfer operator pays if it renders about four lights.
        one_light = network is None and not scene.needs_rays and 4 * len(views) > BLOCK
        shown = scene.changed(
            examples=examples, lights=scene.lights[chosen], one_light=one_light or scene.one_light
        )
        labels = torch.zeros(BLOCK, dtype=torch.int64, device=scene.lights.device)
        if network is not None:
            labels = source_labels(shown, labels.device, network)[:, 0]
        of_service = settings, shown, labels, seed, Phases(labels.device)
        service = AugmentationService(*of_service, **of_network)
        problem = service.problem(block)
        values = service.values(network, problem, block)
        if block == indices[0] // BLOCK:
            warn_of_exposure(problem.scene)
        # Positions of the needed renders in the block.
        rows = torch.tensor([index - every.start for index in members], device=values.device)
        yield from _renders(problem, values, rows, every.start, maps)


def _show_all(camera: Camera, item: SceneObject, size: Size) -> Camera:
    """Widen a camera such that the shorter side of images shows all objects of an entry."""
    height, width = height_and_width(size)
    aspect = max(1.0, width / height)
    # Vertices of all objects, without the table, and half of their largest extent.
    points = item.mesh.vertices[np.unique(item.mesh.faces[: item.ends[-1]])]
    span = float(np.ptp(points, axis=0).max()) / 2 if item.others else 1.0
    camera = camera.widened(aspect).widened(span)
    if not item.others:
        return camera
    # Near objects are larger in perspective, and a camera that moves sees them at other places.
    for _ in range(FITTING_STEPS if camera.has_perspective else 1):
        # Positions in the image in units of half its width. Shift the camera to their center, by
        # less if near objects then move by more.
        seen = camera.project(points)[:, :2]
        depths = camera.depths(points)
        nearest = 1.0 if depths is None else min(1.0, depths.min() / camera.distance)
        right, up = ((seen.min(0) + seen.max(0)) / 4 * camera.width * nearest).tolist()
        camera = replace(camera, right=camera.right - right, up=camera.up - up)
        camera = camera.widened(max(1.0, float((np.ptp(seen, axis=0) * [1, aspect]).max()) / 2))
    return camera


def _renders(
    problem: SceneProblem, values: Values, rows: Int[Tensor, " A"], start: int, maps: bool
) -> Iterator[LabeledRender]:
    """Yield the renders of some examples of a problem, with indices from `start`."""
    scene = problem.scene
    labels_of_scene = (label for item in scene.objects for label in item.labels)
    names = [*dict.fromkeys(label for label in labels_of_scene if label not in NAMELESS)]

    def index_of(label: str | int) -> int:
        return NO_OBJECT if label in NAMELESS else names.index(label)

    # So many at once that image, truth and maps are of the same rasterized views.
    kept = KEPT_SAMPLES // (scene.settings.pixel_count * scene.settings.samples**2)
    for some in rows.split(max(1, kept)):
        conditions = problem.conditions(values[some], some)
        # With operators, the last bits of an image depend on which others are rendered with it.
        parts = some.split(len(some) if scene.one_light else 1)
        images = torch.cat([to_bytes(problem.images(values, part)[:, 0]) for part in parts]).cpu()
        lights = scene.exposed(conditions.light, some).cpu()
        truths = scene.truth(index_of, some, conditions).map(Tensor.cpu)
        maps_of = scene.surface_maps(conditions, some)[:, 0] if maps else None
        for row, example in enumerate(some.tolist()):
            # Labels, boxes, masks and visible fractions in the one view of the example.
            truth = [part[row, 0] for part in vars(truths).values()]
            classes, boxes, masks, visible = (part[truth[0] != NO_OBJECT] for part in truth)
            [camera] = scene.cameras_under(conditions, row, example)
            facts = describe_camera(camera.fixed(), scene.settings.shape)
            labels = [names[index] for index in classes.tolist()]
            depth = None if maps_of is None else maps_of[row, 0]
            normals = None if maps_of is None else maps_of[row, 1:]
            seen = labels, boxes, masks, visible, depth, normals
            name = scene.objects[scene.examples[example].object].name
            yield LabeledRender(start + example, images[row], *seen, facts, lights[row], name)


def describe_camera(camera: Camera, shape: tuple[int, int]) -> dict[str, Any]:
    """Describe a camera by its pose and its intrinsics in pixels, see `LabeledRender`."""
    facts: dict[str, Any] = {"pose": camera.pose().tolist()}
    if not camera.has_perspective:
        return facts | {"width": camera.width}
    height, width = shape
    # Focal length in pixels: at `distance`, the camera sees `camera.width` across.
    focal = width * camera.distance / camera.width
    center_x = width / 2 * (1 + camera.principal_right)
    center_y = height / 2 - width / 2 * camera.principal_up
    return facts | {"fx": focal, "fy": focal * camera.pixel_aspect, "cx": center_x, "cy": center_y}
