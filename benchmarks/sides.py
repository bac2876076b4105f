"""Three sides that share nothing: training, choosing and reporting.

Settings are chosen on the second. The third is looked at once per table, and docs/reporting.csv says when.

pip download --no-deps -d packages robosuite genesis-world pybullet scikit-image scikit-learn
npm pack --pack-destination packages @pmndrs/assets
python -m benchmarks.sides make --data DATA --sides SIDES --packages packages
python -m benchmarks.sides choose pretrained/best runs/mine --data DATA --sides SIDES
python -m benchmarks.sides report pretrained/best runs/mine --data DATA --sides SIDES --table NAME

DATA has meshes/, hdri/, photos/ and cifar100.npz. A folder of runs is an arm: of several seeds, the table has the mean,
the lowest and the highest. A network may also be efficientnet_lite0 or another classifier, for images of --size pixels.
"""

import argparse
import base64
import csv
import hashlib
import subprocess
import tarfile
import zipfile
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from PIL import Image

from augment.classifiers import Classifier, build_classifier
from benchmarks.common import write_csv
from renderer.light.environment import read_map
from train.command_settings import LabSettings
from train.data.photographs import TABLE
from train.data.sets import held_out_rows, load_npz
from train.evaluation.laboratory.laboratory import write_laboratory
from train.evaluation.scores.metrics import METRICS, Pooled, metric_title
from train.evaluation.scores.predictions import PREDICTIONS, Prediction, Predictor, write_predictions
from train.evaluation.tables import Estimate, Table, format_interval
from train.report.comparison import ALL, Evaluation, difference, mean_metric, pools_of
from train.report.summary import RunSummary, summarize
from train.runs.saved_networks import is_classifier, load_network, load_run
from train.system.device import MixedPrecision, choose_precision
from train.system.hashing import content_hash
from train.training.loop import evaluate

LOG = Path(__file__).parent.parent / "docs" / "reporting.csv"
LABEL, VALIDATION = "orange", 0.02
LEFT_OUT = ("turntable", "studio")  # photographs of few objects, whose two halves would show the same ones
TRAINED = {"orange_studio.glb": 1.0, "orange_sketchfab.glb": 3.0}  # meshes of training, with their albedo_scale
OUTSIDE = {  # meshes from no generator of ours and in no training, in DATA or in packages
    "orange_scan.glb": "orange", "orange_leaf.glb": "orange", "apple_scan.glb": "apple", "banana.glb": "other_banana",
    "golf_ball.glb": "other_golf_ball", "racquetball.glb": "other_racquetball", "lemon.obj": "other_lemon",
    "soccerball.obj": "other_soccer_ball", "wooden_sphere.obj": "other_wooden_ball",
}  # fmt: skip
TEXTURES = ("lemon.mtl", "lemon.png", "wood_Mat_Diffuse.png", "wooden_sphere.mtl", "soccerball.mtl", "/colors16.png")
PICTURES = ("astronaut", "chelsea", "coffee", "hubble_deep_field", "rocket", "motorcycle_left", "china", "flower")
CHOSEN = ("city", "studio")
OTHERS = ("lemon", "peach", "ball", "apple", "pear", "sweet_pepper", "lemon", "peach")
UNSEEN = {  # directions, surroundings and materials that no training has
    "azimuth": [-180, 180], "elevation": [5, 85], "ambient": [0.03, 0.2], "albedo": [0.04, 0.5], "walls": 0.5,
    "roughness": [0.1, 0.9], "brightness": [0.5, 4.0],
}  # fmt: skip


def solids(seed: int) -> list[str]:
    """Eight oranges and as many others of the generator, of this seed on."""
    others = [f"solid:{name}:{seed + n // 6}" for n, name in enumerate(OTHERS)]
    return [f"solid:{LABEL}:{seed + n}" for n in range(8)] + others


def parts(data: Path, extra: Path) -> dict[str, dict[str, Any]]:
    """The settings of pnb-lab of each part; those ending in _seen_objects repeat another with objects of training."""
    maps = {path.stem: str(path) for path in [*(extra / "hdri").glob("*.npy"), *(data / "hdri").glob("*.npy")]}
    files = {path.name: str(path) for path in [*(data / "meshes").iterdir(), *extra.rglob("*.obj")]}
    outside = [{"mesh": files[name], "label": label} for name, label in OUTSIDE.items()]
    trained = [{"mesh": files[name], "label": LABEL, "albedo_scale": scale} for name, scale in TRAINED.items()]
    slides = sorted(str(path) for path in (extra / "slides").iterdir())
    unseen = {**UNSEEN, "patterns": ["window", "leaves", "text", "slides", "window+text"], "slides": slides, "seed": 3}
    reported, roughness = [maps[name] for name in sorted(set(maps).difference(CHOSEN))], UNSEEN["roughness"]
    skies = {"environments": reported, "patterns": [], "setups": 5 * len(reported), "seed": 4, "roughness": roughness}
    chosen, seen = {"meshes": solids(2001)}, {"meshes": [*trained, *solids(0)]}
    return {
        "choosing/laboratory": {**chosen, "patterns": ["gradient", "rings", "colors"], "setups": 240, "seed": 1},
        "choosing/hdri": {**chosen, "environments": [maps[x] for x in CHOSEN], "patterns": [], "setups": 80, "seed": 2},
        "reporting/laboratory": {"meshes": outside, **unseen, "setups": 200},
        "reporting/hdri": {"meshes": outside, **skies},
        "reporting/laboratory_seen_objects": {**seen, **unseen, "setups": 100},
        "reporting/hdri_seen_objects": {**seen, **skies},
    }  # fmt: skip


def unpack(packages: Path, extra: Path) -> None:
    """What the wheels and the npm package bring: meshes with their textures, pictures, environment maps."""
    for folder in (extra / "slides", extra / "hdri"):
        folder.mkdir(parents=True)
    for archive in map(zipfile.ZipFile, packages.glob("*.whl")):
        for name in archive.namelist():
            if name.endswith((*OUTSIDE, *TEXTURES)):
                path = Path(archive.extract(name, extra))
                if path.suffix == ".png":
                    Image.open(path).convert("RGB").resize((1024, 1024)).save(path)
                elif path.suffix == ".mtl":  # a gray factor of a texture, which would be painted anew for it
                    path.write_text(path.read_text().replace("0.800000", "1.000000"))
            elif Path(name).stem in PICTURES and Path(name).suffix in (".png", ".jpg"):
                (extra / "slides" / Path(name).name).write_bytes(archive.read(name))
    for package in map(tarfile.open, packages.glob("*.tgz")):
        for name in package.getnames():
            if name.endswith(".exr.js"):
                path = extra / "hdri" / Path(name).stem
                path.write_bytes(base64.b64decode(package.extractfile(name).read().split(b"base64,")[1].split(b"'")[0]))
                np.save(path.with_suffix(".npy"), read_map(path).clamp(min=0).numpy())  # resampled with ringing


def divide_photographs(photos: Path, sides: Path) -> None:
    """Links to every other photograph of a class and source, by name, on either side."""
    rows = [
        row for row in csv.DictReader((photos / TABLE).read_text().splitlines()) if row["source_tag"] not in LEFT_OUT
    ]
    ordered = sorted(rows, key=lambda row: (row["class"], row["source_tag"], row["path"]))
    for offset, side in enumerate(("choosing", "reporting")):
        write_csv(sides / side / "photographs" / TABLE, ordered[offset::2])
        for row in ordered[offset::2]:
            link = sides / side / "photographs" / row["path"]
            link.parent.mkdir(exist_ok=True)
            link.symlink_to((photos / row["path"]).resolve())


def make(args: argparse.Namespace) -> None:
    extra = args.sides.resolve() / "packages"
    if not extra.exists():
        unpack(args.packages, extra)
        divide_photographs(args.data / "photos", args.sides)
    for name, settings in parts(args.data.resolve(), extra).items():
        if not args.part or name in args.part:
            lab = LabSettings(out=str(args.sides / name), size=args.size, **settings)
            print(name, write_laboratory(lab), "renders")


def load(name: str, size: int) -> Classifier:
    """A run's network, or a classifier of others for images of a size."""
    if not is_classifier(name):
        return load_run(name)
    classifier = build_classifier(name, size)
    classifier.load_state_dict(load_network(name).state_dict())
    return classifier


def log_looks(args: argparse.Namespace, networks: dict[str, Classifier], folders: list[Path]) -> None:
    """A row per network in LOG, before anything is scored, and a word where the table has one of it already."""
    weights = {name: content_hash(network.state_dict())[:12] for name, network in networks.items()}
    looks, images = list(csv.DictReader(LOG.read_text(encoding="utf-8").splitlines())), hashlib.sha256()
    for path in sorted(path for folder in folders for path in folder.glob("*/*.*")):
        images.update(path.relative_to(args.sides).as_posix().encode() + path.read_bytes())
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for name in networks:
        if days := [look["date"] for look in looks if (look["table"], look["weights"]) == (args.table, weights[name])]:
            print(f"{name} was looked at for {args.table!r} before, on {', '.join(days)}")
        with LOG.open("a", encoding="utf-8", newline="") as file:
            shown = " ".join(folder.name for folder in folders)
            row = date.today(), commit.strip(), args.table, name, weights[name], shown, images.hexdigest()[:12]
            csv.writer(file, lineterminator="\n").writerow(row)


def score(args: argparse.Namespace) -> None:
    """A table of the side's folders, sources and objects, with DATA of CIFAR-100, and differences from the first."""
    side = {"choose": "choosing", "report": "reporting"}[args.command]
    folders = sorted(path.parent for path in (args.sides / side).glob(f"*/{TABLE}"))
    folders = [folder for folder in folders if not args.part or folder.name in args.part]
    if len(folders) < len(args.part or [1]):
        raise SystemExit(f"{args.sides / side} lacks a part: --part takes its folders with {TABLE}")
    arms = {name: sorted(str(path.parent) for path in Path(name).glob("*/best.pt")) or [name] for name in args.networks}
    networks = {run: load(run, args.size) for runs in arms.values() for run in runs}
    if side == "reporting":
        log_looks(args, networks, folders)
    if args.data:
        data = load_npz(str(args.data / "cifar100.npz"))
        split = data.test if side == "reporting" else data.train[held_out_rows(data.train, VALIDATION, seed=0)]
    lines, scored, answers, blank = [], {}, {}, [""] * (len(METRICS) - 1)
    for arm, runs in arms.items():
        models = [MixedPrecision(networks[run], choose_precision("auto", torch.device("cpu"))) for run in runs]
        for folder in folders:
            pairs = [evaluated(*pair, folder, side) for pair in zip(runs, models, strict=True)]
            group, answers[arm, folder] = zip(*pairs, strict=True)
            scored[arm, folder] = group
            for part in group[0].pools:
                cells = (format_interval(mean_metric(group, part, metric)) for metric in METRICS)
                lines.append([arm, folder.name, Path(part.title()).stem, *cells])
        if args.data:
            values = [evaluate(model, split)["accuracy"] for model in models]
            lines.append([arm, "CIFAR-100", "accuracy", mean_and_range(values), *blank])
    first, *others = arms
    for folder in folders:
        for arm in others:
            pair = scored[arm, folder], scored[first, folder]
            cells = (format_interval(difference(*pair, ALL, metric), "+") for metric in METRICS)
            lines.append([f"{arm} - {first}", folder.name, "all", *cells])
            for group, positive in (("same class", True), ("same class, other things", False)):
                pairs = (zip(own, answers[first, folder][0], strict=True) for own in answers[arm, folder])
                same = [fmean(a.predicted == b.predicted for a, b in x if positive or not b.positive) for x in pairs]
                lines.append([f"{arm} - {first}", folder.name, group, mean_and_range(same), *blank])
    print(Table("", ["network", "images", "group", *map(metric_title, METRICS)], lines))


def mean_and_range(values: Sequence[float]) -> str:
    """Of a number for each seed."""
    if len(values) == 1:
        return format_interval(Estimate(values[0]))
    return format_interval(Estimate(fmean(values), min(values), max(values)))


def evaluated(run: str, model: MixedPrecision, folder: Path, side: str) -> tuple[Evaluation, list[Prediction]]:
    """A run's predictions on a folder, pooled by source, which is a pattern, a map or where photographs come from, and
    by object; and each."""
    network = model.network
    predictions = Predictor(model, network.classes, network.size).predict(folder, LABEL).predictions
    out = Path("runs/sides", side, run.strip("/").replace("/", "_"), folder.name)
    out.mkdir(parents=True, exist_ok=True)
    write_predictions(out / PREDICTIONS, predictions)
    thresholds = {point.label: point.threshold for point in network.operating_points}
    pooled = Pooled(predictions, thresholds=thresholds)
    summary = RunSummary(Path(run), run, {}, {}, None) if is_classifier(run) else summarize(Path(run))
    return Evaluation(summary, pools_of(pooled, "source", "mesh")), predictions


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["make", "choose", "report"])
    parser.add_argument("networks", nargs="*", help="run folders, folders of runs, or names under pretrained/")
    for option in ("--data", "--sides", "--packages"):
        parser.add_argument(option, type=Path, required=option == "--sides")
    parser.add_argument("--size", type=int, default=64, help="of a render, in pixels per side")
    parser.add_argument("--part", nargs="+", help="these folders alone, as reporting/hdri in make and hdri in report")
    parser.add_argument("--table", default="", help="of report: the name of the table that the scores are for")
    arguments = parser.parse_args(argv)
    if arguments.command == "report" and not arguments.table:
        parser.error("report takes --table NAME, under which docs/reporting.csv records the look")
    make(arguments) if arguments.command == "make" else score(arguments)


if __name__ == "__main__":
    main()
