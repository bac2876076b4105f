"""Models of light against Mitsuba and closed forms."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage, signal

import norm_balls as nb
from augment.scene import lights, patterns
from augment.scene.surfaces import Surface
from renderer.image import decode, encode
from renderer.mitsuba_scene import mitsuba

SIZE = (32, 32)


def drawn_of(model: lights.LightModel, first: dict[int, float], size=SIZE) -> lights.Drawn:
    draws = torch.Generator().manual_seed(0)
    values = torch.rand(1, model.dimensions + model.constants, generator=draws)
    values[0, [*first]] = torch.tensor([*first.values()], dtype=torch.float32)
    return model.draw(values, size, seeds=[3])


def irradiance_of_mitsuba(surface: Surface, emitter: dict, folder) -> np.ndarray:
    x, y, height = (one.expand(1, 1, *SIZE).flatten().double().numpy() for one in surface.position)
    slopes = surface.slope_right, surface.slope_down, torch.full_like(surface.slope_down, -1)
    normals = torch.cat(slopes, 1)[0].flatten(1).T.double().numpy() * [-1, 1, -1]
    index = np.arange(len(height)).reshape(SIZE)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    points = np.stack([x, -y, height], -1)
    mesh = trimesh.Trimesh(points, faces, vertex_normals=normals, process=False)
    mesh.export(folder / "surface.ply", vertex_normal=True)
    film = {"type": "hdrfilm", "width": SIZE[1], "height": SIZE[0], "rfilter": {"type": "box"}}
    with mitsuba("scalar_rgb") as mi:
        above = mi.ScalarTransform4f().look_at([0, 0, 9], [0, 0, 0], [0, 1, 0])
        white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
        surface_of_file = {"type": "ply", "filename": str(folder / "surface.ply"), "bsdf": white}
        sampler = {"type": "stratified", "sample_count": 16}
        sensor = {"type": "orthographic", "to_world": above, "film": film, "sampler": sampler}
        parts = {"surface": surface_of_file, "lamp": emitter, "sensor": sensor}
        scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, **parts})
        return math.pi * np.array(mi.render(scene))[..., 0]


def test_directional_light_on_heights_is_that_of_mitsuba(tmp_path):
    drawn = drawn_of(model := lights.DirectionalLight(), {0: 0.3, 2: 0.6})
    azimuth, polar = drawn.numbers[1:3]
    x, y = math.sin(polar) * math.cos(azimuth), -math.sin(polar) * math.sin(azimuth)
    emitter = {"type": "directional", "direction": [-x, -y, -math.cos(polar)]}
    emitter["irradiance"] = {"type": "rgb", "value": 1.0}
    expected = irradiance_of_mitsuba(drawn.surface(), emitter, tmp_path)
    field = model.light(drawn).field[0, 0].numpy()
    # The border of the mesh is at the centers of the outer pixels.
    np.testing.assert_allclose(field[1:-1, 1:-1], expected[1:-1, 1:-1], atol=5e-3)
    assert np.ptp(field) > 0.3


def test_a_point_light_on_heights_is_that_of_mitsuba(tmp_path):
    drawn = drawn_of(model := lights.PointLight(), {0: 0.3})
    right, down, above = drawn.numbers[1:4]
    emitter = {"type": "point", "position": [float(right), -float(down), float(above)]}
    emitter["intensity"] = {"type": "rgb", "value": float(above) ** 2}
    expected = irradiance_of_mitsuba(drawn.surface(), emitter, tmp_path)
    field = model.light(drawn).field[0, 0].numpy()
    np.testing.assert_allclose(field[1:-1, 1:-1], expected[1:-1, 1:-1], atol=5e-3)
    assert np.ptp(field) > 0.3


@pytest.mark.parametrize("kind", lights.CastShadow().kinds)
def test_a_penumbra_is_the_sharp_shadow_averaged_over_the_disc_of_the_sun(kind):
    size = (160, 160)
    model = lights.CastShadow((kind,))
    # The second radius is 1e-6.
    soft, sharp = (drawn_of(model, {3: 0.8, 4: radius}, size) for radius in (0.6, -2.5))
    radius = float(soft.numbers[4]) * size[1] / 2
    y, x = np.indices((2 * math.ceil(radius) + 1,) * 2) - math.ceil(radius)
    disc = (x * x + y * y <= radius * radius).astype(float)
    seen = [model.light(drawn).field[0, 0].double().numpy() / math.pi for drawn in (soft, sharp)]
    averaged = ndimage.convolve(seen[1], disc / disc.sum())
    inner = np.s_[16:-16, 16:-16]
    error = np.abs(seen[0] - averaged)[inner]
    assert error.mean() < 0.01 and np.ptp(averaged) > 0.9


def test_a_shadow_of_no_kind_is_refused():
    with pytest.raises(nb.InputError, match="kinds is empty"):
        lights.CastShadow(())


def test_lamps_add_up():
    model = lights.ColoredLamps()
    drawn = drawn_of(model, {model.dimensions: 0.99})
    total = 0.0
    for lamp in drawn.numbers[1:16, 0, 0, 0, 0].split(5):
        color = patterns.random_colors(lamp[None, 3:])
        white = lights.lamp_light(drawn, lamp[None, None, :3], torch.ones(1, 1, 1))
        total = total + color * white
    torch.testing.assert_close(model.light(drawn).field, total)


def test_a_slide_on_a_print_that_faces_the_projector_is_its_picture():
    model = lights.ProjectedSlide()
    # No steepness, no angle and no gain.
    drawn = drawn_of(model, {0: 0, 2: 0, **dict.fromkeys(range(4, 31), 0.5)})
    picture = patterns.draw_slides(1, SIZE, torch.Generator().manual_seed(3))
    torch.testing.assert_close(model.light(drawn).total(), picture + drawn.numbers[3])


def test_a_ramp_has_the_mean_1_and_its_contrast():
    drawn = drawn_of(model := lights.LinearLight(), {0: 0.13, 1: 0.8}, (400, 300))
    light = model.light(drawn).total()
    assert light.mean() == pytest.approx(1, abs=1e-5)
    assert light.min() == pytest.approx(1 - 0.8 * 0.95, abs=0.01)


@pytest.mark.parametrize("kind", ["stripes", "waves", "border"])
@pytest.mark.parametrize("axis", [2, 3])
def test_stripes_of_a_scanner_have_their_period_place_and_contrast(kind, axis):
    """The surface is flat. The period is 8 of 64 pixels, the ambient light 0.1, the exposure 1."""
    numbers = {0: math.log(5) / math.log(40), 1: 0.6, 2: 0.5, 3: 0.0, 4: 0.5}
    numbers |= {5: math.log(10) / math.log(40), 6: math.log(0.3) / math.log(0.15)}
    constants = {7: axis == 3, 8: {"stripes": 0.3, "waves": 0.7, "border": 0.9}[kind], 9: 0.0}
    drawn = drawn_of(model := lights.Stripes(), numbers | constants, size=(64, 64))
    light = model.illumination(drawn).total()
    assert (light.amax(5 - axis) - light.amin(5 - axis)).max() < 1e-5
    profile = light.mean(5 - axis).flatten().numpy()
    x = np.arange(64) - 31.5
    wave = 2 * math.pi * (x / 8 + 0.6)
    expected = {"stripes": signal.square(wave), "waves": np.sin(wave), "border": np.sign(x + 5.12)}
    np.testing.assert_allclose(profile, 0.55 + 0.45 * expected[kind], atol=0.18)


def test_each_octave_of_cloudy_light_has_half_the_amplitude():
    model, start, amplitudes = lights.FractalLight(), 0, []
    for nodes in model.octaves:
        chosen = torch.full((200, model.dimensions + model.constants), 0.5)
        part = chosen[:, model.dimensions :].view(200, 2, -1)[:, :, start : start + nodes**2]
        part.copy_(torch.rand(part.shape, generator=torch.Generator().manual_seed(1)))
        light = model.light(model.draw(chosen, (64, 64))).field.log()
        # At its corners, a spline has the variance of its nodes.
        amplitudes.append(float(light[:, 0, [0, 0, -1, -1], [0, -1, 0, -1]].std()))
        start += nodes**2
    np.testing.assert_allclose(np.divide(amplitudes[1:], amplitudes[:-1]), 0.5, rtol=0.15)


@pytest.mark.parametrize("kelvin", [2000, 4000, 15000])
def test_a_camera_that_knows_the_temperature_sees_no_color(kelvin):
    lamp = (1 / kelvin - 1 / 2000) / (1 / 15000 - 1 / 2000)
    drawn = drawn_of(model := lights.ColorTemperature(), {0: lamp, 1: 1.0, 2: 0.5})
    torch.testing.assert_close(model.light(drawn).total(), torch.ones(1, 3, 1, 1))


def test_a_long_exposure_multiplies_linear_light_and_clips_it():
    image = torch.rand(3, 5, 5, generator=torch.Generator().manual_seed(0))
    light = (transform := nb.RandomLighting("highlights")).make_params()
    factor = 2 ** (0.5 + 2.5 * float(light["lights"][0].values[0]))
    expected = encode((decode(image, "srgb") * factor).clamp(max=1), "srgb")
    torch.testing.assert_close(transform.apply(image, light), expected)
