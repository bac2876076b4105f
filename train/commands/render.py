"""pnb-render: labeled renders on disk, as a data set for other programs."""

import json
import math
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

from augment import dataset
from augment.progress import progress
from renderer.errors import InputError, keyed, keys_of
from renderer.io.files import TEMPORARY
from renderer.settings import height_and_width
from train import console
from train.checkpoints import load_chosen
from train.class_names import name_of_mesh
from train.command_settings import RenderSettings
from train.data.annotations import DATA_SET
from train.data.formats import FORMATS
from train.data.photographs import require_outside
from train.device import choose_device, choose_rasterizer
from train.run_config import fingerprints, require_same_inputs
from train.run_folder import read_json, writable_folder, write_json
from train.settings import label_names, read_objects

# Processes that share a data set differ in these settings only.
CIRCUMSTANCES = ("out", "shard", "shards", "device", "trust")
DEFAULT_SIZE = 224
# Bytes of a pixel in the files of a render before compression, by the name of the map.
BYTES = {"image": 3, "mask": 1, "depth": 2, "normals": 3}
# Largest number of bytes of the details of a render and of the headers of its files.
DETAILS = 10_000


def run(settings: RenderSettings) -> None:
    """Render a data set, or what a stopped command left to do, and print a summary."""
    settings.require_counting()
    objects = [*read_objects(settings.meshes, "", "meshes").values()]
    default, *more = [None] if settings.label is None else label_names(settings.label)
    if more:
        raise settings.wrong("label", "is several classes: give each mesh its own, {mesh, label}")
    # An object without a label gets the given one, or else the class that its mesh is named by.
    for item in objects:
        item.label = item.label or default or name_of_mesh(item.mesh)
    labels = [of.label for item in objects for of in (item, *item.others)]
    unlabeled = [other.mesh for item in objects for other in item.others if not other.label]
    if unlabeled:
        console.warning("unlabeled objects are drawn, but not annotated: %s", ", ".join(unlabeled))
    classes = [*dict.fromkeys(label for label in labels if label)]
    folder = writable_folder(settings.out, "out")
    vary = settings.augment.vary
    for taken in filter(None, (vary.backgrounds, vary.camera.slides)):
        require_outside(folder, Path(taken))
    for name in classes if settings.format == "imagefolder" else ():
        # A name such as "a/b" or ".." would be another folder.
        if (folder / name).resolve().parent != folder.resolve():
            raise InputError(f"the class {name} is no name of a folder: rename it", "format")
    device = choose_device(settings.device)
    # Each render is attacked to fool this network. Without one, renders are random.
    network = load_chosen(settings).to(device) if settings.network else None
    if settings.size is None:
        settings.size = DEFAULT_SIZE if network is None else network.size or DEFAULT_SIZE
    shards = shard_indices(settings)
    # Classes of `FORMATS` write the files of a data set, whose parts are such as "train".
    data = FORMATS[settings.format](folder, classes, settings.split_counts, shards, settings.maps)
    # Indices of the renders of this process, and of those that a stopped command has finished.
    indices = shards[settings.shard]
    finished = {index for index in indices if data.last_file(index).exists()}
    missing = len(indices) - len(finished)
    options: dict[str, Any] = {"settings": settings.augment, "network": network, "device": device}
    options |= {"scene": settings.scene, "renderer": settings.renderer, "seed": settings.seed}
    options |= {"first": indices.start, "skip": finished, "views": settings.scene.views}
    # Depth and normals are computed only if files of them are asked for.
    options["maps"] = not {"depth", "normals"}.isdisjoint(settings.maps)
    options["rasterizer"] = choose_rasterizer(settings.renderer)
    # An error names an argument by its setting, such as scene.views.
    keys = keys_of("scene", settings.scene) | keys_of("renderer", settings.renderer)
    with keyed("scene", **keys):
        renders = dataset.render_dataset(objects, settings.size, len(indices), **options)
    # A command whose meshes cannot be read leaves no settings in the folder.
    _describe(settings, folder, classes)
    height, width = height_and_width(settings.size)
    bytes_of_pixel = sum(BYTES[name] for name in ("image", *settings.maps))
    megabytes = math.ceil(missing * (height * width * bytes_of_pixel + DETAILS) / 1e6)
    print(f"{folder}: {missing} of {settings.count} renders to do, at most {megabytes:,} MB")
    data.write(progress(renders, "renders", missing))
    # Of several processes, the one that finishes last writes the files about all renders.
    if data.is_finished():
        data.finish()
        parts = ", ".join(f"{count} {name}" for name, count in data.splits.items())
        print(f"{folder}: {settings.count} renders of {len(classes)} classes ({parts})")


def shard_indices(settings: RenderSettings) -> list[range]:
    """Return the indices of the renders of each process, which are whole blocks."""
    blocks = -(-settings.count // dataset.BLOCK)
    ends = [blocks * part // settings.shards * dataset.BLOCK for part in range(settings.shards + 1)]
    return [range(*ends) for ends in pairwise(min(end, settings.count) for end in ends)]


def _describe(settings: RenderSettings, folder: Path, classes: list[str]) -> None:
    """Write the settings to the folder, or check that it holds a data set of the same settings."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / DATA_SET
    facts = {key: value for key, value in asdict(settings).items() if key not in CIRCUMSTANCES}
    if settings.format == "webdataset":
        facts["shards"] = settings.shards  # A tar file has renders of one shard.
    # JSON makes the settings comparable with those in the file: tuples become lists.
    facts = json.loads(json.dumps(facts | {"classes": classes}, default=str))
    # With --multirun, Hydra and submitit keep files in .launcher, as conf/render.yaml says. Another
    # process may begin now: its first file is the description, so the folder is listed before.
    names = {one.name for one in folder.iterdir() if not one.match(TEMPORARY)}
    if path.exists():
        found = read_json(path)
        changed = [key for key in facts if found.get(key) != facts[key]]
        if changed:
            raise InputError(f"out={folder} has another {changed[0]}: choose another folder", "out")
        require_same_inputs(folder, settings, found, "out=")
    elif names - {".launcher"}:
        raise InputError(f"out={folder} is not empty: choose a new folder", "out")
    else:
        write_json(path, facts | {"inputs": fingerprints(settings)}, indent=1)
