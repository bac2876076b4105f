"""The scene of the renderer's benchmark: an ellipsoid under a probe and a sun.

`Converged` is the image and the gradients that all methods converge to; `mitsuba_step` renders the scene with Mitsuba.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import torch
import trimesh
from torch import Tensor

from benchmarks import reference
from benchmarks.common import Row, relative_error
from renderer.camera import OrthographicCamera
from renderer.geometry.mesh import Mesh
from renderer.io.mitsuba import DIFFERENTIABLE, load, mitsuba, mitsuba_map, shape
from renderer.io.mitsuba_entries import environment, integrator, sensor_of
from renderer.light.basis import DEGREE, Harmonics
from renderer.light.harmonics import basis
from renderer.light.presets import probe
from renderer.settings import ImageSettings
from renderer.surface.albedo import surface_albedo
from renderer.transport.operators import TransferOperator, build_operators
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import Rasterizer

SAMPLES = ImageSettings().samples  # the renderer's default, per side of a pixel
ALBEDO = (0.8, 0.5, 0.3)
CAMERA = OrthographicCamera(1.0, 0.5, 2.4)
SUN_FROM = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
SUN = torch.tensor([0.45, 0.4, 0.3], dtype=torch.float64)  # irradiance head on: no pixel is clamped
PROBE = probe("grace")[:9].double() / 4
SHIFTS, FINEST, RESOLUTION = 4, 16, 2048  # of `Converged`: rasterizations per side; samples of a pixel, of an image
MITSUBA_SAMPLES, MITSUBA_ROWS = 4, 32  # rays per side of a pixel; rows of the map, which dims band 2 by 0.5 %

Result = tuple[Tensor, Tensor, Tensor]  # covered pixels (P,), their radiance (3, P), and the gradient
Step = Callable[[], Result]


def ellipsoid(subdivisions: int) -> Mesh:
    """A closed mesh of 10·4^subdivisions + 2 vertices."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh.plain(ball.vertices * (1.0, 0.9, 0.8), ball.faces, ALBEDO)


def coefficients(degree: int, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Tensor:
    """The light's ((degree + 1)², 3), cut off after `degree`."""
    light = basis(SUN_FROM, degree)[:, None] * SUN
    count = min(len(PROBE), len(light))
    light[:count] += PROBE[:count]
    return light.to(device, dtype)


def whole_irradiance(normals: Tensor) -> Tensor:
    """(N, 3) at unit normals (N, 3) float64: the sun's series sums to the clamped cosine."""
    return reference.irradiance(normals, PROBE) + (normals @ SUN_FROM).clamp(min=0)[:, None] * SUN


def cut_irradiance(normals: Tensor) -> Tensor:
    """Of the light cut off after the default degree, as every renderer in a comparison is given it."""
    return reference.irradiance(normals, coefficients(DEGREE))


@dataclass(frozen=True)
class View:
    """One mesh from one camera at one size."""

    mesh: Mesh
    size: int
    rasterizer: Rasterizer
    device: str = "cpu"

    def operator(
        self, samples: int = SAMPLES, degree: int = DEGREE, dtype: torch.dtype = torch.float32
    ) -> TransferOperator:
        settings, light = ImageSettings(self.size, samples), Harmonics(degree)
        [operator] = build_operators(self.mesh, [CAMERA], settings, self.rasterizer, basis=light, dtype=dtype)
        return operator.to(self.device)

    def rasterized(self, samples: int, vertices: Tensor) -> tuple[Fragments, Tensor, Tensor]:
        """(fragments, albedo (S, 3), coverage (1, P)) of the mesh with its vertices there."""
        positions, settings = vertices.detach().double().cpu().numpy(), ImageSettings(self.size, samples)
        views = build_fragments(positions, self.mesh.faces, [CAMERA], settings, self.rasterizer, self.mesh.closed)
        fragments = views[0].to(self.device)
        albedo = surface_albedo(self.mesh, fragments, "linear").to(vertices.dtype)
        return fragments, albedo, fragments.coverage.to(vertices.dtype)[None]

    def vertices(self, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.from_numpy(self.mesh.vertices).to(self.device, dtype)

    @cached_property
    def image_gradient(self) -> Tensor:
        """(3, size²) float64 normal numbers: the gradient of a loss by the image."""
        generator = torch.Generator().manual_seed(0)
        return torch.randn(3, self.size**2, dtype=torch.float64, generator=generator).to(self.device)

    def upstream(self, pixels: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """(3, P) the image's gradient at the covered pixels."""
        return self.image_gradient[:, pixels].to(dtype)


class Converged:
    """Image (3, size²) and gradients that all methods converge to: float64, plain autograd, up to 64² samples.

    Visibility is the view's. The mesh is closed, so every visible face shows its front.
    """

    def __init__(self, view: View, irradiance: Callable[[Tensor], Tensor] = whole_irradiance):
        pixel, face, weight = covered_fractions(view)
        visible, index = face.unique(return_inverse=True)
        vertices = view.vertices(torch.float64).cpu().requires_grad_()
        light = torch.zeros(21**2, 3, dtype=torch.float64, requires_grad=True)
        normals = reference.face_normals(vertices[torch.from_numpy(view.mesh.faces)[visible]])

        def image(at_faces: Tensor) -> Tensor:
            shade = (at_faces * torch.tensor(ALBEDO, dtype=torch.float64))[index] * weight[:, None]
            return torch.zeros(view.size**2, 3, dtype=torch.float64).index_add(0, pixel, shade).T

        lit, by_any_light = image(irradiance(normals)), image(reference.irradiance(normals.detach(), light))
        upstream, self.image = view.image_gradient.cpu(), lit.detach()
        [self.by_light] = torch.autograd.grad((by_any_light * upstream).sum(), light)
        [self.by_vertices] = torch.autograd.grad((lit * upstream).sum(), vertices)

    def errors(self, step: Step, gradient: Tensor) -> Row:
        """gradient: by_light, which is compared on the coefficients that the step's light has, or by_vertices."""
        pixels, radiance, result = step()
        image = radiance.new_zeros(self.image.shape).index_copy(1, pixels, radiance)
        errors = relative_error(image, self.image), relative_error(result, gradient[: len(result)])
        return dict(zip(("image_error", "gradient_error"), errors, strict=True))


def covered_fractions(view: View) -> tuple[Tensor, Tensor, Tensor]:
    """(pixel, face, the fraction of the pixel that the face covers), in several shifted rasterizations."""
    size, faces = view.size, view.mesh.faces
    samples = min(FINEST, max(1, RESOLUTION // size))
    keys = []
    for shift in product(range(SHIFTS), repeat=2):
        points = CAMERA.project(view.mesh.vertices)
        points[:, :2] += 2 * ((np.array(shift) + 0.5) / SHIFTS - 0.5) / (size * samples)
        ids = view.rasterizer.rasterize(points[None], faces, size * samples, closed=view.mesh.closed)[0]
        row, column = np.nonzero(ids >= 0)
        keys.append((row // samples * size + column // samples) * len(faces) + ids[row, column])
    key, count = np.unique(np.concatenate(keys), return_counts=True)
    weight = count / (SHIFTS * samples) ** 2
    return torch.from_numpy(key // len(faces)), torch.from_numpy(key % len(faces)), torch.from_numpy(weight)


def mitsuba_step(view: View, name: str) -> Step:
    """The gradient by light.data (49, 3), or by mesh.vertex_positions (V, 3) through the shading alone, by Mitsuba 3 on
    one thread, as its users would set it up.

    Each camera ray draws one direction by the cosine and looks up an environment map there: Mitsuba's cheapest way, and
    the least noisy for a smooth light. Automatic differentiation holds outlines fixed; moved vertices rebuild the ray
    tracer's tree. InputError: not installed, or no LLVM library.
    """
    with mitsuba(DIFFERENTIABLE) as module:
        import drjit
    drjit.set_thread_count(1)
    light, size = coefficients(DEGREE).requires_grad_(), view.size
    texels = mitsuba_map(light, MITSUBA_ROWS).float()
    repeated = torch.cat([texels[:, -1:], texels, texels[:, :1]], dim=1)  # as Mitsuba holds the map
    surface = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(ALBEDO)}}
    scene = {
        "type": "scene",
        "integrator": integrator(bounces=0),
        "light": environment({"bitmap": texels.detach().numpy()}),
        "sensor": sensor_of(CAMERA, size, "rgb"),
        "mesh": shape(module, surface, view.mesh.vertices, view.mesh.faces),
    }
    scene = load(module, scene)
    parameters = module.traverse(scene)
    upstream = module.TensorXf(np.pi * view.image_gradient.T.cpu().float().unflatten(0, (size, size)).numpy())
    by_light, vertices = name == "light.data", view.mesh.vertices.astype(np.float32).ravel()
    start = module.TensorXf(repeated.detach().numpy()) if by_light else module.Float(vertices)

    def step() -> Result:
        value = drjit.detach(start)
        drjit.enable_grad(value)
        parameters[name] = value
        parameters.update()
        image = module.render(scene, parameters, spp=MITSUBA_SAMPLES**2)
        drjit.backward(drjit.sum(image * upstream, axis=None))
        gradient = torch.from_numpy(np.array(drjit.grad(value)))  # waits for the result
        drjit.disable_grad(parameters[name])
        if by_light:
            [gradient] = torch.autograd.grad(repeated, light, gradient, retain_graph=True)
        radiance = np.pi * np.array(drjit.detach(image)).reshape(-1, 3).T
        return torch.arange(size**2), torch.from_numpy(radiance), gradient.view(-1, 3)

    return step
