"""Cost and accuracy of shadows and bounces, and of lamps and projectors, beside environment light.

    python -m benchmarks.lights --mitsuba

writes lights.csv in some minutes on one CPU thread. It needs the extra `shadows`, and for --mitsuba the extra `lab` and
LLVM (apt install libllvm19). Its tables:

cost          building an operator, and a light step (image, clamp, gradient), by light paths and size; errors are
              against many rays and samples
local lights  the same for lamps and projectors; errors are against 64² samples in float64
mitsuba       difference to a path tracer; "noise" is its standard error, "direct" our error without light paths

Errors are root mean squares of the difference over the reference's.
"""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from itertools import chain, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from benchmarks.common import machine, medians, relative_error, seconds, write_csv
from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.image import ImageSettings
from renderer.io.mitsuba import DIFFERENTIABLE, SCENE, VARIANT, mitsuba, mitsuba_map, write_mitsuba_scene
from renderer.light.basis import HARMONICS, SumBasis
from renderer.light.environment import write_map
from renderer.light.local import Lamps, Projector
from renderer.light.presets import load_light
from renderer.mesh import Mesh, concatenate, normalize
from renderer.rasterizer import choose
from renderer.shapes import solid
from renderer.subdivision import subdivide
from renderer.transfer import TransferOperator, build_operators
from renderer.transport import precomputed, rays

CAMERA = OrthographicCamera(0.9, 0.6, 2.2)
LIGHT_PATHS = {"direct": {}, "shadows": {"shadows": True}, "bounces:3": {"bounces": 3}}
VIEWS, SEEDS = 20, 8  # SEEDS: Mitsuba's images, whose spread tells its noise
CONVERGED, FINEST = (2**14, 2**13, 2**8), 16  # rays per pixel, patches and their rays; samples per side of a pixel
REFERENCE = 64  # samples per side of a pixel for local lights
LAMPS = Lamps(((2.0, 2.0, 2.0), (-2.0, 2.0, 2.0), (2.0, -2.0, 2.0)))
BASES = {
    "harmonics": HARMONICS,
    "3 lamps": LAMPS,
    "3 discs": replace(LAMPS, radius=0.5),
    "projector of 16²": Projector(16),
    "projector of 32²": Projector(32),
    "harmonics and projector of 16²": SumBasis((HARMONICS, Projector(16))),
}

Row = dict[str, Any]


def operator(
    mesh: Mesh, size: int, transport: str = "direct", samples: int = 8, camera: OrthographicCamera = CAMERA, **more: Any
) -> TransferOperator:
    settings = ImageSettings(size, samples, **LIGHT_PATHS[transport])
    return build_operators(mesh, [camera], settings, choose("numpy"), **more)[0]


def light_step(built: TransferOperator, light: Tensor) -> None:
    """An image, clamped, and the gradient of a loss by the light, which requires it."""
    torch.autograd.grad(built.image(light).square().sum(), light)


def image_and_gradient(built: TransferOperator, light: Tensor) -> tuple[Tensor, Tensor]:
    """The radiance (3, size²), and the gradient of Σ radiance × normal random numbers by the light."""
    size = built.settings.size
    weights = torch.randn(3, size**2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).to(light)
    canvas = light.new_zeros(3, size**2).index_copy(1, built.pixels, built.radiance(light))
    return canvas, built.light_gradient(weights[:, built.pixels])


def errors(ours: tuple[Tensor, Tensor], reference: tuple[Tensor, Tensor]) -> Row:
    image, gradient = map(relative_error, ours, reference)
    return {"image_error": image, "gradient_error": gradient}


def megabytes(built: TransferOperator) -> float:
    return sum(tensor.nbytes for tensor in (built.transfer, *(built.sparse or ()))) / 1e6


@contextmanager
def quadrature(
    directions: int, patches: int = precomputed.PATCHES, of_patch: int = precomputed.PATCH_DIRECTIONS
) -> Iterator[None]:
    """Other numbers of rays per pixel, of patches that light bounces between, and of rays per patch."""
    before = rays.DIRECTIONS, precomputed.PATCHES, precomputed.PATCH_DIRECTIONS
    try:
        rays.DIRECTIONS, precomputed.PATCHES, precomputed.PATCH_DIRECTIONS = directions, patches, of_patch
        yield
    finally:
        rays.DIRECTIONS, precomputed.PATCHES, precomputed.PATCH_DIRECTIONS = before


# ---------------------------------------------------------------------------- tables


def cost(cup: Mesh, sizes: Sequence[int], rounds: int) -> Iterator[Row]:
    light = load_light("grace").requires_grad_()
    built = {(paths, size): operator(cup, size, paths) for paths in LIGHT_PATHS for size in sizes}
    times = medians({key: partial(light_step, each, light) for key, each in built.items()}, rounds)
    for (paths, size), each in built.items():
        settings = ImageSettings(size, **LIGHT_PATHS[paths])
        build = partial(build_operators, cup, orbit_cameras(VIEWS, 2.2), settings, choose("numpy"))
        row: Row = {"table": "cost", "light": paths, "size": size, "step_ms": times[paths, size]}
        row |= {"of_direct": times[paths, size] / times["direct", size], "megabytes": megabytes(each)}
        row["build_s"] = min(seconds(build) for _ in range(2)) / VIEWS
        if size == sizes[0]:
            with quadrature(*CONVERGED):
                exact = image_and_gradient(operator(cup, size, paths, FINEST), light.detach())
            row |= errors(image_and_gradient(each, light.detach()), exact)
        yield row


def local_lights(cup: Mesh, sizes: Sequence[int], rounds: int) -> Iterator[Row]:
    keys = list(product(BASES, sizes))
    built = {(name, size): operator(cup, size, samples=2, basis=BASES[name]) for name, size in keys}
    lights = {name: torch.rand(basis.size, 3).requires_grad_() for name, basis in BASES.items()}
    times = medians({key: partial(light_step, built[key], lights[key[0]]) for key in keys}, rounds)
    for name, size in keys:
        row: Row = {"table": "local lights", "light": name, "size": size, "step_ms": times[name, size]}
        row |= {"of_direct": times[name, size] / times["harmonics", size], "megabytes": megabytes(built[name, size])}
        row["build_s"] = seconds(partial(operator, cup, size, samples=2, basis=BASES[name]))
        if size == sizes[0]:
            light = lights[name].detach()
            fine = operator(cup, size, samples=REFERENCE, basis=BASES[name], dtype=torch.float64)
            row |= errors(image_and_gradient(built[name, size], light), image_and_gradient(fine, light.double()))
        yield row


# ---------------------------------------------------------------------------- Mitsuba


def hard_meshes() -> dict[str, Mesh]:
    shell, ring_shape = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.torus(0.45, 0.45)
    lower = shell.vertices[shell.faces].mean(axis=1)[:, 2] < 0
    ball, dents = (
        Mesh.plain(shell.vertices, shell.faces),
        np.random.default_rng(0).uniform(0.6, 1, (len(shell.vertices), 1)),
    )
    plate = Mesh.plain([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]], [[0, 1, 2], [0, 2, 3]], (0.2, 0.6, 0.9))
    box, heights = trimesh.creation.box((0.8, 0.8, 0.02)), 0.05 * np.arange(5)
    boards = [Mesh.plain(box.vertices + np.array([0, 0, height]), box.faces, (0.9, 0.6, 0.4)) for height in heights]
    return {
        "convex: a ball": ball,
        "concave: solid:cup": normalize(solid("cup", 0)),
        "concave: solid:table": normalize(solid("table", 0)),
        "rugged: a dented ball": replace(ball, vertices=shell.vertices * dents),
        "open: half a ball": Mesh.plain(shell.vertices, shell.faces[lower], (0.8, 0.7, 0.5)),
        "self-touching: a ring without a hole": Mesh.plain(ring_shape.vertices, ring_shape.faces, (0.3, 0.8, 0.5)),
        "touching parts: a ball on a plate": concatenate([ball, plate]),
        "thin: boards 0.03 apart": concatenate(boards),
    }


def beside_mitsuba(size: int) -> Iterator[Row]:
    for (name, mesh), paths in product(hard_meshes().items(), ["shadows", "bounces:3"]):
        yield {"table": "mitsuba", "mesh": name, "light": paths, "size": size} | differences(mesh, size, paths)


def differences(mesh: Mesh, size: int, paths: str) -> Row:
    """Of the image, over its brightest value and inside the outline; and of the gradient by the light of its sum with
    random weights there."""
    with quadrature(CONVERGED[0], 2**15, CONVERGED[2]):
        converged = operator(mesh, size, paths, FINEST)
    ours = {"": operator(mesh, size, paths), "_converged": converged, "_direct": operator(mesh, size)}
    theirs, noise = mitsuba_image(mesh, size, paths)
    inside, brightest, row = theirs[3] > 0.999, theirs[:3].max(), {}
    upstream = inside * torch.rand(3, size**2, generator=torch.Generator().manual_seed(0))
    slope, slope_noise = mitsuba_gradient(mesh, size, paths, upstream)
    for name, built in ours.items():
        canvas = torch.zeros(3, size**2, dtype=torch.float64)
        canvas[:, built.pixels] = built.radiance(st_peters()[0].detach().float()).double()
        off = (canvas - theirs[:3])[:, inside]
        row[f"image_error{name}"] = float(off.square().mean().sqrt() / brightest)
        row[f"gradient_error{name}"] = relative_error(built.light_gradient(upstream[:, built.pixels]), slope)
    row["image_noise"] = float(noise[:3, inside].square().mean().sqrt() / brightest)
    return row | {"gradient_noise": float(slope_noise.norm() / slope.norm())}


@cache
def st_peters() -> tuple[Tensor, Tensor]:
    """Coefficients of a probe that is positive all around, and its map's texels with their graph."""
    coefficients = load_light("st_peters").double().requires_grad_()
    return coefficients, mitsuba_map(coefficients, 512)


@contextmanager
def mitsuba_scene(mesh: Mesh, size: int, paths: str, variant: str) -> Iterator[tuple[Any, Any]]:
    """(the module, the scene)"""
    with TemporaryDirectory() as folder, mitsuba(variant) as module:
        settings = ImageSettings(size, **LIGHT_PATHS[paths])
        write_mitsuba_scene(Path(folder), mesh, 1.0, [CAMERA], settings, "light.exr")
        write_map(Path(folder, "light.exr"), st_peters()[1].detach())
        yield module, module.load_file(str(Path(folder, SCENE)))


def mitsuba_image(mesh: Mesh, size: int, paths: str) -> tuple[Tensor, Tensor]:
    """The mean (4, size²) of radiance and coverage over SEEDS images, and its standard error."""
    with mitsuba_scene(mesh, size, paths, VARIANT) as (module, scene):
        images = np.stack([np.array(module.render(scene, seed=seed)) for seed in range(SEEDS)])
    return mean_and_noise(torch.from_numpy(images).double().permute(0, 3, 1, 2).flatten(2))


def mitsuba_gradient(mesh: Mesh, size: int, paths: str, upstream: Tensor) -> tuple[Tensor, Tensor]:
    """The mean (49, 3) over SEEDS of the gradient by the light of Σ image × upstream (3, size²), and its noise.

    Mitsuba differentiates its integrator in reverse mode by the map's texels, which are linear in the light.
    """
    import drjit

    (coefficients, texels), found = st_peters(), []
    weights = torch.zeros(size**2, 4)
    weights[:, :3] = upstream.T
    with mitsuba_scene(mesh, size, paths, DIFFERENTIABLE) as (module, scene):
        parameters = module.traverse(scene)
        [name] = [name for name, _ in parameters if name.endswith(".data")]
        for seed in range(SEEDS):
            data = drjit.detach(module.TensorXf(parameters[name]))
            drjit.enable_grad(data)
            parameters[name] = data
            parameters.update()
            above = module.TensorXf(weights.view(size, size, 4).numpy())
            drjit.backward(drjit.sum(module.render(scene, parameters, seed=seed) * above, axis=None))
            by_texel = torch.from_numpy(np.array(drjit.grad(data)))[:, 1:-1]  # Mitsuba repeats a column on either side
            found += torch.autograd.grad(texels, coefficients, by_texel.to(texels), retain_graph=True)
    return mean_and_noise(torch.stack(found))


def mean_and_noise(draws: Tensor) -> tuple[Tensor, Tensor]:
    """The mean of (SEEDS, ...) draws and its standard error."""
    return draws.mean(0), draws.std(0) / SEEDS**0.5


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path, default=Path("lights.csv"))
    parser.add_argument("--mitsuba", action="store_true", help="compare with Mitsuba 3, too")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 224], help="of images, in pixels")
    parser.add_argument("--vertices", type=int, default=4000, help="of the cup, at least")
    parser.add_argument("--rounds", type=int, default=21, help="in which all settings take turns")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print(machine())
    cup, sizes = subdivide(normalize(solid("cup", 0)), options.vertices), options.sizes
    tables = [cost(cup, sizes, options.rounds), local_lights(cup, sizes, options.rounds)]
    tables += [beside_mitsuba(sizes[0])] if options.mitsuba else []
    rows = []
    for row in chain.from_iterable(tables):
        print(row, flush=True)
        rows.append(row)
        write_csv(options.csv, rows)


if __name__ == "__main__":
    main()
