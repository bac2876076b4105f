"""The public functions that render: images, their gradients, and what they accept."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from oracles import draw, draw_uniform, textured
from torch import Tensor

import renderer
from renderer.errors import InputError
from renderer.image import decode, encode
from renderer.light.basis import HARMONICS, SumBasis, with_local_lights
from renderer.light.files import ambient, load_light
from renderer.light.lamps import Lamps, Projector
from renderer.operators.build import build_operators
from renderer.rendering import light_sphere
from renderer.settings import ENCODINGS, NORMALS, ImageSettings
from renderer.visibility import choose

EPS = torch.finfo(torch.float64).eps
EPS32 = torch.finfo(torch.float32).eps
CAMERAS = renderer.orbit_cameras(3, 2.4)
SMALL = {"size": 9, "rasterizer": "numpy"}
FACE_COUNT = 20


@pytest.fixture(scope="module")
def stone() -> renderer.Mesh:
    shape = trimesh.creation.icosahedron()
    plain = renderer.Mesh.plain(shape.vertices * [1.0, 0.9, 0.8], shape.faces)
    colors = np.random.default_rng(0).uniform(0.2, 0.8, (FACE_COUNT, 1, 3))
    corner_colors = colors.repeat(3, axis=1).astype(np.float32)
    return replace(plain, corner_colors=corner_colors)


@pytest.fixture(scope="module")
def light() -> Tensor:
    """Return a light under which no value of an image is clipped."""
    soft_front_light = ambient(torch.full((3,), 0.2).double())
    return soft_front_light + 0.02 * draw(49, 3)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("normals", NORMALS)
def test_an_operators_image_is_the_rendered_one(stone, light, encoding, normals):
    choices = SMALL | {"encoding": encoding, "normals": normals, "albedo_scale": 1.2}
    images = renderer.render(stone, CAMERAS, light, background=0.3, **choices)
    assert images.shape == (3, 3, 9, 9)
    operators = renderer.precompute_transfer(stone, CAMERAS, **choices)
    for image, operator in zip(images, operators, strict=True):
        # The operator is in float32. It adds 31 terms below 1, and the slope of
        # the sRGB curve is 12.92 near black.
        torch.testing.assert_close(operator.image(light, 0.3), image, rtol=0, atol=13 * 8 * EPS32)


@pytest.mark.parametrize("name", ["light", "roughness", "vertices", "polar", "linear", "operator"])
def test_second_derivatives_of_images_are_refused_whatever_they_are_asked_for(stone, light, name):
    """`torch.autograd.functional.hessian` leaves out what has no gradient, and gives zeros."""
    camera = renderer.PerspectiveCamera(60.0, 20.0, 2.4, distance=5.0)
    operator = renderer.precompute_transfer(stone, camera, encoding="srgb", **SMALL)

    def loss(value: Tensor) -> Tensor:
        if name == "operator":
            return operator.image(value).sum()
        changed = {name: value} if name == "vertices" else {}
        if name == "roughness":
            changed["gloss"] = renderer.Gloss(value, 0.5)
        shown = replace(camera, polar=value) if name == "polar" else camera
        lit = value if name in ("light", "linear") else light
        options = SMALL | {"silhouettes": name in ("vertices", "polar")} | changed
        if name == "linear":  # in the image, but not the image in the light
            return renderer.render(stone, shown, lit, encoding="srgb", **options).sum()
        return renderer.render(stone, shown, lit, **options).square().sum()

    start = {
        "roughness": torch.tensor([0.4]).double(),
        "vertices": torch.from_numpy(stone.vertices),
        "polar": torch.tensor(60.0).double(),
    }
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.functional.hessian(loss, start.get(name, light))


def test_autocast_changes_no_bit_of_images_operators_and_gradients(stone):
    light, sharp = load_light("grace").requires_grad_(), load_light("grace", 20)
    gloss = renderer.Gloss(torch.tensor([0.3]), 1.0)
    operators = renderer.precompute_transfer(stone, CAMERAS, gloss=gloss, **SMALL)
    scene = renderer.precompute_transfer(stone, CAMERAS[0], **SMALL)

    def compute() -> tuple[Tensor, ...]:
        images = renderer.render(stone, CAMERAS, light, **SMALL)
        glossy = renderer.render(stone, CAMERAS, sharp, gloss=gloss, **SMALL)
        image, gradient = scene.image_and_gradient(light.detach(), lambda image: 2 * image)
        return images, glossy, operators.image(light), scene.radiance(light), image, gradient

    expected = compute()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = compute()
    for pair in zip(found, expected, strict=True):
        assert torch.equal(*pair)
    # A backward pass outside of autocast is that of a training.
    gradients = [torch.autograd.grad(of[0].square().sum(), light)[0] for of in (found, expected)]
    assert torch.equal(*gradients)


def camera_at(place: np.ndarray) -> renderer.PinholeCamera:
    axes = renderer.PerspectiveCamera(50.0, 30.0, 2.6, distance=5.0).axes() * [[1], [-1], [-1]]
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = axes, [0, 0, 5.0] - axes @ place
    return renderer.PinholeCamera.from_matrix(view, [[60, 0, 12], [0, 60, 12], [0, 0, 1]], 24)


OFFSETS = [1e3, 5e5]


@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("options", [{}, {"normals": "flat"}, {"shadows": True}, {"bounces": 1}])
def test_a_mesh_in_coordinates_of_the_earth_is_rendered_as_at_the_origin(offset, options):
    cup, light = renderer.solid("cup"), load_light("grace")
    place = offset * np.array([0.5, -1.0, 0.25])
    moved = replace(cup, vertices=cup.vertices + place)
    expected = renderer.render(cup, camera_at(np.zeros(3)), light, 24, **options)
    found = renderer.render(moved, camera_at(place), light, 24, **options)
    # Far from the origin, the grid of patches begins at another place.
    tolerance = 0.03 if options.get("bounces") else 2e-5
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)
    operator = renderer.precompute_transfer(moved, camera_at(place), 24, **options)
    torch.testing.assert_close(operator.image(light, 0.5), expected, rtol=0, atol=tolerance)


def test_a_lamp_lights_a_mesh_far_from_the_origin_as_at_the_origin():
    cup, far = renderer.solid("cup"), np.array([6e4, 5e4, 1e3])
    images = []
    for place in (np.zeros(3), far):
        mesh = replace(cup, vertices=cup.vertices + place)
        lamp = Lamps((tuple(place + np.array([0.5, 1.0, 3.0])),))
        options = {"size": 24, "normals": "flat", "lights": [lamp]}
        images.append(renderer.render(mesh, camera_at(place), None, **options))
    assert images[0].max() > 0.1
    torch.testing.assert_close(*images, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "camera",
    [
        renderer.OrthographicCamera(55.0, 20.0, 2.3),
        renderer.PerspectiveCamera(55.0, 20.0, 2.3, distance=4.0),
        renderer.PinholeCamera(55.0, 20.0, 2.3, distance=4.0),
    ],
)
@pytest.mark.parametrize(
    "options",
    [{}, {"shadows": True}, {"silhouettes": True}, {"lights": [Lamps(((1.0, 1.0, 2.0),))]}],
)
def test_vertices_that_no_face_uses_change_neither_images_nor_gradients(camera, options):
    """The vertex lies behind the camera."""
    cup = renderer.normalize(renderer.solid("cup"))
    more = replace(cup, vertices=np.vstack([cup.vertices, [[3e4, 0.0, 0.0]]]))
    images, gradients = [], []
    for mesh in (cup, more):
        vertices = torch.from_numpy(mesh.vertices).requires_grad_()
        changed = {"vertices": vertices, **options}
        images.append(renderer.render(mesh, camera, load_light("grace"), 24, **changed))
        gradients.append(torch.autograd.grad(images[-1][:, :12].sum(), vertices)[0])
    assert torch.equal(*images)
    assert gradients[0].any()
    assert torch.equal(gradients[1], torch.cat([gradients[0], torch.zeros(1, 3)]))
    assert np.array_equal(renderer.normalize(more).vertices[:-1], renderer.normalize(cup).vertices)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32, np.longdouble, ">f8"])
def test_vertices_can_be_numbers_of_any_type(dtype):
    cup, light = renderer.solid("cup"), load_light("grace")
    vertices = np.rint(60 * (cup.vertices + 1))
    plain = renderer.Mesh.plain(vertices, cup.faces)
    small = replace(plain, vertices=vertices.astype(dtype), normal_ids=None)
    camera = renderer.OrthographicCamera(60.0, 20.0, 150.0, clip_range=300.0)
    options = SMALL | {"bounces": int(dtype == np.float32)}
    operators = [renderer.precompute_transfer(mesh, camera, **options) for mesh in (small, plain)]
    images = [operator.image(light) for operator in operators]
    assert torch.equal(*images)


def test_arrays_of_a_mesh_can_be_views_in_reverse_order(stone):
    texture = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    mesh = textured(stone, draw_uniform(FACE_COUNT, 3, 2), texture)
    arrays = {name: value for name, value in vars(mesh).items() if isinstance(value, np.ndarray)}
    turned = {name: value[::-1].copy()[::-1] for name, value in arrays.items()}
    turned["textures"] = [texture[::-1].copy()[::-1]]
    both = mesh, replace(mesh, **turned)
    images = [renderer.render(each, CAMERAS[0], load_light("grace"), **SMALL) for each in both]
    assert torch.equal(*images)


@pytest.mark.parametrize("name", ["light", "albedo"])
def test_the_image_is_linear_in_light_and_in_albedo(stone, light, name):
    """So a change of the image is the product of the gradient and the change of the input."""
    albedo = torch.full((FACE_COUNT, 3), 0.5, dtype=torch.float64)
    variables = {"light": light, "vertices": torch.from_numpy(stone.vertices), "albedo": albedo}
    variables[name] = variables[name].clone().requires_grad_()
    image = renderer.render(stone, CAMERAS[0], **variables, **SMALL)
    (gradient,) = torch.autograd.grad(image.sum(), variables[name])
    change = 1e-3 * draw(*gradient.shape, seed=1)
    changed = variables | {name: variables[name] + change}
    changed_image = renderer.render(stone, CAMERAS[0], **changed, **SMALL)
    difference = float((changed_image - image).detach().sum())
    assert difference == pytest.approx(float((gradient * change).sum()), abs=1e3 * EPS)


@pytest.mark.parametrize(
    "change",
    [lambda vertices: vertices[:, [1, 2, 0]], lambda vertices: vertices * [-1, 1, 1]],
    ids=["turned", "inside out"],
)
def test_vertices_replace_those_of_the_mesh(stone, light, change):
    vertices = change(stone.vertices)
    expected = renderer.render(replace(stone, vertices=vertices), CAMERAS, light, **SMALL)
    found = renderer.render(stone, CAMERAS, light, vertices=torch.from_numpy(vertices), **SMALL)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("shadows", "gloss"), [(True, None), (False, renderer.Gloss(0.5))])
def test_a_leaf_with_two_sides_has_the_image_of_a_leaf_with_one(light, shadows, gloss):
    """The sides do not share normals, which would cancel. A single side is shaded on both sides."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0.5], [-1, 1, 0]])
    front = np.array([[0, 1, 2], [0, 2, 3]])
    one_side = renderer.Mesh.plain(corners, front)
    two_sides = renderer.Mesh.plain(corners, np.concatenate([front, front[:, ::-1]]))
    options = {"shadows": shadows, "gloss": gloss} | SMALL
    expected = renderer.render(one_side, CAMERAS, light, **options)
    found = renderer.render(two_sides, CAMERAS, light, **options)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    operators = renderer.precompute_transfer(two_sides, CAMERAS, **options)
    torch.testing.assert_close(operators.image(light.float()), found.float(), rtol=0, atol=1e-5)


def test_a_mesh_of_any_size_is_shown_whole(light):
    """As its normalized copy. A range that the user gives cuts it."""
    ball = renderer.solid("ball")
    large = replace(ball, vertices=4 * ball.vertices)
    expected = renderer.render(ball, renderer.orbit_cameras(2, 2.4), light, 16)
    cameras = renderer.orbit_cameras(2, 9.6)
    torch.testing.assert_close(renderer.render(large, cameras, light, 16), expected)
    moved = {"vertices": torch.from_numpy(large.vertices)}
    torch.testing.assert_close(renderer.render(ball, cameras, light, 16, **moved), expected)
    [operator, _] = renderer.precompute_transfer(large, cameras, 16)
    torch.testing.assert_close(operator.image(light), expected[0].to(light), rtol=0, atol=1e-5)
    cut = [replace(camera, clip_range=3.0) for camera in cameras]
    assert not torch.allclose(renderer.render(large, cut, light, 16), expected, atol=0.1)


@pytest.mark.parametrize(
    ("kind", "name", "bounces", "encoding"),
    [("a color per face", "plate", 0, "linear"), ("a texture", "cup", 2, "srgb")],
)
def test_a_given_albedo_replaces_the_meshs_also_in_bounces(light, kind, name, bounces, encoding):
    mesh = renderer.solid(name)
    rng = np.random.default_rng(3)
    if kind == "a texture":
        texture = rng.integers(0, 256, (4, 5, 3)).astype(np.uint8)
        white = renderer.Mesh.plain(mesh.vertices, mesh.faces)
        painted = textured(white, rng.random((len(mesh.faces), 3, 2)), texture)
        other = replace(painted, textures=(np.zeros_like(texture),))
        encoded = torch.from_numpy(texture).double() / 255
    else:
        colors = np.float32(rng.integers(0, 256, (len(mesh.faces), 3)) / 255)
        painted, other = replace(mesh, corner_colors=colors[:, None].repeat(3, 1)), mesh
        encoded = torch.from_numpy(colors).double()
    options = {**SMALL, "bounces": bounces, "encoding": encoding}
    expected = renderer.render(painted, CAMERAS, light, **options)
    found = renderer.render(other, CAMERAS, light, albedo=decode(encoded, encoding), **options)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6 if bounces else 52 * EPS)


def test_light_in_bfloat16_does_not_move_silhouettes(light):
    apple = renderer.solid("apple")
    camera = renderer.OrthographicCamera(60.0, 20.0, 2.4)
    options = {"size": 64, "background": 0.0}
    expected = renderer.render(apple, camera, light.float(), **options)
    found = renderer.render(apple, camera, light.bfloat16(), **options)
    assert found.dtype == torch.bfloat16
    # Light and image values in bfloat16 have 8 bits.
    torch.testing.assert_close(found.float(), expected, rtol=0, atol=0.03)


COLOR = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
BACKDROPS = draw_uniform(3, 3, 9, 9)


@pytest.mark.parametrize(
    ("background", "expected"),
    [
        (0.25, torch.tensor(0.25, dtype=torch.float64)),
        (COLOR, COLOR.view(3, 1, 1)),
        (BACKDROPS[0], BACKDROPS[0]),
        (BACKDROPS, BACKDROPS),
    ],
    ids=["gray", "color", "image", "image per view"],
)
def test_backgrounds_are_grays_colors_images_of_one_view_or_all(stone, light, background, expected):
    beside_the_image = replace(stone, vertices=stone.vertices + 10)
    found = renderer.render(beside_the_image, CAMERAS, light, background=background, **SMALL)
    assert torch.equal(found, expected.expand(3, 3, 9, 9))


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_an_image_of_few_pixels_is_the_mean_of_those_of_a_finer_one(stone, light, size):
    # Both images have 12 samples in each row.
    fine = renderer.render(stone, CAMERAS, light, 12, samples=1, rasterizer="numpy")
    coarse = renderer.render(stone, CAMERAS, light, size, samples=12 // size, rasterizer="numpy")
    expected = torch.nn.functional.avg_pool2d(fine, 12 // size)
    torch.testing.assert_close(coarse, expected, rtol=0, atol=64 * EPS)


@pytest.mark.parametrize(("sky", "samples"), [(None, 1), (load_light("grace"), 2)])
def test_lamps_and_projectors_are_rendered_as_by_operators(sky, samples):
    """Lamps without coefficients have their full power. The cup casts shadows."""
    cup = renderer.solid("cup")
    lamps = Lamps(((2.0, 1.0, 2.0),), radius=0.3)
    projector = Projector(8, 28.6, 91.7)
    pattern = draw_uniform(64, 3).float()
    options = SMALL | {"samples": samples, "normals": "flat", "shadows": True}
    images = renderer.render(cup, CAMERAS, sky, lights=[lamps, (projector, pattern)], **options)
    full_power = torch.full((1, 3), lamps.power)
    sky_coefficients = torch.zeros(49, 3) if sky is None else sky
    local_lights = [(lamps, full_power), (projector, pattern)]
    basis, coefficients = with_local_lights(sky_coefficients, local_lights)
    settings = ImageSettings(9, samples, normals="flat", shadows=True)
    operators = build_operators(cup, CAMERAS, settings, choose("numpy"), basis=basis)
    expected = torch.stack([operator.image(coefficients) for operator in operators])
    torch.testing.assert_close(images, expected, rtol=0, atol=1e-5)
    assert (images > 0.5).any()


def ball_from_above(size: int) -> tuple[Tensor, Tensor]:
    centers = (torch.arange(size).double() + 0.5) * 2 / size - 1
    y = centers.expand(size, -1)
    # The top of the image lies at -x.
    x = centers[:, None].expand(-1, size)
    z = (1 - x**2 - y**2).clamp(min=0).sqrt()
    return torch.stack([x, y, z], dim=2), z > 0.3


def test_a_light_sphere_shows_environment_light_and_lamps_in_one_unit():
    """Uniform radiance L and a lamp of power P are shown as L and as P cos θ / (π d²)."""
    position = torch.tensor([0.3, -0.4, 2.5], dtype=torch.float64)
    power = torch.pi * torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    environment = ambient(torch.full((3,), 0.1))
    light = torch.cat([environment, power[None].float()])
    lamp = Lamps((tuple(position.tolist()),))
    camera = renderer.OrthographicCamera(0.0, 0.0, 2.0)
    image = light_sphere(light, 64, camera, SumBasis((HARMONICS, lamp)))

    normals, is_inside = ball_from_above(64)
    toward_lamp = position - normals
    distance = toward_lamp.norm(dim=2)
    cosine = (toward_lamp * normals).sum(2) / distance
    arriving = cosine.clamp(min=0) / distance**2
    linear = 0.1 + power[:, None, None] * arriving / torch.pi
    expected = encode(linear.clamp(max=1), "srgb").float()
    assert expected[:, is_inside].std() > 0.05
    torch.testing.assert_close(image[:, is_inside], expected[:, is_inside], rtol=0, atol=6e-3)
    assert (image[:, ::63, ::63] == 1).all()  # The background is white.


@pytest.mark.parametrize("function", ["render", "precompute_transfer"])
def test_images_that_need_more_than_free_memory_are_refused(stone, light, function, monkeypatch):
    monkeypatch.setattr("renderer.errors.free_memory", lambda device: 10**6)
    arguments = (stone, CAMERAS, light)[: 3 if function == "render" else 2]
    getattr(renderer, function)(*arguments, **SMALL)
    with pytest.raises(InputError, match=r"^3 views of 512 × 512 samples need"):
        getattr(renderer, function)(*arguments, size=256, rasterizer="numpy")
