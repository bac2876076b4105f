"""Cost and accuracy of shadows and bounces, and of lamps and projectors, beside environment light.

    python -m benchmarks.lights --mitsuba

writes lights.jsonl, a line per measurement, in some minutes on one CPU thread. It needs the extra `shadows`, and for
--mitsuba the extra `lab` and LLVM (apt install libllvm19). Its tables:

cost          building operators and a light step (image, clamp, gradient), by light paths, mesh and size
rays          time and error of an operator with shadows or bounces, by its rays and samples per pixel
local lights  the same for lamps and projectors; "dense" stores zeros, too; errors are against 64² samples in float64
lamp step     a step by the positions of three lamps, which casts its rays in every step
stale         error of the image and of its gradient by the vertices when shadows stay as the mesh moves away
mitsuba       difference to a path tracer; "noise" is its standard error, "direct" our error without light paths

Errors are root mean squares of the difference over the reference's.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from augment.reshading import FrozenTransport
from benchmarks.common import append_json, machine, medians, relative_error, seconds
from renderer import shading
from renderer.albedo import surface_albedo
from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.fragments import build_fragments
from renderer.image import ImageSettings
from renderer.io.mitsuba import DIFFERENTIABLE, SCENE, VARIANT, mitsuba, mitsuba_map, write_mitsuba_scene
from renderer.light.basis import HARMONICS, Basis, SumBasis
from renderer.light.environment import write_map
from renderer.light.local import Lamps, Projector
from renderer.light.presets import load_light
from renderer.mesh import Mesh, concatenate, normalize
from renderer.rasterizer import choose
from renderer.shapes import solid
from renderer.subdivision import subdivide
from renderer.transfer import TransferOperator, build_operators
from renderer.transport import local as sparse
from renderer.transport import radiosity, rays
from renderer.transport.local import local_radiance, unoccluded
from renderer.transport.surface import Surface

CAMERA = OrthographicCamera(0.9, 0.6, 2.2)
LIGHT_PATHS = {"direct": {}, "shadows": {"shadows": True}, "bounces:3": {"bounces": 3}}
VIEWS, SEEDS = 20, 8  # SEEDS: Mitsuba's images, whose spread tells its noise
CONVERGED, FINEST = (2**14, 2**13, 2**8), 16  # rays per pixel, patches and their rays; samples per side of a pixel
RAYS, SAMPLES, REFERENCE = (64, 128, 256, 512, 1024, 2048), (2, 4, 8, 16), 64
LAMPS = Lamps(((2.0, 2.0, 2.0), (-2.0, 2.0, 2.0), (2.0, -2.0, 2.0)))
BASES: dict[str, Basis] = {
    "harmonics": HARMONICS,
    "3 lamps": LAMPS,
    "3 discs": replace(LAMPS, radius=0.5),
    "projector of 16²": Projector(16),
    "projector of 32²": Projector(32),
    "harmonics and projector of 16²": SumBasis((HARMONICS, Projector(16))),
}
STEP, STEPS_AWAY = 0.0005, (0, 1, 2, 5, 10, 20)  # of an attack on a shape, which moves every coordinate

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
    directions: int, patches: int = radiosity.PATCHES, of_patch: int = radiosity.DIRECTIONS
) -> Iterator[None]:
    """Other numbers of rays per pixel, of patches that light bounces between, and of rays per patch."""
    before = rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS
    try:
        rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS = directions, patches, of_patch
        yield
    finally:
        rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS = before


@contextmanager
def dense() -> Iterator[None]:
    """Operators store their zeros."""
    before, sparse.SPARSE = sparse.SPARSE, 0.0
    try:
        yield
    finally:
        sparse.SPARSE = before


# ---------------------------------------------------------------------------- tables


def cost(cup: Mesh, sizes: Sequence[int], rounds: int) -> Iterator[Row]:
    """A mesh of one color needs one channel where several need three, unless colored light bounces."""
    light = load_light("grace").requires_grad_()
    colors = {"several colors": None, "one gray": (0.5, 0.5, 0.5), "one color": (0.9, 0.5, 0.2)}
    for name, color in colors.items():
        mesh = cup
        if color:
            corner_colors = np.ones_like(cup.corner_colors) * np.array(color, np.float32)
            mesh = replace(cup, corner_colors=corner_colors, texture_ids=np.full(len(cup.faces), -1))
        built = {(paths, size): operator(mesh, size, paths) for paths in LIGHT_PATHS for size in sizes}
        times = medians({key: partial(light_step, each, light) for key, each in built.items()}, rounds)
        for paths, size in built:
            settings = ImageSettings(size, **LIGHT_PATHS[paths])
            build = partial(build_operators, mesh, orbit_cameras(VIEWS, 2.2), settings, choose("numpy"))
            channels, coefficients = built[paths, size].transfer.shape[:2]
            yield {
                "table": "cost", "mesh": name, "light_paths": paths, "size": size, "step_ms": times[paths, size],
                "of_direct": times[paths, size] / times["direct", size], "channels": channels,
                "coefficients": coefficients, "megabytes": megabytes(built[paths, size]),
                "build_s": min(seconds(build) for _ in range(2)) / VIEWS,
            }  # fmt: skip


def rays_and_samples(cup: Mesh, size: int, rounds: int) -> Iterator[Row]:
    light = load_light("grace")
    for paths in [*LIGHT_PATHS][1:]:
        with quadrature(*CONVERGED):
            exact = image_and_gradient(operator(cup, size, paths, FINEST), light)
        rows, calls = {}, {}
        for count, samples in product(RAYS, SAMPLES):

            def build(count: int = count, samples: int = samples, paths: str = paths) -> TransferOperator:
                with quadrature(count):
                    return operator(cup, size, paths, samples)

            calls[count, samples] = build
            rows[count, samples] = errors(image_and_gradient(build(), light), exact)
        for key, milliseconds in medians(calls, max(1, rounds // 5)).items():
            setting = {"table": "rays", "light_paths": paths, "size": size, "rays": key[0], "samples": key[1] ** 2}
            yield setting | {"build_ms": milliseconds} | rows[key]


def local_lights(cup: Mesh, sizes: Sequence[int], rounds: int) -> Iterator[Row]:
    built = {
        (name, size, False): operator(cup, size, samples=2, basis=each)
        for name, each in BASES.items()
        for size in sizes
    }
    with dense():
        for name, basis in BASES.items():
            if built[name, sizes[-1], False].sparse is not None:
                built |= {(name, size, True): operator(cup, size, samples=2, basis=basis) for size in sizes}
    lights = {key: torch.rand(each.basis.size, 3).requires_grad_() for key, each in built.items()}
    times = medians({key: partial(light_step, each, lights[key]) for key, each in built.items()}, rounds)
    for (name, size, is_dense), each in built.items():
        row: Row = {
            "table": "local lights",
            "light": name,
            "dense": is_dense,
            "size": size,
            "functions": each.basis.size,
        }
        row |= {"step_ms": times[name, size, is_dense], "megabytes": megabytes(each)}
        if not is_dense:
            row["build_s"] = seconds(partial(operator, cup, size, samples=2, basis=each.basis))
        if size == sizes[0] and not is_dense:
            generator = torch.Generator().manual_seed(0)
            light = torch.rand(each.basis.size, 3, generator=generator, dtype=torch.float64)
            fine = operator(cup, size, samples=REFERENCE, basis=each.basis, dtype=torch.float64)
            exact = image_and_gradient(fine, light)
            for samples in (2, 8):
                coarse = operator(cup, size, samples=samples, basis=each.basis)
                found = errors(image_and_gradient(coarse, light.float()), exact)
                row |= {f"{key}_{samples}x{samples}": value for key, value in found.items()}
        yield row


def lamp_steps(cup: Mesh, sizes: Sequence[int], rounds: int) -> Iterator[Row]:
    positions, powers, caster = (
        torch.tensor(LAMPS.positions).requires_grad_(),
        torch.ones(3, 3).double(),
        rays.Rays(cup),
    )

    def step(surface: Surface, albedo: Tensor) -> None:
        connections = unoccluded(caster, surface, LAMPS.connect(surface.points, surface.normals, positions.double()))
        radiance = local_radiance(surface.fragments, albedo, connections, powers)
        torch.autograd.grad(radiance.square().sum(), positions)

    calls = {}
    for size in sizes:
        settings = ImageSettings(size, 2)
        [view] = build_fragments(cup.vertices, cup.faces, [CAMERA], settings, choose("numpy"))
        calls[size] = partial(step, Surface.of(cup, view, settings), surface_albedo(cup, view, settings.encoding))
    for size, milliseconds in medians(calls, rounds).items():
        yield {"table": "lamp step", "size": size, "step_ms": milliseconds}


def stale_shadows(size: int) -> Iterator[Row]:
    """The vertices move by signed steps in one random direction, from the shape whose shadows are used."""
    cup, light, settings = normalize(solid("cup", 0)), load_light("grace"), ImageSettings(size, 2, shadows=True)
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(cup.vertices.shape, generator=generator).sign().double().numpy()
    weights = torch.randn(3, size**2, generator=generator)

    def render(shadows: FrozenTransport, vertices: np.ndarray) -> tuple[Tensor, Tensor]:
        variable = torch.from_numpy(vertices).float().requires_grad_()
        [fragments] = build_fragments(vertices, cup.faces, [CAMERA], settings, choose("numpy"))
        albedo = surface_albedo(cup, fragments, settings.encoding)
        if not shadows.knows(CAMERA):
            shadows.add(CAMERA, fragments, albedo)
        radiance = shading.radiance(fragments, variable, light, albedo) + shadows.radiance(
            CAMERA, fragments, albedo, light
        )
        loss = (radiance.square() * weights[:, fragments.pixels]).sum()  # not linear, as a classifier is not
        [gradient] = torch.autograd.grad(loss, variable)
        return radiance.new_zeros(3, size**2).index_copy(1, fragments.pixels, radiance.detach()), gradient

    first = FrozenTransport(cup, settings, 1.0, HARMONICS)
    render(first, cup.vertices)
    for steps in STEPS_AWAY:
        vertices = cup.vertices + steps * STEP * direction
        anew = FrozenTransport(replace(cup, vertices=vertices), settings, 1.0, HARMONICS)
        found = errors(render(first, vertices), render(anew, vertices))
        yield {"table": "stale", "size": size, "steps": steps, "distance": steps * STEP} | found


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


def beside_mitsuba(size: int, meshes: Sequence[str] | None = None) -> Iterator[Row]:
    for (name, mesh), paths in product(hard_meshes().items(), [*LIGHT_PATHS][1:]):
        if meshes is None or name in meshes:
            yield {"table": "mitsuba", "mesh": name, "light_paths": paths, "size": size} | differences(
                mesh, size, paths
            )


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
    """Measure, and write a line of JSON for each measurement, in place of the file before."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/lights.jsonl"))
    parser.add_argument("--mitsuba", action="store_true", help="compare with Mitsuba 3, too")
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 224], help="of images, in pixels")
    parser.add_argument("--vertices", type=int, default=4000, help="of the cup, at least")
    parser.add_argument("--rounds", type=int, default=21, help="in which all settings take turns")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print(machine())
    cup, sizes, rounds = subdivide(normalize(solid("cup", 0)), options.vertices), options.sizes, options.rounds
    tables = [
        cost(cup, sizes, rounds),
        local_lights(cup, sizes, rounds),
        lamp_steps(cup, sizes, rounds),
        stale_shadows(sizes[0]),
        rays_and_samples(cup, sizes[0], rounds),
        *([beside_mitsuba(sizes[0])] if options.mitsuba else []),
    ]
    options.out.unlink(missing_ok=True)
    for table in tables:
        for row in table:
            row = {name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in row.items()}
            append_json(options.out, row)
            print(json.dumps(row, ensure_ascii=False), flush=True)


if __name__ == "__main__":
    main()
