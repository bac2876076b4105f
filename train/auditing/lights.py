"""Test a network on renders in many kinds of lighting, and attack the lighting.

All classifiers of an audit see the same objects from the same cameras, in images
of the size that each classifier takes. No lighting has negative radiance in any
direction.

Of a detector or a segmenter, only the class of the meshes counts. On renders of hard negatives,
each of its detections or pixels is false.
"""

import base64
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from augment import attack_settings
from augment.attack_settings import AttackSettings
from augment.attacks.attack import EXPOSURES, attack
from augment.attacks.checks import success_by_radius, transfer
from augment.attacks.result import AttackResult
from augment.augmentation_settings import VariationSettings
from augment.classifier import TaskNetwork
from augment.network import compute_outputs, device_of
from augment.progress import progress
from augment.random_streams import generator
from augment.scene.build import build_lights, reached_gloss
from augment.scene.objects import Conditions, SceneObject
from augment.scene.scene import Scene
from augment.scene.truth import NO_OBJECT, Truth
from augment.scene.vary import vary
from augment.settings import SceneSettings
from augment.tasks.detection import Detection
from augment.tasks.task import Criterion
from renderer.camera import orbit_cameras
from renderer.errors import MAX_SCALE
from renderer.image import to_bytes, to_unit
from renderer.io.files import write_numbers
from renderer.io.images import encode_image
from renderer.light.basis import HARMONICS
from renderer.light.files import UNIFORM, load_light, perturb
from renderer.rendering import light_sphere
from renderer.settings import ImageSettings, Size, height_and_width
from renderer.visibility import choose
from train.data.annotations import LETTERBOX, Annotations
from train.results import annotated_scores, detections
from train.results.detections import Found, Marked, Matches
from train.results.intervals import Units
from train.results.pictures import evenly_spaced

# Result file: in which environment lights a network recognizes each view.
RECOGNIZED = "recognized.json"
# Result file: the ordinary light in which the audited network recognizes most views.
PLAIN = "plain_light.json"
# End of the name of the result file of an attack whose smaller radii are not measured yet.
FIRST = "_first.json"
# Result file: how often attacks on a network also fool the other network.
TRANSFER = "transfer.json"
# Result file: metrics in each group of lights, and recall against false detections per image.
DETECTED = "detections.json"
# Folder of the scores on photographs with boxes.
BOXED = "photographs_with_boxes"
# Number of points of the curve of recall against false detections.
CURVE_POINTS = 50
# End of the key of a network whose images are normalized before they are classified.
NORMALIZED = "_normalized_light"
# Number of images that a classifier classifies in one pass.
BATCH = 16
# Name of the environment lighting in which the views are rendered before an attack.
LIGHT = "grace"
# A random light is LIGHT plus a uniform random number in [-0.5, 0.5] in each
# spherical-harmonics coefficient, as in the paper's training with random lighting.
AMPLITUDE = 0.5
# The names of random lights are "random 1", "random 2" and so on.
RANDOM = "random "
# The camera is 2.6 world units from the origin. Its polar angle, azimuth and field of view are in
# degrees.
CAMERA = orbit_cameras(1, 2.6, 60, 45, 40)
# Ranges of the random changes to the azimuth of the camera and to the rotation of the
# object in degrees, and range of the random factor of its size.
VARIATION = VariationSettings(azimuth=25, rotation=60, scale=[0.85, 1.15])
# Number of steps of a gradient attack at each radius. As many random draws are tried
# for comparison.
STEPS = 10
# A classifier without gradients is attacked by a random search with this many forward
# passes at each radius. As many random draws are tried for comparison.
QUERIES = 100
# Number of steps of an attack that does not end at its first success.
ADDITIONAL_STEPS = 20
# An attack within a ball takes steps of a quarter of the radius.
STEPS_PER_RADIUS = 4
# The background of the views is medium gray, in sRGB.
BACKGROUND = 0.5

# The objects are scaled by each of these factors.
SIZES = (1.0, 0.75, 1.2)
# The search ends as soon as this fraction of the views is recognized.
ENOUGH = 0.75
# Number of positions of the slider, from the natural to the attacked light.
FRAME_COUNT = 21
# Number of classes whose probabilities are shown beside the slider.
CLASS_COUNT = 5
# Height of the image of the object, in pixels.
SIDE = 200
# Width and height of the image of a white ball, which shows the light, in pixels.
BALL_SIDE = 120


# Environment lights by name.
Lights = Mapping[str, Float[Tensor, "C K"]]


class LightKind(NamedTuple):
    """Kind of lighting, and the norm-balls in which an attack changes it.

    Attributes:
        title: Name of the lighting in the report.
        unit: Unit of the radii in the report.
        radii: Radii of the L∞ norm-balls, in ascending order.
    """

    title: str
    unit: str
    radii: tuple[float, ...]


# The kinds of lighting that an audit attacks. A key is also the name of the parameter
# of the attack and of the file with its results.
KINDS = {
    "lighting": LightKind(
        "light from all around", "change of each coefficient", (0.02, 0.05, 0.1, 0.3)
    ),
    "skylight": LightKind(
        "a daylight sky", "1 is 57.3° of the sun, or 4 of turbidity", (0.1, 0.3, 1.0, 3.0)
    ),
    "projector": LightKind(
        "a projector", "fraction of its power, in each pixel", (0.03, 0.1, 0.3, 1.0)
    ),
    "lamps": LightKind("four lamps", "change of the power in each channel", (0.3, 1.0, 3.0, 10.0)),
}


@dataclass(frozen=True)
class Views:
    """Views of objects in random poses from random cameras.

    The poses and cameras depend only on the seed and on the number of views.

    Attributes:
        objects: Objects. Successive views show successive objects.
        count: Number of views.
        seed: Seed of the poses and the cameras.
        device: Device of the renders.
        light: Name of the environment lighting before an attack.
        exposure: Factor by which this lighting is multiplied.
        size: Factor by which the objects are scaled.
    """

    objects: Sequence[SceneObject]
    count: int
    seed: int
    device: torch.device
    light: str = LIGHT
    exposure: float = 1.0
    size: float = 1.0

    def scene(self, size: Size, kind: str = "lighting") -> Scene:
        """Build a scene with one example for each view."""
        # The views show the objects in turn.
        objects = [self.objects[index % len(self.objects)] for index in range(self.count)]
        of_scene = SceneSettings(exposure=self.exposure).with_lights([kind])
        basis, lights = build_lights(of_scene, load_light(self.light))
        # A gray background, shape (1, 1, H, W).
        background = torch.full((1, 1, *height_and_width(size)), BACKGROUND)
        settings = ImageSettings(size, samples=2, encoding="srgb", normals="smooth")
        shown = objects, CAMERA, background, lights.to(self.device), settings, choose("auto")
        scene = Scene.grid(*shown, shared=False, basis=basis)
        variation = replace(VARIATION, scale=[self.size * scale for scale in VARIATION.scale])
        return vary(scene, variation, generator(self.seed, "views"))


def environment_lights(views: Views, environments: Sequence[str], random_count: int) -> Lights:
    """Return the environment lights of an audit by name, at the exposure of the views."""
    noise = generator(views.seed, "lights")
    center = load_light(LIGHT)
    random_lights = perturb(center, random_count, AMPLITUDE, radius=None, generator=noise)
    roughness = reached_gloss(views.objects).gloss_roughness
    lights = {Path(name).stem: load_light(name, roughness=roughness) for name in environments}
    for number, light in enumerate(HARMONICS.project_nonnegative(random_lights), 1):
        lights[f"{RANDOM}{number}"] = light
    return {name: views.exposure * light.to(views.device) for name, light in lights.items()}


def recognize_in_environments(
    classifier: TaskNetwork, views: Views, lights: Lights
) -> dict[str, list[bool]]:
    """Test whether a classifier recognizes views in several environment lights."""
    scene = views.scene(classifier.size)
    criterion = criterion_of(classifier, scene, classifier.label(scene.labels[0]))
    return {
        name: is_found(classifier, criterion, render_in(scene, light)).tolist()
        for name, light in progress(lights.items(), "renders in other light")
    }


@torch.no_grad()
def render_in(scene: Scene, light: Float[Tensor, "C K"]) -> Float[Tensor, "E 1 3 H W"]:
    """Render all examples of a scene in the same light."""
    examples = torch.arange(len(scene), device=light.device)
    return scene.render(Conditions(light.expand(len(scene), -1, -1)), examples)


def plain_images(views: Views, size: Size) -> Float[Tensor, "E 3 H W"]:
    """Render all views before an attack, in the only light in which they are shown."""
    scene = views.scene(size).changed(one_light=True)
    return render_in(scene, scene.lights[0])[:, 0]


def criterion_of(network: TaskNetwork, scene: Scene, label: int) -> Criterion:
    """Return the criterion of an attack on a scene, all of whose views show the same class."""
    source = torch.full((len(scene), scene.views), label, device=scene.lights.device)
    return network.task.criterion(source, partial(scene.truth, network.label), len(network.classes))


def is_found(
    network: TaskNetwork, criterion: Criterion, images: Float[Tensor, "E 1 3 H W"]
) -> Bool[Tensor, " E"]:
    """Test in which images a network finds the true class, such as a detection of the object."""
    of_images = criterion.map(lambda rows: rows[:, 0])
    outputs = compute_outputs(network, images[:, 0], BATCH)
    return of_images.predicted(of_images.evidence(outputs)) == of_images.source


def adversaries(
    classifier: TaskNetwork, views: Views, kind: str, additional: bool = False
) -> AttackResult:
    """Attack a classifier by one kind of lighting, within the largest radius of this kind.

    Each step changes all values of the lighting by a quarter of the radius, in the direction of the
    sign of the gradient. A classifier without gradients is attacked by a random search with QUERIES
    forward passes. `additional` always takes ADDITIONAL_STEPS steps. Otherwise the attack stops
    when the prediction is wrong even with the noise of a camera.
    """
    # An attack stops when the wrong class leads by the margin in every view. With this margin,
    # which no attack can reach, it takes all steps.
    further = {"max_steps": ADDITIONAL_STEPS, "margin": MAX_SCALE}
    first = {"max_steps": STEPS, "margin": 0.0, "noise_margin": attack_settings.NOISE_MARGIN}
    options: dict[str, Any] = further if additional else first
    radius = KINDS[kind].radii[-1]
    ball = attack_settings.SkylightSettings if kind == "skylight" else attack_settings.StepSettings
    options[kind] = ball("linf", radius, "sign", radius / STEPS_PER_RADIUS)
    scene = views.scene(classifier.size, kind)
    # The attack uses the operators again that this builds.
    if not classifier.is_differentiable(lambda: render_in(scene, scene.lights[0])[:, 0]):
        options |= {"optimizer": attack_settings.RANDOM_SEARCH, "max_queries": QUERIES}
    settings = AttackSettings(**options, batch_size=BATCH)
    return attack(classifier, scene, settings=settings, seed=views.seed, force=True)


def success_by_light(
    classifier: TaskNetwork, views: Views, kind: str, out: Path
) -> Iterator[dict[str, Any]]:
    """Attack one kind of lighting, and count the misclassified views for each radius.

    Yield the counts of one attack within the largest radius, which take a fifth of the time, and
    then those of all radii. The images in the attacked lighting of the largest radius are written
    to out/KIND.npy. "adversarial" and "random" of the result count, for each radius, the "correct"
    of "n" views that become wrong even with the noise of a camera. "predicted", "confidence" and
    "slider" are missing if no attack succeeds.
    """
    result = adversaries(classifier, views, kind)
    radii = KINDS[kind].radii
    clean = result.clean_correct
    successes = {"": result.success, "_without_noise": result.success_without_noise}
    counts: dict[str, Any] = {"n": views.count, "correct": int(clean.sum())}
    for suffix, success in successes.items():
        counts |= {f"adversarial{suffix}": [int(success[clean].sum())], f"random{suffix}": []}
    is_wrong = clean & result.success
    write_numbers(out / f"{kind}.npy", to_bytes(result.images_in_views.cpu()).numpy())
    if is_wrong.any():
        # The first view that is lost is shown before and after the attack.
        example = int(is_wrong.nonzero()[0])
        evidence = (result.evidence_in_views_before, result.evidence_in_views)
        both_evidence = torch.cat([part[example] for part in evidence])
        # The same example stands for both rows of the evidence.
        criterion = result.criterion.map(lambda rows: rows[[example, example], 0])
        predicted = criterion.predicted(both_evidence)
        counts |= classifier.task.found(both_evidence, predicted, classifier.classes)
        counts["slider"] = frames_of(result, example)
    yield counts
    by_radius = success_by_radius(result, [radius / radii[-1] for radius in radii])
    for suffix, success in successes.items():
        adversarial, random = f"adversarial{suffix}", f"random{suffix}"
        # There are two attacks for the largest radius. The attack in `by_radius` starts
        # where the attack within the next smaller radius ended. The attack in `result`
        # starts at the natural light. Either may succeed.
        by_radius[-1][adversarial] |= success[clean].cpu()
        counts[adversarial] = [int((row[adversarial] | row[random]).sum()) for row in by_radius]
        counts[random] = [int(row[random].sum()) for row in by_radius]
    yield counts


def transfer_success(first: TaskNetwork, other: TaskNetwork, views: Views) -> dict[str, list[int]]:
    """Test whether lighting that fools one classifier also fools another classifier.

    The attacks continue after their success. The views are rendered again at the image size of the
    other classifier. A view is tested if its attacked lighting fools the first classifier, and if
    the other classifier recognizes it before the attack. The three numbers for each kind of
    lighting are tested views that are misclassified even with the noise of a camera, tested views,
    and tested views that are misclassified without noise.
    """
    counts = {}
    for kind in progress(KINDS, "transfer"):
        (row,) = transfer(adversaries(first, views, kind, additional=True), [other])
        # Without a success, there is no lighting to test, and all masks are empty.
        is_tested = np.array(row["clean_correct"], bool)
        masks = (row["success"], is_tested, row["success_without_noise"])
        counts[kind] = (is_tested & np.array(masks, bool)).sum(axis=1).tolist()
    return counts


def frames_of(result: AttackResult, example: int) -> dict[str, Any]:
    """Render an example in lights between the start and the end of an attack.

    Frame i of n has the light start + i / (n - 1) · (end - start). If the attack may use two
    lights, it may use all lights between them, too. "classes" are the right class and the
    CLASS_COUNT - 1 most probable others. Each of "frames" has "image", "ball" (a white ball in the
    same light), both JPEG in base64, "probabilities" of these classes, and "predicted".
    """
    start, end = result.problem.start[example], result.minimum.values[example]
    # Shape (FRAME_COUNT, D), from the start to the end of the attack.
    values = start + torch.linspace(0, 1, FRAME_COUNT).to(start)[:, None] * (end - start)
    # All frames are of the same example.
    examples = torch.full((FRAME_COUNT,), example, device=start.device)
    with torch.no_grad():
        images = result.problem.render(values, examples)
        conditions = result.problem.conditions(values, examples)
        evidence = result.objective().select(examples).evidence(images)[:, 0]
    probabilities = result.classifier.task.confidences(evidence).cpu()
    criterion = result.criterion.map(lambda rows: rows[[example] * FRAME_COUNT, 0])
    predicted = criterion.predicted(evidence)
    classes = result.classifier.classes
    predictions = result.classifier.task.found(evidence, predicted, classes)["predicted"]
    label = int(result.criterion.source[example, 0])
    # Classes by their highest probability in any frame.
    ranked = probabilities.amax(dim=0).argsort(descending=True).tolist()
    shown_classes = [label, *(index for index in ranked if index != label)][:CLASS_COUNT]
    frames = []
    for index in range(FRAME_COUNT):
        basis = result.problem.scene.basis_under(conditions, index)
        ball = light_sphere(conditions.light[index], BALL_SIDE, basis=basis)
        shown = [round(value, 4) for value in probabilities[index, shown_classes].tolist()]
        image = _encode_jpeg(result.drawn(images[index, 0]), SIDE)
        frame = {"image": image, "ball": _encode_jpeg(ball, BALL_SIDE), "probabilities": shown}
        frames.append(frame | {"predicted": predictions[index]})
    names = [classes[index] for index in shown_classes]
    return {"classes": names, "label": names[0], "frames": frames}


def _encode_jpeg(image: Float[Tensor, "3 H W"], height: int) -> str:
    """Resize an image in [0, 1] to a height, and encode it as a JPEG file in base64."""
    picture = Image.fromarray(to_bytes(image.clamp(0, 1).cpu()).permute(1, 2, 0).numpy())
    width = round(height * picture.width / picture.height)
    content = encode_image(picture.resize((width, height)), "JPEG", quality=85)
    return base64.b64encode(content).decode()


@dataclass(frozen=True)
class PlainViews:
    """Lighting and size at which a classifier recognizes most views in plain light.

    Attributes:
        light: Name of the environment lighting.
        exposure: Factor by which this lighting is multiplied.
        size: Factor by which the objects are scaled.
        recognized: Number of views that are classified correctly.
        n: Number of views.
        recognized_as_given: Number of views that are classified correctly
            before the search, with an exposure and a size of 1.
    """

    light: str
    exposure: float
    size: float
    recognized: int
    n: int
    recognized_as_given: int


def find_plain_views(classifier: TaskNetwork, views: Views) -> PlainViews:
    """Find the plain light, exposure and size at which a classifier recognizes most views.

    All combinations are tried, until one is found at which the classifier recognizes a fraction of
    ENOUGH. If no view is ever recognized, the first combination is returned.
    """
    tried: list[PlainViews] = []
    for size in progress(SIZES, "search for plain light"):
        scene = replace(views, size=size).scene(classifier.size)
        criterion = criterion_of(classifier, scene, classifier.label(scene.labels[0]))
        for exposure, name in product(EXPOSURES, (LIGHT, UNIFORM)):
            images = render_in(scene, load_light(name).to(scene.lights) * exposure)
            recognized = int(is_found(classifier, criterion, images).sum())
            # The first combination is the light as it is given, before any search.
            as_given = tried[0].recognized if tried else recognized
            tried.append(PlainViews(name, exposure, size, recognized, views.count, as_given))
            if recognized >= ENOUGH * views.count:
                return tried[-1]
    return max(tried, key=lambda item: item.recognized)


def _find(
    network: TaskNetwork, label: int, images: Float[Tensor, "E 1 3 H W"], truth: Truth | None
) -> list[tuple[Any, Any]]:
    """Return a pair for each render: what is found, and the truth. None stands for no object."""
    pairs: list[tuple[Any, Any]] = []
    for row, output in enumerate(compute_outputs(network, images[:, 0], BATCH)):
        # The mask of the class in a segmentation, and the true mask: 1 on the object, otherwise 0.
        if not isinstance(network.task, Detection):
            shown = (output.argmax(0) == label).long()
            mask = torch.zeros_like(shown) if truth is None else truth.masks[row, 0, 0].long()
            pairs.append((shown.cpu().numpy(), mask.cpu().numpy()))
            continue
        # The detections, and the true boxes of the view.
        arrays = [output[name].cpu().numpy() for name in ("boxes", "labels", "scores")]
        boxes, labels = np.zeros((0, 4)), np.zeros(0, int)
        if truth is not None:
            is_marked = truth.labels[row, 0] != NO_OBJECT
            boxes = truth.boxes[row, 0][is_marked].cpu().double().numpy()
            labels = truth.labels[row, 0][is_marked].cpu().numpy()
        pairs.append((Found(*arrays), Marked(boxes, labels, np.zeros(len(labels), bool))))
    return pairs


def find_in_lights(
    network: TaskNetwork,
    views: Views,
    attacked_views: Views,
    negatives: Views,
    unusual: Lights,
    out: Path,
) -> dict[str, Any]:
    """Score a network in plain and unusual light, after its attacks have been written to `out`."""
    label = network.label(views.objects[0].label)
    # Pairs of what is found and the truth, with the number of their view, by the title of a group.
    groups: defaultdict[str, list[tuple[int, tuple[Any, Any]]]] = defaultdict(list)
    plain = load_light(views.light).to(views.device) * views.exposure
    # The hard negatives have no truth: all that is found in them is false.
    for shown, title in ((views, ""), (negatives, "hard negatives, ")):
        scene = shown.scene(network.size)
        truth = None if title else scene.truth(network.label)
        # Views of hard negatives are other units than those of the class.
        first = views.count if title else 0
        for name, light in progress({"": plain, **unusual}.items(), "objects in other light"):
            pairs = _find(network, label, render_in(scene, light), truth)
            group = "random light" if name.startswith(RANDOM) else "environments"
            groups[group if name else "plain light"] += enumerate(pairs, first)
    truth = attacked_views.scene(network.size).truth(network.label)
    for kind, light_kind in KINDS.items():
        images = to_unit(torch.from_numpy(np.load(out / f"{kind}.npy"))).to(views.device)
        groups[f"attacked: {light_kind.title}"] += enumerate(_find(network, label, images, truth))
    task = network.task
    metrics: dict[str, Any] = {}
    for title, numbered in groups.items():
        # Lights of the same view are no independent units, so the interval is over the views.
        units = Units([np.array([unit for unit, _ in numbered])], "views")
        pairs = [pair for _, pair in numbered]
        if isinstance(task, Detection):
            at_iou, at_half = (_match(pairs, iou) for iou in (task.iou, 0.5))
            measured = at_iou, [label], task.threshold, at_half, units
            metrics[title] = asdict(detections.score(*measured))
        else:
            miou, _ = detections.mean_iou(pairs, 2, units)
            metrics[title] = {"n": len(pairs), "miou": asdict(miou)}
    # Only detections have scores, and so a curve of recall against false detections.
    if not isinstance(task, Detection):
        return {"metrics": metrics, "curve": []}
    not_attacked = ("plain light", "environments", "random light")
    every = [pair for title in not_attacked for _, pair in groups[title]]
    return {"metrics": metrics, "curve": _curve(_match(every, task.iou).of([label]))}


def _match(pairs: Sequence[tuple[Found, Marked]], iou: float) -> Matches:
    """Return the matches of detections and true boxes in all views."""
    return detections.join([detections.match_image(*pair, iou) for pair in pairs])


def _curve(matches: Matches) -> list[tuple[float, ...]]:
    """Return false detections per image and recall at descending thresholds."""
    every = np.ones((1, matches.image_count))
    thresholds = np.unique(matches.detections.score)[::-1]
    measures = (matches.false_per_image, matches.recall)
    # CURVE_POINTS thresholds are enough for the plot.
    return [
        tuple(float(measure(threshold, every)[0]) for measure in measures)
        for threshold in evenly_spaced(thresholds.tolist(), CURVE_POINTS)
    ]


def score_photographs(network: TaskNetwork, annotations: Annotations, out: Path) -> None:
    """Score a detector on photographs with boxes. Unreadable ones are left out."""
    how = annotated_scores.Showing(LETTERBOX, skip_unreadable=True, device=device_of(network))
    annotated_scores.write(annotated_scores.evaluate_detector(network, annotations, None, how), out)
