from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import normalized_light as benchmark
from tests.helpers import darker_than

SIZE = 8


@pytest.fixture
def renders(tmp_path) -> Path:
    """Write gray images of both splits, whose brightness tells the class only after exposure.

    An orange has a dark center, at any exposure. Other images are even.
    """
    generator = np.random.default_rng(0)
    for split in (benchmark.VALIDATION, benchmark.TEST):
        for part in benchmark.PARTS:
            for name in ("orange", "other_ball"):
                folder = tmp_path / split / part / name
                folder.mkdir(parents=True)
                for number in range(6):
                    pixels = np.full((SIZE, SIZE, 3), generator.integers(40, 250), np.uint8)
                    if name == "orange":
                        pixels[2:6, 2:6] = pixels[2:6, 2:6] // 2
                    Image.fromarray(pixels).save(folder / f"{number}.png")
    return tmp_path


def test_the_splits_share_no_object_pattern_or_map():
    names = {}
    for split in (benchmark.VALIDATION, benchmark.TEST):
        settings = benchmark.parts(Path("data"), Path("renders"))
        names[split] = set()
        for part in (benchmark.PATTERNS, benchmark.MAPS):
            lab = settings[f"{split}/{part}"]
            names[split] |= {*lab["meshes"], *lab["patterns"], *lab.get("environments", [])}
    assert len(names[benchmark.TEST]) > 20
    assert names[benchmark.VALIDATION].isdisjoint(names[benchmark.TEST])


def test_normalized_light_ranks_images_whose_contrast_tells_the_class(renders, monkeypatch, capsys):
    load = lambda name, size: darker_than(0.9, SIZE, name, scale=10)  # noqa: E731
    monkeypatch.setattr(benchmark, "load", load)
    monkeypatch.setattr(benchmark, "CANDIDATES", {"level": (0.6, 0.9)})
    benchmark.main(["choose", "--renders", str(renders)])
    assert "best: {'percentile': 98.0" in capsys.readouterr().out
    benchmark.main(["test", "--renders", str(renders)])
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split(" | ") for line in lines if "efficientnet_lite0" in line]
    areas = [float(row[3].split()[0]) for row in rows if row[2].strip() == "with"]
    assert areas == [1.0, 1.0, 1.0]
