"""A window of a photograph is what a camera that is turned to it renders."""

import math

import numpy as np
import pytest
import torch
from oracles import relative_error

import renderer
from renderer.camera import OrthographicCamera, PerspectiveCamera
from renderer.image import to_bytes
from renderer.photograph import window_around

SIZE = 384  # pixels per side of the photographs
GRACE = renderer.load_light("grace").double()


def photographed(mesh: renderer.Mesh, camera: renderer.camera.Camera) -> np.ndarray:
    return to_bytes(renderer.render(mesh, camera, GRACE, SIZE, 0.0).permute(1, 2, 0)).numpy()


@pytest.mark.parametrize(("size", "side"), [(48, 260.0), (160, 120.0)])
def test_a_window_of_a_wide_photograph_is_what_the_turned_camera_renders(size, side):
    mesh = renderer.solid("pear")
    camera = PerspectiveCamera(57.3, 40.1, 6.0, 1.2, -0.9, distance=5.0)
    pixels = photographed(mesh, camera)
    focal_length = SIZE * camera.distance / camera.width
    origin = np.array([camera.right, -camera.up]) / camera.width * SIZE + SIZE / 2
    polar = math.radians(camera.polar)
    above = np.array([0.0, math.sin(polar), math.cos(polar)])
    window = window_around(pixels.shape, focal_length, origin, side, above)
    eye = camera.eye()[:3]
    distance = float(np.linalg.norm(eye))
    angles = math.acos(eye[2] / distance), math.atan2(eye[1], eye[0])
    width = side * distance / focal_length
    turned = PerspectiveCamera(*map(math.degrees, angles), width, distance=distance)
    expected = renderer.render(mesh, turned, GRACE, size, 0.0, samples=8)
    straight = window_around(pixels.shape, None, origin, side, above).cut(pixels, size)
    assert relative_error(window.cut(pixels, size), expected) < 0.04
    assert relative_error(straight, expected) > 0.1


def test_a_photograph_without_its_upper_and_lower_edge_has_the_same_window():
    """The axis of the camera still passes through the middle of the photograph."""
    camera = PerspectiveCamera(57.3, 40.1, 6.0, 1.2, -0.9, distance=5.0)
    pixels = photographed(renderer.solid("pear"), camera)
    focal_length = SIZE * camera.distance / camera.width
    above = np.array([0.0, 0.8, 0.6])
    windows = []
    for edge in (0, 64):
        shown = pixels[edge : SIZE - edge]
        center = np.array([270.0, 250.0 - edge])
        window = window_around(shown.shape, focal_length, center, 100.0, above)
        windows.append(window.cut(shown, 50))
    assert windows[0].max() > 0
    torch.testing.assert_close(windows[1], windows[0], rtol=0, atol=1e-5)


def test_a_window_without_perspective_is_what_the_moved_camera_renders():
    mesh = renderer.solid("pear")
    pixels = photographed(mesh, OrthographicCamera(57.3, 40.1, 6.0, 1.25, -0.9375))
    # The center of the window is at a corner of pixels.
    origin = np.array([1.25, 0.9375]) / 6 * SIZE + SIZE / 2
    window = window_around(pixels.shape, None, origin, SIZE / 2, np.array([0.0, 1.0, 0.0]))
    nearer = OrthographicCamera(57.3, 40.1, 3.0)
    expected = renderer.render(mesh, nearer, GRACE, 48, 0.0, samples=8)
    assert relative_error(window.cut(pixels, 48), expected) < 0.02


def test_a_window_beyond_the_photograph_repeats_the_border_or_has_the_given_value():
    pixels = np.full((20, 20, 1), 51, np.uint8)
    above = np.array([0.0, 1.0, 0.0])
    window = window_around(pixels.shape, None, np.array([0.0, 10.0]), 20.0, above)
    torch.testing.assert_close(window.cut(pixels, 4), torch.full((1, 4, 4), 0.2))
    left, right = window.cut(pixels, 4, beyond=255)[0].split(2, dim=1)
    torch.testing.assert_close(left, torch.ones(4, 2))
    torch.testing.assert_close(right, torch.full((4, 2), 0.2))
