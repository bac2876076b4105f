"""Rank networks in several lights by how well they tell oranges from similar objects.

    python -m benchmarks.networks add NETWORK --out mine.csv

scores a network in all simulated lights, adds its rows to a copy of docs/ranking.csv, and prints
its rank in each light. A network is any name that `pnb-evaluate` takes as network=, a published
name, or the folder of a run. After "normalized:" it sees normalized light. --real FOLDER also
scores the photographs in FOLDER/low_light and FOLDER/projector, which docs/ranking.md describes.

    python -m benchmarks.networks table

prints the table of docs/ranking.md.
"""

import argparse
import csv
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

import norm_balls as nb
from augment.classifier import Classifier
from augment.random_streams import generator
from augment.scene.objects import Conditions, load_object
from benchmarks import real_light
from benchmarks.splits import current_commit
from renderer.errors import InputError
from renderer.image import to_bytes
from renderer.io.images import write_image
from renderer.light.basis import HARMONICS
from renderer.light.files import perturb
from renderer.settings import height_and_width
from train.auditing.lights import AMPLITUDE, Views
from train.commands.audit import NEGATIVE_SOLIDS
from train.data.photo import TABLE
from train.data.photographs import find_photographs, folder_names
from train.results.scoring import Predictor, score
from train.results.tables import Estimate, Table, format_interval, write_csv
from train.settings import OTHER_PREFIX, published_folder

SCORES = Path(__file__).parents[1] / "docs" / "ranking.csv"
HEADER = ["network", "light", "quantity", "value", "low", "high", "commit"]
QUANTITIES = ("AUC", "recall at 5% FPR", "recall", "FPR")
TOP1 = "top-1"
LABEL = "orange"
OTHERS = f"{OTHER_PREFIX}fruit"
# Generated objects by class folder. No published network and no other test saw these seeds.
OBJECTS = {
    LABEL: [f"solid:{LABEL}:{seed}" for seed in range(4001, 4021)],
    OTHERS: [f"solid:{name}:{seed}" for name in NEGATIVE_SOLIDS for seed in range(4001, 4005)],
}
MAPS = ("grace", "eucalyptus", "st_peters")
SEED = 5
SIZE = 224  # Pixels per side of the renders. A network sees them at its own size.
NATURAL, RANDOM, ADVERSARIAL = "natural", "random", "adversarial"
RELIT = {"projector, simulated": "projected_slide", "low light, simulated": "low_light"}
PATH_TRACED = "projector, path-traced"
MAX_PATH_TRACED_SIZE = 64  # Larger networks would see its images of 32 pixels enlarged.
REAL = {"plain light, real": "plain", "low light, real": "low_light"}
PROJECTED = "projector, real"
STRIPES = "stripes_coarse+stripes_medium+stripes_fine"
LIGHTS = (NATURAL, RANDOM, ADVERSARIAL, *RELIT, PATH_TRACED, *REAL, PROJECTED)
# All attacks have the same norm-ball and as many steps, also after a success.
ATTACK = nb.AttackSettings(
    lighting=nb.StepSettings("linf", 0.1, "sign", 0.025), max_steps=10, margin=1e5, batch_size=16
)
# Rows of a file without their header.
Rows = list[list[str]]
# Estimates by light and quantity.
Scores = dict[str, Mapping[str, Estimate]]


def views_in_maps(folder: str) -> Iterator[Views]:
    """Yield a view of each object of a class folder in each map."""
    objects = [load_object(nb.ObjectSettings(mesh=name, label=folder)) for name in OBJECTS[folder]]
    for number, name in enumerate(MAPS):
        yield Views(objects, len(objects), SEED + number, torch.device("cpu"), name)


def natural_light(views: Views) -> Tensor:
    """Return the light of the map for each view."""
    return nb.load_light(views.light).expand(views.count, -1, -1)


def random_light(views: Views) -> Tensor:
    """Draw a random light around that of the map for each view, as the audit does."""
    draws = generator(views.seed, "lights")
    lights = perturb(nb.load_light(views.light), views.count, AMPLITUDE, None, draws)
    return HARMONICS.project_nonnegative(lights)


def attacked_light(network: Classifier, views: Views) -> Tensor:
    """Return the light of each view after an attack on the network."""
    scene = views.scene(network.size)
    result = nb.attack(network, scene, settings=ATTACK, seed=views.seed, force=True)
    examples = torch.arange(views.count)
    return result.problem.conditions(result.minimum.values, examples).light.detach()


def render(folder: str, light_of: Callable[[Views], Tensor]) -> UInt8[Tensor, "N 3 H W"]:
    """Render all views of the objects of a class folder."""
    images = []
    for views in views_in_maps(folder):
        conditions = Conditions(light_of(views))
        with torch.no_grad():
            images.append(views.scene(SIZE).render(conditions, torch.arange(views.count))[:, 0])
    return to_bytes(torch.cat(images))


def write_images(folder: Path, images: Mapping[str, Tensor]) -> None:
    """Write the images of class folders, and the table that names the objects of all."""
    for name, of_class in images.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        for index, image in enumerate(of_class):
            write_image(folder / name / f"{index:03d}.png", image.permute(1, 2, 0).numpy())
    rows = [["path", "source_tag", "mesh"]]
    for name, objects in OBJECTS.items():
        # Each map has one view of each object.
        meshes = enumerate(objects * len(MAPS))
        rows += [[f"{name}/{index:03d}.png", "", mesh] for index, mesh in meshes]
    write_csv(folder / TABLE, rows)


def write_renders(folder: Path) -> None:
    """Render the objects in all lights that do not depend on a network."""
    images = {
        NATURAL: {name: render(name, natural_light) for name in OBJECTS},
        RANDOM: {name: render(name, random_light) for name in OBJECTS},
    }
    for title, light in RELIT.items():
        relight = partial(nb.relight_photographs, seed=SEED, lights=[light])
        images[title] = {name: relight(each) for name, each in images[NATURAL].items()}
    for title, of_light in images.items():
        write_images(folder / title, of_light)


def score_renders(network: Classifier, renders: Path) -> Scores:
    """Score a network in all simulated lights, with intervals over objects."""
    folders = {title: renders / title for title in (NATURAL, RANDOM, *RELIT)}
    if max(height_and_width(network.size)) <= MAX_PATH_TRACED_SIZE:
        folders[PATH_TRACED] = published_folder(Path("pretrained/laboratory"))
    predictor = Predictor(network, network.classes, network.size)
    scores: Scores = {}
    with tempfile.TemporaryDirectory() as temporary:
        folders[ADVERSARIAL] = Path(temporary)
        attacked = render(LABEL, partial(attacked_light, network))
        # The light of the other objects is not attacked.
        shutil.copytree(renders / NATURAL / OTHERS, folders[ADVERSARIAL] / OTHERS)
        write_images(folders[ADVERSARIAL], {LABEL: attacked})
        for title, folder in folders.items():
            found = score(predictor.predict(folder, LABEL, False)).overall
            values = (found.auc, found.recall_at["0.05"], found.recall, found.false_positive_rate)
            scores[title] = dict(zip(QUANTITIES, values, strict=True))
    return scores


def score_photographs(
    network: Classifier, path: Path, label: str, lights: Mapping[str, str], has_crops: bool
) -> Scores:
    """Score a network on real photographs in some lights, with intervals over photographs."""
    found = find_photographs(path, network.classes, label)
    folder = real_light.Folder(path, found, has_crops)
    predictions = real_light.predict(network, folder, [label])
    counts, units = folder.draw(label), folder.units(label)
    scores: Scores = {}
    words = []
    for title, light in lights.items():
        # Several lights may be fewer in a folder. A folder without any of them is refused.
        shown = [each for each in light.split("+") if each in folder.lights]
        words.append(f"{title}={'+'.join(shown) or light}")
    for title, rows in real_light.choose_lights(folder, words).items():
        draws = real_light.measure(predictions, folder.objects, counts, rows)
        units_of_metrics = real_light.count_units(predictions, units, rows)
        estimates = list(map(real_light.estimate, draws, units_of_metrics))
        scores[title] = dict(zip(real_light.METRICS, estimates, strict=True))
    return scores


def load(name: str) -> Classifier:
    """Load a classifier by its name on the command line."""
    network = real_light.load(name)
    if not isinstance(network, Classifier):
        raise InputError(f"{name} is no classifier: only classifiers are ranked")
    return network


def real_folders(real: Path | None) -> dict[str, Path]:
    """Find the folders of real photographs that are scored, by their names."""
    if real is None:
        return {}
    paths = [real / name for name in ("low_light", "projector")]
    if not any(path.is_dir() for path in paths):
        raise InputError(f"--real: {real} has neither a folder low_light nor a folder projector")
    return {path.name: path for path in paths if path.is_dir()}


def score_real(network: Classifier, folders: Mapping[str, Path]) -> Scores:
    """Score a network in real light. Projected objects count if it has all of their classes."""
    scores: Scores = {}
    if path := folders.get("low_light"):
        scores = score_photographs(network, path, LABEL, REAL, True)
    if path := folders.get("projector"):
        shown = folder_names(path)
        if unknown := {*shown} - {*network.classes}:
            print(f"{network.title} has no score in {PROJECTED}: it has no class {min(unknown)}")
        else:
            found = score_photographs(network, path, shown[0], {PROJECTED: STRIPES}, False)
            scores[PROJECTED] = {TOP1: found[PROJECTED][TOP1]}
    return scores


def read(path: Path) -> dict[str, Rows]:
    """Read the rows of each network from a file of scores."""
    rows: dict[str, Rows] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            rows.setdefault(row["network"], []).append([row[name] for name in HEADER])
    return rows


def rows_of(name: str, scores: Scores) -> Rows:
    """Return the rows of a network, whose scores have four digits."""
    commit = current_commit()
    rows = []
    for light in LIGHTS:
        for quantity, found in scores.get(light, {}).items():
            ends = ("" if end is None else f"{end:.4f}" for end in (found.low, found.high))
            if found.value is not None:
                rows.append([name, light, quantity, f"{found.value:.4f}", *ends, commit])
    return rows


def ranked_scores(rows: Mapping[str, Rows], light: str) -> dict[str, list[float]]:
    """Return the value by which each network is ranked in a light, and the ends of its interval."""
    ranked_by = [light, TOP1 if light == PROJECTED else QUANTITIES[0]]
    found = (row for of_network in rows.values() for row in of_network if row[1:3] == ranked_by)
    return {row[0]: [float(cell or "nan") for cell in row[3:6]] for row in found}


def rank(scores: Mapping[str, Sequence[float]]) -> dict[str, tuple[int, int, int]]:
    """Return the rank of each network, and the first and the last rank that intervals allow.

    Networks with equal values share the first of their ranks. The limits count the networks whose
    intervals lie completely above, or below.
    """
    ranks = {}
    values, lows, highs = np.array([*scores.values()]).T
    for name, (value, low, high) in scores.items():
        above, surely_above, surely_below = map(
            int, ((values > value).sum(), (lows > high).sum(), (highs < low).sum())
        )
        ranks[name] = (1 + above, 1 + surely_above, len(scores) - surely_below)
    return ranks


def add(options: argparse.Namespace) -> None:
    """Score networks, write a file with their rows, and print their ranks."""
    rows = read(options.scores) | (read(options.out) if options.out.exists() else {})
    folders = real_folders(options.real)
    networks = {name: load(name) for name in options.networks}
    real = {name: score_real(network, folders) for name, network in networks.items()}
    with tempfile.TemporaryDirectory() as temporary:
        renders = options.renders or Path(temporary) / "renders"
        # The table of the last light is written last.
        if not (renders / [*RELIT][-1] / TABLE).exists():
            write_renders(renders)
        for name, network in networks.items():
            rows[name] = rows_of(name, score_renders(network, renders) | real[name])
            # The scores of a network are kept if a later network cannot be scored.
            write_csv(options.out, [HEADER, *(row for each in rows.values() for row in each)])
    for name in options.networks:
        lines = []
        for light in LIGHTS:
            scores = ranked_scores(rows, light)
            if name in scores:
                interval = format_interval(Estimate(*scores[name]))
                position, first, last = rank(scores)[name]
                of_all = f"{position} of {len(scores)}, {first} to {last} within the intervals"
                lines.append([light, interval, of_all])
        print(Table(name, ["light", "score", "rank"], lines))
    if options.real:
        print("Ranks in real light compare only networks that saw the same photographs.")


def table(options: argparse.Namespace) -> None:
    """Print the table of the page: the rank and the score of each network in each light."""
    rows = read(options.scores)
    columns = {light: ranked_scores(rows, light) for light in LIGHTS}
    print("|".join(["", "network", *columns, ""]))
    print("|-" * (1 + len(columns)) + "|")
    for name in rows:
        line = ["", f"`{name}`"]
        for scores in columns.values():
            cell = ""
            if name in scores:
                value, low, high = scores[name]
                cell = f"**{rank(scores)[name][0]}**: {value:.2f} [{low:.2f}, {high:.2f}]"
            line.append(cell)
        print("|".join([*line, ""]))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    adding = commands.add_parser("add", help="score networks, and rank them among those of a file")
    adding.set_defaults(body=add)
    adding.add_argument("networks", nargs="+", metavar="NETWORK")
    adding.add_argument("--out", type=Path, default=Path("ranking.csv"), help="file to write")
    adding.add_argument("--real", type=Path, help="folder of photographs")
    adding.add_argument("--renders", type=Path, help="folder in which to keep the renders")
    printing = commands.add_parser("table", help="print the table of the page")
    printing.set_defaults(body=table)
    for command in (adding, printing):
        command.add_argument("--scores", type=Path, default=SCORES, help="file of other networks")
    options = parser.parse_args(arguments)
    real_light.run(options, parser)


if __name__ == "__main__":
    main()
