"""Time that the renderer saves, because it skips what a scene does not need."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor

from benchmarks.common import Row, medians
from benchmarks.scene import CAMERA, View, coefficients
from benchmarks.steps import LightStep
from renderer import rendering
from renderer.light.basis import COEFFICIENTS, DEGREE
from renderer.mesh import Mesh
from renderer.surface.gloss import Gloss

Call = Callable[[], object]
# Number of views of `many_view_savings`.
VIEWS = 16


@dataclass(frozen=True)
class Saving:
    """A pair of calls with the same result, or of a scene with and without a part.

    Attributes:
        name: What the second call skips.
        complete: Call that does the whole work.
        needed: Call that skips a part of the work.
    """

    name: str
    complete: Call
    needed: Call


def measure_savings(view: View, rounds: int) -> list[Row]:
    """Time both calls of each saving in turns.

    Args:
        view: View to render.
        rounds: Number of rounds.

    Returns:
        Rows with the milliseconds of the call that skips a part, and in "saved"
        how many times as long the complete call takes.
    """
    rows = []
    for saving in savings(view):
        calls = {"complete": saving.complete, "needed": saving.needed}
        times = medians(calls, rounds, view.device)
        rows.append(
            {
                "panel": f"skipped, {view.size}²",
                "setting": saving.name,
                "time_ms": times["needed"],
                "saved": times["complete"] / times["needed"],
            }
        )
    return rows


def savings(view: View) -> Iterator[Saving]:
    """Yield what the renderer skips when it renders a view.

    Args:
        view: View to render.
    """
    yield from product_savings(view)
    yield from light_step_savings(view)
    yield from vertex_step_savings(view)
    yield from many_view_savings(view)


class Products:
    """Radiance and gradient of a transfer matrix with random numbers.

    Args:
        coefficient_count: Number of coefficients of the light.
        pixel_count: Number of pixels.
        device: Device of the matrix.
    """

    def __init__(self, coefficient_count: int, pixel_count: int, device: str):
        self.transfer = torch.rand(coefficient_count, pixel_count, device=device)
        self.light = torch.rand(3, coefficient_count, device=device)
        self.image_gradient = torch.rand(3, pixel_count, device=device)

    def __call__(self) -> tuple[Tensor, Tensor]:
        """Return the radiance (3, pixels) and the gradient by the light (3, coefficients)."""
        radiance = self.light @ self.transfer
        gradient = self.image_gradient @ self.transfer.T
        return radiance, gradient


def product_savings(view: View) -> Iterator[Saving]:
    """Yield the coefficients and the pixels that an operator leaves out."""
    _, nonzero, covered = view.operator().transfer.shape
    pixels = view.size**2
    needed = Products(nonzero, covered, view.device)
    yield Saving(
        name=f"{COEFFICIENTS - nonzero} of {COEFFICIENTS} coefficients reach no surface",
        complete=Products(COEFFICIENTS, covered, view.device),
        needed=needed,
    )
    yield Saving(
        name=f"{pixels - covered:,} of {pixels:,} pixels show background",
        complete=Products(nonzero, pixels, view.device),
        needed=needed,
    )


def light_step_savings(view: View) -> Iterator[Saving]:
    """Yield what rasterization and steps by the light leave out."""
    points = CAMERA.project(view.mesh.vertices)[None]
    rasterize = partial(view.rasterizer.rasterize, points, view.mesh.faces, view.size)
    yield Saving(
        name=f"back faces of a closed mesh are not drawn, {view.rasterizer.name}",
        complete=rasterize,
        needed=partial(rasterize, closed=True),
    )
    light = coefficients(DEGREE, torch.float32, view.device)
    step = LightStep(view, view.operator(), light)
    yield Saving(
        name="a step by the light does not rasterize",
        complete=lambda: (view.operator(), step()),
        needed=step,
    )
    glossy_view = replace(view, mesh=Gloss(0.4).on(view.mesh))
    glossy_operator = glossy_view.operator()
    glossy_step = LightStep(view, glossy_operator, light)
    yield Saving(name="a step by the light without gloss", complete=glossy_step, needed=step)
    # A transfer matrix of random numbers has no zeros to skip.
    dense_transfer = torch.rand_like(glossy_operator.transfer)
    dense_operator = replace(glossy_operator, transfer=dense_transfer)
    yield Saving(
        name="as many coefficients and channels without gloss",
        complete=glossy_step,
        needed=LightStep(view, dense_operator, light),
    )
    yield Saving(
        name="building an operator without gloss",
        complete=glossy_view.operator,
        needed=view.operator,
    )


class RenderGradient:
    """Render a mesh with `renderer.render`, and differentiate the sum of the image.

    Args:
        view: View with the camera's image size, the rasterizer and the device.
        mesh: Mesh to render.
        variables: Tensors by which the image is differentiated.
        **options: Further arguments of `renderer.render`.
    """

    def __init__(self, view: View, mesh: Mesh, variables: list[Tensor], **options: Any):
        self.variables = variables
        self.render = partial(
            rendering.render,
            mesh,
            CAMERA,
            coefficients(DEGREE, torch.float32, view.device),
            view.size,
            rasterizer=view.rasterizer.name,
            **options,
        )

    @classmethod
    def by_vertices(cls, view: View, mesh: Mesh, **options: Any) -> "RenderGradient":
        """Differentiate the image by the vertices of the view.

        Args:
            view: View to render.
            mesh: Mesh of the view.
            options: Further arguments of `renderer.render`.
        """
        vertices = view.vertices().requires_grad_()
        return cls(view, mesh, [vertices], vertices=vertices, **options)

    @classmethod
    def by_gloss(cls, view: View) -> "RenderGradient":
        """Differentiate the image by the roughness, the metallic and the specular factor."""
        material = [
            torch.tensor(value, device=view.device, requires_grad=True) for value in (0.4, 0.0, 1.0)
        ]
        return cls(view, view.mesh, material, gloss=Gloss(*material))

    def __call__(self) -> tuple[Tensor, ...]:
        """Return the gradient by each variable."""
        return torch.autograd.grad(self.render().sum(), self.variables)


def vertex_step_savings(view: View) -> Iterator[Saving]:
    """Yield what steps by the vertices leave out."""
    step = RenderGradient.by_vertices(view, view.mesh)
    yield Saving(
        name="a step by the vertices without gloss",
        complete=RenderGradient.by_vertices(view, Gloss(0.4).on(view.mesh)),
        needed=step,
    )
    yield Saving(
        name="a step by the vertices, not by the material",
        complete=RenderGradient.by_gloss(view),
        needed=step,
    )
    for normals, samples in product(("flat", "smooth"), (8, 2)):
        step_with = partial(
            RenderGradient.by_vertices, view, view.mesh, normals=normals, samples=samples
        )
        yield Saving(
            name=f"a step by the vertices with fixed outlines, {normals}, {samples}² samples",
            complete=step_with(silhouettes=True),
            needed=step_with(silhouettes=False),
        )


def many_view_savings(view: View) -> Iterator[Saving]:
    """Yield what images of many views share in one call."""
    cameras = [replace(CAMERA, azimuth=20.0 * index) for index in range(VIEWS)]
    light = coefficients(DEGREE, torch.float32, view.device)
    of_mesh = partial(rendering.render, view.mesh, light=light, size=view.size)
    yield Saving(
        name=f"{VIEWS} views in one call of render",
        complete=lambda: [of_mesh(camera) for camera in cameras],
        needed=partial(of_mesh, cameras),
    )
    operators = partial(rendering.precompute_transfer, view.mesh, size=view.size)
    yield Saving(
        name=f"operators of {VIEWS} views in one call",
        complete=lambda: [operators(camera) for camera in cameras],
        needed=partial(operators, cameras),
    )
