"""The sides for choosing and reporting: what they share, and that looks are logged."""

import csv
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from benchmarks import sides
from train.evaluation.laboratory import lab_patterns as patterns

TRAINING = {"stripes", "checkers", "spots", "half", "solid", "grace", "eucalyptus", "st_peters", *sides.TRAINED}
SETUPS = {"choosing": 12, "reporting": 10}
GIVEN = ["--sides", "sides", "--packages", "packages"]


@pytest.fixture
def data(tmp_path, monkeypatch) -> None:
    """A ball in the place of each mesh, maps, and 16 photographs of two sources; a wheel with the rest."""
    monkeypatch.chdir(tmp_path)
    ball, rng = trimesh.creation.icosphere(1), np.random.default_rng(0)
    for folder in ("meshes", "hdri", "photos/orange", "photos/apple", "packages"):
        Path(folder).mkdir(parents=True)
    rows = [[f"{('orange', 'apple')[n % 2]}/{n}.png", ("orange", "apple")[n % 2], f"tag{n // 8}"] for n in range(16)]
    rows[-1][2] = sides.EXCLUDED_SOURCES[0]
    for path in (*(f"photos/{row[0]}" for row in rows), "packages/astronaut.png"):
        Image.fromarray(rng.integers(0, 256, (8, 8, 3), np.uint8)).save(path)
    with open("photos/photos.csv", "w", newline="") as file:
        csv.writer(file).writerows([["path", "class", "source_tag"], *rows])
    for name in (*sides.OUTSIDE, *sides.TRAINED):
        ball.export(f"{'packages' if name.endswith('.obj') else 'meshes'}/{name}")
    with zipfile.ZipFile("packages/objects.whl", "w") as archive:
        for path in Path("packages").glob("*.[op]*"):
            archive.write(path)
    for name in (*sides.CHOOSING_MAPS, "night"):
        np.save(f"hdri/{name}.npy", rng.random((8, 16, 3), np.float32))


@pytest.mark.slow  # bootstraps
def test_the_sides_share_no_image_object_or_light_and_looks_are_logged(data, monkeypatch, capsys):
    pytest.importorskip("mitsuba")
    whole, log = sides.parts, Path("log.csv")
    few = lambda *folders: {k: {**part, "setups": SETUPS[k.split("/")[0]]} for k, part in whole(*folders).items()}  # noqa: E731
    small = partial(sides.LabSettings, size=8, spp=1, bounces=1)
    for name, value in {"parts": few, "LabSettings": small, "LOG": log}.items():
        monkeypatch.setattr(sides, name, value)
    monkeypatch.setattr(patterns, "RESOLUTION", 64)
    sides.main(["make", *GIVEN, "--data", "."])
    images, names, photographs = [], [TRAINING], []
    for side in SETUPS:
        tables = [Path("sides", side, part, "photos.csv").read_text() for part in ("laboratory", "hdri")]
        rows = [row for table in tables for row in csv.DictReader(table.splitlines())]
        names.append({name for row in rows for name in (Path(row["mesh"]).name, row["source_tag"])})
        images.append({path.read_bytes() for path in Path("sides", side).glob("*/*/*.png")})
        photographs.append({path.name for path in Path("sides", side, "photographs").glob("*/*.png")})
    assert len(set.union(*names)) == sum(map(len, names)) and not images[0] & images[1]
    assert not photographs[0] & photographs[1] and len(photographs[0] | photographs[1]) == 15  # one is left out
    log.write_text("date,commit,table,network,weights,parts,images\n")
    for command, looks in (("choose", 0), ("report", 1), ("report", 2)):
        sides.main([command, "pretrained/none", *GIVEN, "--part", "photographs", "--table", "mine"])
        assert len(log.read_text().splitlines()) == 1 + looks
        assert ("was looked at for 'mine' before" in capsys.readouterr().out) == (looks == 2)
