import json
import math
from dataclasses import replace

import PIL.Image
import pytest
import torch
import trimesh

from augment.attacks.descent import DescentSettings
from augment.attacks.parameters import Lighting, StepSettings
from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.utils import generator
from renderer.camera import OrthographicCamera, ring
from renderer.errors import InputError
from renderer.files.mesh_export import export_mesh
from renderer.mesh import Mesh
from train.studies.paper import adversaries, subjects, transfer, unseen_views
from train.studies.paper.adversaries import ATTACKS, FURTHER, with_random_signs
from train.studies.paper.shares import percent
from train.studies.paper.subjects import answers, recognised_parts, scene_of

SIZE = 12
BALL = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
SUBJECT = SceneObject("orange", Mesh.plain(BALL.vertices, BALL.faces, (0.5, 0.4, 0.3)), name="ball")


def by_brightness(grey: float = 0.2, name: str = "source") -> Classifier:
    """Calls what is brighter than a grey in the middle an orange."""
    middle = slice(SIZE // 3, SIZE - SIZE // 3)

    def logits(images):
        bright = 20 * (images[:, :, middle, middle].mean((1, 2, 3)) - grey)
        return torch.stack([bright, -bright], dim=1)

    return Classifier(logits, SIZE, ("orange", "coal"), name)


def always(answer: str) -> Classifier:
    """Blind to images."""
    sign = 1 if answer == "orange" else -1
    return Classifier(
        lambda images: images.mean((1, 2, 3))[:, None] * 0 + sign * torch.tensor([1.0, -1.0]),
        SIZE,
        ("orange", "coal"),
        f"always {answer}",
    )


def a_scene(count: int, classifier: Classifier):
    return scene_of(SUBJECT, classifier, "grace", [[camera] for camera in ring(count, 2.0)], torch.full((count,), 0.5))


@pytest.fixture
def short(monkeypatch):
    """Shapes, which are rasterised at each step, are attacked for a step, and everything for one more."""
    geometry = replace(ATTACKS["geometry"], descent=DescentSettings(1, shorten=True))
    monkeypatch.setitem(ATTACKS, "geometry", geometry)
    monkeypatch.setattr(adversaries, "FURTHER", 1)


class Line:
    """Images of a value's grey."""

    start = torch.tensor([[0.42], [0.92]])

    def render(self, values, examples):
        return values.view(-1, 1, 1, 1, 1).expand(-1, 1, 3, SIZE, SIZE)

    def step(self, gradient):
        return 0.05 * gradient.sign()

    def project(self, values, examples):
        return values


# ---------------------------------------------------------------------------------------- attacks


def test_the_descent_stops_where_it_fools_and_then_goes_on_for_as_many_steps_as_were_asked():
    """From 0.42 in steps of 0.05 it is 5 steps to below 0.2, and from 0.92 it is 15."""
    attack = adversaries.Attack(Lighting, StepSettings(), DescentSettings(30))
    first, further = attack.adversaries(Line(), by_brightness(), "orange", views=1)
    # Sums of at most 25 float32 steps of size 0.05, each rounded to 2⁻²⁵.
    torch.testing.assert_close(first, torch.tensor([[0.17], [0.17]]), rtol=0, atol=1e-6)
    torch.testing.assert_close(further, first - 0.05 * FURTHER, rtol=0, atol=1e-6)


def test_random_signs_go_as_far_in_every_entry_and_to_either_side():
    draws = generator(0, "test")
    start = torch.randn(4, 500, generator=draws, dtype=torch.float64)
    values = start + torch.randn(4, 500, generator=draws, dtype=torch.float64)
    values[:, :100] = start[:, :100]
    drawn = with_random_signs(values, start, draws)
    torch.testing.assert_close((drawn - start).abs(), (values - start).abs(), rtol=0, atol=1e-14)  # two roundings
    assert torch.equal(drawn[:, :100], start[:, :100])
    agreeing = ((drawn - start) * (values - start) > 0).double().mean()
    assert 0.35 < agreeing < 0.45  # half of 400 of 500 entries, ten standard deviations of 1600 draws


def test_examples_are_drawn_until_as_many_are_recognised_as_were_asked(monkeypatch):
    parts = list(recognised_parts(SUBJECT, by_brightness(), "grace", 5, generator(0, "test"), at_once=2))
    assert sum(map(len, parts)) == 5
    monkeypatch.setattr(subjects, "LEAST_SHARE", 0.5)
    with pytest.raises(InputError, match="always coal recognises only 0"):
        list(recognised_parts(SUBJECT, always("coal"), "grace", 1, generator(0, "test")))


# ---------------------------------------------------------------------------------------- transfer


def test_all_transfers_to_an_equal_network_and_nothing_to_a_blind_one(short):
    source, twin, blind = by_brightness(), by_brightness(name="twin"), always("orange")
    records = list(transfer.transfer(SUBJECT, (source, twin, blind), 3, "grace", generator(0, "test")))
    lighting = [record for record in records if record["kind"] == "lighting"]
    assert len(lighting) == 1 and len(records) == 2
    for state in ("first", "further"):
        assert transfer.outcomes(lighting, "twin", state, "source", "orange") == [True] * 3
        assert transfer.outcomes(lighting, blind.name, state, "source", "orange") == [False] * 3


def test_only_what_fools_the_source_and_was_recognised_counts():
    source = {"before": ["orange"] * 4, "first": ["coal", "coal", "coal", "orange"], "first_random": ["orange"] * 4}
    target = {
        "before": ["orange", "orange", "coal", "orange"],
        "first": ["coal", "orange", "coal", "coal"],
        "first_random": ["orange", "coal", "coal", "coal"],
    }
    records = [{"answers": {"source": source, "target": target}}]
    assert transfer.outcomes(records, "target", "first", "source", "orange") == [True, False]
    assert transfer.outcomes(records, "target", "first_random", "source", "orange") == [False, True]
    assert transfer.outcomes(records, "source", "first", "source", "orange") == [True, True, True, False]
    assert transfer.outcomes(records, "source", "first_random", "source", "orange") == [False] * 4


@pytest.mark.parametrize(
    ("found", "text"),
    [([], "none of 0"), ([True] * 81 + [False] * 182, "31 % [26, 37] of 263")],
    ids=["none", "Newcombe"],
)
def test_a_cell_has_the_share_with_its_wilson_interval(found, text):
    """81 of 263: 0.2553 to 0.3662 (Newcombe 1998, table I)."""
    assert percent(found) == text


# ---------------------------------------------------------------------------------------- unseen views


@pytest.mark.parametrize("kind", ATTACKS)
def test_views_together_have_the_sum_of_their_gradients(kind):
    scene = a_scene(3, by_brightness())
    problem, every = ATTACKS[kind].problem(scene), torch.arange(3)
    together = unseen_views.Together(problem)
    shared = together.start.clone().requires_grad_(True)
    apart = problem.start.clone().requires_grad_(True)
    views, images = together.render(shared, torch.tensor([0])), problem.render(apart, every)
    assert torch.equal(views[0], images[:, 0])
    views.square().sum().backward()
    images.square().sum().backward()
    assert apart.grad.abs().amax() > 0
    # Float32 sums of three views in another order.
    torch.testing.assert_close(shared.grad[0], apart.grad.sum(0), rtol=1e-5, atol=1e-5 * float(apart.grad.abs().amax()))


def test_the_angle_to_the_attacked_view_goes_either_way_round():
    other, *seen = (OrthographicCamera(1.0, math.radians(each), 2.0) for each in (10, 350, 180, 31))
    assert [unseen_views.degrees_apart(each, other) for each in seen] == [20, 170, 21]


def test_darkness_fools_every_view_and_the_start_none():
    scene, classifier = a_scene(3, by_brightness(0.1)), by_brightness(0.1)
    problem = ATTACKS["lighting"].problem(scene)
    assert answers(classifier, problem.images(0 * problem.start)) == ["coal"] * 3
    assert answers(classifier, problem.images(problem.start)) == ["orange"] * 3


def test_each_unseen_view_has_an_answer_for_each_attack(short):
    records = list(unseen_views.unseen(SUBJECT, by_brightness(), 0, 4, "grace", 0))
    attacks = [(kind, views) for kind in ATTACKS for views in unseen_views.ATTACKED]
    assert [(record["kind"], record["attacked"]) for record in records] == attacks
    for record in records:
        assert len(record["angle"]) == 4 and all(0 < angle <= 180 for angle in record["angle"])
        assert record["answers"].keys() == unseen_views.STATES.keys()
        assert all(len(said) == 4 for said in record["answers"].values())


# ---------------------------------------------------------------------------------------- pages


@pytest.mark.parametrize(
    ("section", "settings", "lines"),
    [
        ("transfer", ["section.examples=1", "section.targets=[run:pretrained/random]"], 2),
        ("unseen_views", ["section.sets=1", "section.views=2"], 4),
    ],
)
def test_a_section_has_data_figure_and_text_alone(section, settings, lines, short, tmp_path, monkeypatch, reproduce):
    monkeypatch.setattr(subjects, "VERTICES", 0)
    monkeypatch.setattr(transfer, "load_classifier", lambda name: by_brightness(name=name))
    export_mesh(SUBJECT.mesh, tmp_path / "ball.glb")
    meshes, out = f"scene.meshes=[{{mesh:{tmp_path}/ball.glb,gain:1.5}}]", f"out={tmp_path}"
    reproduce(by_brightness(), f"section={section}", meshes, *settings, out)
    page = (tmp_path / "paper.md").read_text()
    data = (tmp_path / "paper" / f"{section}.jsonl").read_text()
    command = f"python scripts/reproduce_paper.py section={section} 'scene.meshes=[{{mesh:ball.glb,gain:1.5}}]'"
    assert command in page and str(tmp_path) not in page + data
    with PIL.Image.open(tmp_path / "paper" / f"{section}.png") as figure:
        assert figure.width > 400 and f"(paper/{section}.png)" in page
    assert len([json.loads(line) for line in data.splitlines()]) == lines
    assert "{" not in page.replace(command, "") and "nan" not in page.split("```")[0].lower().split()
