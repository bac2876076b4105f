"""Cost and accuracy of shadows and bounces, and of lamps and projectors, beside environment light.

    python -m benchmarks.lights --mitsuba

writes lights.csv in some minutes on one CPU thread. It needs the extra `shadows`, and for --mitsuba the extra `lab` and
LLVM (apt install libllvm19). Its tables:

cost          building an operator of one of 20 views, and a light step (image, clamp, gradient), by light paths and
              size; errors are against many rays and samples
local lights  the same for lamps and projectors; errors are against 64² samples
mitsuba       difference to a path tracer; "noise" is its standard error, "direct" our error without light paths

Errors are root mean squares of the difference over the reference's.
"""

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
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

from benchmarks.common import Row, quartiles_of_ratio, record, relative_error, times_in_turn
from renderer.camera import Camera, OrthographicCamera, orbit_cameras
from renderer.geometry.mesh import Mesh, concatenate, normalize, subdivide
from renderer.geometry.shapes import solid
from renderer.io.mitsuba import SCENE, mitsuba, mitsuba_map, write_mitsuba_scene
from renderer.light.basis import HARMONICS, Basis
from renderer.light.environment import write_map
from renderer.light.lamps import Lamps
from renderer.light.presets import load_light
from renderer.light.projector import Projector
from renderer.settings import ImageSettings
from renderer.transport import precomputed, rays
from renderer.transport.operators import TransferOperator, build_operators
from renderer.visibility.rasterizers import choose

CAMERA = OrthographicCamera(0.9, 0.6, 2.2)
VIEWS, SEEDS = 20, 8  # SEEDS: Mitsuba's images, whose spread tells its noise
RAYS, PATCHES, RAYS_OF_PATCH = 2**14, 2**13, 2**8  # per pixel; that light bounces between; per patch: converged
SAMPLES = {"cost": (8, 16), "local lights": (2, 64)}  # per side of a pixel: of what is measured, and of its reference

Case = tuple[Basis, Mapping[str, Any]]  # the light, and settings of the image
DIRECT: Case = (HARMONICS, {})
LIGHT_PATHS: dict[str, Case] = {
    "direct": DIRECT,
    "shadows": (HARMONICS, {"shadows": True}),
    "shadows, smooth": (HARMONICS, {"shadows": True, "normals": "smooth"}),
    "bounces:3": (HARMONICS, {"bounces": 3}),
}
LAMPS = Lamps(((2.0, 2.0, 2.0), (-2.0, 2.0, 2.0), (2.0, -2.0, 2.0)))
LOCAL_LIGHTS: dict[str, Case] = {"harmonics": DIRECT, "3 lamps": (LAMPS, {}), "projector of 16²": (Projector(16), {})}


def operators(
    mesh: Mesh, size: int, samples: int, case: Case, cameras: Sequence[Camera] = (CAMERA,)
) -> list[TransferOperator]:
    basis, settings = case
    return build_operators(mesh, cameras, ImageSettings(size, samples, **settings), choose("numpy"), basis=basis)


def converged(mesh: Mesh, size: int, samples: int, case: Case) -> TransferOperator:
    """With many more rays per pixel, patches, and rays per patch."""
    more_patches = patch.multiple(precomputed, PATCHES=PATCHES, PATCH_DIRECTIONS=RAYS_OF_PATCH)
    with patch.object(rays, "DIRECTIONS", RAYS), more_patches:
        return operators(mesh, size, samples, case)[0]


def costs(
    table: str, cases: Mapping[str, Case], cup: Mesh, sizes: Sequence[int], rounds: int, steps_only: bool
) -> Iterator[Row]:
    """Yield a row per case and size. Errors are at the first size.

    The columns of_direct, of_direct_low and of_direct_high hold the median and the quartiles over the rounds of the
    light step's time over that of the first case.
    """
    samples, finest = SAMPLES[table]
    built = {(name, size): operators(cup, size, samples, cases[name])[0] for name, size in product(cases, sizes)}
    lights = {name: torch.rand(basis.size, 3) for name, (basis, _) in cases.items()}
    lights |= {name: load_light("grace") for name, (basis, _) in cases.items() if basis == HARMONICS}
    steps = {key: partial(light_step, operator, lights[key[0]].requires_grad_()) for key, operator in built.items()}
    times = times_in_turn(steps, rounds)
    for (name, size), operator in built.items():
        row: Row = {"table": table, "light": name, "size": size, "step_ms": median(times[name, size])}
        ratios = quartiles_of_ratio(times[name, size], times[next(iter(cases)), size])
        row["of_direct_low"], row["of_direct"], row["of_direct_high"] = ratios
        if steps_only:
            yield row
            continue
        row["megabytes"] = sum(part.nbytes for part in (operator.transfer, *(operator.sparse or ()))) / 1e6
        build = partial(operators, cup, size, samples, cases[name], orbit_cameras(VIEWS, 2.2))
        row["build_s"] = min(repeat(build, timer=time.process_time, number=1, repeat=2)) / VIEWS
        if size == sizes[0]:
            light, exact = lights[name].detach(), converged(cup, size, finest, cases[name])
            pairs = zip(image_and_gradient(operator, light), image_and_gradient(exact, light), strict=True)
            row["image_error"], row["gradient_error"] = (relative_error(*pair) for pair in pairs)
        yield row


def light_step(operator: TransferOperator, light: Tensor) -> None:
    """An image, clamped, and the gradient of a loss by the light, which requires it."""
    torch.autograd.grad(operator.image(light).square().sum(), light)


def image_and_gradient(operator: TransferOperator, light: Tensor) -> tuple[Tensor, Tensor]:
    """The radiance (3, size²), and the gradient of Σ radiance × normal random numbers by the light."""
    size = operator.settings.size
    weights = torch.randn(3, size**2, generator=torch.Generator().manual_seed(0))
    image = light.new_zeros(3, size**2).index_copy(1, operator.pixels, operator.radiance(light))
    return image, operator.light_gradient(weights[:, operator.pixels])


def hard_meshes() -> dict[str, Mesh]:
    shell, torus = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.torus(0.45, 0.45)
    lower, dents = shell.triangles_center[:, 2] < 0, np.random.default_rng(0).uniform(0.6, 1, (len(shell.vertices), 1))
    ball = Mesh.plain(shell.vertices, shell.faces)
    plate = Mesh.plain([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]], [[0, 1, 2], [0, 2, 3]], (0.2, 0.6, 0.9))
    box, heights = trimesh.creation.box((0.8, 0.8, 0.02)), 0.05 * np.arange(5)
    boards = [Mesh.plain(box.vertices + np.array([0, 0, height]), box.faces, (0.9, 0.6, 0.4)) for height in heights]
    return {
        "convex: a ball": ball,
        "concave: solid:cup": normalize(solid("cup", 0)),
        "concave: solid:table": normalize(solid("table", 0)),
        "rugged: a dented ball": replace(ball, vertices=shell.vertices * dents),
        "open: half a ball": Mesh.plain(shell.vertices, shell.faces[lower], (0.8, 0.7, 0.5)),
        "self-touching: a ring without a hole": Mesh.plain(torus.vertices, torus.faces, (0.3, 0.8, 0.5)),
        "touching parts: a ball on a plate": concatenate([ball, plate]),
        "thin: boards 0.03 apart": concatenate(boards),
    }


def beside_mitsuba(size: int) -> Iterator[Row]:
    for (name, mesh), paths in product(hard_meshes().items(), list(LIGHT_PATHS)[1:]):
        yield {"table": "mitsuba", "mesh": name, "light": paths, "size": size} | differences(mesh, size, paths)


def differences(mesh: Mesh, size: int, paths: str) -> Row:
    """Of the image, over its brightest value and inside the outline."""
    light, (samples, finest) = load_light("st_peters"), SAMPLES["cost"]  # a probe that is positive all around
    unblocked = {**LIGHT_PATHS[paths][1], "shadows": False, "bounces": 0}
    ours = {
        "image_error": operators(mesh, size, samples, LIGHT_PATHS[paths])[0],
        "image_error_converged": converged(mesh, size, finest, LIGHT_PATHS[paths]),
        "image_error_direct": operators(mesh, size, samples, (HARMONICS, unblocked))[0],
    }
    image, coverage, noise = mitsuba_image(mesh, size, paths, light)
    inside, row = coverage > 0.999, {}
    for name, operator in ours.items():
        canvas = torch.zeros(3, size**2).index_copy(1, operator.pixels, operator.radiance(light))
        row[name] = float((canvas - image)[:, inside].square().mean().sqrt() / image.max())
    return row | {"image_noise": float(noise[:, inside].square().mean().sqrt() / image.max())}


def mitsuba_image(mesh: Mesh, size: int, paths: str, light: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The mean of SEEDS images (3, size²), the coverage (size²,), and the standard error of the mean (3, size²)."""
    settings = ImageSettings(size, **LIGHT_PATHS[paths][1])
    with TemporaryDirectory() as folder, mitsuba() as module:
        write_mitsuba_scene(Path(folder), mesh, 1.0, [CAMERA], settings, "light.exr")
        write_map(Path(folder, "light.exr"), mitsuba_map(light, 512))
        scene = module.load_file(str(Path(folder, SCENE)))
        renders = np.stack([np.array(module.render(scene, seed=seed)) for seed in range(SEEDS)])
    draws = torch.from_numpy(renders).permute(0, 3, 1, 2).flatten(2)
    return draws.mean(0)[:3], draws.mean(0)[3], draws.std(0)[:3] / SEEDS**0.5


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path, default=Path("lights.csv"))
    parser.add_argument("--mitsuba", action="store_true", help="compare with Mitsuba 3, too")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 224], help="of images, in pixels")
    parser.add_argument("--vertices", type=int, default=4000, help="of the cup, at least")
    parser.add_argument("--rounds", type=int, default=21, help="in which all settings take turns")
    parser.add_argument("--steps-only", action="store_true", help="time light steps; measure no building and no errors")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cup, sizes = subdivide(normalize(solid("cup", 0)), options.vertices), options.sizes
    tables = [costs("cost", LIGHT_PATHS, cup, sizes, options.rounds, options.steps_only)]
    tables += [costs("local lights", LOCAL_LIGHTS, cup, sizes, options.rounds, options.steps_only)]
    tables += [beside_mitsuba(sizes[0])] if options.mitsuba else []
    record(chain.from_iterable(tables), options.csv)


if __name__ == "__main__":
    main()
