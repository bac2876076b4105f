"""Procedural solids: objects of the demo data set and hard negatives, from formulas alone.

The names of `SOLIDS` are classes of CIFAR-100, so that the labels of a
classifier agree with them. `HARD_NEGATIVES` resemble an orange and are not in
CIFAR-100.

Each solid is a closed mesh that stands upright along z, with counter-clockwise
faces seen from outside, and lies within about [-1, 1] along each axis. Colors
are RGB in [0, 1] with sRGB encoding.

Most solids are surfaces of revolution: a profile is rotated about the z-axis
(see `revolve`). The profile is a sequence of points (radius, height). It
consists of sections, each of which has its own color (see `paint`).
"""

import colorsys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from renderer.errors import require_choice, require_whole
from renderer.mesh import Mesh, concatenate

Random = np.random.Generator
# Positions or colors of V vertices.
Points = Float[np.ndarray, "V 3"]
# Colors of stalks and leaves, sRGB-encoded red, green and blue.
STALK = (0.36, 0.27, 0.15)
LEAF_GREEN = (0.25, 0.42, 0.12)
# Smallest and largest hue of the solid `fruit`, as fractions of the color circle. 1.02 is the same
# hue as 0.02. The hues of oranges are outside of this range.
LOWEST_HUE = 0.14
HIGHEST_HUE = 1.02
# Number of vertices around the axis of a surface of revolution.
SEGMENTS = 48
# Largest distance in world units between neighboring points of the profile
# of a surface of revolution. Longer edges of the profile are divided.
MAX_EDGE_LENGTH = 0.1
# Number of points of an elliptical arc in a profile.
ARC_POINTS = 13
# Number of plane waves in a random field of `ripples`.
WAVES = 32
# Default number of subdivisions of the sphere from which round solids are made.
SUBDIVISIONS = 4


def solid(name: str, seed: int = 0) -> Mesh:
    """Create an instance of a procedural solid.

    Args:
        name: Name of the solid, such as "orange": a key of `SOLIDS` or of
            `HARD_NEGATIVES`.
        seed: Seed of the random shape and colors, at least 0.

    Returns:
        Closed mesh.

    Raises:
        InputError: If the name is unknown or the seed is negative.

    >>> import norm_balls as nb
    >>> orange = nb.solid("orange", seed=3)
    >>> orange.faces.shape, orange.closed
    ((5120, 3), True)
    """
    require_whole("seed", seed)
    known = SOLIDS | HARD_NEGATIVES
    require_choice("name", name, known)
    return known[name](np.random.default_rng(seed))


def orange(rng: Random) -> Mesh:
    """Create an oblate sphere with pores and a green-brown navel in a dimple on top."""
    directions, faces = sphere()
    angle_from_top = np.arccos(np.clip(directions[:, 2], -1, 1))
    pores = ripples(rng, directions, wavelength=0.2)
    dents = 0.01 * ripples(rng, directions, wavelength=2.0) - 0.04 * bump(angle_from_top / 0.25)
    flattening = rng.uniform(0.9, 0.98)
    peel_color = draw(rng, (0.97, 0.5, 0.06), (0.95, 0.56, 0.08), (0.96, 0.44, 0.07))
    patch_color = draw(rng, (0.98, 0.64, 0.14), (0.9, 0.42, 0.05))
    patches = ripples(rng, directions, wavelength=1.5)
    peel = mix(peel_color, patch_color, 0.4 + 0.3 * patches + 0.1 * pores)
    navel_color = draw(rng, (0.33, 0.36, 0.13), (0.38, 0.28, 0.12))
    colors = mix(peel, navel_color, 1.2 * bump(angle_from_top / 0.15))
    # Distance of each vertex from the center, shape (V,).
    radius = 1 + 0.004 * pores + dents
    vertices = 0.95 * radius[:, None] * directions * [1, 1, flattening]
    return Mesh.plain(vertices, faces, colors)


def apple(rng: Random) -> Mesh:
    """Create an apple with a dimple at both ends, a stalk, and red streaks on yellow or green."""
    latitude = np.linspace(-np.pi / 2, 0.49 * np.pi, 40)
    radius = np.cos(latitude) * (1 + rng.uniform(0.1, 0.16) * np.sin(latitude))
    height = rng.uniform(0.85, 0.95) * np.sin(latitude)
    upper_dimple = -0.4 * bump(radius / 0.35)
    lower_dimple = 0.18 * bump(radius / 0.25)
    height += np.where(latitude > 0, upper_dimple, lower_dimple)
    # Points (radius, height) of the profile of the fruit and of its stalk.
    flesh = 0.88 * np.stack([radius, height], axis=1)
    stalk_top = rng.uniform(0.7, 0.9)
    vertices, faces, section = revolve(flesh, [(0.03, stalk_top), (0, stalk_top)])
    # A random field that varies slowly along z looks like vertical streaks.
    streaks = ripples(rng, vertices * [1, 1, 0.2], wavelength=0.5)
    streaks += ripples(rng, vertices, wavelength=2.0)
    green = draw(rng, (0.62, 0.72, 0.25), (0.86, 0.76, 0.35))
    red = draw(rng, (0.72, 0.08, 0.1), (0.8, 0.16, 0.12))
    skin = mix(green, red, rng.uniform(-0.2, 1.3) + 0.25 * streaks)
    return paint(vertices, faces, section, skin, STALK)


def pear(rng: Random) -> Mesh:
    """Create a pear with a neck and a stalk, freckled in yellow to green."""
    latitude = np.linspace(-np.pi / 2, 0.49 * np.pi, 40)
    belly_radius = rng.uniform(0.46, 0.5)
    width = belly_radius - rng.uniform(0.15, 0.19) * np.tanh(4 * np.sin(latitude) - 1.2)
    radius = width * np.cos(latitude)
    # Points (radius, height) of the profile of the fruit and of its stalk.
    flesh = np.stack([radius, 0.88 * np.sin(latitude) - 0.12], axis=1)
    vertices, faces, section = revolve(flesh, [(0.03, 0.97), (0, 0.97)])
    skin_color = draw(rng, (0.78, 0.78, 0.27), (0.6, 0.68, 0.22))
    patch_color = draw(rng, (0.55, 0.62, 0.16), (0.72, 0.6, 0.24))
    patches = ripples(rng, vertices, wavelength=1.5)
    freckles = ripples(rng, vertices, wavelength=0.2)
    skin = mix(skin_color, patch_color, 0.4 + 0.25 * patches + 0.15 * freckles)
    return paint(vertices, faces, section, skin, STALK)


def sweet_pepper(rng: Random) -> Mesh:
    """Create a bell pepper with three or four lobes and a sunken green stalk."""
    # Points (radius, height) of the profile of the fruit and of its stalk.
    belly = arc((0.38, -0.5), (0.2, 0.4), -90, -10)
    shoulder = arc((0.46, 0.4), (0.26, 0.28), 0, 110)
    flesh = np.concatenate([[(0, -0.78)], belly, shoulder, [(0.12, 0.5)]])
    stalk = [(0.08, 0.52), (0.08, 0.8), (0.12, 0.9), (0, 0.9)]
    vertices, faces, section = revolve(flesh, stalk)
    lobe_count = rng.integers(3, 5)
    azimuth = np.arctan2(vertices[:, 1], vertices[:, 0])
    # 0 at the axis, and 1 from a distance of 0.5 on.
    away_from_axis = np.hypot(vertices[:, 0], vertices[:, 1]).clip(0, 0.5) / 0.5
    # The sine is 0 at the furrow between two lobes.
    furrows = 0.2 * bump(np.sin(lobe_count / 2 * azimuth) / 0.5) * away_from_axis**2
    vertices[:, :2] *= (1.08 - furrows)[:, None]
    vertices[:, 2] *= rng.uniform(0.9, 1.05)
    # Red, yellow, green or orange red.
    hue = draw(rng, (0.78, 0.07, 0.07), (0.95, 0.75, 0.08), (0.22, 0.48, 0.12), (0.93, 0.42, 0.05))
    skin = mix(hue, LEAF_GREEN, 0.1 * ripples(rng, vertices, wavelength=1.0))
    return paint(vertices, faces, section, skin, LEAF_GREEN)


def mushroom(rng: Random) -> Mesh:
    """Create a pale stalk under a domed cap that is brown, or red with white flecks."""
    cap_radius = rng.uniform(0.75, 0.95)
    cap_height = rng.uniform(0.5, 0.7)
    # Points (radius, height) of the three sections of the profile.
    stalk = [(0, -0.85), (0.26, -0.85), (0.3, -0.7), (0.2, -0.3), (0.18, 0.05)]
    cap = arc((0, 0.08), (cap_radius, cap_height), 0, 90)
    vertices, faces, section = revolve(stalk, [(cap_radius - 0.08, -0.02)], cap)
    brown = draw(rng, (0.55, 0.34, 0.18), (0.78, 0.62, 0.44))
    white_weight = 4 * ripples(rng, vertices, wavelength=0.5) - 3
    red_with_flecks = mix(draw(rng, (0.8, 0.1, 0.06)), (0.95, 0.93, 0.88), white_weight)
    cap_color = red_with_flecks if rng.random() < 0.4 else brown
    stalk_color = (0.9, 0.86, 0.76)
    gill_color = (0.72, 0.6, 0.46)
    return paint(vertices, faces, section, stalk_color, gill_color, cap_color)


def bottle(rng: Random) -> Mesh:
    """Create a bottle of colored glass with shoulders, a long neck, a label and a cap."""
    radius = rng.uniform(0.27, 0.34)
    shoulder_height = rng.uniform(0.0, 0.2)
    # Points (radius, height) of the four sections of the profile.
    base = [(0, -1), (radius, -1), (radius, -0.75)]
    label = [(radius, -0.15)]
    neck = [*arc((0.1, shoulder_height - 0.05), (radius - 0.1, 0.35), 0, 85), (0.1, 0.8)]
    cap = [(0.125, 0.8), (0.125, 1), (0, 1)]
    glass = draw(rng, (0.1, 0.36, 0.16), (0.36, 0.18, 0.06), (0.2, 0.42, 0.6), (0.62, 0.74, 0.74))
    paper = draw(rng, (0.93, 0.9, 0.8), (0.85, 0.2, 0.15), (0.92, 0.78, 0.25))
    metal = draw(rng, (0.75, 0.62, 0.25), (0.7, 0.12, 0.12), (0.8, 0.8, 0.82))
    return paint(*revolve(base, label, neck, cap), glass, paper, glass, metal)


def cup(rng: Random) -> Mesh:
    """Create a mug with a drink. Its handle is a bent tube that ends inside the wall."""
    foot_radius = rng.uniform(0.42, 0.55)
    rim_radius = rng.uniform(0.58, 0.65)
    drink_height = rng.uniform(0.3, 0.5)
    # Points (radius, height) of the three sections of the profile.
    outside = [(0, -0.7), (foot_radius, -0.7), (rim_radius, 0.7)]
    inside = [(rim_radius - 0.07, 0.7), (rim_radius - 0.1, drink_height)]
    drink = [(0, drink_height)]
    glaze = draw(rng, (0.93, 0.93, 0.9), (0.2, 0.35, 0.62), (0.75, 0.16, 0.14), (0.3, 0.52, 0.42))
    white = (0.95, 0.94, 0.9)
    coffee = (0.28, 0.16, 0.08)
    body = paint(*revolve(outside, inside, drink), glaze, white, coffee)
    # The handle ends in the middle of the wall of thickness 0.07, at the heights -0.4 and 0.4.
    outer_radii = np.interp([-0.4, 0.4], [-0.7, 0.7], [foot_radius, rim_radius])
    handle_vertices, handle_faces, _ = loft(_handle(outer_radii - 0.035))
    return concatenate([body, Mesh.plain(handle_vertices, handle_faces, glaze)])


def _handle(end_radii: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "19 12 3"]:
    """Create the rings of the handle of a cup, whose ends have these distances from the axis."""
    x_axis, y_axis, z_axis = np.eye(3)
    open_ring_count = 17
    points_per_ring = 12
    tube_radius = 0.07
    bend_radius = 0.4
    # Angle of each ring about the y-axis, from -90° to 90°. The first and the last angle occur
    # twice, because a ring of radius 0 closes each end of the tube.
    bend = np.linspace(-np.pi / 2, np.pi / 2, open_ring_count)
    bend = np.pad(bend, 1, mode="edge")[:, None, None]
    # Radius of each ring: 0 at both ends.
    radius = np.pad(np.full(open_ring_count, tube_radius), 1)[:, None, None]
    around = np.linspace(0, 2 * np.pi, points_per_ring, endpoint=False)[None, :, None]
    outward = np.cos(bend) * x_axis + np.sin(bend) * z_axis
    # Points on the straight line between both ends, about which the tube is bent.
    bend_center = np.interp(np.sin(bend), [-1, 1], end_radii) * x_axis
    ring_center = bend_center + outward * bend_radius
    return ring_center + radius * (np.cos(around) * outward + np.sin(around) * y_axis)


def plate(rng: Random) -> Mesh:
    """Create a pale, shallow dish with a colored band on its brim."""
    well_radius = rng.uniform(0.5, 0.62)
    brim_height = rng.uniform(0.1, 0.2)
    # Points (radius, height) of the three sections of the profile.
    underside = [(0, -0.06), (well_radius, -0.06), (0.97, brim_height - 0.03), (0.97, brim_height)]
    band = [(0.85, brim_height - 0.03)]
    inside = [(well_radius + 0.08, brim_height - 0.06), (well_radius, 0), (0, 0)]
    china = draw(rng, (0.95, 0.95, 0.93), (0.93, 0.89, 0.8))
    stripe = draw(rng, (0.15, 0.25, 0.6), (0.7, 0.15, 0.12), (0.2, 0.5, 0.45), (0.8, 0.65, 0.25))
    return paint(*revolve(underside, band, inside), china, stripe, china)


def lamp(rng: Random) -> Mesh:
    """Create a table lamp with a bulbous foot, a rod, and a shade that is hollow from below."""
    shade_radius = rng.uniform(0.55, 0.7)
    top_radius = rng.uniform(0.25, 0.4)
    # Points (radius, height) of the four sections of the profile.
    bulb = arc((0, -0.55), (rng.uniform(0.18, 0.3), 0.36), -75, 75)
    foot = np.concatenate([[(0, -1), (0.34, -1), (0.34, -0.93)], bulb])
    rod = [(0.05, -0.15), (0.05, 0.9)]
    lining = [(top_radius - 0.03, 0.9), (shade_radius - 0.03, 0)]
    shade = [(shade_radius, 0), (top_radius, 0.95), (0, 0.95)]
    base = draw(rng, (0.62, 0.48, 0.22), (0.25, 0.18, 0.14), (0.3, 0.45, 0.55), (0.85, 0.85, 0.82))
    cloth = draw(rng, (0.95, 0.88, 0.7), (0.9, 0.8, 0.55), (0.7, 0.22, 0.16), (0.92, 0.92, 0.9))
    brass = (0.7, 0.6, 0.35)
    cream = (0.98, 0.93, 0.75)
    return paint(*revolve(foot, rod, lining, shade), base, brass, cream, cloth)


def table(rng: Random) -> Mesh:
    """Create a wooden table with four square legs, as one closed polyhedron."""
    # The table consists of cubic cells. True marks the filled cells along x, y and z.
    is_filled = np.zeros((14, 10, 10), dtype=bool)
    # The board is the top layer of cells.
    is_filled[:, :, -1] = True
    # Each leg is a column of cells, one cell away from the edges of the board.
    is_filled[np.ix_([1, -2], [1, -2])] = True
    vertices, faces = surface_of_cells(is_filled)
    half_size = rng.uniform([0.85, 0.5, 0.45], [1, 0.75, 0.6])
    vertices = (2 * vertices / is_filled.shape - 1) * half_size
    wood = draw(rng, (0.55, 0.34, 0.17), (0.74, 0.54, 0.32), (0.36, 0.21, 0.12))
    dark_wood = (0.4, 0.23, 0.11)
    # A random field that varies slowly along x looks like wood grain.
    grain = ripples(rng, vertices * [0.1, 1, 1], wavelength=0.3)
    return Mesh.plain(vertices, faces, mix(wood, dark_wood, 0.3 + 0.3 * grain))


def lemon(rng: Random) -> Mesh:
    """Create a yellow ellipsoid with pores and a tip at both ends, often greener toward one end."""
    directions, faces = sphere()
    # Angle from the nearer one of both ends of the lemon, which are on the z-axis.
    angle_from_end = np.arccos(np.clip(np.abs(directions[:, 2]), 0, 1))
    pores = ripples(rng, directions, wavelength=0.2)
    radius = 1 + 0.004 * pores + 0.015 * ripples(rng, directions, wavelength=2.0)
    vertices = radius[:, None] * directions * [0.68, 0.68, rng.uniform(0.78, 0.86)]
    tips = rng.uniform(0.08, 0.15) * bump(angle_from_end / 0.25)
    vertices[:, 2] += np.sign(directions[:, 2]) * tips
    yellow = draw(rng, (0.96, 0.85, 0.18), (0.93, 0.78, 0.12), (0.9, 0.86, 0.3))
    second_color = draw(rng, (0.74, 0.76, 0.2), (0.95, 0.74, 0.1))
    # The weight of the second color rises or falls from one end to the other.
    slope_along_z = 0.5 * rng.uniform(-1, 1) * directions[:, 2]
    colors = mix(yellow, second_color, 0.3 + slope_along_z + 0.15 * pores)
    return Mesh.plain(vertices, faces, colors)


def peach(rng: Random) -> Mesh:
    """Create a yellow or pale sphere with a dimple on top, a furrow on one side and a red cheek."""
    directions, faces = sphere()
    angle_from_top = np.arccos(np.clip(directions[:, 2], -1, 1))
    # The furrow runs along the half circle y = 0, x > 0.
    furrow = bump(directions[:, 1] / 0.12) * np.sqrt(np.clip(directions[:, 0], 0, 1))
    dimple = 0.15 * bump(angle_from_top / 0.3)
    radius = 1 + 0.015 * ripples(rng, directions, wavelength=2.0) - 0.06 * furrow - dimple
    cheek_direction = rng.normal(size=3)
    # Cosine of the angle between each vertex and the middle of the cheek.
    toward_cheek = directions @ cheek_direction / np.linalg.norm(cheek_direction)
    pale = draw(rng, (0.95, 0.72, 0.38), (0.96, 0.8, 0.55), (0.93, 0.62, 0.32))
    red = draw(rng, (0.78, 0.22, 0.18), (0.86, 0.38, 0.26))
    least_red = rng.uniform(0.1, 0.6)
    patches = ripples(rng, directions, wavelength=0.6)
    skin = mix(pale, red, least_red + 0.5 * toward_cheek + 0.2 * patches)
    vertices = 0.95 * radius[:, None] * directions * [1, 1, rng.uniform(0.88, 0.98)]
    return Mesh.plain(vertices, faces, skin)


def ball(rng: Random) -> Mesh:
    """Create a rubber ball of one color, or a yellow or green tennis ball with a white seam."""
    directions, faces = sphere(SUBDIVISIONS + 1)
    if rng.random() < 0.5:
        x, y, z = directions.T
        # Approximate distance from the seam f(x, y, z) = z - 1.2 (x² - y²)
        # = 0: the magnitude of f, divided by the length of its gradient.
        seam_distance = np.abs(z - 1.2 * (x**2 - y**2)) / np.sqrt(1 + 5.76 * (x**2 + y**2))
        felt = draw(rng, (0.8, 0.88, 0.22), (0.72, 0.84, 0.3))
        skin = mix(felt, (0.92, 0.92, 0.88), (0.07 - seam_distance) / 0.02)
    else:
        # Red, orange red, blue or white.
        skin = draw(rng, (0.8, 0.12, 0.12), (0.93, 0.4, 0.1), (0.15, 0.35, 0.75), (0.93, 0.9, 0.85))
    return Mesh.plain(0.95 * directions, faces, skin)


def fruit(rng: Random) -> Mesh:
    """Create a made-up fruit in two shades of any hue except those of oranges.

    Its shape lies between a ball, a lemon and an apple.
    """
    directions, faces = sphere()
    # Angle from the nearer one of both ends of the fruit, which are on the z-axis.
    angle_from_end = np.arccos(np.clip(np.abs(directions[:, 2]), 0, 1))
    length = rng.uniform(0.75, 1.35)
    pores = ripples(rng, directions, wavelength=0.2)
    pore_depth = rng.uniform(0, 0.004)
    wave_height = rng.uniform(0, 0.03)
    radius = 1 + pore_depth * pores + wave_height * ripples(rng, directions, wavelength=2.0)
    # Long fruit has tips at both ends, and short fruit has dimples.
    end_height = rng.uniform(0, 0.15) if length > 1 else -rng.uniform(0, 0.3)
    vertices = radius[:, None] * directions * [1, 1, length]
    vertices[:, 2] += np.sign(directions[:, 2]) * end_height * bump(angle_from_end / 0.3)
    vertices = 0.95 * vertices / np.abs(vertices).max()
    hue = rng.uniform(LOWEST_HUE, HIGHEST_HUE)
    hues = (hue, hue + rng.uniform(-0.1, 0.1))
    first_shade, second_shade = (_random_shade(rng, of_shade) for of_shade in hues)
    patches = ripples(rng, directions, rng.uniform(0.3, 2.0))
    colors = mix(first_shade, second_shade, 0.5 + 0.3 * patches + 0.1 * pores)
    return Mesh.plain(vertices, faces, colors)


def _random_shade(rng: Random, hue: float) -> Float[np.ndarray, " 3"]:
    """Draw a color (HSV) of a hue, a fraction of the circle, clipped to exclude oranges."""
    clipped_hue = np.clip(hue, LOWEST_HUE, HIGHEST_HUE) % 1
    saturation = rng.uniform(0.1, 0.95)
    return np.array(colorsys.hsv_to_rgb(clipped_hue, saturation, rng.uniform(0.3, 0.95)))


# Solids whose names are classes of CIFAR-100, by their names.
SOLIDS = {
    maker.__name__: maker
    for maker in (orange, apple, pear, sweet_pepper, mushroom, bottle, cup, plate, lamp, table)
}
# Solids that resemble an orange. The training run `experiment=patterns` shows the network the solid
# `fruit` in training, and the other three solids in its evaluation.
HARD_NEGATIVES = {maker.__name__: maker for maker in (lemon, peach, ball, fruit)}


@cache
def sphere(subdivisions: int = SUBDIVISIONS) -> tuple[np.ndarray, np.ndarray]:
    """Create a unit sphere (vertices, faces) by dividing faces of an icosahedron into four."""
    # trimesh is imported here because the import takes half a second.
    from trimesh.creation import icosphere

    unit_sphere = icosphere(subdivisions=subdivisions)
    return np.array(unit_sphere.vertices), np.array(unit_sphere.faces)


def revolve(
    *sections: np.ndarray | Sequence[tuple[float, float]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Create a surface of revolution by rotating a profile about the z-axis.

    The profile is a polygonal line from the axis back to the axis,
    counter-clockwise around the right half of the cross section of the solid. Each section is a
    list of points (radius, height) and begins where the previous one ends. The result is
    vertices, faces, and the section of each face.
    """
    corners = np.concatenate(sections)
    section_of_corner = np.repeat(np.arange(len(sections)), list(map(len, sections)))
    edges = np.diff(corners, axis=0)
    # An edge between two equal points has 0 pieces. Subtracting 1e-9
    # prevents an additional piece because of a rounding error of the length.
    lengths = np.linalg.norm(edges, axis=1)
    piece_counts = np.ceil(lengths / MAX_EDGE_LENGTH - 1e-9).astype(int)
    edge_of_piece = np.repeat(np.arange(len(edges)), piece_counts)
    # Position of the start of each piece on its edge, as a fraction of the edge.
    fraction = np.concatenate([np.arange(count) / count for count in piece_counts if count])
    starts = corners[edge_of_piece] + fraction[:, None] * edges[edge_of_piece]
    profile = np.concatenate([starts, corners[-1:]])
    azimuth = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    # Each point of the profile becomes a ring of points of the same height.
    radius = profile[:, :1]
    x = radius * np.cos(azimuth)
    y = radius * np.sin(azimuth)
    z = np.broadcast_to(profile[:, 1:], x.shape)
    vertices, faces, piece_of_face = loft(np.stack([x, y, z], axis=-1))
    # An edge between two sections belongs to the section of its last corner.
    return vertices, faces, section_of_corner[edge_of_piece[piece_of_face] + 1]


def loft(rings: Float[np.ndarray, "R P 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Create a closed surface that connects each ring of points to the next ring.

    The points are counter-clockwise about the direction from the first to the last ring. All
    points of these two rings coincide, which closes the surface. The result is vertices, faces,
    and for each face the first of its two rings.
    """
    ring_count, point_count = rings.shape[:2]
    vertices = np.concatenate([rings[0, :1], rings[1:-1].reshape(-1, 3), rings[-1, :1]])
    # Vertex of each point of each ring, shape (R, P). The points of the second ring have the
    # vertices 1 to P, and so on. The clipping gives all points of the first ring the vertex 0, and
    # all points of the last ring the last vertex.
    consecutive = np.arange(1 - point_count, (ring_count - 1) * point_count + 1)
    vertex = consecutive.clip(0, len(vertices) - 1).reshape(ring_count, point_count)
    # Four corners of each quadrilateral between two rings: a and b are
    # neighbors on the first ring, and d and c are neighbors on the next ring.
    a = vertex[:-1]
    b = np.roll(a, -1, axis=1)
    d = vertex[1:]
    c = np.roll(d, -1, axis=1)
    # Each quadrilateral becomes the triangles a, b, c and a, c, d.
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    ring_of_face = np.repeat(np.arange(ring_count - 1), 2 * point_count)
    # Two corners are equal in half of the triangles at the first and at the last ring.
    has_area = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])
    return vertices, faces[has_area], ring_of_face[has_area]


def surface_of_cells(is_filled: Bool[np.ndarray, "X Y Z"]) -> tuple[np.ndarray, np.ndarray]:
    """Create the surface of a solid of cubic cells: vertices in units of cells, and faces."""
    padded = np.pad(is_filled, 1)
    unit_vectors = np.eye(3, dtype=int)
    squares = []
    for axis in range(3):
        u = unit_vectors[(axis + 1) % 3]
        v = unit_vectors[(axis + 2) % 3]
        # Corners of the lower side of a cell along the axis, relative to the
        # cell's lowest corner. The order is counter-clockwise seen from above.
        square = np.array([0 * u, u, u + v, v])
        # A lower side faces down, so its corners are in the reversed order.
        for toward, side in ((1, square[::-1]), (-1, unit_vectors[axis] + square)):
            is_neighbor_filled = np.roll(padded, toward, axis)[1:-1, 1:-1, 1:-1]
            # A filled cell next to an empty cell has a side on the surface.
            squares.append(np.argwhere(is_filled & ~is_neighbor_filled)[:, None] + side)
    corners = np.concatenate(squares).reshape(-1, 3)
    vertices, corner_to_vertex = np.unique(corners, axis=0, return_inverse=True)
    # Each square with the corners 0 to 3 becomes two triangles.
    triangles = corner_to_vertex.reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]]
    return vertices, triangles.reshape(-1, 3)


def paint(
    vertices: Points, faces: Int[np.ndarray, "F 3"], section: np.ndarray, *colors: ArrayLike
) -> Mesh:
    """Create a mesh whose faces have the color of their section, one color or one per vertex."""
    # Color that each vertex has in each section, shape (sections, V, 3).
    vertex_colors = np.stack([np.broadcast_to(color, vertices.shape) for color in colors])
    # The color of a corner depends on the section of the face and on the vertex.
    corner_colors = vertex_colors.astype(np.float32)[section[:, None], faces]
    return replace(Mesh.plain(vertices, faces), corner_colors=corner_colors)


def arc(
    center: ArrayLike, radii: ArrayLike, start: float, stop: float
) -> Float[np.ndarray, "ARC_POINTS 2"]:
    """Create points on an arc of an ellipse, for the profile of a surface of revolution.

    Points and radii are (radius, height). Angles are in degrees: 0 is away from the axis of
    revolution, 90 is up.
    """
    angle = np.radians(np.linspace(start, stop, ARC_POINTS))
    return np.array(center) + radii * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def bump(x: Float[np.ndarray, " ..."]) -> np.ndarray:
    """Evaluate exp(-x²), which is 1 at 0, and almost 0 from a distance of 2 on."""
    return np.exp(-(x**2))


def ripples(rng: Random, points: Points, wavelength: float) -> Float[np.ndarray, " V"]:
    """Draw a smooth random field, and evaluate it at points.

    The field is a sum of plane waves in random directions, with the mean 0 and
    the variance 1. The wavelength is in world units.
    """
    wave_vectors = rng.normal(size=(3, WAVES))
    wave_vectors *= 2 * np.pi / wavelength / np.linalg.norm(wave_vectors, axis=0)
    # torch computes cosines much faster than NumPy.
    waves = torch.from_numpy(points @ wave_vectors + rng.uniform(0, 2 * np.pi, WAVES)).cos().numpy()
    # A cosine has the variance 1/2. The sum of 32 cosines therefore has the standard deviation 4.
    return waves.sum(axis=1) / 4


def draw(rng: Random, *colors: tuple[float, float, float]) -> Float[np.ndarray, " 3"]:
    """Draw one of several colors, and change it by up to 0.04 per channel. Colors are in [0, 1]."""
    return np.clip(rng.choice(colors) + rng.uniform(-0.04, 0.04, 3), 0, 1)


def mix(from_color: np.ndarray, to_color: ArrayLike, weight: np.ndarray) -> Points:
    """Interpolate from a color (weight 0) to another (weight 1). Weights are clipped to [0, 1]."""
    return from_color + np.clip(weight, 0, 1)[..., None] * (np.asarray(to_color) - from_color)
