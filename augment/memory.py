"""Estimates the memory that renders, operators and attacks need."""

import torch

# An attack on the light keeps about so many numbers in memory for each coefficient of the light of
# each example.
NUMBERS_PER_LIGHT_VALUE = 12
# An attack on the light keeps about so many numbers in memory for each pixel of all images.
NUMBERS_PER_PIXEL = 10
# An attack on the light also keeps about so many numbers for each pixel of the images that are
# rendered at the same time.
NUMBERS_PER_RENDERED_PIXEL = 16
# If effects of a camera, such as blur and noise, are rendered, an attack on the light keeps about
# so many numbers for each pixel of the images that are rendered at the same time.
NUMBERS_PER_RENDERED_PIXEL_WITH_CAMERA = 48

# Bytes of the linear operator from light to image, for each pixel and each coefficient of the
# light: two channels of float32.
OPERATOR_BYTES = 8


def attack_bytes(
    pixels: int,
    pixels_at_once: int,
    lights: torch.Tensor,
    camera_effects: bool,
) -> int:
    """Estimate the memory that an attack on the light of a scene takes.

    The linear operators from light to image are not counted. `pixels_at_once` counts the pixels of
    images that are rendered at the same time.
    """
    per_rendered_pixel = NUMBERS_PER_RENDERED_PIXEL
    if camera_effects:
        per_rendered_pixel = NUMBERS_PER_RENDERED_PIXEL_WITH_CAMERA
    numbers = NUMBERS_PER_PIXEL * pixels
    numbers += per_rendered_pixel * pixels_at_once
    numbers += NUMBERS_PER_LIGHT_VALUE * lights.numel()
    return lights.element_size() * numbers


def operator_bytes(degree: int, pixels: int) -> int:
    """Estimate the memory of the linear operators that map light to images."""
    coefficient_count = (degree + 1) ** 2
    return OPERATOR_BYTES * coefficient_count * pixels
