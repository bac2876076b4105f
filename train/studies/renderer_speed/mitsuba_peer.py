"""Mitsuba 3 as its users would set it up for this task: an environment map of the light and plain AD."""

import math
from types import ModuleType
from typing import Any

import numpy as np
import torch

from renderer.files.mitsuba_scene import DIFFERENTIABLE, TO_Z_UP, mitsuba, mitsuba_map
from renderer.transfer import DEGREE
from train.studies.renderer_speed.scenes import ALBEDO, CAMERA, View, coefficients

NAME, SAMPLES = "Mitsuba 3", 16  # camera rays per pixel
MAP_ROWS = 32  # bilinear texels this wide dim band l by l(l + 1) (π / 31)² / 12: band 2 by 0.5 %


class MitsubaPeer:
    """A view in its light of degree 6 by Mitsuba's `direct` integrator in llvm_ad_rgb on one thread.

    Each camera ray draws one direction by the cosine and looks the map up there: Mitsuba's cheapest way, and the least
    noisy for a smooth light. Each call turns coefficients into texels by a matrix product, and the gradient back by its
    transpose, or moves the vertices and rebuilds the ray tracer's tree. Outlines count as fixed.
    Everything is float32 NumPy. A call returns when its result is there; the first one of each kind compiles.
    """

    def __init__(self, view: View):
        """InputError as `on_one_thread`."""
        self._mi, self._dr = on_one_thread()
        self._positions = view.mesh.vertices.astype(np.float32).ravel()
        self._light = coefficients(DEGREE).float().numpy()
        numbered = self._mi.Bitmap(np.tile(np.arange(2 * MAP_ROWS, dtype=np.float32)[:, None], (MAP_ROWS, 1, 3)))
        description = {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1, "hide_emitters": True},
            "light": {"type": "envmap", "bitmap": numbered, "to_world": self._mi.ScalarTransform4f(np.array(TO_Z_UP))},
            "mesh": self._mesh(view.mesh.faces),
            "sensor": self._sensor(view.size),
        }
        self._scene = self._mi.load_dict(description)
        self._parameters = self._mi.traverse(self._scene)
        with_seam = np.array(self._parameters["light.data"])[0, :, 0].astype(int)  # its map repeats columns there
        by_coefficient = mitsuba_map(torch.eye(len(self._light), dtype=torch.float64), MAP_ROWS)  # (rows, columns, 49)
        self._basis = by_coefficient.float().numpy()[:, with_seam]
        self._parameters["light.data"] = self._mi.TensorXf(self._basis @ self._light)
        self._parameters.update()

    def image(self) -> np.ndarray:
        """(3, size, size) linear radiance by our conventions, black where nothing is."""
        return math.pi * np.array(self._render()).transpose(2, 0, 1)

    def light_gradient(self, image_gradient: np.ndarray) -> np.ndarray:
        """(49, 3): renders, and differentiates Σ image × image_gradient (3, size, size)."""
        texels = self._mi.TensorXf(self._basis @ self._light)
        by_texel = self._gradient("light.data", texels, image_gradient)
        return np.tensordot(self._basis, by_texel, ([0, 1], [0, 1]))

    def vertex_gradient(self, image_gradient: np.ndarray) -> np.ndarray:
        """(V, 3): the same by the vertices' positions, through the shading alone."""
        positions = self._mi.Float(self._positions)
        return self._gradient("mesh.vertex_positions", positions, image_gradient).reshape(-1, 3)

    def _gradient(self, key: str, value: Any, image_gradient: np.ndarray) -> np.ndarray:
        self._dr.enable_grad(value)
        self._parameters[key] = value
        self._parameters.update()
        by_radiance = self._mi.TensorXf(np.ascontiguousarray(math.pi * image_gradient.transpose(1, 2, 0), np.float32))
        self._dr.backward(self._dr.sum(self._render() * by_radiance))
        gradient = np.array(self._dr.grad(value))  # waits for the result
        self._dr.disable_grad(self._parameters[key])
        return gradient

    def _render(self) -> Any:
        return self._mi.render(self._scene, self._parameters, spp=SAMPLES)

    def _mesh(self, faces: np.ndarray) -> Any:
        properties = self._mi.Properties()
        properties["face_normals"] = True
        diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(ALBEDO)}}
        properties["bsdf"] = self._mi.load_dict(diffuse)
        mesh = self._mi.Mesh("mesh", len(self._positions) // 3, len(faces), props=properties)
        buffers = self._mi.traverse(mesh)
        buffers["vertex_positions"] = self._positions
        buffers["faces"] = faces.astype(np.uint32).ravel()
        buffers.update()
        return mesh

    def _sensor(self, size: int) -> dict[str, Any]:
        _, up, back = CAMERA.axes()
        half = CAMERA.field_of_view / 2  # its image spans [-1, 1]
        look = self._mi.ScalarTransform4f().look_at(origin=list(4 * back), target=[0, 0, 0], up=list(up))
        film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
        return {"type": "orthographic", "to_world": look.scale([half, half, 1]), "film": film}


def on_one_thread() -> tuple[ModuleType, ModuleType]:
    """The modules (mitsuba, drjit). InputError: not installed, or no LLVM library."""
    with mitsuba(DIFFERENTIABLE) as module:
        import drjit

        drjit.set_thread_count(1)
    return module, drjit
