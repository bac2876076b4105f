"""Scene of the renderer's benchmark: an ellipsoid under a light probe and a sun.

`Converged` has the image and the gradients that all methods converge to.
`MitsubaStep` renders the scene with Mitsuba.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from benchmarks import reference
from benchmarks.common import Row, relative_error
from renderer.camera import OrthographicCamera
from renderer.io.mitsuba_entries import environment, integrator, sensor_of
from renderer.light.basis import DEGREE, Harmonics
from renderer.light.files import probe
from renderer.light.harmonics import basis
from renderer.mesh import Mesh
from renderer.mitsuba_scene import load, mitsuba, mitsuba_map, shape
from renderer.operators.apply import TransferOperator
from renderer.operators.build import build_operators
from renderer.settings import ImageSettings
from renderer.surface.albedo import surface_albedo
from renderer.visibility import Rasterizer
from renderer.visibility.fragments import Fragments, build_fragments

# Samples per side of a pixel in training with the paper's settings.
SAMPLES = 8
ALBEDO = (0.8, 0.5, 0.3)
CAMERA = OrthographicCamera(math.degrees(1.0), math.degrees(0.5), 2.4)
# Gray value of the background.
BACKGROUND = 0.5

# Unit vector toward the sun.
TO_SUN = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
# Irradiance of the sun on a surface that faces it. No pixel is clamped.
SUN = torch.tensor([0.45, 0.4, 0.3], dtype=torch.float64)
# Coefficients of the probe, up to degree 2.
PROBE = probe("grace")[:9].double() / 4

# `Converged` rasterizes SHIFTS² times, each time shifted by a fraction of a
# sample. It takes at most CONVERGED_SAMPLES samples per side of a pixel and
# CONVERGED_RESOLUTION per side of an image.
SHIFTS = 4
CONVERGED_SAMPLES = 16
CONVERGED_RESOLUTION = 2048
# Degree up to which `Converged` has the gradient by the light.
CONVERGED_DEGREE = 20

# Rays per side of a pixel that Mitsuba traces.
MITSUBA_SAMPLES = 4
# Rows of the environment map that Mitsuba gets. With so few rows, the
# harmonics of degree 2 are 0.5% too dark.
MITSUBA_ROWS = 32


@dataclass(frozen=True)
class Result:
    """Radiance of a render, and the gradient of a loss.

    Attributes:
        pixels: Row-major indices of the covered pixels, shape (P,).
        radiance: Radiance of the covered pixels before clamping, shape (3, P).
        gradient: Gradient of the loss by the light, shape (K, 3), or by the
            vertices, shape (V, 3).
    """

    pixels: Tensor
    radiance: Tensor
    gradient: Tensor

    def image(self, pixel_count: int) -> Tensor:
        """Return the radiance of all pixels before black, shape (3, pixel_count)."""
        black = self.radiance.new_zeros(3, pixel_count)
        return black.index_copy(1, self.pixels, self.radiance)

    def errors(self, exact: "Result") -> Row:
        """Compute the relative errors to a result for all pixels.

        The gradient of the exact result may have more rows, and none leaves out
        the error of the gradient.
        """
        count = exact.radiance.shape[1]
        errors = {"image_error": relative_error(self.image(count), exact.radiance)}
        if len(exact.gradient):
            same_rows = exact.gradient[: len(self.gradient)]
            errors["gradient_error"] = relative_error(self.gradient, same_rows)
        return errors


Step = Callable[[], Result]


@dataclass(frozen=True)
class Contender:
    """A method that renders the image and computes the gradient.

    Attributes:
        setting: Name of the method with its settings.
        samples: Samples per side of a pixel. None for photographs.
        degree: Degree of the light's harmonics. None for photographs.
        step: Step whose errors are measured.
        call: Call whose time is measured.
        exact: Reference of the errors. None for that of the panel.
    """

    setting: str
    samples: int | None
    degree: int | None
    step: Step
    call: Callable[[], object]
    exact: Result | None = None


def ellipsoid(subdivisions: int) -> Mesh:
    """Make a closed mesh with 10 · 4^subdivisions + 2 vertices and a single color."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh.plain(ball.vertices * (1.0, 0.9, 0.8), ball.faces, ALBEDO)


def coefficients(degree: int, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Tensor:
    """Return the SH coefficients of the probe and the sun up to a degree.

    Args:
        degree: Degree after which the light is cut off.
        dtype: Type of the coefficients.
        device: Device of the coefficients.

    Returns:
        Coefficients, shape ((degree + 1)², 3).
    """
    light = basis(TO_SUN, degree)[:, None] * SUN
    count = min(len(PROBE), len(light))
    light[:count] += PROBE[:count]
    return light.to(device, dtype)


def whole_irradiance(normals: Tensor) -> Tensor:
    """Compute the irradiance of the probe and of the whole sun, without a cutoff.

    The series of the sun converges to the clamped cosine, which stands for it.

    Args:
        normals: Unit normals, float64, shape (N, 3).

    Returns:
        Irradiance, shape (N, 3).
    """
    of_sun = (normals @ TO_SUN).clamp(min=0)[:, None] * SUN
    return reference.irradiance(normals, PROBE) + of_sun


def cut_irradiance(normals: Tensor) -> Tensor:
    """Compute the irradiance of the light that is cut off after the default degree.

    All renderers that are compared with each other get this light.

    Args:
        normals: Unit normals, float64, shape (N, 3).

    Returns:
        Irradiance, shape (N, 3).
    """
    return reference.irradiance(normals, coefficients(DEGREE))


@dataclass(frozen=True)
class VisibleSurface:
    """Samples of a mesh that a camera sees.

    Attributes:
        fragments: The S visible samples.
        albedo: Linear albedo of the samples, shape (S, 3).
        coverage: Covered fraction of each of the P covered pixels,
            shape (1, P).
    """

    fragments: Fragments
    albedo: Tensor
    coverage: Tensor


@dataclass(frozen=True)
class View:
    """A mesh that `CAMERA` sees.

    Attributes:
        mesh: Mesh of V vertices.
        size: Pixels per side of the image.
        rasterizer: Rasterizer of all renders.
        device: Device of all tensors.
    """

    mesh: Mesh
    size: int
    rasterizer: Rasterizer
    device: str = "cpu"

    def operator(
        self,
        samples: int = SAMPLES,
        degree: int = DEGREE,
        dtype: torch.dtype = torch.float32,
        shadows: bool = False,
    ) -> TransferOperator:
        """Build the transfer operator of the view.

        Args:
            samples: Samples per side of a pixel.
            degree: Degree of the light's harmonics.
            dtype: Type of the operator.
            shadows: Whether the mesh casts shadows on itself.

        Returns:
            Operator from the light to the image.
        """
        [operator] = build_operators(
            self.mesh,
            [CAMERA],
            ImageSettings(self.size, samples, shadows=shadows),
            self.rasterizer,
            basis=Harmonics(degree),
            dtype=dtype,
        )
        return operator.to(self.device)

    def visible_surface(self, samples: int, vertices: Tensor) -> VisibleSurface:
        """Rasterize the mesh with other vertices.

        Args:
            samples: Samples per side of a pixel.
            vertices: Vertices of the mesh, shape (V, 3).

        Returns:
            Samples of the visible surface, in the type of the vertices.
        """
        [fragments] = build_fragments(
            vertices.detach().double().cpu().numpy(),
            self.mesh.faces,
            [CAMERA],
            ImageSettings(self.size, samples),
            self.rasterizer,
            self.mesh.closed,
        )
        fragments = fragments.to(self.device)
        return VisibleSurface(
            fragments=fragments,
            albedo=surface_albedo(self.mesh, fragments, "linear").to(vertices.dtype),
            coverage=fragments.coverage.to(vertices.dtype)[None],
        )

    def vertices(self, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return the vertices of the mesh, shape (V, 3)."""
        return torch.from_numpy(self.mesh.vertices).to(self.device, dtype)

    @cached_property
    def image_gradient(self) -> Tensor:
        """Gradient of a loss by the image: normal random numbers, float64, shape (3, size²)."""
        generator = torch.Generator().manual_seed(0)
        numbers = torch.randn(3, self.size**2, dtype=torch.float64, generator=generator)
        return numbers.to(self.device)

    def image_gradient_at(self, pixels: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return the gradient of the loss by some pixels.

        Args:
            pixels: Row-major indices of pixels, shape (P,).
            dtype: Type of the result.

        Returns:
            Gradient, shape (3, P).
        """
        return self.image_gradient[:, pixels].to(dtype)


class Converged:
    """Image and gradients that all methods converge to.

    They are computed in float64 by plain autograd, with up to 64² samples per
    pixel. Visibility is fixed. The mesh is closed, so that every visible face
    shows its front.

    Args:
        view: View to render.
        irradiance: Function from unit normals (N, 3) to irradiance (N, 3).

    Attributes:
        image: Radiance of all pixels, shape (3, size²).
        by_light: Gradient of the loss of `View.image_gradient` by the light,
            shape ((CONVERGED_DEGREE + 1)², 3).
        by_vertices: Gradient of the same loss by the vertices, shape (V, 3).
    """

    def __init__(self, view: View, irradiance: Callable[[Tensor], Tensor] = whole_irradiance):
        fractions = CoveredFractions.measure(view)
        vertices = view.vertices(torch.float64).cpu().requires_grad_()
        visible_faces = torch.from_numpy(view.mesh.faces)[fractions.visible_faces]
        normals = reference.face_normals(vertices[visible_faces])
        image_gradient = view.image_gradient.cpu()

        image = fractions.draw(irradiance(normals))
        self.image = image.detach()
        [self.by_vertices] = torch.autograd.grad((image * image_gradient).sum(), vertices)

        # The image is linear in the light, so any light has the same gradient.
        light = torch.zeros((CONVERGED_DEGREE + 1) ** 2, 3, dtype=torch.float64)
        light.requires_grad_()
        image = fractions.draw(reference.irradiance(normals.detach(), light))
        [self.by_light] = torch.autograd.grad((image * image_gradient).sum(), light)

    def result(self, gradient: Tensor) -> Result:
        """Return the image with its gradient `by_light` or `by_vertices`."""
        return Result(torch.arange(self.image.shape[1]), self.image, gradient)


@dataclass(frozen=True)
class CoveredFractions:
    """Fractions of pixels that faces cover, for R pairs of a pixel and a face.

    Attributes:
        size: Pixels per side of the image.
        pixels: Row-major index of the pixel of each pair, shape (R,).
        visible_faces: Indices of the G visible faces in the mesh, shape (G,).
        pair_to_visible_face: Index of each pair's face among the visible faces,
            shape (R,).
        fractions: Fraction of the pixel that the face covers, float64,
            shape (R,).
    """

    size: int
    pixels: Tensor
    visible_faces: Tensor
    pair_to_visible_face: Tensor
    fractions: Tensor

    @classmethod
    def measure(cls, view: View) -> "CoveredFractions":
        """Count the samples of faces in pixels, over SHIFTS² shifted rasterizations."""
        size = view.size
        face_count = len(view.mesh.faces)
        samples = min(CONVERGED_SAMPLES, max(1, CONVERGED_RESOLUTION // size))
        pairs_of_samples = []
        for shift in product(range(SHIFTS), repeat=2):
            # Normalized coordinates span 2 over the samples of a side.
            fraction_of_sample = (np.array(shift) + 0.5) / SHIFTS - 0.5
            points = CAMERA.project(view.mesh.vertices)
            points[:, :2] += 2 * fraction_of_sample / (size * samples)
            [face_of_sample] = view.rasterizer.rasterize(
                points[None], view.mesh.faces, size * samples, closed=view.mesh.closed
            )
            row, column = np.nonzero(face_of_sample >= 0)
            pixel_of_sample = row // samples * size + column // samples
            pairs_of_samples.append(pixel_of_sample * face_count + face_of_sample[row, column])
        pairs, counts = np.unique(np.concatenate(pairs_of_samples), return_counts=True)
        faces = torch.from_numpy(pairs % face_count)
        visible_faces, pair_to_visible_face = faces.unique(return_inverse=True)
        return cls(
            size=size,
            pixels=torch.from_numpy(pairs // face_count),
            visible_faces=visible_faces,
            pair_to_visible_face=pair_to_visible_face,
            fractions=torch.from_numpy(counts / (SHIFTS * samples) ** 2),
        )

    def draw(self, irradiance: Tensor) -> Tensor:
        """Return the radiance of all pixels, shape (3, size²).

        Args:
            irradiance: Irradiance at the visible faces, shape (G, 3).
        """
        radiance_of_faces = irradiance * torch.tensor(ALBEDO, dtype=torch.float64)
        radiance_of_pairs = radiance_of_faces[self.pair_to_visible_face] * self.fractions[:, None]
        black = torch.zeros(self.size**2, 3, dtype=torch.float64)
        return black.index_add(0, self.pixels, radiance_of_pairs).T


class MitsubaStep:
    """Render and gradient by Mitsuba 3 on one thread, as its users would set them up.

    Each camera ray draws one direction in proportion to the cosine and looks up
    an environment map there. This is Mitsuba's cheapest way, and the least
    noisy one for a smooth light. Its automatic differentiation holds the
    outlines fixed. Moved vertices rebuild the tree of the ray tracer.

    Args:
        view: View to render.
        parameter: Parameter of the gradient: "light.data" for the coefficients
            of the light, shape (49, 3), or "mesh.vertex_positions" for the
            vertices, shape (V, 3), through the shading alone.

    Raises:
        InputError: If Mitsuba or the LLVM library is not installed.
    """

    def __init__(self, view: View, parameter: str):
        with mitsuba("llvm_ad_rgb") as module:
            import drjit
        drjit.set_thread_count(1)
        self.drjit = drjit
        self.module = module
        self.view = view
        self.parameter = parameter
        self.light = coefficients(DEGREE).requires_grad_()
        texels = mitsuba_map(self.light, MITSUBA_ROWS).float()
        # Mitsuba's own map repeats the first and the last column at its ends.
        self.texels = torch.cat([texels[:, -1:], texels, texels[:, :1]], dim=1)
        self.scene = load(module, self._entries(texels.detach()))
        self.parameters = module.traverse(self.scene)
        # Our surfaces reflect π times as much as those of Mitsuba.
        image_gradient = np.pi * view.image_gradient.T.cpu().float()
        image_gradient = image_gradient.unflatten(0, (view.size, view.size))
        self.image_gradient = module.TensorXf(image_gradient.numpy())
        if parameter == "light.data":
            self.start = module.TensorXf(self.texels.detach().numpy())
        else:
            self.start = module.Float(view.mesh.vertices.astype(np.float32).ravel())

    def _entries(self, texels: Tensor) -> dict[str, Any]:
        """Describe the scene with an environment map (rows, columns, 3) for Mitsuba."""
        surface = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(ALBEDO)}}
        mesh = self.view.mesh
        sensor = sensor_of(CAMERA, self.view.size)
        sensor["film"]["pixel_format"] = "rgb"
        return {
            "type": "scene",
            "integrator": integrator(bounces=0),
            "light": environment({"bitmap": texels.numpy()}),
            "sensor": sensor,
            "mesh": shape(self.module, surface, mesh.vertices, mesh.faces),
        }

    def __call__(self) -> Result:
        """Render the view, and compute the gradient by the parameter."""
        drjit = self.drjit
        value = drjit.detach(self.start)
        drjit.enable_grad(value)
        self.parameters[self.parameter] = value
        self.parameters.update()
        image = self.module.render(self.scene, self.parameters, spp=MITSUBA_SAMPLES**2)
        drjit.backward(drjit.sum(image * self.image_gradient, axis=None))
        # Reading the gradient waits until it is computed.
        gradient = torch.from_numpy(np.array(drjit.grad(value)))
        drjit.disable_grad(self.parameters[self.parameter])
        if self.parameter == "light.data":
            [gradient] = torch.autograd.grad(self.texels, self.light, gradient, retain_graph=True)
        radiance = np.pi * np.array(drjit.detach(image)).reshape(-1, 3).T
        return Result(
            pixels=torch.arange(self.view.size**2),
            radiance=torch.from_numpy(radiance),
            gradient=gradient.view(-1, 3),
        )
