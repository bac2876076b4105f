"""Time and memory of operators with shadows and bounces, beside those of direct light."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from renderer.camera import OrthographicCamera, ring
from renderer.errors import require_range
from renderer.image import ImageSettings
from renderer.lights import load_light
from renderer.mesh import Mesh
from renderer.subdivision import MOST_VERTICES
from renderer.transfer import Operator, build_operators
from renderer.transport import rays
from renderer.visibility import choose
from train.report.tables import markdown
from train.studies.renderer_speed import measure
from train.studies.renderer_speed.measure import MOST_ROUNDS, Clock

TRANSPORTS = ("direct", "shadows", "bounces:3")
VIEWS, FIELD_OF_VIEW = 20, 2.2
RESOLUTION = 256  # of a depth map
EACH = 8  # of them is timed


@dataclass
class CupSettings:
    """conf/benchmark_transport.yaml and conf/benchmark_lights.yaml. out: the page. vertices: the cup has more. rounds:
    of the clock."""

    out: str
    vertices: int
    rounds: int

    def __post_init__(self) -> None:
        require_range("vertices", self.vertices, 0, MOST_VERTICES)
        require_range("rounds", self.rounds, 1, MOST_ROUNDS)


def painted(mesh: Mesh, color: Sequence[float]) -> Mesh:
    """Of one colour, which needs one channel where several need three, unless coloured light bounces."""
    colors = np.ones_like(mesh.corner_colors) * np.array(color, dtype=np.float32)
    return replace(mesh, corner_colors=colors, texture_ids=np.full(len(mesh.faces), -1))


def operators(mesh: Mesh, transport: str, size: int, views: int = VIEWS) -> list[Operator]:
    settings = ImageSettings(size, transport=transport)
    return build_operators(mesh, ring(views, FIELD_OF_VIEW), settings, choose("software"))


def seconds(call: Callable[[], object]) -> float:
    """The process's own, the lesser of two calls."""
    return min(measure.seconds(call) for _ in range(2))


def light_step(operator: Operator, light: Tensor) -> None:
    """An image, clamped, and the gradient of a loss by the light, which requires it."""
    torch.autograd.grad(operator.image(light).square().sum(), light)


def costs(meshes: dict[str, Mesh], sizes: Sequence[int], clock: Clock) -> str:
    """A row per mesh and transport; all transports of a mesh take turns on the clock."""
    rows, light = [], load_light("grace").requires_grad_()
    for name, mesh in meshes.items():
        builds = {each: seconds(partial(operators, mesh, each, sizes[0])) for each in TRANSPORTS}
        steps = {}
        for size in sizes:
            calls = {each: partial(light_step, operators(mesh, each, size, 1)[0], light) for each in TRANSPORTS}
            steps[size] = clock.medians(calls)
        for each in TRANSPORTS:
            views = operators(mesh, each, sizes[0])
            channels, kept = views[0].transfer.shape[:2]
            megabytes = sum(view.transfer.numel() * view.transfer.element_size() for view in views) / 1e6
            of_direct = [f"{by[each]:.3g} ms, {by[each] / by['direct']:.2f} ×" for by in steps.values()]
            rows.append([name, each, f"{builds[each]:.2f}", f"{channels} × {kept}", f"{megabytes:.1f}", *of_direct])
    head = ["mesh", "transport", f"s for {VIEWS} views", "channels × coefficients", "MB"]
    return markdown([*head, *(f"light step, {size}²" for size in sizes)], rows)


def depth_maps(mesh: Mesh) -> float:
    """Seconds to rasterise the mesh from as many directions as rays are cast in."""
    some = rays.sphere(rays.DIRECTIONS)[::EACH]
    z, azimuth = some[:, 2], torch.atan2(some[:, 1], some[:, 0])
    cameras = [
        OrthographicCamera(*angles, 2 * 3**0.5) for angles in zip(z.acos().tolist(), azimuth.tolist(), strict=True)
    ]
    points, backend = np.stack([camera.project(mesh.vertices) for camera in cameras]), choose("software")
    return EACH * seconds(lambda: backend.rasterise(points, mesh.faces, RESOLUTION, closed=mesh.closed))
