import json

import pytest
import torch
import trimesh

from augment.classifiers import Classifier
from augment.objects import SceneObject
from renderer.camera import OrthographicCamera
from renderer.mesh import Mesh
from train.studies.paper import balls, norm_balls, subjects
from train.studies.paper.balls import LEVELS, SPACES, Outcome, attack_ball, parts
from train.studies.paper.norm_balls import most_comparable
from train.studies.paper.subjects import scene_of

SIZE = 12
BALL = trimesh.creation.icosphere(subdivisions=2, radius=1.0)


def mean_above(threshold: float) -> Classifier:
    """Calls an image an orange if the mean of its values is above a threshold."""

    def logits(images):
        margin = images.mean((1, 2, 3)) - threshold
        return torch.stack([margin, torch.zeros_like(margin)], dim=1)

    return Classifier(logits, SIZE, ["orange", "other"], "mean")


@pytest.fixture
def subject():
    return SceneObject("orange", Mesh.plain(BALL.vertices, BALL.faces, (0.5, 0.4, 0.3)), name="ball")


@pytest.fixture
def scene(subject):
    cameras = [[OrthographicCamera(1.0, azimuth, 3.0)] for azimuth in (0.0, 2.0, 4.0)]
    return scene_of(subject, mean_above(0), "st_peters", cameras, torch.full((3,), 0.5))


def attack(scene, threshold: float, name: str, radius: float) -> Outcome:
    return attack_ball(scene, mean_above(threshold), "orange", name, radius, 3, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("excess, fooled", [(0.9, True), (1.1, False)])
def test_a_pixel_attack_lowers_a_mean_by_its_radius_and_random_draws_do_not(scene, excess, fooled):
    """All values lie further than the radius from 0 and 1, so that the sign step takes it off each of them."""
    radius, first = 0.02, torch.arange(1)
    start = scene.render(scene.conditions(first), first)
    assert radius < start.min() and start.max() < 1 - radius
    outcome = attack(scene, float(start.mean()) - excess * radius, "pixels", radius)
    assert outcome.adversarial[0] == fooled
    assert not outcome.search[0]  # the mean of 432 draws is off by radius / √(3 · 432), a thirtieth of the radius
    assert float(outcome.reach[0]) == pytest.approx(radius, abs=1e-6)  # a few ε of values below 1


@pytest.mark.parametrize("name", SPACES)
def test_a_search_holds_its_first_draw_and_fools_a_classifier_on_the_verge(scene, name):
    verge = 0.99999 * float(images_of(scene).mean((1, 2, 3, 4)).min())
    found = [attack(scene, verge, name, SPACES[name].radii[index]) for index in (0, -1)]
    assert all((each.random <= each.search).all() for each in found)
    assert any(each.search.any() for each in found)
    assert not attack(scene, 0, name, SPACES[name].radii[-1]).search.any()


def test_parts_hold_all_examples_in_order(scene, monkeypatch):
    monkeypatch.setattr(balls, "PART", 2)
    split = list(parts(scene))
    assert [len(part) for part in split] == [2, 1]
    seen = torch.cat([images_of(part) for part in split])
    torch.testing.assert_close(seen, images_of(scene), rtol=0, atol=1e-6)  # products of other sizes round otherwise


def images_of(scene):
    every = torch.arange(len(scene))
    return scene.render(scene.conditions(every), every)


def outcome_with(reach: list[float], adversarial: list[bool]) -> Outcome:
    hits, before = torch.tensor(adversarial), torch.zeros(len(reach), 3, 1, 1)
    return Outcome(hits, hits, hits, before, before + torch.tensor(reach).view(-1, 1, 1, 1), hits.long())


def test_the_example_shown_is_the_one_nearest_to_the_levels_by_adversaries_alone():
    """The second example reaches the levels best, but its nearest image at the smallest radius fools nobody."""
    found = {}
    for name, space in SPACES.items():
        levels = [*LEVELS.values(), *[2.0] * len(space.radii)]
        for index, radius in enumerate(space.radii):
            hits = [True, index > 0, True]
            found[name, radius] = outcome_with([levels[index] + off for off in (0.05, 0.0, 0.3)], hits)
    example, chosen = most_comparable(found)
    assert example == 0
    assert chosen == {
        (name, level): space.radii[index] for name, space in SPACES.items() for index, level in enumerate(LEVELS)
    }


def test_the_section_has_datan_images_and_text_without_paths(tmp_path, monkeypatch, reproduce):
    monkeypatch.setattr(subjects, "VERTICES", 0)
    BALL.export(tmp_path / "ball.ply")
    settings = [f"scene.meshes=[{tmp_path}/ball.ply]", "section.examples=2", "section.steps=1", f"out={tmp_path}"]
    reproduce(mean_above(0.2), "section=norm_balls", *settings)
    records = [json.loads(line) for line in (tmp_path / "paper" / "norm_balls.jsonl").read_text().splitlines()]
    balls = [(name, radius) for name, space in SPACES.items() for radius in space.radii]
    assert [(each["mesh"], each["space"], each["radius"]) for each in records] == [
        (mesh, *ball) for mesh in ("ball", "all") for ball in balls
    ]
    for each in records:
        for method in norm_balls.METHODS:
            assert each[method]["n"] == 2 and each[method]["low"] <= each[method]["value"] <= each[method]["high"]
    page = (tmp_path / "paper.md").read_text()
    assert page.count("| light |") == len(SPACES["lighting"].radii) and str(tmp_path) not in page
    for name in ("norm_balls.png", "norm_balls.spaces.png"):
        assert f"(paper/{name})" in page
        assert (tmp_path / "paper" / name).read_bytes().startswith(b"\x89PNG")
