"""The parts of a sum of lights: which coefficients, positions and files belong to which light."""

import math
import xml.etree.ElementTree as xml

import pytest
import torch

from renderer.camera import OrthographicCamera
from renderer.light.basis import Harmonics, SumBasis, split_light
from renderer.light.environment import read_map
from renderer.light.lamps import Lamps, Projector
from renderer.mesh import Mesh
from renderer.mitsuba_scene import SCENE, write_mitsuba_scene
from renderer.settings import ImageSettings
from renderer.solids import sphere


def test_a_light_is_split_into_environment_light_and_local_lights_in_any_order():
    lamps, projector = Lamps(((2.0, 0.0, 1.0), (0.0, 2.0, 1.0))), Projector(3)
    coefficients = torch.arange(20.0)[:, None].expand(-1, 3)
    split = split_light(SumBasis((lamps, Harmonics(2), projector)), coefficients)
    assert split.environment[:, 0].tolist() == list(range(2, 11))
    first = [(basis, values[0, 0].item()) for basis, values in split.local_lights]
    assert first == [(lamps, 0), (projector, 11)]


def test_each_projector_has_its_own_pattern_in_a_scene_of_mitsuba(tmp_path):
    dark_pattern = torch.full((4, 3), 0.25)
    lights = [(Projector(2), dark_pattern), (Projector(2), torch.full((4, 3), 0.5))]
    ball = Mesh.plain(*sphere(1))
    camera = OrthographicCamera(57.3, 0.0, 2.0)
    write_mitsuba_scene(tmp_path, ball, 1.0, [camera], ImageSettings(4), "light.exr", lights)
    emitters = xml.parse(tmp_path / SCENE).findall("emitter[@type='projector']")
    files = [emitter.find(".//string[@name='filename']").get("value") for emitter in emitters]
    shown_values = [read_map(tmp_path / file).unique().tolist() for file in files]
    assert shown_values == [[0.25], [0.5]]


@pytest.mark.parametrize("light", [Lamps(((2.0, 0.0, 1.0),), power=3.0), Projector(1, power=0.5)])
def test_lamps_and_projectors_are_projected_to_the_range_from_0_to_their_power(light):
    projected = light.project_nonnegative(torch.tensor([[-100.0, 0.25, 100.0]]))
    assert projected.tolist() == [[0, 0.25, light.power]]


def test_lights_in_mitsuba_are_brighter_by_the_factor_for_the_albedo():
    """A disc of radius r has the area π r². The projector is lit at distance 1 instead of 3."""
    powers = torch.tensor([[0.5, 1.0, 2.0]])
    [point] = Lamps(((2.0, 0.0, 1.0),)).mitsuba_emitters(powers, 0.25)
    assert point["intensity"]["value"] == pytest.approx(
        [math.pi * c for c in (1 / 8, 1 / 4, 1 / 2)]
    )
    [disc] = Lamps(((2.0, 0.0, 1.0),), radius=0.5).mitsuba_emitters(powers, 0.25)
    assert disc["emitter"]["radiance"]["value"] == pytest.approx([0.5, 1.0, 2.0])
    [projector] = Projector(1, distance=3.0).mitsuba_emitters(powers, 0.25)
    assert projector["scale"] == pytest.approx(9 / 4)
