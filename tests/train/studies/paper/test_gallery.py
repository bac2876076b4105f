"""The paper's rendering quality, gallery and run time."""

import json
import math
from itertools import repeat

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from torch import nn

from augment.attacks import files
from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.utils import generator
from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from renderer.mesh import Mesh
from train.studies.page import wrapped
from train.studies.paper import gallery, run_time
from train.studies.paper.adversaries import ATTACKS
from train.studies.paper.iterations import Setup, Stopwatch, stubborn
from train.studies.paper.rendering_quality import STATISTICS, bootstrap, enough_views, record, views_of
from train.studies.paper.run_time import Attack
from train.studies.paper.section import Study
from train.studies.paper.study import with_section
from train.studies.paper.subjects import FIELDS_OF_VIEW, GREYS, scene_of

SIZE = 24
BALL = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
CLASSES = ("orange", "candle", "joystick")


class Bright(nn.Module):
    """An orange where an image's mean is above a threshold, else a candle where its left half is the brighter."""

    def __init__(self, threshold: float):
        super().__init__()
        self.register_buffer("threshold", torch.tensor(threshold))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        margin = 20 * (images.mean((1, 2, 3)) - self.threshold)
        left, right = images[..., : SIZE // 2].mean((1, 2, 3)), images[..., SIZE // 2 :].mean((1, 2, 3))
        return torch.stack([margin, left - right, right - left], dim=1)


def bright(threshold: float = 0.2) -> Classifier:
    return Classifier(Bright(threshold), SIZE, CLASSES, "bright")


@pytest.fixture
def subject():
    return SceneObject("orange", Mesh.plain(BALL.vertices, BALL.faces, (0.5, 0.4, 0.3)), name="ball")


# ---------------------------------------------------------------------------------------- rendering quality


NONE = math.nan


def test_a_view_holds_the_confidence_of_the_label_where_it_is_the_answer(subject):
    classifier, light = bright(0.4), "grace"
    found = next(views_of(subject, classifier, light, seed=0))
    azimuth = 2 * math.pi * float(torch.rand((), generator=generator(0, subject.name, "quality")))
    camera = OrthographicCamera(math.pi / 3, azimuth, FIELDS_OF_VIEW[0])
    for grey, confidence in zip(GREYS, found, strict=True):
        scene, first = scene_of(subject, classifier, light, [[camera]], torch.tensor([grey])), torch.arange(1)
        shares = classifier(scene.render(scene.conditions(first), first)[:, 0]).softmax(1)[0]
        expected = float(shares[0]) if shares.argmax() == 0 else NONE
        assert confidence == pytest.approx(expected, abs=1e-6, nan_ok=True)  # a few ε of float32, in batches of five
    assert 0 < np.isfinite(found).sum() < len(GREYS)  # the greys straddle the threshold


def test_views_are_drawn_until_enough_renders_are_recognised():
    found = enough_views(repeat(np.array([0.5, NONE, 0.7, NONE, NONE])), 7, "ball")
    assert found.shape == (4, 5)  # two recognised each


def test_a_mesh_that_is_never_recognised_is_given_up():
    with pytest.raises(InputError, match="ball: only 0 of"):
        enough_views(repeat(np.full(5, NONE)), 7, "ball")


def test_statistics_count_recognised_renders_and_their_confidence():
    views = np.array([[0.2, NONE, 0.7, NONE, NONE], [0.6, 0.9, 0.4, NONE, NONE]])
    assert [statistic(views) for statistic in STATISTICS.values()] == [0.5, 0.6, 0.6]


def test_the_bootstrap_resamples_cameras_and_not_renders():
    """All renders of a camera agree, so 200 cameras carry 200 outcomes: a standard error of √(0.25 / 200) = 0.035."""
    views = np.array([[0.9 if index % 2 else NONE] * 5 for index in range(200)])
    low, high = bootstrap(views, STATISTICS["recognised"], seed=0)
    # 1000 resamples give a quantile at 2.5 % within about a tenth of the half width.
    assert (high - low) / 2 == pytest.approx(1.96 * 0.0354, rel=0.15)


def test_a_histogram_holds_each_recognised_render_once():
    found = record("ball", np.array([[0.01, NONE, 0.99, NONE, 1.0], [0.52, 0.52, NONE, NONE, NONE]]))
    assert (found["mesh"], found["rendered"], found["recognised"]) == ("ball", 10, 5)
    assert found["histogram"] == [1, *[0] * 9, 2, *[0] * 8, 2]


# ---------------------------------------------------------------------------------------- the page


def test_paragraphs_and_lists_are_wrapped_and_tables_headings_and_code_are_not():
    words, row, code = "word " * 60, f"| {'cell ' * 40}|", f"```bash\n{'word ' * 40}\n```"
    text = "\n\n".join(["## Title", words, f"- {words}\n- one\n  item", row, code])
    heading, paragraph, items, table, block = wrapped(text).split("\n\n")
    assert [heading, table, block] == ["## Title", row, code]
    assert paragraph.split() == words.split() and items.split() == f"- {words} - one item".split()
    assert max(map(len, f"{paragraph}\n{items}".split("\n"))) <= 120
    assert [line[:2] for line in items.split("\n")] == ["- ", "  ", "  ", "- "] and items.endswith("- one item")


def test_a_section_takes_the_place_of_its_title_in_the_order_of_the_page():
    page = ""
    for title in ("Run time", "Unseen views", "Run time"):
        page = with_section(page, title, f"{title}\n\n### Part\n\nnumber {len(page)}\n")
    parts = [block.splitlines() for block in page.split("\n## ")]
    assert [part[0] for part in parts] == ["# The paper's tables and figures", "Unseen views", "Run time"]
    assert page.count("number") == 2 and "number 0" not in page and page.endswith("\n") and "\n\n\n" not in page


# ---------------------------------------------------------------------------------------- run time


@pytest.mark.parametrize(("views", "backgrounds"), [(1, (0.5,)), (3, GREYS)])
@pytest.mark.parametrize("kind", ATTACKS)
def test_an_iteration_holds_its_time_in_the_classifier_and_the_pixels_it_covers(subject, kind, views, backgrounds):
    """A ball looks the same from all sides."""
    setup = Setup("ball", subject, 2, "smooth", views, backgrounds)
    measured = stubborn(setup, kind, bright(), "grace", 4.0, passes=2, turns=3)
    assert len(measured.whole) == len(measured.bare) == len(measured.inside) == 3
    assert (measured.renderer > 0).all() and min(measured.inside) > 0
    # The unit ball fills π/16 of an image that is 4 wide; its outline of 6π pixels counts whole.
    assert 0 < measured.pixels - math.pi / 16 * SIZE**2 < 6 * math.pi


def test_the_stopwatch_counts_only_the_classifier():
    watch = Stopwatch()
    with watch("attack_classifier"):
        sum(range(100_000))
    counted = watch.seconds
    with watch("other"):
        sum(range(100_000))
    assert watch.seconds == counted > 0


def test_failures_count_as_attacks_without_end():
    success, failed = Attack("ball", True, 3, 0.2), Attack("ball", False, 30, 2.0)
    assert "67% [" in run_time.finding([success, success, failed]) and ": met" in run_time.finding(
        [success, success, failed]
    )
    assert "not met" in run_time.finding([success, failed, failed])


def test_the_distribution_is_over_attacks_that_succeed():
    done = [Attack("ball", True, steps, steps / 10) for steps in range(1, 10)] + [Attack("ball", False, 30, 9.0)]
    steps, spent = run_time.distribution(done)
    assert steps == ["steps", "3", "5", "7", "8", "9"]
    assert spent == ["seconds", "0.30", "0.50", "0.70", "0.82", "0.90"]


def test_each_image_is_attacked_until_it_is_fooled(subject):
    settings = run_time.Settings("run_time", threads=1, examples=2, max_steps=5, passes=2, turns=3)
    done = list(run_time.attacks(subject, Study(bright(0.35), [], "grace", "orange", seed=0), settings))
    assert len(done) == settings.examples
    assert all(each.seconds > 0 for each in done)
    assert all(each.success or each.steps == settings.max_steps for each in done)


# ---------------------------------------------------------------------------------------- gallery


def test_the_gallery_has_a_small_image_and_a_row_for_each_case(tmp_path, monkeypatch, reproduce):
    BALL.export(tmp_path / "ball.ply")
    meshes = f"scene.meshes=[{tmp_path}/ball.ply,{tmp_path}/ball.ply]"
    monkeypatch.setattr(gallery, "VERTICES", 100)
    monkeypatch.setattr(files, "SPHERE", 16)
    settings = ["section.targets=[candle,joystick]", "section.steps=2", f"out={tmp_path}/docs"]
    reproduce(bright(), "section=gallery", meshes, *settings)
    folder = tmp_path / "docs" / "paper"
    text, lines = folder.with_suffix(".md").read_text(), (folder / "gallery.jsonl").read_text().splitlines()
    assert str(tmp_path) not in text
    for numbers in map(json.loads, lines):
        path = folder / f"gallery_{numbers['case']}.png"
        assert f"(paper/{path.name})" in text
        assert path.stat().st_size <= gallery.LIMIT
        with Image.open(path) as image:
            assert np.asarray(image.convert("RGB")).std() > 1
        assert len(numbers["before"]) == len(numbers["after"]) == numbers["views"]
    assert len(lines) == len(list(folder.glob("gallery_*.png"))) == 10


def test_a_gallery_of_one_mesh_is_refused(tmp_path, reproduce):
    with pytest.raises(InputError, match="section=gallery has two"):
        reproduce(bright(), "section=gallery", "scene.meshes=[a.ply]", "section.targets=[candle]", f"out={tmp_path}")
