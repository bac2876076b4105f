"""Which coefficients of a sum of lights belong to which light."""

import xml.etree.ElementTree as xml

import pytest
import torch

from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.geometry.shapes import sphere
from renderer.io.mitsuba import SCENE, write_mitsuba_scene
from renderer.light.basis import Harmonics, SumBasis, parts_of, split_light
from renderer.light.environment import read_map
from renderer.light.lamps import Lamps
from renderer.light.projector import Projector
from renderer.settings import ImageSettings

LAMPS = Lamps(((2.0, 0.0, 1.0), (0.0, 2.0, 1.0)))
SKY = Harmonics(2)


@pytest.mark.parametrize("parts", [(SKY, LAMPS, Projector(3)), (LAMPS, SKY, Projector(3))])
def test_each_light_of_a_sum_has_its_own_coefficients_in_the_order_of_the_parts(parts):
    ends = torch.tensor([0, *(part.size for part in parts)]).cumsum(0).tolist()
    values = torch.arange(float(ends[-1]))[:, None].expand(-1, 3)
    expected = {part: values[first:end] for part, first, end in zip(parts, ends, ends[1:], strict=False)}
    basis = SumBasis(parts)
    found = {part: values[rows] for rows, part in parts_of(basis)}
    assert list(found) == list(parts)
    assert all(torch.equal(found[part], expected[part]) for part in parts)
    split = split_light(basis, values)
    assert torch.equal(split.environment, expected[SKY])
    assert [part for part, _ in split.local_lights] == [part for part in parts if part != SKY]
    assert all(torch.equal(coefficients, expected[part]) for part, coefficients in split.local_lights)


def test_a_sum_has_one_environment_light_at_most():
    with pytest.raises(InputError, match=r"^parts"):
        SumBasis((SKY, LAMPS, Harmonics(3)))


def test_only_lamps_are_moved():
    there = torch.tensor([[0.0, 0.0, 3.0], [1.0, 0.0, 3.0]])
    moved = SumBasis((SKY, Projector(3), LAMPS)).moved(there)
    assert moved.parts[:2] == (SKY, Projector(3))
    assert moved.parts[2] == Lamps(((0.0, 0.0, 3.0), (1.0, 0.0, 3.0)))


def test_each_projector_has_its_own_pattern_in_a_scene_of_mitsuba(tmp_path):
    lights = [(Projector(2), torch.full((4, 3), 0.25)), (Projector(2), torch.full((4, 3), 0.5))]
    ball, camera = Mesh.plain(*sphere(1)), OrthographicCamera(1.0, 0.0, 2.0)
    write_mitsuba_scene(tmp_path, ball, 1.0, [camera], ImageSettings(4), "light.exr", lights)
    emitters = xml.parse(tmp_path / SCENE).findall("emitter[@type='projector']")
    files = [emitter.find(".//string[@name='filename']").get("value") for emitter in emitters]
    assert [read_map(tmp_path / file).unique().tolist() for file in files] == [[0.25], [0.5]]
