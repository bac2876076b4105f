"""docs/performance.md: what lights in a scene cost, beside light from afar, and how right they are."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from renderer import sparse
from renderer.albedo import surface_albedo
from renderer.basis import HARMONICS, Basis, Sum
from renderer.camera import OrthographicCamera
from renderer.fragments import build_fragments
from renderer.image import ImageSettings
from renderer.lamps import RAYS, Lamps
from renderer.mesh import Mesh, normalise
from renderer.projector import Projector
from renderer.shapes import solid
from renderer.subdivision import subdivide
from renderer.transfer import Operator, build_operators
from renderer.transport.placed import lit, placed_radiance
from renderer.transport.rays import Rays
from renderer.transport.surface import Surface
from renderer.visibility import choose
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.report.tables import markdown
from train.studies.page import filled, machine, wrapped, write_section
from train.studies.renderer_speed.measure import Clock, relative_error
from train.studies.transport.cost import CupSettings, light_step, seconds

CAMERA = OrthographicCamera(0.9, 0.4, 2.2)
SIZES, SAMPLES, REFERENCE = (32, 224), (2, 8), 64  # pixels per side, and samples
LAMPS = Lamps(((2.0, 2.0, 2.0), (-2.0, 2.0, 2.0), (2.0, -2.0, 2.0)))
DISCS = replace(LAMPS, radius=0.5)
BASES: dict[str, Basis] = {
    "harmonics": HARMONICS,
    "3 lamps": LAMPS,
    "3 discs": DISCS,
    "projector of 16²": Projector(16),
    "projector of 32²": Projector(32),
    "harmonics and projector of 16²": Sum((HARMONICS, Projector(16))),
}


def run(settings: CupSettings) -> None:
    """Measure on one thread, and write the section."""
    out = writable_file(settings.out, "out")
    torch.set_num_threads(1)
    cup, clock = subdivide(normalise(solid("cup", 0)), settings.vertices), Clock(torch.device("cpu"), settings.rounds)
    text = filled(
        __file__,
        command=command_line(),
        machine=machine(clock.device),
        faces=len(cup.faces),
        vertices=len(cup.vertices),
        small_operator=sparse.SMALL,
        fewer=round(1 / sparse.SPARSE),
        rays=RAYS,
        radius=DISCS.radius,
        steps=_steps(cup, clock),
        small=SIZES[0],
        reference=REFERENCE,
        errors=_errors(cup),
        samples=SAMPLES[0],
        moved=_moved(cup, clock),
    )
    write_section(out, wrapped(text))


def operator(mesh: Mesh, basis: Basis, size: int, samples: int = SAMPLES[0], **kind: Any) -> Operator:
    return build_operators(mesh, [CAMERA], ImageSettings(size, samples), choose("software"), basis=basis, **kind)[0]


@contextmanager
def all_entries() -> Iterator[None]:
    """No operator is sparse."""
    chosen = sparse.SPARSE
    sparse.SPARSE = 0.0
    try:
        yield
    finally:
        sparse.SPARSE = chosen


def megabytes(built: Operator) -> float:
    few = built.sparse or ()
    return sum(each.nbytes for each in (built.transfer, *few)) / 1e6


def _steps(mesh: Mesh, clock: Clock) -> str:
    """A row per basis, and where it is sparse, one with all of its entries."""
    built = {(name, size): operator(mesh, basis, size) for name, basis in BASES.items() for size in SIZES}
    with all_entries():
        for name, basis in BASES.items():
            if built[name, SIZES[1]].sparse is not None:
                built |= {(f"{name}, all entries", size): operator(mesh, basis, size) for size in SIZES}
    lights = {key: torch.rand(each.basis.size, 3).requires_grad_() for key, each in built.items()}
    times = clock.medians({key: partial(light_step, each, lights[key]) for key, each in built.items()})
    first = next(iter(BASES))
    rows = []
    for name in dict.fromkeys(name for name, _ in built):
        each = built[name, SIZES[1]]
        build = f"{seconds(partial(operator, mesh, each.basis, SIZES[1])):.2f}" if name in BASES else ""
        cells = [f"{times[name, size]:.3g} ms, {times[name, size] / times[first, size]:.2f} ×" for size in SIZES]
        rows.append([name, str(each.basis.size), build, f"{megabytes(each):.3g}", *cells])
    head = ["light", "functions", f"s to build, {SIZES[1]}²", f"MB, {SIZES[1]}²"]
    return markdown([*head, *(f"light step, {size}²" for size in SIZES)], rows)


def _errors(mesh: Mesh) -> str:
    rows, size = [], SIZES[0]
    for name, basis in BASES.items():
        draws = torch.Generator().manual_seed(0)
        light = torch.rand(basis.size, 3, generator=draws, dtype=torch.float64)
        weights = torch.randn(3, size**2, generator=draws, dtype=torch.float64)
        exact = _image_and_gradient(operator(mesh, basis, size, REFERENCE, dtype=torch.float64), light, weights)
        errors = []
        for samples in SAMPLES:
            seen = _image_and_gradient(operator(mesh, basis, size, samples), light.float(), weights.float())
            errors += [f"{relative_error(ours, true):.2%}" for ours, true in zip(seen, exact, strict=True)]
        rows.append([name, *errors])
    return markdown(["light", *(f"{what}, {n}²" for n in SAMPLES for what in ("radiance", "gradient"))], rows)


def _image_and_gradient(built: Operator, light: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    canvas = light.new_zeros(3, built.settings.size**2).index_copy(1, built.pixels, built.radiance(light))
    return canvas, built.light_gradient(weights[:, built.pixels])


def _moved(mesh: Mesh, clock: Clock) -> str:
    """Milliseconds of a step by the places of lamps, in words."""
    places = torch.tensor(LAMPS.places).requires_grad_()
    powers, rays, calls = torch.ones(len(places), 3), Rays(mesh), {}
    for size in SIZES:
        settings = ImageSettings(size, SAMPLES[0])
        (view,) = build_fragments(mesh.vertices, mesh.faces, [CAMERA], settings, choose("software"))
        surface, albedo = Surface.of(mesh, view, settings), surface_albedo(mesh, view, settings.encoding)
        calls[size] = partial(_step_by_places, rays, surface, albedo, places, powers)
    return " and ".join(f"{taken:.3g} ms at {size}²" for size, taken in clock.medians(calls).items())


def _step_by_places(rays: Rays, surface: Surface, albedo: Tensor, places: Tensor, powers: Tensor) -> None:
    reach = lit(rays, surface, LAMPS.reach(surface.points, surface.normals, places.double()))
    seen = placed_radiance(surface.fragments, albedo, reach, powers.double())
    torch.autograd.grad(seen.square().sum(), places)
