import math

import pytest
import torch
import trimesh

from augment import reshading
from renderer.errors import InputError
from renderer.files.mitsuba_scene import DIFFERENTIABLE, mitsuba
from renderer.image import ImageSettings
from renderer.mesh import Mesh, normalise
from renderer.shapes import solid
from renderer.transport import radiosity, rays
from train.run_folder.classifier import load_classifier
from train.studies.quadrature import quadrature
from train.studies.transport import beside_mitsuba, cost, held


@pytest.fixture
def few_rays(monkeypatch):
    monkeypatch.setattr(rays, "DIRECTIONS", 64)
    monkeypatch.setattr(cost, "VIEWS", 1)


def pit() -> tuple[list, list]:
    """A square hole of width and depth 1: floor and walls, facing inward."""
    corners = [[x, y, z] for z in (0, 1) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    walls = [face for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)) for face in ([a, 4 + a, b], [b, 4 + a, 4 + b])]
    return corners, [[0, 1, 2], [0, 2, 3], *walls]


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


@pytest.mark.slow
def test_costs_are_of_each_transport_against_direct_light(few_rays):
    clock = cost.Clock(torch.device("cpu"), rounds=1)
    mesh = Mesh.plain(*pit())
    rows = cells(
        cost.costs(
            {"grey": cost.painted(mesh, (0.5, 0.5, 0.5)), "red": cost.painted(mesh, (0.9, 0.1, 0.1))}, [8], clock
        )
    )
    assert [row[:2] for row in rows] == [[name, each] for name in ("grey", "red") for each in cost.TRANSPORTS]
    assert [row[3] for row in rows] == ["1 × 31", "1 × 49", "1 × 49", "1 × 31", "1 × 49", "3 × 49"]
    assert rows[0][5].endswith("1.00 ×") and rows[3][5].endswith("1.00 ×")


def test_another_number_of_rays_and_patches_is_put_back():
    before = rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS
    with pytest.raises(InputError), quadrature(32, 16, 8):
        assert (rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS) == (32, 16, 8)
        raise InputError("anything")
    assert before == (rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS)


@pytest.mark.slow
def test_shadows_found_anew_at_each_step_are_right_and_those_held_are_not(monkeypatch):
    monkeypatch.setattr(held, "EXAMPLES", 2)
    monkeypatch.setattr(held, "STEPS", 4)
    monkeypatch.setattr(held, "EVERY", (1, math.inf))
    near, network = reshading.NEAR, load_classifier("run:pretrained/none", None)
    anew, still = cells(held.table(normalise(solid("cup", 0)), network))
    assert anew[0] == "one step" and anew[2:4] == ["0.00%", "0.0%"]
    assert still[0] == "the whole attack" and 0 < float(still[2].rstrip("%")) < 5
    assert near == reshading.NEAR


def test_mitsubas_image_is_in_the_place_of_ours(monkeypatch):
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(beside_mitsuba, "SEEDS", 2)
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh, settings = Mesh.plain(ball.vertices, ball.faces, (0.9, 0.5, 0.2)), ImageSettings(12)
    theirs, noise = beside_mitsuba.mitsuba_image(mesh, settings)
    off, inside = beside_mitsuba.image(beside_mitsuba.operator(mesh, settings)) - theirs, theirs[3] > 0.999
    assert inside.sum() > 20 and noise[:3, inside].mean() > 0
    assert off[:3, inside].abs().max() < 0.05 * theirs[:3].max()


@pytest.mark.slow
@pytest.mark.parametrize("transport", beside_mitsuba.TRANSPORTS)
@pytest.mark.parametrize("mesh", ["convex: a ball", "open: half a ball", "rugged: a dented ball"])
def test_images_and_gradients_by_the_light_go_to_mitsubas_noise(mesh, transport):
    """Which is itself known from eight renders to a fifth or so; a convex mesh has nothing to converge."""
    pytest.importorskip("mitsuba")
    try:
        with mitsuba(DIFFERENTIABLE):
            pass
    except InputError as error:
        pytest.skip(str(error))
    of_image, of_gradient = (found := beside_mitsuba.errors(beside_mitsuba.meshes()[mesh], transport))[:4], found[4:]
    for error, converged, noise, direct in (of_image, of_gradient):
        assert 0 < noise < 0.006 and converged < 1.3 * noise
        assert error < 1.3 * noise if mesh.startswith("convex") else converged < error < 0.02 < direct
