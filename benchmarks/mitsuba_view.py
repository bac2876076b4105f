"""Mitsuba 3 as its users would set it up for the task of the renderer's benchmark."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.scene import ALBEDO, CAMERA, View, coefficients
from renderer.io.mitsuba import DIFFERENTIABLE, environment, integrator, load, mitsuba, mitsuba_map, sensor_of, shape
from renderer.transfer import DEGREE


class MitsubaView:
    """A view in its light of degree 6 by Mitsuba's `direct` integrator in llvm_ad_rgb, on one thread.

    Each camera ray draws one direction by the cosine and looks up an environment map there: Mitsuba's cheapest way, and
    the least noisy for a smooth light. The gradient is by automatic differentiation with fixed outlines; moved vertices
    rebuild the ray tracer's tree. InputError: not installed, or no LLVM library.
    """

    samples, rows = 4, 32  # camera rays per side of a pixel; of the map, which dims band 2 by 0.5 %

    def __init__(self, view: View):
        with mitsuba(DIFFERENTIABLE) as self._mi:
            import drjit
        self._dr = drjit
        drjit.set_thread_count(1)
        self._view, self._positions = view, view.mesh.vertices.astype(np.float32).ravel()
        self._light = coefficients(DEGREE).float().numpy()
        numbered = np.tile(np.arange(2 * self.rows, dtype=np.float32)[:, None], (self.rows, 1, 3))
        scene = {
            "type": "scene",
            "integrator": integrator(bounces=0),
            "light": environment({"bitmap": numbered}),
            "sensor": sensor_of(CAMERA, view.size, "rgb"),
        }
        surface = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(ALBEDO)}}
        mesh = shape(self._mi, surface, view.mesh.vertices, view.mesh.faces)
        self._scene = load(self._mi, scene | {"mesh": mesh})
        self._parameters = self._mi.traverse(self._scene)
        columns = np.array(self._parameters["light.data"])[0, :, 0].astype(int)  # Mitsuba repeats some at the seam
        by_coefficient = mitsuba_map(torch.eye(len(self._light), dtype=torch.float64), self.rows)
        self._basis = by_coefficient.float().numpy()[:, columns]  # (rows, columns, 49)
        self._parameters["light.data"] = self._mi.TensorXf(self._basis @ self._light)
        self._parameters.update()

    def image(self) -> Tensor:
        """(3, size, size) linear radiance."""
        return torch.from_numpy(np.pi * np.array(self._render()).transpose(2, 0, 1))

    def light_gradient(self) -> Tensor:
        """(49, 3) of Σ image × image gradient; renders the image."""
        by_texel = self._gradient("light.data", self._mi.TensorXf(self._basis @ self._light))
        return torch.from_numpy(np.tensordot(self._basis, by_texel, ([0, 1], [0, 1])))

    def vertex_gradient(self) -> Tensor:
        """(V, 3), through the shading alone."""
        gradient = self._gradient("mesh.vertex_positions", self._mi.Float(self._positions))
        return torch.from_numpy(gradient.reshape(-1, 3))

    def _gradient(self, key: str, value: Any) -> np.ndarray:
        self._dr.enable_grad(value)
        self._parameters[key] = value
        self._parameters.update()
        upstream = np.pi * self._view.image_gradient.cpu().float().numpy().transpose(1, 2, 0)
        self._dr.backward(self._dr.sum(self._render() * self._mi.TensorXf(np.ascontiguousarray(upstream))))
        gradient = np.array(self._dr.grad(value))  # waits for the result
        self._dr.disable_grad(self._parameters[key])
        return gradient

    def _render(self) -> Any:
        return self._mi.render(self._scene, self._parameters, spp=self.samples**2)
