"""Procedural solids: objects of the demo data set and hard negatives, from formulas alone.

The names of `SOLIDS` are classes of CIFAR-100, so that the labels of a
classifier agree with them. `HARD_NEGATIVES` resemble an orange and are not in
CIFAR-100.

Each solid is a closed mesh that stands upright along z, with counter-clockwise
faces seen from outside, and lies within about [-1, 1] along each axis. Colors
are RGB in [0, 1] with sRGB encoding.

Most solids are surfaces of revolution. A profile is a sequence of points
(radius, height) from the axis back to the axis, counter-clockwise around the
right half of the cross section. It consists of strokes: parts with their own
color (see `revolve` and `paint`).
"""

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from numpy.typing import ArrayLike

from renderer.errors import require_choice, require_range
from renderer.geometry.mesh import Mesh, concatenate
from renderer.validation import require_whole

# Colors of stalks and leaves, sRGB-encoded red, green and blue.
STALK = (0.36, 0.27, 0.15)
LEAF_GREEN = (0.25, 0.42, 0.12)
# Smallest and largest hue of the solid `fruit`, as fractions of the color circle. A hue of
# 1.02 is the same as 0.02. The range does not contain the hues of oranges.
LOWEST_HUE = 0.14
HIGHEST_HUE = 1.02
# Number of vertices that `revolve` places around the axis.
SEGMENTS = 48
# `revolve` divides edges of a profile that are longer than this, in world units.
STEP = 0.1
# Number of points of an `arc`.
ARC_POINTS = 13
# Number of plane waves that `ripples` adds up.
WAVES = 32
# Default number of subdivisions of a `sphere`, from which round solids are made.
SUBDIVISIONS = 4


def solid(name: str, seed: int = 0) -> Mesh:
    """Create an instance of a procedural solid.

    Args:
        name: Name in `SOLIDS` or `HARD_NEGATIVES`, such as "orange".
        seed: Seed of the random numbers that set shape and colors, at least 0.

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
    require_range("seed", seed, 0, 2**63 - 1)
    known = SOLIDS | HARD_NEGATIVES
    require_choice("name", name, known)
    return known[name](np.random.default_rng(seed))


def orange(rng: np.random.Generator) -> Mesh:
    """Create an oblate sphere with pores and a green-brown navel in a dimple on top."""
    directions, faces = sphere()
    from_top = np.arccos(np.clip(directions[:, 2], -1, 1))
    pores = ripples(rng, directions, wavelength=0.2)
    dents = 0.01 * ripples(rng, directions, wavelength=2.0) - 0.04 * bump(from_top / 0.25)
    flattening = rng.uniform(0.9, 0.98)
    first = choose(rng, (0.97, 0.50, 0.06), (0.95, 0.56, 0.08), (0.96, 0.44, 0.07))
    second = choose(rng, (0.98, 0.64, 0.14), (0.90, 0.42, 0.05))
    patches = ripples(rng, directions, wavelength=1.5)
    peel = mix(first, second, 0.4 + 0.3 * patches + 0.1 * pores)
    navel = choose(rng, (0.33, 0.36, 0.13), (0.38, 0.28, 0.12))
    relief = 1 + 0.004 * pores + dents
    vertices = 0.95 * relief[:, None] * directions * [1, 1, flattening]
    return Mesh.plain(vertices, faces, mix(peel, navel, 1.2 * bump(from_top / 0.15)))


def apple(rng: np.random.Generator) -> Mesh:
    """Create an apple with a dimple at both ends, a stalk, and red streaks on yellow or green."""
    latitude = np.linspace(-np.pi / 2, 0.49 * np.pi, 40)
    radius = np.cos(latitude) * (1 + rng.uniform(0.1, 0.16) * np.sin(latitude))
    height = rng.uniform(0.85, 0.95) * np.sin(latitude)
    upper_dimple = -0.4 * bump(radius / 0.35)
    lower_dimple = 0.18 * bump(radius / 0.25)
    height += np.where(latitude > 0, upper_dimple, lower_dimple)
    flesh = 0.88 * np.stack([radius, height], axis=1)
    stalk_top = rng.uniform(0.7, 0.9)
    vertices, faces, part = revolve(flesh, [(0.03, stalk_top), (0, stalk_top)])
    # Ripples that are stretched along z look like streaks.
    streaks = ripples(rng, vertices * [1, 1, 0.2], wavelength=0.5)
    streaks += ripples(rng, vertices, wavelength=2.0)
    green = choose(rng, (0.62, 0.72, 0.25), (0.86, 0.76, 0.35))
    red = choose(rng, (0.72, 0.08, 0.10), (0.80, 0.16, 0.12))
    skin = mix(green, red, rng.uniform(-0.2, 1.3) + 0.25 * streaks)
    return paint(vertices, faces, part, skin, STALK)


def pear(rng: np.random.Generator) -> Mesh:
    """Create a pear with a neck and a stalk, freckled in yellow to green."""
    latitude = np.linspace(-np.pi / 2, 0.49 * np.pi, 40)
    belly_radius = rng.uniform(0.46, 0.5)
    narrowing = rng.uniform(0.15, 0.19)
    radius = belly_radius - narrowing * np.tanh(4 * np.sin(latitude) - 1.2)
    flesh = np.stack([radius * np.cos(latitude), 0.88 * np.sin(latitude) - 0.12], axis=1)
    vertices, faces, part = revolve(flesh, [(0.03, 0.97), (0, 0.97)])
    first = choose(rng, (0.78, 0.78, 0.27), (0.60, 0.68, 0.22))
    second = choose(rng, (0.55, 0.62, 0.16), (0.72, 0.60, 0.24))
    patches = ripples(rng, vertices, wavelength=1.5)
    freckles = ripples(rng, vertices, wavelength=0.2)
    skin = mix(first, second, 0.4 + 0.25 * patches + 0.15 * freckles)
    return paint(vertices, faces, part, skin, STALK)


def sweet_pepper(rng: np.random.Generator) -> Mesh:
    """Create a bell pepper with three or four lobes and a sunken green stalk."""
    belly = arc((0.38, -0.5), (0.2, 0.4), -90, -10)
    shoulder = arc((0.46, 0.4), (0.26, 0.28), 0, 110)
    flesh = np.concatenate([[(0, -0.78)], belly, shoulder, [(0.12, 0.5)]])
    stalk = [(0.08, 0.52), (0.08, 0.8), (0.12, 0.9), (0, 0.9)]
    vertices, faces, part = revolve(flesh, stalk)
    lobes = rng.integers(3, 5)
    azimuth = np.arctan2(vertices[:, 1], vertices[:, 0])
    away_from_stalk = np.hypot(vertices[:, 0], vertices[:, 1]).clip(0, 0.5) / 0.5
    furrows = 0.2 * bump(np.sin(lobes / 2 * azimuth) / 0.5) * away_from_stalk**2
    vertices[:, :2] *= (1.08 - furrows)[:, None]
    vertices[:, 2] *= rng.uniform(0.9, 1.05)
    red = (0.78, 0.07, 0.07)
    yellow = (0.95, 0.75, 0.08)
    green = (0.22, 0.48, 0.12)
    orange_red = (0.93, 0.42, 0.05)
    color = choose(rng, red, yellow, green, orange_red)
    skin = mix(color, LEAF_GREEN, 0.1 * ripples(rng, vertices, wavelength=1.0))
    return paint(vertices, faces, part, skin, LEAF_GREEN)


def mushroom(rng: np.random.Generator) -> Mesh:
    """Create a pale stalk under a domed cap that is brown, or red with white flecks."""
    cap_radius = rng.uniform(0.75, 0.95)
    cap_height = rng.uniform(0.5, 0.7)
    stalk = [(0, -0.85), (0.26, -0.85), (0.3, -0.7), (0.2, -0.3), (0.18, 0.05)]
    gills = [(cap_radius - 0.08, -0.02)]
    cap = arc((0, 0.08), (cap_radius, cap_height), 0, 90)
    vertices, faces, part = revolve(stalk, gills, cap)
    brown = choose(rng, (0.55, 0.34, 0.18), (0.78, 0.62, 0.44))
    white_weight = 4 * ripples(rng, vertices, wavelength=0.5) - 3
    red_with_flecks = mix(choose(rng, (0.80, 0.10, 0.06)), (0.95, 0.93, 0.88), white_weight)
    skin = red_with_flecks if rng.random() < 0.4 else brown
    cream = (0.90, 0.86, 0.76)
    tan = (0.72, 0.60, 0.46)
    return paint(vertices, faces, part, cream, tan, skin)


def bottle(rng: np.random.Generator) -> Mesh:
    """Create a bottle of colored glass with shoulders, a long neck, a label and a cap."""
    radius = rng.uniform(0.27, 0.34)
    shoulder_height = rng.uniform(0.0, 0.2)
    base = [(0, -1), (radius, -1), (radius, -0.75)]
    label = [(radius, -0.15)]
    shoulder = arc((0.1, shoulder_height - 0.05), (radius - 0.1, 0.35), 0, 85)
    neck = np.concatenate([shoulder, [(0.1, 0.8)]])
    cap = [(0.125, 0.8), (0.125, 1), (0, 1)]
    glass = choose(
        rng, (0.10, 0.36, 0.16), (0.36, 0.18, 0.06), (0.20, 0.42, 0.60), (0.62, 0.74, 0.74)
    )
    paper = choose(rng, (0.93, 0.90, 0.80), (0.85, 0.20, 0.15), (0.92, 0.78, 0.25))
    metal = choose(rng, (0.75, 0.62, 0.25), (0.70, 0.12, 0.12), (0.80, 0.80, 0.82))
    return paint(*revolve(base, label, neck, cap), glass, paper, glass, metal)


def cup(rng: np.random.Generator) -> Mesh:
    """Create a mug with a drink. Its handle is a bent tube that ends inside the wall."""
    foot_radius = rng.uniform(0.42, 0.55)
    rim_radius = rng.uniform(0.58, 0.65)
    drink_height = rng.uniform(0.3, 0.5)
    outside = [(0, -0.7), (foot_radius, -0.7), (rim_radius, 0.7)]
    inside = [(rim_radius - 0.07, 0.7), (rim_radius - 0.1, drink_height)]
    surface = [(0, drink_height)]
    glaze = choose(
        rng, (0.93, 0.93, 0.90), (0.20, 0.35, 0.62), (0.75, 0.16, 0.14), (0.30, 0.52, 0.42)
    )
    white = (0.95, 0.94, 0.90)
    coffee = (0.28, 0.16, 0.08)
    body = paint(*revolve(outside, inside, surface), glaze, white, coffee)
    # The handle ends in the middle of the wall, at the heights -0.4 and 0.4.
    end_radii = np.interp([-0.4, 0.4], [-0.7, 0.7], [foot_radius, rim_radius]) - 0.035
    vertices, faces, _ = loft(_handle(end_radii))
    return concatenate([body, Mesh.plain(vertices, faces, glaze)])


def _handle(end_radii: np.ndarray) -> np.ndarray:
    """Create the rings of the handle of a cup: a tube that is bent in the plane of x and z.

    Args:
        end_radii: x of the lower and of the upper end of the tube, shape (2,).

    Returns:
        19 rings of 12 points for `loft`, shape (19, 12, 3). The first and the
        last ring have the radius 0, which closes the tube.
    """
    x_axis = [1, 0, 0]
    y_axis = [0, 1, 0]
    z_axis = [0, 0, 1]
    open_ring_count = 17
    points_per_ring = 12
    tube_radius = 0.07
    bend_radius = 0.4
    # Angle of each ring about the y-axis, from -90° to 90°. The first and the
    # last angle are repeated for the closed ends.
    bend = np.linspace(-np.pi / 2, np.pi / 2, open_ring_count)
    bend = np.pad(bend, 1, mode="edge")[:, None, None]
    radius = np.pad(np.full(open_ring_count, tube_radius), 1)[:, None, None]
    around = np.linspace(0, 2 * np.pi, points_per_ring, endpoint=False)[None, :, None]
    outward = np.cos(bend) * x_axis + np.sin(bend) * z_axis
    between_ends = np.interp(np.sin(bend), [-1, 1], end_radii) * x_axis
    center = between_ends + outward * bend_radius
    return center + radius * (np.cos(around) * outward + np.sin(around) * y_axis)


def plate(rng: np.random.Generator) -> Mesh:
    """Create a pale, shallow dish with a colored band on its brim."""
    well_radius = rng.uniform(0.5, 0.62)
    brim_height = rng.uniform(0.1, 0.2)
    underside = [(0, -0.06), (well_radius, -0.06), (0.97, brim_height - 0.03), (0.97, brim_height)]
    band = [(0.85, brim_height - 0.03)]
    inside = [(well_radius + 0.08, brim_height - 0.06), (well_radius, 0), (0, 0)]
    china = choose(rng, (0.95, 0.95, 0.93), (0.93, 0.89, 0.80))
    stripe = choose(
        rng, (0.15, 0.25, 0.60), (0.70, 0.15, 0.12), (0.20, 0.50, 0.45), (0.80, 0.65, 0.25)
    )
    return paint(*revolve(underside, band, inside), china, stripe, china)


def lamp(rng: np.random.Generator) -> Mesh:
    """Create a table lamp with a bulbous foot, a rod, and a shade that is hollow from below."""
    shade_radius = rng.uniform(0.55, 0.7)
    top_radius = rng.uniform(0.25, 0.4)
    foot_radius = rng.uniform(0.18, 0.3)
    bulb = arc((0, -0.55), (foot_radius, 0.36), -75, 75)
    foot = np.concatenate([[(0, -1), (0.34, -1), (0.34, -0.93)], bulb])
    rod = [(0.05, -0.15), (0.05, 0.9)]
    lining = [(top_radius - 0.03, 0.9), (shade_radius - 0.03, 0)]
    shade = [(shade_radius, 0), (top_radius, 0.95), (0, 0.95)]
    stand = choose(
        rng, (0.62, 0.48, 0.22), (0.25, 0.18, 0.14), (0.30, 0.45, 0.55), (0.85, 0.85, 0.82)
    )
    cloth = choose(
        rng, (0.95, 0.88, 0.70), (0.90, 0.80, 0.55), (0.70, 0.22, 0.16), (0.92, 0.92, 0.90)
    )
    brass = (0.70, 0.60, 0.35)
    cream = (0.98, 0.93, 0.75)
    return paint(*revolve(foot, rod, lining, shade), stand, brass, cream, cloth)


def table(rng: np.random.Generator) -> Mesh:
    """Create a wooden table with four square legs, as one closed polyhedron."""
    is_filled = np.zeros((14, 10, 10), dtype=bool)
    # The board is the top layer, and the legs stand one cell inside its corners.
    is_filled[:, :, -1] = True
    is_filled[np.ix_([1, -2], [1, -2])] = True
    vertices, faces = surface_of_cells(is_filled)
    half_size = rng.uniform([0.85, 0.5, 0.45], [1, 0.75, 0.6])
    vertices = (2 * vertices / is_filled.shape - 1) * half_size
    wood = choose(rng, (0.55, 0.34, 0.17), (0.74, 0.54, 0.32), (0.36, 0.21, 0.12))
    dark_wood = (0.40, 0.23, 0.11)
    # Ripples that are stretched along x look like grain.
    grain = ripples(rng, vertices * [0.1, 1, 1], wavelength=0.3)
    return Mesh.plain(vertices, faces, mix(wood, dark_wood, 0.3 + 0.3 * grain))


def lemon(rng: np.random.Generator) -> Mesh:
    """Create a yellow ellipsoid with pores and a tip at both ends, often greener toward one end."""
    directions, faces = sphere()
    from_pole = np.arccos(np.clip(np.abs(directions[:, 2]), 0, 1))
    pores = ripples(rng, directions, wavelength=0.2)
    relief = 1 + 0.004 * pores + 0.015 * ripples(rng, directions, wavelength=2.0)
    vertices = relief[:, None] * directions * [0.68, 0.68, rng.uniform(0.78, 0.86)]
    vertices[:, 2] += np.sign(directions[:, 2]) * rng.uniform(0.08, 0.15) * bump(from_pole / 0.25)
    yellow = choose(rng, (0.96, 0.85, 0.18), (0.93, 0.78, 0.12), (0.90, 0.86, 0.30))
    second = choose(rng, (0.74, 0.76, 0.20), (0.95, 0.74, 0.10))
    toward_end = 0.5 * rng.uniform(-1, 1) * directions[:, 2]
    return Mesh.plain(vertices, faces, mix(yellow, second, 0.3 + toward_end + 0.15 * pores))


def peach(rng: np.random.Generator) -> Mesh:
    """Create a yellow or pale sphere with a dimple on top, a furrow on one side and a red cheek."""
    directions, faces = sphere()
    from_top = np.arccos(np.clip(directions[:, 2], -1, 1))
    furrow = bump(directions[:, 1] / 0.12) * np.sqrt(np.clip(directions[:, 0], 0, 1))
    dimple = 0.15 * bump(from_top / 0.3)
    relief = 1 + 0.015 * ripples(rng, directions, wavelength=2.0) - 0.06 * furrow - dimple
    cheek_direction = rng.normal(size=3)
    toward_cheek = directions @ cheek_direction / np.linalg.norm(cheek_direction)
    pale = choose(rng, (0.95, 0.72, 0.38), (0.96, 0.80, 0.55), (0.93, 0.62, 0.32))
    red = choose(rng, (0.78, 0.22, 0.18), (0.86, 0.38, 0.26))
    least_red = rng.uniform(0.1, 0.6)
    patches = ripples(rng, directions, wavelength=0.6)
    skin = mix(pale, red, least_red + 0.5 * toward_cheek + 0.2 * patches)
    vertices = 0.95 * relief[:, None] * directions * [1, 1, rng.uniform(0.88, 0.98)]
    return Mesh.plain(vertices, faces, skin)


def ball(rng: np.random.Generator) -> Mesh:
    """Create a rubber ball of one color, or a yellow or green tennis ball with a white seam."""
    directions, faces = sphere(SUBDIVISIONS + 1)
    if rng.random() < 0.5:
        x, y, z = directions.T
        # The seam is the curve z = 1.2 (x² - y²). The value divided by its slope
        # is the distance from the curve.
        seam_distance = np.abs(z - 1.2 * (x**2 - y**2)) / np.sqrt(1 + 5.76 * (x**2 + y**2))
        felt = choose(rng, (0.80, 0.88, 0.22), (0.72, 0.84, 0.30))
        white = (0.92, 0.92, 0.88)
        skin = mix(felt, white, (0.07 - seam_distance) / 0.02)
    else:
        red = (0.80, 0.12, 0.12)
        orange_red = (0.93, 0.40, 0.10)
        blue = (0.15, 0.35, 0.75)
        white = (0.93, 0.90, 0.85)
        skin = choose(rng, red, orange_red, blue, white)
    return Mesh.plain(0.95 * directions, faces, skin)


def fruit(rng: np.random.Generator) -> Mesh:
    """Create a made-up fruit in two shades of any hue except those of oranges.

    Its shape lies between a ball, a lemon and an apple.
    """
    directions, faces = sphere()
    from_pole = np.arccos(np.clip(np.abs(directions[:, 2]), 0, 1))
    length = rng.uniform(0.75, 1.35)
    pores = ripples(rng, directions, wavelength=0.2)
    pore_depth = rng.uniform(0, 0.004)
    wave_height = rng.uniform(0, 0.03)
    relief = 1 + pore_depth * pores + wave_height * ripples(rng, directions, wavelength=2.0)
    # Long fruit has tips at both ends, and short fruit has dimples.
    end_height = rng.uniform(0, 0.15) if length > 1 else -rng.uniform(0, 0.3)
    vertices = relief[:, None] * directions * [1, 1, length]
    vertices[:, 2] += np.sign(directions[:, 2]) * end_height * bump(from_pole / 0.3)
    hue = rng.uniform(LOWEST_HUE, HIGHEST_HUE)
    hue_difference = rng.uniform(-0.1, 0.1)
    first = _random_shade(rng, hue)
    second = _random_shade(rng, hue + hue_difference)
    weight = 0.5 + 0.3 * ripples(rng, directions, rng.uniform(0.3, 2.0)) + 0.1 * pores
    return Mesh.plain(0.95 * vertices / np.abs(vertices).max(), faces, mix(first, second, weight))


def _random_shade(rng: np.random.Generator, hue: float) -> np.ndarray:
    """Draw a color with a given hue and with random saturation and value.

    Args:
        rng: Random numbers.
        hue: Hue as a fraction of the color circle. It is clipped to LOWEST_HUE
            and HIGHEST_HUE.

    Returns:
        RGB color, shape (3,).
    """
    clipped_hue = np.clip(hue, LOWEST_HUE, HIGHEST_HUE) % 1
    saturation = rng.uniform(0.1, 0.95)
    value = rng.uniform(0.3, 0.95)
    return np.array(colorsys.hsv_to_rgb(clipped_hue, saturation, value))


# Type of a function that creates a random instance of a solid.
Maker = Callable[[np.random.Generator], Mesh]
# Solids whose names are classes of CIFAR-100.
SOLIDS: dict[str, Maker] = {
    "orange": orange,
    "apple": apple,
    "pear": pear,
    "sweet_pepper": sweet_pepper,
    "mushroom": mushroom,
    "bottle": bottle,
    "cup": cup,
    "plate": plate,
    "lamp": lamp,
    "table": table,
}
# Solids that resemble an orange. The training run experiment=best uses `fruit` in training,
# and the other three in its evaluation.
HARD_NEGATIVES: dict[str, Maker] = {
    "lemon": lemon,
    "peach": peach,
    "ball": ball,
    "fruit": fruit,
}


@cache
def sphere(subdivisions: int = SUBDIVISIONS) -> tuple[np.ndarray, np.ndarray]:
    """Create a unit sphere of triangles of similar size.

    Args:
        subdivisions: Number of times that the 20 faces of an icosahedron are
            divided into four.

    Returns:
        A tuple of vertices, shape (V, 3), and faces, shape (F, 3).
    """
    # trimesh is imported here because the import takes half a second.
    from trimesh.creation import icosphere

    unit_sphere = icosphere(subdivisions=subdivisions)
    return np.array(unit_sphere.vertices), np.array(unit_sphere.faces)


def revolve(
    *strokes: np.ndarray | Sequence[tuple[float, float]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Create a surface of revolution about the z-axis.

    Args:
        *strokes: Parts of the profile, each with points (radius, height),
            shape (P, 2). A stroke begins at the end of the stroke before it.
            The profile leads from the axis back to the axis, counter-clockwise
            around the right half of the cross section.

    Returns:
        A tuple of
        - vertices, shape (V, 3);
        - faces, shape (F, 3);
        - the index of the stroke of each face, shape (F,).
    """
    # Points (radius, height) of the whole profile, shape (P, 2), with the P points of all
    # strokes.
    corners = np.concatenate(strokes)
    stroke_of_corner = np.repeat(np.arange(len(strokes)), [len(stroke) for stroke in strokes])
    edges = np.diff(corners, axis=0)
    # Edges that are longer than STEP are divided into pieces. If a corner is repeated, the
    # edge between both has the length 0 and no pieces.
    piece_counts = np.ceil(np.linalg.norm(edges, axis=1) / STEP - 1e-9).astype(int)
    edge_of_piece = np.repeat(np.arange(len(edges)), piece_counts)
    # Position of the start of each piece on its edge, in [0, 1).
    fraction = np.concatenate([np.arange(count) / count for count in piece_counts if count])
    starts = corners[edge_of_piece] + fraction[:, None] * edges[edge_of_piece]
    profile = np.concatenate([starts, corners[-1:]])
    azimuth = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    # One ring of points for each point of the profile. Adding 0 · azimuth repeats the
    # height for all points of a ring.
    radius = profile[:, :1]
    height = profile[:, 1:] + 0 * azimuth
    rings = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=-1)
    vertices, faces, piece_of_face = loft(rings)
    # An edge belongs to the stroke of its last corner.
    stroke_of_piece = stroke_of_corner[edge_of_piece + 1]
    return vertices, faces, stroke_of_piece[piece_of_face]


def loft(rings: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Create a closed surface that connects each ring of points to the next ring.

    Args:
        rings: n rings of s points each, shape (n, s, 3). The points are
            counter-clockwise about the direction from the first ring to the last.
            All points of the first ring are the same point, and all points of the
            last ring are, too, so that the surface is closed.

    Returns:
        A tuple of
        - vertices, shape (V, 3);
        - faces, shape (F, 3);
        - the index of the first of the two rings between which each face lies,
          shape (F,).
    """
    ring_count, point_count = rings.shape[:2]
    first_point = rings[0, :1]
    last_point = rings[-1, :1]
    vertices = np.concatenate([first_point, rings[1:-1].reshape(-1, 3), last_point])
    # Index of the vertex of each point, shape (n, s). The clipping gives all points of the
    # first ring the vertex 0, and all points of the last ring the last vertex.
    consecutive = np.arange(1 - point_count, (ring_count - 1) * point_count + 1)
    last_vertex = (ring_count - 2) * point_count + 1
    vertex = np.clip(consecutive.reshape(ring_count, point_count), 0, last_vertex)
    # Corners of quadrilaterals: a and b on one ring, d and c on the next one.
    a = vertex[:-1]
    b = np.roll(a, -1, axis=1)
    d = vertex[1:]
    c = np.roll(d, -1, axis=1)
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    ring_of_face = np.repeat(np.arange(ring_count - 1), 2 * point_count)
    # At both ends, half of the triangles have two equal corners and no area.
    has_area = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])
    return vertices, faces[has_area], ring_of_face[has_area]


def surface_of_cells(is_filled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Create the surface of a solid that consists of cubic cells of a grid.

    Args:
        is_filled: True for the cells of the solid, shape (X, Y, Z).

    Returns:
        A tuple of vertices in units of cells, shape (V, 3), and faces,
        shape (F, 3).
    """
    padded = np.pad(is_filled, 1)
    unit_vectors = np.eye(3, dtype=int)
    squares = []
    for axis in range(3):
        u = unit_vectors[(axis + 1) % 3]
        v = unit_vectors[(axis + 2) % 3]
        # Corners of a side of a cell, counter-clockwise seen from the positive axis.
        square = np.array([0 * u, u, u + v, v])
        is_lower_neighbor_filled = np.roll(padded, 1, axis)[1:-1, 1:-1, 1:-1]
        is_upper_neighbor_filled = np.roll(padded, -1, axis)[1:-1, 1:-1, 1:-1]
        # Cells with a side on the surface, toward the negative and the positive axis.
        lower_cells = np.argwhere(is_filled & ~is_lower_neighbor_filled)
        upper_cells = np.argwhere(is_filled & ~is_upper_neighbor_filled)
        # The reversed order is counter-clockwise seen from the negative axis.
        squares.append(lower_cells[:, None] + square[::-1])
        squares.append(upper_cells[:, None] + unit_vectors[axis] + square)
    corners = np.concatenate(squares).reshape(-1, 3)
    vertices, corner_to_vertex = np.unique(corners, axis=0, return_inverse=True)
    # Each square becomes two triangles.
    square_vertices = corner_to_vertex.reshape(-1, 4)
    triangles = square_vertices[:, [[0, 1, 2], [0, 2, 3]]]
    return vertices, triangles.reshape(-1, 3)


def paint(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, *paints: ArrayLike) -> Mesh:
    """Create a mesh whose parts have different colors.

    Args:
        vertices: Vertex positions, shape (V, 3).
        faces: Vertex indices of the faces, shape (F, 3).
        part: Index of the part to which each face belongs, shape (F,).
        *paints: Color of each part: one RGB color, shape (3,), or one per
            vertex, shape (V, 3).

    Returns:
        Mesh with these colors.
    """
    # Color of each vertex in each part, shape (parts, V, 3).
    colors = np.stack([np.broadcast_to(color, vertices.shape) for color in paints])
    # Color of the part of a face at each of its corners, shape (F, 3 corners, 3).
    corner_colors = colors.astype(np.float32)[part[:, None], faces]
    return replace(Mesh.plain(vertices, faces), corner_colors=corner_colors)


def arc(center: ArrayLike, radii: ArrayLike, start: float, stop: float) -> np.ndarray:
    """Create points of a profile, see `revolve`, on an arc of an ellipse.

    Args:
        center: Center of the ellipse as (radius, height).
        radii: Semi-axes of the ellipse along the radius and the height.
        start: Angle of the first point in degrees: 0 is outward, and 90 is up.
        stop: Angle of the last point in degrees.

    Returns:
        Points (radius, height), shape (ARC_POINTS, 2).
    """
    angle = np.radians(np.linspace(start, stop, ARC_POINTS))[:, None]
    on_circle = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
    return np.array(center) + radii * on_circle


def bump(x: np.ndarray) -> np.ndarray:
    """Evaluate exp(-x²), which is 1 at 0 and about 0 beyond 2.

    Args:
        x: Positions, shape (...).

    Returns:
        Values, same shape.
    """
    return np.exp(-(x**2))


def ripples(rng: np.random.Generator, points: np.ndarray, wavelength: float) -> np.ndarray:
    """Draw a smooth random field and evaluate it at points.

    The field is a sum of plane waves in random directions, with the mean 0 and
    the variance 1.

    Args:
        rng: Random numbers for directions and phases.
        points: Points, shape (V, 3).
        wavelength: Wavelength in world units.

    Returns:
        Values, shape (V,).
    """
    wave_vectors = rng.normal(size=(3, WAVES))
    wave_vectors *= 2 * np.pi / wavelength / np.linalg.norm(wave_vectors, axis=0)
    phases = rng.uniform(0, 2 * np.pi, WAVES)
    # The cosine takes much longer in NumPy than in torch.
    waves = torch.from_numpy(points @ wave_vectors + phases).cos().numpy()
    # A cosine has the variance 1/2, so the sum of WAVES cosines has the variance 16.
    return waves.sum(axis=1) / 4


def choose(rng: np.random.Generator, *colors: tuple[float, float, float]) -> np.ndarray:
    """Choose one of several colors and change it a little.

    Args:
        rng: Random numbers.
        *colors: RGB colors.

    Returns:
        RGB color, shape (3,).
    """
    return np.clip(rng.choice(colors) + rng.uniform(-0.04, 0.04, 3), 0, 1)


def mix(from_color: np.ndarray, to_color: ArrayLike, weight: np.ndarray) -> np.ndarray:
    """Mix two colors.

    Args:
        from_color: RGB color at weight 0, shape (3,) or (V, 3).
        to_color: RGB color at weight 1, shape (3,) or (V, 3).
        weight: Weight, clipped to [0, 1], shape (V,) or a number.

    Returns:
        RGB colors, shape (V, 3).
    """
    return from_color + np.clip(weight, 0, 1)[..., None] * (np.asarray(to_color) - from_color)
