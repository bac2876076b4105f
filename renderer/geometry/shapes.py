"""Procedural solids: the embedded orange, the other things of the demo data set and hard negatives, from formulas
alone.

Names are CIFAR-100 class names, so that a classifier's labels agree; hard negatives are not in CIFAR-100. Every
solid is closed, stands upright along z, has counter-clockwise faces outward and lies within about [−1, 1]³. Colors are
RGB in [0, 1], sRGB-encoded.
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

STALK = (0.36, 0.27, 0.15)
LEAF_GREEN = (0.25, 0.42, 0.12)
SEGMENTS = 48  # faces around an axis of revolution
STEP = 0.1  # longest edge along a profile, in world units


def solid(name: str, seed: int = 0) -> Mesh:
    """The instance of the solid `name` that `seed` draws; InputError for a name that is in neither registry.

    >>> orange = solid("orange", seed=3)
    >>> orange.faces.shape, orange.closed
    ((5120, 3), True)
    """
    require_whole("seed", seed)
    require_range("seed", seed, 0, 2**63 - 1)
    known = SOLIDS | HARD_NEGATIVES
    require_choice("name", name, known)
    return known[name](np.random.default_rng(seed))


def orange(rng: np.random.Generator) -> Mesh:
    """An oblate sphere with pores and a green-brown navel in a dimple on top."""
    directions, faces = sphere()
    from_top = np.arccos(np.clip(directions[:, 2], -1, 1))
    pores = ripples(rng, directions, wavelength=0.2)
    dents = 0.01 * ripples(rng, directions, wavelength=2.0) - 0.04 * bump(from_top / 0.25)
    flattening = rng.uniform(0.9, 0.98)
    peel = mix(
        choose(rng, (0.97, 0.50, 0.06), (0.95, 0.56, 0.08), (0.96, 0.44, 0.07)),
        choose(rng, (0.98, 0.64, 0.14), (0.90, 0.42, 0.05)),
        0.4 + 0.3 * ripples(rng, directions, wavelength=1.5) + 0.1 * pores,
    )
    navel = choose(rng, (0.33, 0.36, 0.13), (0.38, 0.28, 0.12))
    vertices = 0.95 * (1 + 0.004 * pores + dents)[:, None] * directions * [1, 1, flattening]
    return Mesh.plain(vertices, faces, mix(peel, navel, 1.2 * bump(from_top / 0.15)))


def apple(rng: np.random.Generator) -> Mesh:
    """Broad shoulders, a dimple at either end, a stalk; red streaks over green or yellow."""
    latitude = np.linspace(-np.pi / 2, 0.49 * np.pi, 40)
    radius = np.cos(latitude) * (1 + rng.uniform(0.1, 0.16) * np.sin(latitude))
    height = rng.uniform(0.85, 0.95) * np.sin(latitude)
    height += np.where(latitude > 0, -0.4 * bump(radius / 0.35), 0.18 * bump(radius / 0.25))
    flesh = 0.88 * np.stack([radius, height], axis=1)
    stalk_top = rng.uniform(0.7, 0.9)
    vertices, faces, part = revolve(flesh, [(0.03, stalk_top), (0, stalk_top)])
    streaks = ripples(rng, vertices * [1, 1, 0.2], wavelength=0.5) + ripples(rng, vertices, wavelength=2.0)
    skin = mix(
        choose(rng, (0.62, 0.72, 0.25), (0.86, 0.76, 0.35)),
        choose(rng, (0.72, 0.08, 0.10), (0.80, 0.16, 0.12)),
        rng.uniform(-0.2, 1.3) + 0.25 * streaks,
    )
    return paint(vertices, faces, part, skin, STALK)


def pear(rng: np.random.Generator) -> Mesh:
    """A round belly that narrows to a neck with a stalk; yellow to green, freckled."""
    latitude = np.linspace(-np.pi / 2, 0.49 * np.pi, 40)
    girth = rng.uniform(0.46, 0.5) - rng.uniform(0.15, 0.19) * np.tanh(4 * np.sin(latitude) - 1.2)
    flesh = np.stack([girth * np.cos(latitude), 0.88 * np.sin(latitude) - 0.12], axis=1)
    vertices, faces, part = revolve(flesh, [(0.03, 0.97), (0, 0.97)])
    skin = mix(
        choose(rng, (0.78, 0.78, 0.27), (0.60, 0.68, 0.22)),
        choose(rng, (0.55, 0.62, 0.16), (0.72, 0.60, 0.24)),
        0.4 + 0.25 * ripples(rng, vertices, wavelength=1.5) + 0.15 * ripples(rng, vertices, wavelength=0.2),
    )
    return paint(vertices, faces, part, skin, STALK)


def sweet_pepper(rng: np.random.Generator) -> Mesh:
    """A blunt, three- or four-lobed bell with a sunken green stalk; red, yellow, orange or green."""
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
    skin = mix(
        choose(rng, (0.78, 0.07, 0.07), (0.95, 0.75, 0.08), (0.22, 0.48, 0.12), (0.93, 0.42, 0.05)),
        LEAF_GREEN,
        0.1 * ripples(rng, vertices, wavelength=1.0),
    )
    return paint(vertices, faces, part, skin, LEAF_GREEN)


def mushroom(rng: np.random.Generator) -> Mesh:
    """A pale stalk under a domed cap, brown or red with white flecks."""
    reach, dome = rng.uniform(0.75, 0.95), rng.uniform(0.5, 0.7)
    stalk = [(0, -0.85), (0.26, -0.85), (0.3, -0.7), (0.2, -0.3), (0.18, 0.05)]
    gills = [(reach - 0.08, -0.02)]
    cap = arc((0, 0.08), (reach, dome), 0, 90)
    vertices, faces, part = revolve(stalk, gills, cap)
    brown = choose(rng, (0.55, 0.34, 0.18), (0.78, 0.62, 0.44))
    flecks = 4 * ripples(rng, vertices, wavelength=0.5) - 3
    flecked = mix(choose(rng, (0.80, 0.10, 0.06)), (0.95, 0.93, 0.88), flecks)
    skin = flecked if rng.random() < 0.4 else brown
    cream, tan = (0.90, 0.86, 0.76), (0.72, 0.60, 0.46)
    return paint(vertices, faces, part, cream, tan, skin)


def bottle(rng: np.random.Generator) -> Mesh:
    """A cylinder of colored glass with shoulders, a long neck, a label and a cap."""
    girth, shoulder = rng.uniform(0.27, 0.34), rng.uniform(0.0, 0.2)
    base = [(0, -1), (girth, -1), (girth, -0.75)]
    label = [(girth, -0.15)]
    neck = np.concatenate([arc((0.1, shoulder - 0.05), (girth - 0.1, 0.35), 0, 85), [(0.1, 0.8)]])
    cap = [(0.125, 0.8), (0.125, 1), (0, 1)]
    glass = choose(rng, (0.10, 0.36, 0.16), (0.36, 0.18, 0.06), (0.20, 0.42, 0.60), (0.62, 0.74, 0.74))
    paper = choose(rng, (0.93, 0.90, 0.80), (0.85, 0.20, 0.15), (0.92, 0.78, 0.25))
    metal = choose(rng, (0.75, 0.62, 0.25), (0.70, 0.12, 0.12), (0.80, 0.80, 0.82))
    return paint(*revolve(base, label, neck, cap), glass, paper, glass, metal)


def cup(rng: np.random.Generator) -> Mesh:
    """A hollow mug with something to drink; its handle is a bent tube that ends inside the wall."""
    foot, rim, drink = rng.uniform(0.42, 0.55), rng.uniform(0.58, 0.65), rng.uniform(0.3, 0.5)
    outside = [(0, -0.7), (foot, -0.7), (rim, 0.7)]
    inside = [(rim - 0.07, 0.7), (rim - 0.1, drink)]
    surface = [(0, drink)]
    glaze = choose(rng, (0.93, 0.93, 0.90), (0.20, 0.35, 0.62), (0.75, 0.16, 0.14), (0.30, 0.52, 0.42))
    white, coffee = (0.95, 0.94, 0.90), (0.28, 0.16, 0.08)
    body = paint(*revolve(outside, inside, surface), glaze, white, coffee)
    ends = np.interp([-0.4, 0.4], [-0.7, 0.7], [foot, rim]) - 0.035  # of the handle, in the middle of the wall
    bend = np.pad(np.linspace(-np.pi / 2, np.pi / 2, 17), 1, mode="edge")[:, None, None]
    thickness = np.pad(np.full(17, 0.07), 1)[:, None, None]  # zero closes the ends
    around = np.linspace(0, 2 * np.pi, 12, endpoint=False)[None, :, None]
    outward = np.cos(bend) * [1, 0, 0] + np.sin(bend) * [0, 0, 1]
    spine = np.interp(np.sin(bend), [-1, 1], ends) * [1, 0, 0] + outward * [0.4, 0, 0.4]
    vertices, faces, _ = loft(spine + thickness * (np.cos(around) * outward + np.sin(around) * [0, 1, 0]))
    return concatenate([body, Mesh.plain(vertices, faces, glaze)])


def plate(rng: np.random.Generator) -> Mesh:
    """A shallow dish, pale with a colored band on its brim."""
    well, lift = rng.uniform(0.5, 0.62), rng.uniform(0.1, 0.2)
    underside = [(0, -0.06), (well, -0.06), (0.97, lift - 0.03), (0.97, lift)]
    band = [(0.85, lift - 0.03)]
    inside = [(well + 0.08, lift - 0.06), (well, 0), (0, 0)]
    china = choose(rng, (0.95, 0.95, 0.93), (0.93, 0.89, 0.80))
    stripe = choose(rng, (0.15, 0.25, 0.60), (0.70, 0.15, 0.12), (0.20, 0.50, 0.45), (0.80, 0.65, 0.25))
    return paint(*revolve(underside, band, inside), china, stripe, china)


def lamp(rng: np.random.Generator) -> Mesh:
    """A table lamp: a bulbous foot, a rod, and a shade that is hollow from below."""
    spread, neck, belly = rng.uniform(0.55, 0.7), rng.uniform(0.25, 0.4), rng.uniform(0.18, 0.3)
    foot = np.concatenate([[(0, -1), (0.34, -1), (0.34, -0.93)], arc((0, -0.55), (belly, 0.36), -75, 75)])
    rod = [(0.05, -0.15), (0.05, 0.9)]
    lining = [(neck - 0.03, 0.9), (spread - 0.03, 0)]
    shade = [(spread, 0), (neck, 0.95), (0, 0.95)]
    stand = choose(rng, (0.62, 0.48, 0.22), (0.25, 0.18, 0.14), (0.30, 0.45, 0.55), (0.85, 0.85, 0.82))
    cloth = choose(rng, (0.95, 0.88, 0.70), (0.90, 0.80, 0.55), (0.70, 0.22, 0.16), (0.92, 0.92, 0.90))
    brass, cream = (0.70, 0.60, 0.35), (0.98, 0.93, 0.75)
    return paint(*revolve(foot, rod, lining, shade), stand, brass, cream, cloth)


def table(rng: np.random.Generator) -> Mesh:
    """A wooden board on four square legs: one closed polyhedron without faces inside."""
    cells = np.zeros((14, 10, 10), dtype=bool)
    cells[:, :, -1] = True
    cells[np.ix_([1, -2], [1, -2])] = True
    vertices, faces = surface_of_cells(cells)
    extent = rng.uniform([0.85, 0.5, 0.45], [1, 0.75, 0.6])
    vertices = (2 * vertices / cells.shape - 1) * extent
    wood = mix(
        choose(rng, (0.55, 0.34, 0.17), (0.74, 0.54, 0.32), (0.36, 0.21, 0.12)),
        (0.40, 0.23, 0.11),
        0.3 + 0.3 * ripples(rng, vertices * [0.1, 1, 1], wavelength=0.3),
    )
    return Mesh.plain(vertices, faces, wood)


def lemon(rng: np.random.Generator) -> Mesh:
    """An ellipsoid with a nipple at either end and pores; yellow, greener towards one end or not."""
    directions, faces = sphere()
    from_pole = np.arccos(np.clip(np.abs(directions[:, 2]), 0, 1))
    pores = ripples(rng, directions, wavelength=0.2)
    relief = 1 + 0.004 * pores + 0.015 * ripples(rng, directions, wavelength=2.0)
    vertices = relief[:, None] * directions * [0.68, 0.68, rng.uniform(0.78, 0.86)]
    vertices[:, 2] += np.sign(directions[:, 2]) * rng.uniform(0.08, 0.15) * bump(from_pole / 0.25)
    peel = mix(
        choose(rng, (0.96, 0.85, 0.18), (0.93, 0.78, 0.12), (0.90, 0.86, 0.30)),
        choose(rng, (0.74, 0.76, 0.20), (0.95, 0.74, 0.10)),
        0.3 + 0.5 * rng.uniform(-1, 1) * directions[:, 2] + 0.15 * pores,
    )
    return Mesh.plain(vertices, faces, peel)


def peach(rng: np.random.Generator) -> Mesh:
    """A sphere with a furrow down one side into a dimple on top; yellow or pale with a red cheek."""
    directions, faces = sphere()
    from_top = np.arccos(np.clip(directions[:, 2], -1, 1))
    furrow = bump(directions[:, 1] / 0.12) * np.sqrt(np.clip(directions[:, 0], 0, 1))
    relief = 1 + 0.015 * ripples(rng, directions, wavelength=2.0) - 0.06 * furrow - 0.15 * bump(from_top / 0.3)
    side = rng.normal(size=3)
    cheek = directions @ side / np.linalg.norm(side)
    skin = mix(
        choose(rng, (0.95, 0.72, 0.38), (0.96, 0.80, 0.55), (0.93, 0.62, 0.32)),
        choose(rng, (0.78, 0.22, 0.18), (0.86, 0.38, 0.26)),
        rng.uniform(0.1, 0.6) + 0.5 * cheek + 0.2 * ripples(rng, directions, wavelength=0.6),
    )
    return Mesh.plain(0.95 * relief[:, None] * directions * [1, 1, rng.uniform(0.88, 0.98)], faces, skin)


def ball(rng: np.random.Generator) -> Mesh:
    """A rubber ball of one color, or a tennis ball: yellow or green with the white curve of its seam."""
    directions, faces = sphere(5)
    if rng.random() < 0.5:
        x, y, z = directions.T
        seam = np.abs(z - 1.2 * (x**2 - y**2)) / np.sqrt(1 + 5.76 * (x**2 + y**2))
        felt = choose(rng, (0.80, 0.88, 0.22), (0.72, 0.84, 0.30))
        skin = mix(felt, (0.92, 0.92, 0.88), (0.07 - seam) / 0.02)
    else:
        skin = choose(rng, (0.80, 0.12, 0.12), (0.93, 0.40, 0.10), (0.15, 0.35, 0.75), (0.93, 0.90, 0.85))
    return Mesh.plain(0.95 * directions, faces, skin)


def fruit(rng: np.random.Generator) -> Mesh:
    """A made-up fruit: between a ball, a lemon and an apple, of two shades of any hue but an orange's."""
    directions, faces = sphere()
    from_pole = np.arccos(np.clip(np.abs(directions[:, 2]), 0, 1))
    length = rng.uniform(0.75, 1.35)
    pores = ripples(rng, directions, wavelength=0.2)
    relief = 1 + rng.uniform(0, 0.004) * pores + rng.uniform(0, 0.03) * ripples(rng, directions, wavelength=2.0)
    ends = rng.uniform(0, 0.15) if length > 1 else -rng.uniform(0, 0.3)  # nipples or dimples
    vertices = relief[:, None] * directions * [1, 1, length]
    vertices[:, 2] += np.sign(directions[:, 2]) * ends * bump(from_pole / 0.3)
    hue = rng.uniform(0.14, 1.02)
    shades = [
        colorsys.hsv_to_rgb(np.clip(hue + turn, 0.14, 1.02) % 1, rng.uniform(0.1, 0.95), rng.uniform(0.3, 0.95))
        for turn in (0, rng.uniform(-0.1, 0.1))
    ]
    weight = 0.5 + 0.3 * ripples(rng, directions, rng.uniform(0.3, 2.0)) + 0.1 * pores
    first, second = map(np.array, shades)
    return Mesh.plain(0.95 * vertices / np.abs(vertices).max(), faces, mix(first, second, weight))


Maker = Callable[[np.random.Generator], Mesh]
SOLIDS: dict[str, Maker] = {
    make.__name__: make for make in (orange, apple, pear, sweet_pepper, mushroom, bottle, cup, plate, lamp, table)
}
# Hard negatives of an orange, beside the fruit above: not in CIFAR-100. experiment=best trains on `fruit` alone, and is
# evaluated on the others.
HARD_NEGATIVES: dict[str, Maker] = {make.__name__: make for make in (lemon, peach, ball, fruit)}


@cache
def sphere(subdivisions: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a unit sphere of 20·4^subdivisions faces."""
    from trimesh.creation import icosphere  # trimesh takes half a second

    ball = icosphere(subdivisions=subdivisions)
    return np.array(ball.vertices), np.array(ball.faces)


def revolve(*strokes: np.ndarray | Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), faces (F, 3) and the stroke (F,) of each face of a surface of revolution.

    Its profile is drawn in strokes, each a list of (radius, height) points with a paint of its own; a stroke starts
    where the one before it ended. The whole runs from the axis back to the axis, counter-clockwise around the solid's
    half section.
    """
    corners = np.concatenate(strokes)
    stroke_of_corner = np.repeat(np.arange(len(strokes)), [len(stroke) for stroke in strokes])
    edges = np.diff(corners, axis=0)
    pieces = np.ceil(np.linalg.norm(edges, axis=1) / STEP - 1e-9).astype(int)  # none of a repeated corner
    edge = np.repeat(np.arange(len(edges)), pieces)
    fraction = np.concatenate([np.arange(n) / n for n in pieces if n])
    profile = np.concatenate([corners[edge] + fraction[:, None] * edges[edge], corners[-1:]])
    azimuth = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    radius, height = profile[:, :1], profile[:, 1:]
    rings = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height + 0 * azimuth], axis=-1)
    vertices, faces, band = loft(rings)
    return vertices, faces, stroke_of_corner[edge + 1][band]


def loft(rings: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The closed surface through rings (n, s, 3) that run counter-clockwise about the direction of travel.

    The first and the last ring are single points, repeated. Returns vertices (V, 3), faces (F, 3) and the
    band (F,) between two rings that each face lies in.
    """
    n, s = rings.shape[:2]
    vertices = np.concatenate([rings[0, :1], rings[1:-1].reshape(-1, 3), rings[-1, :1]])
    index = np.clip(np.arange(1 - s, (n - 1) * s + 1).reshape(n, s), 0, (n - 2) * s + 1)
    a, d = index[:-1], index[1:]
    b, c = np.roll(a, -1, axis=1), np.roll(d, -1, axis=1)
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    band = np.repeat(np.arange(n - 1), 2 * s)
    real = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])
    return vertices, faces[real], band[real]


def surface_of_cells(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), in cells, and faces (F, 3) between filled cells (nx, ny, nz) and empty ones."""
    padded, unit, quads = np.pad(cells, 1), np.eye(3, dtype=int), []
    for axis in range(3):
        u, v = unit[(axis + 1) % 3], unit[(axis + 2) % 3]
        square = np.array([0 * u, u, u + v, v])  # counter-clockwise about +axis
        for side in (0, 1):
            neighbor = np.roll(padded, 1 - 2 * side, axis)[1:-1, 1:-1, 1:-1]
            exposed = np.argwhere(cells & ~neighbor)
            quads.append(exposed[:, None] + side * unit[axis] + square[:: 2 * side - 1])
    vertices, corners = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    return vertices, corners.reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def paint(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, *paints: ArrayLike) -> Mesh:
    """A mesh whose faces of part i have the color paints[i]: one RGB (3,) or one per vertex (V, 3)."""
    colors = np.stack([np.broadcast_to(paint, vertices.shape) for paint in paints]).astype(np.float32)
    return replace(Mesh.plain(vertices, faces), corner_colors=colors[part[:, None], faces])


def arc(center: ArrayLike, radii: ArrayLike, start: float, stop: float) -> np.ndarray:
    """Profile rows (13, 2) along an ellipse, from and to an angle in degrees above the horizontal."""
    angle = np.radians(np.linspace(start, stop, 13))[:, None]
    return np.array(center) + radii * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)


def bump(x: np.ndarray) -> np.ndarray:
    """1 at x = 0, falling to nothing within |x| of about 2."""
    return np.exp(-(x**2))


def ripples(rng: np.random.Generator, points: np.ndarray, wavelength: float) -> np.ndarray:
    """A smooth random field of mean 0 and variance 1 at points (V, 3): plane waves, 32 random directions."""
    directions = rng.normal(size=(3, 32))
    directions *= 2 * np.pi / wavelength / np.linalg.norm(directions, axis=0)
    phases = rng.uniform(0, 2 * np.pi, 32)
    return torch.from_numpy(points @ directions + phases).cos().numpy().sum(axis=1) / 4  # in NumPy it takes long


def choose(rng: np.random.Generator, *colors: tuple[float, float, float]) -> np.ndarray:
    """One of the RGB colors, a little off."""
    return np.clip(rng.choice(colors) + rng.uniform(-0.04, 0.04, 3), 0, 1)


def mix(from_color: np.ndarray, to_color: ArrayLike, weight: np.ndarray) -> np.ndarray:
    """(V, 3) colors between two, RGB (3,) or (V, 3) each; weight (V,) or a number is clipped to [0, 1]."""
    return from_color + np.clip(weight, 0, 1)[..., None] * (np.asarray(to_color) - from_color)
