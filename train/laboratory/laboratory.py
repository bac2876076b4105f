"""Render the path-traced test set of pnb-lab, and write it as a folder of photographs.

After a training, such a test set shows the same classes as the training, but other objects in other
lighting.

A shot is the lighting, the camera and the pose of each render, which are drawn at random. A mesh is
normalized to [-1, 1]³ and then scaled. These are the world units. It stands on the table z = 0,
above the origin. Azimuths and elevations are in degrees. Radiance and albedo are linear RGB. At an
exposure of 1, a radiance of 1 is white in the image.
"""

import json
import math
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from augment.network import say_once
from augment.progress import progress
from augment.random_streams import stream_seed
from augment.scene.objects import load_object
from augment.scene.patterns import LAB_RESOLUTION, draw_lab_color, draw_lab_pattern
from renderer.errors import InputError
from renderer.image import decode, encode
from renderer.io.images import read_image, write_image
from renderer.io.mitsuba_entries import environment, look_at, projector, sensor
from renderer.light.basis import HARMONICS
from renderer.light.environment import read_panorama, to_map
from renderer.light.files import PROBES, load_light
from renderer.light.harmonics import equirectangular
from renderer.mesh import Mesh
from renderer.mitsuba_scene import Part, load, mitsuba, shape, split_parts
from renderer.settings import Size
from renderer.solids import HARD_NEGATIVES, SOLIDS
from train import settings as common
from train.command_settings import OTHER_PATTERNS, LabSettings
from train.data.photo import DESCRIPTION, TABLE
from train.results.tables import write_csv
from train.run_folder import LOCK, read_json, sole_writer, writable_folder, write_json
from train.settings import OTHER_PREFIX, ExperimentSettings, label_names, simplified

# Glob pattern of the renders in the folder of the test set. Their paths are
# LABEL/NUMBER_LIGHTING.png.
RENDERS = "*/[0-9][0-9][0-9][0-9]*_*.png"
# Columns of photos.csv, the table of all renders.
COLUMNS = ("path", "source_tag", "setup", "mesh", "brightness")
# Another version of one of these packages may render other pixels. The versions are
# therefore recorded with the renders.
PACKAGES = ("mitsuba", "numpy", "torch")
# A projector lights a square around the object. This is half of its width, in world
# units.
PROJECTOR_HALF_WIDTH = 2.6
# A built-in light is rendered to an environment map with this many rows.
BUILT_IN_MAP_HEIGHT = 64
# The table and the wall are squares. This is half of their width, in world units.
PLANE_HALF_WIDTH = 100.0
# Mitsuba takes seeds from 0 to 2^32 - 1.
SEED_COUNT = 2**32
# The generated solids for testing have the seeds 2001, 2002 and so on. Training uses
# lower seeds, or draws seeds that are far larger.
FIRST_SEED = 2001
# Number of generated solids of each positive class.
POSITIVE_COUNT = 6
# Number of generated solids for each name in NEGATIVES.
NEGATIVE_COUNT = 2
# Solids that a network may confuse with the positive class: fruit, a vegetable and a
# ball. A solid of a positive class is left out.
NEGATIVES = ("lemon", "peach", "ball", "apple", "pear", "sweet_pepper", "orange")
# Horizontal field of view of the camera in degrees.
FOV = 25.0
# Range of the random draw of half of the width that the camera sees at the object, in
# world units.
HALF_WIDTHS = (1.2, 1.9)
# Factor by which the normalized object is scaled: range of the random draw.
SCALES = (0.75, 1)
# The projectors face a point above the origin. Its height is 0.8 times the scale of
# the object.
CENTER_HEIGHT = 0.8
# The camera faces a random point near the object. Each coordinate differs by at most
# this from the point that the projectors face, in world units.
MAX_AIM_OFFSET = 0.25
# Distance of a projector from the point that it faces: range of the random draw, in
# world units.
PROJECTOR_DISTANCES = (5, 8)
# Elevation of the camera above the table: range of the random draw, in degrees.
CAMERA_ELEVATIONS = (18, 60)
# The object is rotated by three random Euler angles, about z, x and z. Each is drawn
# between 0 and its maximum, in degrees.
MAX_EULER_ANGLES = (360, 60, 360)
# The wall stands behind the object. The azimuth of its direction from the object
# differs by at most this from the direction opposite to the camera, in degrees.
MAX_WALL_TURN = 30
# Distance of the wall from the object: range of the random draw, in world units.
WALL_DISTANCES = (1.8, 3.5)
# Radiance of an environment map, linear RGB.
Panorama = Float[np.ndarray, "H W 3"]


class Subject(NamedTuple):
    """A mesh to render.

    Attributes:
        label: Class of the mesh. Its renders are in a folder of this name.
        mesh: File of the mesh, or name of the generated solid.
        parts: Parts of the mesh, split such that each has one texture or none.
    """

    label: str
    mesh: str
    parts: list[Part]


def lab_parts(mesh: Mesh, albedo_scale: float) -> list[Part]:
    """Split a mesh by texture, and convert its colors from sRGB to linear RGB.

    The parts have smooth normals, except at sharp edges. `albedo_scale` multiplies the linear
    colors, which are then limited to [0, 1].
    """

    def scaled(albedo: np.ndarray) -> np.ndarray:
        return np.clip(albedo_scale * albedo, 0, 1).astype(np.float32)

    parts = []
    # A part has one texture, or colors at its vertices.
    for part in split_parts(mesh, mesh.written_normals("smooth"), "srgb"):
        texture = part.texture
        if texture is not None:
            texture = scaled(decode(torch.from_numpy(texture / 255), "srgb").numpy())
        parts.append(replace(part, colors=scaled(part.colors), texture=texture))
    return parts


@dataclass(frozen=True)
class Shot:
    """Lighting, camera, pose and surroundings in which an object is rendered.

    Attributes:
        lighting: Name of the projected patterns, or of the environment map.
        brightness: Radiance of a white surface. With projectors, the surface
            faces all of them and their images are white. In an environment
            map, the surface faces up.
        patterns: Image of each projector, linear RGB, shape (H, W, 3).
        ambient: Radiance of uniform light from all directions, linear RGB,
            shape (3,).
        table: Albedo of the table and of the wall, linear RGB, shape (3,).
        projectors: Position of each projector, shape (3,).
        camera: Position of the camera, shape (3,).
        center: Point that the projectors face, shape (3,).
        aim: Point that the camera faces, shape (3,).
        rotation: Rotation matrix of the object, shape (3, 3).
        scale: Factor by which the normalized object is scaled.
        roughness: Roughness of the surface of the object, in [0, 1].
        wall: Point of the wall that is nearest to `center`, shape (3,). None
            without a wall.
        environment: Radiance of an environment map, linear RGB, shape
            (H, W, 3). Its pixels have the directions of `equirectangular`. It
            replaces the projectors and `ambient`. None with projectors.
    """

    lighting: str
    brightness: float
    patterns: Sequence[np.ndarray]
    ambient: Float[np.ndarray, " 3"]
    table: Float[np.ndarray, " 3"]
    projectors: Sequence[np.ndarray]
    camera: Float[np.ndarray, " 3"]
    center: Float[np.ndarray, " 3"]
    aim: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]
    scale: float
    roughness: float
    wall: Float[np.ndarray, " 3"] | None = None
    environment: Panorama | None = None


def draw_shots(
    settings: LabSettings, environments: Mapping[str, np.ndarray], slides: Sequence[np.ndarray] = ()
) -> Iterator[Shot]:
    """Draw the same number of random shots for each pattern and each environment map.

    The shots of a pattern, or of an environment map, have evenly spread
    logarithms of the brightness. An environment map is rotated about the
    vertical axis by a random angle. `environments` and `slides` are linear RGB.
    """
    dimmest, brightest = settings.brightness
    lightings = [*settings.patterns, *environments]
    shots_per_lighting = settings.setups // len(lightings)
    for lighting, index in product(lightings, range(shots_per_lighting)):
        rng = np.random.default_rng(stream_seed(settings.seed, "shot", lighting, index))
        # For what later versions added: the draws of `rng` stay those of earlier versions.
        extra_rng = np.random.default_rng(stream_seed(settings.seed, "more", lighting, index))
        # The range of log(brightness) is divided into equal intervals, one for each of
        # the shots in a lighting. A shot draws its brightness from its interval.
        position = (index + rng.uniform()) / shots_per_lighting
        brightness = dimmest * (brightest / dimmest) ** position
        pattern = "solid" if lighting in environments else lighting
        first_pattern, *other_patterns = pattern.split("+")
        # The first pattern and its generator, and further projectors with another generator, so
        # that they do not change the other draws of the shot.
        sources = [(first_pattern, rng), *((name, extra_rng) for name in other_patterns)]
        azimuth = rng.uniform(0, 360)
        half_width = rng.uniform(*HALF_WIDTHS)
        scale = rng.uniform(*SCALES)
        center = np.array([0, 0, CENTER_HEIGHT * scale])
        aim = center + rng.uniform(-MAX_AIM_OFFSET, MAX_AIM_OFFSET, 3)
        roughness = _between(settings.roughness, extra_rng)
        patterns = [draw_lab_pattern(name, draws, slides) for name, draws in sources]
        ambient = _between(settings.ambient, rng) * draw_lab_color(rng)
        table = _between(settings.albedo, rng) * draw_lab_color(rng)
        projectors = []
        for _, draws in sources:
            projector_azimuth = azimuth + _between(settings.azimuth, draws)
            elevation = _between(settings.elevation, draws)
            distance = draws.uniform(*PROJECTOR_DISTANCES)
            projectors.append(center + _from_angles(projector_azimuth, elevation, distance))
        # At this distance, the image shows `half_width` to each side of its center.
        camera_distance = half_width / math.tan(math.radians(FOV / 2))
        camera = aim + _from_angles(azimuth, rng.uniform(*CAMERA_ELEVATIONS), camera_distance)
        angles = rng.uniform(0, MAX_EULER_ANGLES)
        rotation = Rotation.from_euler("ZXZ", angles, degrees=True).as_matrix()
        # The wall stands behind the object, as seen from the camera. `to_wall` leads from the
        # center of the object to the nearest point of the wall.
        wall_azimuth = azimuth + 180 + extra_rng.uniform(-MAX_WALL_TURN, MAX_WALL_TURN)
        to_wall = _from_angles(wall_azimuth, 0, extra_rng.uniform(*WALL_DISTANCES))
        wants_wall = extra_rng.uniform() < settings.walls and lighting not in environments
        # `to_wall` is normal to the wall, so its dot product with a vector is larger than
        # its squared length only if the vector ends behind the wall.
        is_behind_wall = [(place - center) @ to_wall >= to_wall @ to_wall for place in projectors]
        # A wall between a projector and the object would block the light.
        wall = center + to_wall if wants_wall and not any(is_behind_wall) else None
        radiance = None
        if lighting in environments:
            radiance = _scale_environment(environments[lighting], brightness, rng)
        shown = patterns, ambient, table, projectors, camera, center, aim, rotation
        yield Shot(lighting, brightness, *shown, scale, roughness, wall, radiance)


def _scale_environment(radiance: Panorama, brightness: float, rng: np.random.Generator) -> Panorama:
    """Rotate an environment map about the vertical axis by a random angle, and scale it.

    `brightness` is the radiance of a white diffuse surface that faces up.
    """
    directions, solid_angles = equirectangular(*radiance.shape[:2])
    # Light from a direction counts by its cosine to the vertical. Light from below does not count.
    weights = directions[..., 2].clamp(min=0) * solid_angles
    irradiance = (weights[..., None] * torch.from_numpy(radiance)).sum((0, 1))
    # A white diffuse surface has the radiance irradiance / π.
    white_radiance = float(irradiance.mean()) / math.pi
    # A map whose columns are shifted is rotated about the vertical axis.
    rotated = np.roll(radiance, rng.integers(radiance.shape[1]), axis=1)
    return (brightness / white_radiance * rotated).astype(np.float32)


def _between(limits: Sequence[float], rng: np.random.Generator) -> float:
    """Draw a random number from the uniform distribution between two limits."""
    return rng.uniform(limits[0], limits[1])


def _from_angles(azimuth: float, elevation: float, distance: float) -> Float[np.ndarray, " 3"]:
    """Convert azimuth (from +x to +y) and elevation (above z = 0), in degrees, to x, y and z."""
    turn, rise = math.radians(azimuth), math.radians(elevation)
    x, y = math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn)
    return distance * np.array([x, y, math.sin(rise)])


def path_traced(
    parts: Sequence[Part], shot: Shot, size: Size, spp: int, bounces: int, seed: int
) -> Float[np.ndarray, "height width 3"]:
    """Render an object with the path tracer of Mitsuba 3.

    Each light source is rendered alone, and the images are added. With all
    light sources in one scene, each path would choose one of them at random,
    and this choice would cause most of the noise. `spp` is the number of paths for each pixel and
    light source; the result is linear radiance. The paths of a pixel are stratified, since as many
    independent ones have the noise of about a third of them.
    """
    lens = {"type": "perspective", "fov": FOV}
    camera = sensor(look_at(shot.camera, shot.aim), size, lens, "rgb")
    # The cells of a pixel form a grid, and Mitsuba warns of a count that does not fill it.
    rows = math.isqrt(spp)
    spp = rows * math.ceil(spp / rows)
    camera["sampler"] = {"type": "multijitter", "sample_count": spp}
    with mitsuba() as module:
        scene = {
            "type": "scene",
            # Depth 1 shows only the light sources themselves, and each bounce adds 1.
            "integrator": {"type": "path", "max_depth": bounces + 1},
            "sensor": camera,
            "table": _plane(np.eye(4), shot.table),
        }
        if shot.wall is not None:
            scene["wall"] = _plane(look_at(shot.wall, shot.center), shot.table)
        scene |= {f"part_{i}": part for i, part in enumerate(_object_shapes(module, parts, shot))}
        scenes = [load(module, {**scene, "light": light}) for light in _light_sources(shot)]
        images = [np.array(module.render(scene, spp=spp, seed=seed)) for scene in scenes]
        return np.sum(images, axis=0)


def _light_sources(shot: Shot) -> list[dict[str, Any]]:
    """Describe the light sources of a shot by dictionaries that Mitsuba takes."""
    if shot.environment is not None:
        return [environment({"bitmap": shot.environment})]
    lights = []
    for position, pattern in zip(shot.projectors, shot.patterns, strict=True):
        distance = float(np.linalg.norm(position - shot.center))
        fov = 2 * float(np.degrees(np.arctan(PROJECTOR_HALF_WIDTH / distance)))
        # The irradiance of a projector falls with the square of the distance.
        power = shot.brightness * distance**2
        pose = look_at(position, shot.center)
        lights.append(projector(pose, fov, {"bitmap": pattern}, power / len(shot.patterns)))
    # Light from all directions, as from the walls of a room.
    lights.append({"type": "constant", "radiance": {"type": "rgb", "value": shot.ambient.tolist()}})
    return lights


def _plane(pose: Float[np.ndarray, "4 4"], color: Float[np.ndarray, " 3"]) -> dict[str, Any]:
    """Describe a large diffuse square by a dictionary that Mitsuba takes.

    The table and the wall are such squares. `pose` leads from the square in the plane z = 0, which
    faces +z, to the world; `color` is linear RGB.
    """
    scale = np.diag([PLANE_HALF_WIDTH, PLANE_HALF_WIDTH, 1.0, 1.0])
    surface = {"type": "diffuse", "reflectance": {"type": "rgb", "value": color.tolist()}}
    return {"type": "rectangle", "to_world": pose @ scale, "bsdf": surface}


def _object_shapes(module: Any, parts: Sequence[Part], shot: Shot) -> list[Any]:
    """Create a Mitsuba shape for each part of an object in the pose of a shot."""
    # Positions (3 · faces, 3) of the vertices of the faces, in the pose of the shot.
    turned = [(shot.scale * part.positions @ shot.rotation.T).reshape(-1, 3) for part in parts]
    min_height = min(positions[:, 2].min() for positions in turned)
    shapes = []
    for part, positions in zip(parts, turned, strict=True):
        albedo: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_color"}
        if part.texture is not None:
            albedo = {"type": "bitmap", "bitmap": part.texture, "raw": True}
        surface = {"type": "principled", "base_color": albedo, "roughness": shot.roughness}
        two_sided = {"type": "twosided", "surface": surface}
        # The lowest vertex touches the table, which has the height 0.
        placed = positions - [0, 0, min_height]
        # Faces share no vertices: face i has the vertices 3i, 3i + 1 and 3i + 2.
        faces = np.arange(len(positions)).reshape(-1, 3)
        normals = (part.normals @ shot.rotation.T).reshape(-1, 3)
        uvs, colors = part.uvs.reshape(-1, 2), part.colors.reshape(-1, 3)
        shapes.append(shape(module, two_sided, placed, faces, normals, uvs, colors))
    return shapes


def write_laboratory(settings: LabSettings) -> int:
    """Render a test set of objects in random lighting, and write it to `settings.out`.

    The folder gets a subfolder of PNG files for each class, the table
    photos.csv and the settings lab.json. `find_photographs` of
    `train.data.photographs` reads such a folder. The same settings and the same
    versions of the packages give the same bytes. Return the number of renders.
    """
    out = writable_folder(settings.out, "out")
    meshes = progress(settings.meshes, "meshes")
    subjects = [read_subject(item, index) for index, item in enumerate(meshes)]
    environments = {path.stem: _read_environment(path) for path in map(Path, settings.environments)}
    groups = _group_subjects(subjects, label_names(settings.label))
    # Pictures that a projector can show: linear RGB, shape (LAB_RESOLUTION, LAB_RESOLUTION, 3).
    pictures = [decode(read_image(path, LAB_RESOLUTION), "srgb") for path in settings.slides]
    slides = [picture.permute(1, 2, 0).numpy() for picture in pictures]
    # A shot, or setup, is a random lighting, camera and pose in which objects are rendered.
    shots = draw_shots(settings, environments, slides)
    with sole_writer(out):
        if settings.overwrite:
            # Only renders are removed, no other files. lab.json says that they are complete.
            for file in (out / DESCRIPTION, out / TABLE, *out.glob(RENDERS)):
                file.unlink(missing_ok=True)
        elif any(path.name != LOCK for path in out.iterdir()):
            fault = f"out={out} holds files, but the renders need an empty folder"
            raise InputError(f"{fault}: choose another, or set overwrite=true")
        rows = []
        for number, shot in progress(enumerate(shots), "setups", settings.setups):
            for group in groups:
                # The shots of a lighting go from dim to bright. Each round of n shots shows all n
                # meshes of a group, and in n rounds each mesh takes each place once.
                count, (turn, place) = len(group), divmod(number, len(group))
                rng = np.random.default_rng(stream_seed(settings.seed, "meshes", turn // count))
                places, turns = rng.permutation(count), rng.permutation(count)
                subject = group[(places[place] + turns[turn % count]) % count]
                path = _write_render(settings, subject, shot, number)
                # A row of photos.csv. Images of one shot have its number.
                rows.append((path, shot.lighting, number, subject.mesh, f"{shot.brightness:.4f}"))
        write_csv(out / TABLE, [COLUMNS, *sorted(rows)], line_end="\r\n")
        versions = {"python": platform.python_version()}
        versions |= {name: version(name) for name in PACKAGES}
        write_json(out / DESCRIPTION, {**asdict(settings), "versions": versions}, indent=2)
        return len(rows)


def is_laboratory(folder: Path, settings: LabSettings) -> bool:
    """Return whether `write_laboratory` completed a folder with these settings, moved or not."""
    try:
        description = read_json(folder / DESCRIPTION)
    except InputError:
        return False
    wanted = {**asdict(settings), "out": description.get("out")}
    return {**description, **json.loads(json.dumps(wanted))} == description


def _group_subjects(subjects: Sequence[Subject], labels: Sequence[str]) -> list[list[Subject]]:
    """Group meshes by their class.

    With several positive classes, the meshes of each are the negatives of the
    others. With a single positive class, meshes of another class are needed. The last group has all
    other meshes, if there are any.
    """
    groups = [[subject for subject in subjects if subject.label == label] for label in labels]
    negatives = [subject for subject in subjects if subject.label not in labels]
    for label, group in zip(labels, groups, strict=True):
        # A metric of a single class needs negatives.
        if not group or (len(labels) == 1 and not negatives):
            counts = f"{len(group)} meshes of label={label} and {len(negatives)} of other classes"
            raise InputError(f"meshes has {counts}: name at least one of each")
    return [*groups, negatives] if negatives else groups


def _write_render(settings: LabSettings, subject: Subject, shot: Shot, number: int) -> str:
    """Render a mesh in a random setup (shot), and write the image as an 8-bit sRGB file.

    Return its path in `settings.out`. `number` is part of it, and decides the seed of the paths.
    """
    seed = stream_seed(settings.seed, "samples", number) % SEED_COUNT
    radiance = path_traced(subject.parts, shot, settings.size, settings.spp, settings.bounces, seed)
    exposed = torch.from_numpy(settings.exposure * radiance).clamp(0, 1)
    path = Path(subject.label) / f"{number:04d}_{shot.lighting}.png"
    file = Path(settings.out, path)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_image(file, encode(exposed, "srgb").permute(2, 0, 1))
    return path.as_posix()


def _read_environment(path: Path) -> Float[np.ndarray, "H W 3"]:
    """Read an environment map from a file, or render a built-in light to such a map.

    It is linear radiance, whose upper half is above the horizon. Negative radiance of a built-in
    light is removed.
    """
    # Built-in lights are spherical harmonics, whose radiance can be negative in some directions.
    if str(path) in PROBES:
        light = HARMONICS.project_nonnegative(load_light(str(path)))
        return to_map(light, BUILT_IN_MAP_HEIGHT).clamp(min=0).numpy()
    radiance = read_panorama(path).numpy()
    # `not ... > 0` is also true for NaN, which `... <= 0` is not.
    if not radiance[: len(radiance) // 2].max() > 0:
        raise InputError(f"environments: {path} has no light above the horizon: give another")
    return radiance


def read_subject(item: str | dict[str, Any], index: int) -> Subject:
    """Load a mesh of the setting `meshes`, and choose its label.

    A generated solid without a label gets its own name as its label. A solid
    that serves as a hard negative gets the label "other_NAME".
    """
    settings = common.read_object(item, "", f"meshes[{index}]")
    label = str(settings.label)
    name = common.solid_name(settings.mesh)
    if not label and name:
        label = OTHER_PREFIX + name if name in HARD_NEGATIVES else name
    if not label:
        labels = f"CLASS, or {OTHER_PREFIX}NAME for an object of another class"
        advice = f"write {{mesh: {settings.mesh}, label: {labels}}}"
        raise InputError(f"meshes[{index}] has no label: {advice}")
    # The label is the name of the folder of the images.
    if Path(label).name != label or label == "..":
        fault = f"meshes[{index}] has the label {label!r}, which cannot be the name of a folder"
        raise InputError(f"{fault}: remove slashes and dots")
    if settings.gloss is not None:
        say_once(f"{settings.mesh}: path-traced test images do not show its gloss")
    parts = lab_parts(load_object(settings).mesh, settings.albedo_scale)
    return Subject(label, settings.mesh, parts)


def kept_aside_settings(
    settings: ExperimentSettings, classes: Sequence[str], size: Size, out: Path
) -> LabSettings:
    """Choose objects and lighting for test renders that training does not use.

    If a positive class is the name of a generated solid, new solids are
    generated. Otherwise the meshes of training are rendered in other lighting. The number of setups
    is a multiple of the number of projected patterns.
    """
    labels = label_names(settings.label)
    meshes: list[Any] = []
    for label in labels:
        # The name of the solid of a class, such as "golf_ball".
        name = simplified(label).replace(" ", "_")
        if name in {*SOLIDS, *HARD_NEGATIVES}:
            meshes += _generated(name, label, POSITIVE_COUNT)
        else:
            # Meshes of the user are the objects of the training, in other lighting.
            meshes += [asdict(item) for item in settings.objects.values() if item.label == label]
    # Names are compared in lower case and with spaces instead of "_" and "-", as `simplified`
    # returns them.
    class_of_simplified = {simplified(name): name for name in classes}
    for name in NEGATIVES:
        if simplified(name) not in map(simplified, labels):
            # A solid that is no class of the network gets a label that marks it as another object.
            label = class_of_simplified.get(simplified(name), OTHER_PREFIX + name)
            meshes += _generated(name, label, NEGATIVE_COUNT)
    setups = settings.evaluate.laboratory_setups
    rendered = str(out), settings.label, meshes, setups, [*OTHER_PATTERNS]
    return LabSettings(*rendered, size=size, seed=FIRST_SEED, overwrite=True)


def _generated(name: str, label: str, count: int) -> list[Any]:
    """Return the settings of generated solids of the same kind with different seeds."""
    return [{"mesh": f"solid:{name}:{FIRST_SEED + i}", "label": label} for i in range(count)]
