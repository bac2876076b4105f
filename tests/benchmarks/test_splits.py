import csv
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh

from augment.scene import patterns
from benchmarks import splits
from tests.helpers import save_noise

# Patterns, lights and meshes of training.
TRAINING = {
    *("stripes", "checkers", "spots", "half", "solid", "grace", "eucalyptus", "st_peters"),
    *splits.TRAINED,
}
# Number of setups in each part of a split, instead of up to 240.
SETUPS = {"validation": 12, "test": 10}
ARGUMENTS = ["--splits", "splits", "--packages", "packages"]
LOG_HEADER = "date,commit,table,network,weights,parts,images\n"


@pytest.fixture
def data(tmp_path, monkeypatch) -> None:
    """Write small data and packages into the working folder.

    A ball takes the place of each mesh. There are three environment maps and 16
    photographs of two sources. A wheel has what comes from packages.
    """
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for folder in ("meshes", "hdri", "photos/orange", "photos/apple", "packages"):
        Path(folder).mkdir(parents=True)
    write_photographs(rng)
    save_noise(Path("packages/astronaut.png"), rng, (8, 8))
    ball = trimesh.creation.icosphere(1)
    for name in (*splits.OUTSIDE, *splits.TRAINED):
        folder = "packages" if name.endswith(".obj") else "meshes"
        ball.export(f"{folder}/{name}")
    with zipfile.ZipFile("packages/objects.whl", "w") as archive:
        for path in Path("packages").glob("*.[op]*"):
            archive.write(path)
    for name in (*splits.VALIDATION_MAPS, "night"):
        np.save(f"hdri/{name}.npy", rng.random((8, 16, 3), np.float32))


def write_photographs(rng: np.random.Generator) -> None:
    """Write 16 photographs with their table. The last is of a source that is left out."""
    rows = []
    for number in range(16):
        label = ("orange", "apple")[number % 2]
        rows.append([f"{label}/{number}.png", label, f"tag{number // 8}"])
    rows[-1][2] = splits.EXCLUDED_SOURCES[0]
    for path, _, _ in rows:
        save_noise(Path("photos", path), rng, (8, 8))
    with open("photos/photos.csv", "w", newline="") as file:
        csv.writer(file).writerows([["path", "class", "source_tag"], *rows])


@pytest.fixture
def made_splits(data, monkeypatch) -> None:
    pytest.importorskip("mitsuba")
    all_parts = splits.parts

    def small_parts(*folders):
        parts = all_parts(*folders)
        for name, settings in parts.items():
            settings["setups"] = SETUPS[Path(name).parent.name]
        return parts

    monkeypatch.setattr(splits, "parts", small_parts)
    small_lab = partial(splits.LabSettings, size=8, spp=1, bounces=1)
    monkeypatch.setattr(splits, "LabSettings", small_lab)
    monkeypatch.setattr(patterns, "LAB_RESOLUTION", 64)
    splits.main(["make", *ARGUMENTS, "--data", "."])


def images_of(split: str) -> set[bytes]:
    return {path.read_bytes() for path in Path("splits", split).glob("*/*/*.png")}


def names_of(split: str) -> set[str]:
    names = set()
    for part in ("laboratory", "hdri"):
        with Path("splits", split, part, "photos.csv").open() as file:
            for row in csv.DictReader(file):
                names.add(Path(row["mesh"]).name)
                names.add(row["source_tag"])
    return names


def photographs_of(split: str) -> set[str]:
    return {path.name for path in Path("splits", split, "photographs").glob("*/*.png")}


@pytest.mark.slow  # Scoring takes bootstraps.
def test_the_splits_share_no_image_object_or_light_and_evaluations_are_logged(
    made_splits, monkeypatch, capsys
):
    names = [TRAINING, names_of("validation"), names_of("test")]
    assert len(set.union(*names)) == sum(len(part) for part in names)
    assert images_of("validation").isdisjoint(images_of("test"))
    photographs = [photographs_of("validation"), photographs_of("test")]
    assert photographs[0].isdisjoint(photographs[1])
    # One of the 16 photographs is of a source that is left out.
    assert len(photographs[0] | photographs[1]) == 15

    log = Path("log.csv")
    log.write_text(LOG_HEADER)
    monkeypatch.setattr(splits, "LOG", log)
    networks = ["pretrained/none", "normalized:pretrained/none"]
    arguments = [*networks, *ARGUMENTS, "--part", "photographs", "--table", "mine"]
    for command, logged_count in (("validate", 0), ("test", 2), ("test", 4)):
        splits.main([command, *arguments])
        assert len(log.read_text().splitlines()) == 1 + logged_count
        printed = capsys.readouterr().out
        assert ("was evaluated for 'mine' before" in printed) == (logged_count == 4)
    assert {row["network"] for row in csv.DictReader(log.read_text().splitlines())} == set(networks)
