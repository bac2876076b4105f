"""Cost and accuracy of shadows and bounces, and of lamps and projectors, beside environment light.

    python -m benchmarks.lights --mitsuba

writes lights.csv in some minutes on one CPU thread. It needs the extra
`shadows`, and for --mitsuba the extra `lab` and LLVM (apt install libllvm19).
The column "table" has the name of the table of a row:

cost          Building an operator of one of 20 views, and a light step (image,
              clamp, gradient), for each kind of light paths and each size.
              Errors are against many rays and samples.
local lights  The same for lamps and projectors. Errors are against 64² samples.
samples       Errors of a cup by the number of samples, against 32² samples.
mitsuba       The difference to a path tracer. "noise" is the standard error of
              the path tracer. "direct" is our error without light paths.

Errors are root mean squares of the difference, divided by the root mean square
of the reference. In the table "mitsuba", they are divided by the brightest
value of the image instead.
"""

import argparse
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from timeit import repeat
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import trimesh
from torch import Tensor

from benchmarks import common
from benchmarks.common import Row, quartiles_of_ratio, record, relative_error, times_in_turn
from benchmarks.scene import Contender, View, coefficients
from benchmarks.steps import LightStep
from renderer.camera import Camera, OrthographicCamera, orbit_cameras
from renderer.light.basis import DEGREE, HARMONICS, Basis
from renderer.light.environment import write_map
from renderer.light.files import load_light
from renderer.light.lamps import Lamps, Projector
from renderer.mesh import Mesh, concatenate, normalize, subdivide
from renderer.mitsuba_scene import SCENE, mitsuba, mitsuba_map, write_mitsuba_scene
from renderer.operators import rays
from renderer.operators import shadows as precomputed
from renderer.operators.apply import TransferOperator
from renderer.operators.build import build_operators
from renderer.settings import ImageSettings
from renderer.solids import solid
from renderer.visibility import choose

CAMERA = OrthographicCamera(math.degrees(0.9), math.degrees(0.6), 2.2)
# Number of views over which the time of building an operator is averaged.
VIEWS = 20
# Number of images by Mitsuba. Their spread is Mitsuba's noise.
MITSUBA_SEEDS = 8
# Rows of the environment map that Mitsuba gets.
MITSUBA_ROWS = 512

# Converged operators trace so many rays per pixel, bounce light between so many
# patches of the surface, and trace so many rays per patch.
CONVERGED_RAYS = 2**14
CONVERGED_PATCHES = 2**13
CONVERGED_RAYS_PER_PATCH = 2**11


@dataclass(frozen=True)
class Samples:
    """Samples per side of a pixel.

    Attributes:
        measured: Samples of the operators that are measured.
        converged: Samples of the reference of their errors.
    """

    measured: int
    converged: int


COST_SAMPLES = Samples(measured=8, converged=16)
LOCAL_LIGHT_SAMPLES = Samples(measured=2, converged=64)
# Samples per side of a pixel in the table of errors by the number of samples.
SAMPLES = (2, 4, 8, 16)
CONVERGED_SAMPLES = 32

# Ray directions of a pixel that `shadow_builds` compares, and the most of them for each sample.
DIRECTIONS = (128, 512, 2048, 8192)
MAX_DIRECTIONS_PER_SAMPLE = 128
# Most samples per side of an image, and ray directions of a pixel, of their reference.
CONVERGED_RESOLUTION = 4096
CONVERGED_DIRECTIONS = 2**15


@dataclass(frozen=True)
class Case:
    """A kind of light.

    Attributes:
        basis: Basis of the light.
        image: Settings of the image that differ from the defaults.
    """

    basis: Basis = HARMONICS
    image: Mapping[str, Any] = field(default_factory=dict)


LIGHT_PATHS = {
    "direct": Case(),
    "shadows": Case(image={"shadows": True}),
    "shadows, smooth": Case(image={"shadows": True, "normals": "smooth"}),
    "bounces:3": Case(image={"bounces": 3}),
}
LAMPS = Lamps(((2.0, 2.0, 2.0), (-2.0, 2.0, 2.0), (2.0, -2.0, 2.0)))
LOCAL_LIGHTS = {
    "harmonics": Case(),
    "3 lamps": Case(LAMPS),
    "projector of 16²": Case(Projector(16)),
}


@dataclass(frozen=True)
class Load:
    """Mesh and sizes that the tables of costs render, and numbers of repetitions.

    Attributes:
        mesh: Mesh to render.
        sizes: Pixels per side of the images.
        rounds: Number of rounds.
        steps_only: Whether only the time of light steps is measured.
    """

    mesh: Mesh
    sizes: Sequence[int]
    rounds: int
    steps_only: bool


# ---------------------------------------------------------------------------- costs


def build(
    mesh: Mesh, size: int, samples: int, case: Case, cameras: Sequence[Camera] = (CAMERA,)
) -> list[TransferOperator]:
    """Build operators from the light of a case to the images of cameras.

    Args:
        mesh: Mesh to render.
        size: Pixels per side of the images.
        samples: Samples per side of a pixel.
        case: Kind of light.
        cameras: Cameras of the views.

    Returns:
        Operator of each camera.
    """
    settings = ImageSettings(size, samples, **case.image)
    return build_operators(mesh, cameras, settings, choose("numpy"), basis=case.basis)


def build_converged(mesh: Mesh, size: int, samples: int, case: Case) -> TransferOperator:
    """Build the operator of `CAMERA` with many more rays and patches than usual.

    Args:
        mesh: Mesh to render.
        size: Pixels per side of the image.
        samples: Samples per side of a pixel.
        case: Kind of light.

    Returns:
        The operator.
    """
    more_patches = patch.multiple(
        precomputed, PATCHES=CONVERGED_PATCHES, PATCH_DIRECTIONS=CONVERGED_RAYS_PER_PATCH
    )
    more_rays = patch.object(rays, "DIRECTIONS", CONVERGED_RAYS)
    with more_rays, more_patches:
        [operator] = build(mesh, size, samples, case)
    return operator


def measure_costs(
    table: str, cases: Mapping[str, Case], samples: Samples, load: Load
) -> Iterator[Row]:
    """Measure light steps, operators and errors of several kinds of light.

    Args:
        table: Name of the table.
        cases: Kinds of light by name. The first is the one that light steps are
            compared with.
        samples: Samples per side of a pixel.
        load: Mesh, sizes and number of rounds.

    Yields:
        A row for each case and size. Errors are measured at the first size. The
        columns of_direct, of_direct_low and of_direct_high have the median and
        the quartiles, over the rounds, of the time of the light step divided by
        that of the first case.
    """
    lights = {name: make_light(case.basis) for name, case in cases.items()}
    operators = {}
    steps = {}
    for name, size in product(cases, load.sizes):
        [operator] = build(load.mesh, size, samples.measured, cases[name])
        operators[name, size] = operator
        steps[name, size] = partial(take_light_step, operator, lights[name].requires_grad_())
    times = times_in_turn(steps, load.rounds)
    first_case = next(iter(cases))
    for (name, size), operator in operators.items():
        seconds = times[name, size]
        low, middle, high = quartiles_of_ratio(seconds, times[first_case, size])
        row: Row = {
            "table": table,
            "light": name,
            "size": size,
            "step_ms": median(seconds),
            "of_direct_low": low,
            "of_direct": middle,
            "of_direct_high": high,
        }
        if not load.steps_only:
            row["megabytes"] = megabytes_of(operator)
            row["build_s"] = time_build(load.mesh, size, samples.measured, cases[name])
            if size == load.sizes[0]:
                exact = build_converged(load.mesh, size, samples.converged, cases[name])
                row |= measure_errors(operator, exact, lights[name].detach())
        yield row


def make_light(basis: Basis) -> Tensor:
    """Return a light probe, or random coefficients in [0, 1] for lamps and projectors."""
    if basis == HARMONICS:
        return load_light("grace")
    return torch.rand(basis.size, 3, generator=torch.Generator().manual_seed(0))


def take_light_step(operator: TransferOperator, light: Tensor) -> None:
    """Render a clamped image, and compute the gradient of a loss by the light.

    Args:
        operator: Operator from the light to the image.
        light: Coefficients of the light, which require a gradient.
    """
    torch.autograd.grad(operator.image(light).square().sum(), light)


def megabytes_of(operator: TransferOperator) -> float:
    """Return the memory of the matrices of an operator in megabytes."""
    matrices = [operator.transfer, *(operator.sparse or ())]
    return sum(matrix.nbytes for matrix in matrices) / 1e6


def time_build(mesh: Mesh, size: int, samples: int, case: Case) -> float:
    """Return how many seconds it takes to build an operator.

    The time is averaged over VIEWS views. It is measured twice, and the smaller
    result counts.

    Args:
        mesh: Mesh to render.
        size: Pixels per side of the image.
        samples: Samples per side of a pixel.
        case: Local lights of the operator.
    """
    cameras = orbit_cameras(VIEWS, 2.2)
    call = partial(build, mesh, size, samples, case, cameras)
    seconds = repeat(call, timer=time.process_time, number=1, repeat=2)
    return min(seconds) / VIEWS


def measure_errors(operator: TransferOperator, exact: TransferOperator, light: Tensor) -> Row:
    """Compute the errors of an operator.

    Args:
        operator: Operator to check.
        exact: Operator of the same view that has converged.
        light: Coefficients of the light.

    Returns:
        Row with the relative errors of the image and of the gradient.
    """
    image_error = relative_error(radiance_image(operator, light), radiance_image(exact, light))
    gradient_error = relative_error(
        gradient_by_light(operator, light), gradient_by_light(exact, light)
    )
    return {"image_error": image_error, "gradient_error": gradient_error}


def measure_errors_by_samples(mesh: Mesh, size: int) -> Iterator[Row]:
    """Measure how the errors of direct light and of shadows fall as the samples increase.

    Args:
        mesh: Mesh to render.
        size: Pixels per side of the images.

    Yields:
        A row for each kind of light paths and each number of samples.
    """
    light = load_light("grace")
    for name in ("direct", "shadows"):
        [exact] = build(mesh, size, CONVERGED_SAMPLES, LIGHT_PATHS[name])
        for samples in SAMPLES:
            [operator] = build(mesh, size, samples, LIGHT_PATHS[name])
            errors = measure_errors(operator, exact, light)
            yield {"table": "samples", "light": name, "size": size, "samples": samples} | errors


def radiance_image(operator: TransferOperator, light: Tensor) -> Tensor:
    """Return the radiance of all pixels before a black background, shape (3, size²).

    Args:
        operator: Operator from the light to the image.
        light: Coefficients of the light.
    """
    black = light.new_zeros(3, operator.settings.size**2)
    return black.index_copy(1, operator.pixels, operator.radiance(light))


def gradient_by_light(operator: TransferOperator, light: Tensor) -> Tensor:
    """Return the gradient of Σ radiance × normal random numbers by the light.

    The gradient does not depend on the light, because the radiance is linear.

    Args:
        operator: Operator from the light to the image.
        light: Coefficients of the light.
    """
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(3, operator.settings.size**2, generator=generator)
    return operator.light_gradient(weights[:, operator.pixels])


def shadow_builds(view: View) -> Iterator[Contender]:
    """Yield the building of an operator of a cup with shadows, by samples and ray directions."""
    view = replace(view, mesh=subdivide(normalize(solid("cup", 0)), 4000))
    light = coefficients(DEGREE, torch.float32, view.device)
    samples = min(CONVERGED_SAMPLES, CONVERGED_RESOLUTION // view.size)
    exact = LightStep(view, build_shadows(view, samples, CONVERGED_DIRECTIONS), light)()
    pixels = torch.arange(view.size**2)
    exact = replace(exact, pixels=pixels, radiance=exact.image(len(pixels)))
    for samples, directions in product((1, *SAMPLES), DIRECTIONS):
        if not 1 <= directions / samples**2 <= MAX_DIRECTIONS_PER_SAMPLE:
            continue
        if 2 * samples * view.size > CONVERGED_RESOLUTION:
            continue
        build = partial(build_shadows, view, samples, directions)
        step = LightStep(view, build(), light)
        yield Contender(f"{directions:,} directions", samples, DEGREE, step, build, exact)


def build_shadows(view: View, samples: int, directions: int) -> TransferOperator:
    """Build an operator with shadows whose samples divide some ray directions of each pixel."""
    with patch.multiple(rays, DIRECTIONS=directions, DIRECTIONS_PER_SAMPLE=1):
        return view.operator(samples, shadows=True)


# ---------------------------------------------------------------------------- Mitsuba


def make_hard_meshes() -> dict[str, Mesh]:
    """Make meshes of various shapes, some of which are hard for light paths."""
    shell = trimesh.creation.icosphere(subdivisions=3)
    ball = Mesh.plain(shell.vertices, shell.faces)
    is_lower_face = shell.triangles_center[:, 2] < 0
    half_ball = Mesh.plain(shell.vertices, shell.faces[is_lower_face], (0.8, 0.7, 0.5))
    dents = np.random.default_rng(0).uniform(0.6, 1, (len(shell.vertices), 1))
    torus = trimesh.creation.torus(0.45, 0.45)
    return {
        "convex: a ball": ball,
        "concave: solid:cup": normalize(solid("cup", 0)),
        "concave: solid:table": normalize(solid("table", 0)),
        "rugged: a dented ball": replace(ball, vertices=shell.vertices * dents),
        "open: half a ball": half_ball,
        "self-touching: a ring without a hole": Mesh.plain(
            torus.vertices, torus.faces, (0.3, 0.8, 0.5)
        ),
        "touching parts: a ball on a plate": concatenate([ball, make_plate()]),
        "thin: boards 0.03 apart": concatenate(make_boards()),
    }


def make_plate() -> Mesh:
    """Make a square at z = -1, which touches the unit ball."""
    corners = [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]]
    return Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]], (0.2, 0.6, 0.9))


def make_boards() -> list[Mesh]:
    """Make five boards of thickness 0.02, one every 0.05 along z."""
    box = trimesh.creation.box((0.8, 0.8, 0.02))
    boards = []
    for height in 0.05 * np.arange(5):
        vertices = box.vertices + np.array([0, 0, height])
        boards.append(Mesh.plain(vertices, box.faces, (0.9, 0.6, 0.4)))
    return boards


def compare_with_mitsuba(size: int) -> Iterator[Row]:
    """Compare renders of hard meshes with Mitsuba's.

    Args:
        size: Pixels per side of the images.

    Yields:
        A row for each mesh and each kind of light paths except direct light.
    """
    indirect = [name for name in LIGHT_PATHS if name != "direct"]
    for (mesh_name, mesh), name in product(make_hard_meshes().items(), indirect):
        row = {"table": "mitsuba", "mesh": mesh_name, "light": name, "size": size}
        yield row | differences_from_mitsuba(mesh, size, LIGHT_PATHS[name])


def differences_from_mitsuba(mesh: Mesh, size: int, case: Case) -> Row:
    """Measure how far three of our images are from the image by Mitsuba.

    Args:
        mesh: Mesh to render.
        size: Pixels per side of the images.
        case: Kind of light paths.

    Returns:
        Row with the errors of our usual image ("image_error"), of our converged
        image ("image_error_converged") and of our image of direct light alone
        ("image_error_direct"). An error is the root mean square of the
        difference inside the outline of the mesh, divided by the brightest
        value of Mitsuba's image. "image_noise" is the standard error of
        Mitsuba's image in the same unit.
    """
    # This probe is positive all around.
    light = load_light("st_peters")
    direct = Case(image={**case.image, "shadows": False, "bounces": 0})
    [usual_operator] = build(mesh, size, COST_SAMPLES.measured, case)
    [direct_operator] = build(mesh, size, COST_SAMPLES.measured, direct)
    operators = {
        "image_error": usual_operator,
        "image_error_converged": build_converged(mesh, size, COST_SAMPLES.converged, case),
        "image_error_direct": direct_operator,
    }
    expected = render_with_mitsuba(mesh, size, case, light)
    is_inside = expected.coverage > 0.999
    brightest = expected.image.max()
    row: Row = {}
    for name, operator in operators.items():
        difference = radiance_image(operator, light) - expected.image
        row[name] = float(root_mean_square(difference[:, is_inside]) / brightest)
    noise = root_mean_square(expected.standard_error[:, is_inside])
    return row | {"image_noise": float(noise / brightest)}


def root_mean_square(values: Tensor) -> Tensor:
    """Return the square root of the mean of the squares of all values."""
    return values.square().mean().sqrt()


@dataclass(frozen=True)
class MitsubaImage:
    """Mean of images that Mitsuba rendered with different seeds.

    Attributes:
        image: Radiance, shape (3, size²).
        coverage: Covered fraction of each pixel, shape (size²,).
        standard_error: Standard error of the radiance, shape (3, size²).
    """

    image: Tensor
    coverage: Tensor
    standard_error: Tensor


def render_with_mitsuba(mesh: Mesh, size: int, case: Case, light: Tensor) -> MitsubaImage:
    """Render a mesh MITSUBA_SEEDS times with Mitsuba.

    Args:
        mesh: Mesh to render.
        size: Pixels per side of the image.
        case: Kind of light paths.
        light: SH coefficients of the environment light, shape (K, 3).

    Returns:
        Mean and standard error of the images.

    Raises:
        InputError: If Mitsuba is not installed.
    """
    settings = ImageSettings(size, **case.image)
    with TemporaryDirectory() as folder, mitsuba() as module:
        write_mitsuba_scene(Path(folder), mesh, 1.0, [CAMERA], settings, "light.exr")
        write_map(Path(folder, "light.exr"), mitsuba_map(light, MITSUBA_ROWS))
        scene = module.load_file(str(Path(folder, SCENE)))
        images = [np.array(module.render(scene, seed=seed)) for seed in range(MITSUBA_SEEDS)]
    # Shape (seeds, 4, size²) with red, green, blue and coverage.
    renders = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).flatten(2)
    mean = renders.mean(0)
    return MitsubaImage(
        image=mean[:3], coverage=mean[3], standard_error=renders.std(0)[:3] / MITSUBA_SEEDS**0.5
    )


# ---------------------------------------------------------------------------- command


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = common.make_parser(__doc__)
    add = parser.add_argument
    add("--csv", type=Path, default=Path("lights.csv"), help="file of the results")
    add("--mitsuba", action="store_true", help="compare with Mitsuba 3, too")
    add("--vertices", type=int, default=4000, help="smallest number of vertices of the cup")
    add(
        "--steps-only",
        action="store_true",
        help="time light steps; measure no building and no errors",
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all tables, and write them to a CSV file.

    Args:
        arguments: Words of the command line. None takes those of the process.
    """
    options = make_parser().parse_args(arguments)
    torch.set_num_threads(1)
    load = Load(
        mesh=subdivide(normalize(solid("cup", 0)), options.vertices),
        sizes=options.sizes,
        rounds=options.rounds,
        steps_only=options.steps_only,
    )
    tables = [
        measure_costs("cost", LIGHT_PATHS, COST_SAMPLES, load),
        measure_costs("local lights", LOCAL_LIGHTS, LOCAL_LIGHT_SAMPLES, load),
    ]
    if not options.steps_only:
        tables.append(measure_errors_by_samples(normalize(solid("cup", 0)), options.sizes[0]))
    if options.mitsuba:
        tables.append(compare_with_mitsuba(options.sizes[0]))
    record(chain.from_iterable(tables), options.csv)


if __name__ == "__main__":
    main()
