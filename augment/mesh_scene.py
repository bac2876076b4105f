"""One mesh before cameras and backgrounds, rendered under conditions that an attack may change."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from renderer.albedo import face_albedo, surface_albedo
from renderer.cache import OperatorCache
from renderer.camera import OrthographicCamera
from renderer.fragments import Fragments, build_fragments
from renderer.image import PictureSettings, clamp, develop
from renderer.mesh import Mesh
from renderer.shading import radiance
from renderer.transfer import Operator
from renderer.visibility import Backend


@dataclass(frozen=True)
class Conditions:
    """What A examples are rendered under.

    light: (A, 49, 3). vertices: (A, N, 3), None where they are the mesh's. albedo: (A, F, 3), added to each face's
    linear albedo. pixels: (A, V, 3, size, size), added to the pictures' values.
    """

    light: Tensor
    vertices: Tensor | None = None
    albedo: Tensor | None = None
    pixels: Tensor | None = None


class MeshScene:
    """E examples of V views each: cameras (E × V), backgrounds (E, 3, size, size) picture values in [0, 1].

    Under a change of light alone nothing is rasterised after the first time: equal cameras share one operator. Where
    vertices move, their view is rasterised anew each time. light: (49, 3), where attacks begin.
    """

    def __init__(
        self,
        mesh: Mesh,
        cameras: Sequence[Sequence[OrthographicCamera]],
        backgrounds: Tensor,
        light: Tensor,
        settings: PictureSettings,
        backend: Backend,
        gain: float = 1.0,
        operators: OperatorCache | None = None,
    ):
        self.mesh, self.cameras, self.settings, self.backend, self.gain = mesh, cameras, settings, backend, gain
        self.backgrounds, self.light = backgrounds.flatten(2).to(light), light
        self.vertices = torch.from_numpy(mesh.vertices).to(light)
        self.faces = torch.from_numpy(mesh.faces).to(light.device)
        self._operators = operators or OperatorCache()
        self.operator = cache(self._build_operator)
        self._still = cache(self._fragments_of_mesh)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def views(self) -> int:
        """Views per example."""
        return len(self.cameras[0])

    def conditions(self, examples: Tensor) -> Conditions:
        """The scene's own, for examples (A,)."""
        return Conditions(self.light.expand(len(examples), -1, -1))

    def render(self, conditions: Conditions, examples: Tensor) -> Tensor:
        """Pictures (A, V, 3, size, size) in [0, 1] of examples (A,), differentiable in the conditions."""
        only_light = conditions.vertices is None and conditions.albedo is None
        pictures = (self._relight if only_light else self._reshade)(conditions, examples.tolist())
        pictures = pictures.unflatten(-1, (self.settings.size, self.settings.size))
        return pictures if conditions.pixels is None else clamp(pictures + conditions.pixels)

    def _relight(self, conditions: Conditions, examples: list[int]) -> Tensor:
        """By one product per camera."""
        rows = defaultdict(list)
        for row, example in enumerate(examples):
            for view, camera in enumerate(self.cameras[example]):
                rows[camera].append(row * self.views + view)
        parts = [self._relit_view(camera, conditions, examples, cells) for camera, cells in rows.items()]
        return _in_order(parts, rows.values()).unflatten(0, (len(examples), self.views))

    def _relit_view(
        self, camera: OrthographicCamera, conditions: Conditions, examples: list[int], cells: list[int]
    ) -> Tensor:
        """(B, 3, size²) pictures from one camera; cells are rows of A × V."""
        row = torch.tensor(cells, device=self.light.device) // self.views
        operator = self.operator(camera)
        seen = operator.radiance(conditions.light.index_select(0, row))
        behind = self.backgrounds.index_select(0, torch.tensor(examples, device=self.light.device)[row])
        return self._develop(seen, operator.coverage, behind, operator.pixels)

    def _reshade(self, conditions: Conditions, examples: list[int]) -> Tensor:
        pictures = [
            self._reshaded_view(camera, conditions, row, example)
            for row, example in enumerate(examples)
            for camera in self.cameras[example]
        ]
        return torch.stack(pictures).unflatten(0, (len(examples), self.views))

    def _reshaded_view(self, camera: OrthographicCamera, conditions: Conditions, row: int, example: int) -> Tensor:
        """(3, size²) of one example."""
        if conditions.vertices is None:
            vertices = self.vertices
            fragments, albedo = self._still(camera)
        else:
            vertices = conditions.vertices[row]
            fragments, albedo = self._fragments(camera, vertices.detach().cpu().double().numpy())
        if conditions.albedo is not None:
            offset = face_albedo(conditions.albedo[row], fragments)
            albedo = clamp(albedo + offset, albedo.clamp(min=1))
        smooth_faces = self.faces if self.settings.normals == "smooth" else None
        seen = radiance(fragments, vertices, conditions.light[row], albedo, smooth_faces)
        return self._develop(seen, fragments.coverage.to(seen), self.backgrounds[example].clone(), fragments.pixels)

    def _develop(self, seen: Tensor, coverage: Tensor, behind: Tensor, pixels: Tensor) -> Tensor:
        """(..., 3, size²) pictures of radiance (..., 3, P) in front of pictures, which are overwritten."""
        rows = behind.flatten(0, -2)  # torch selects from matrices ten times faster than from stacks of them
        covered = develop(seen, coverage[None], rows.index_select(1, pixels).view_as(seen), self.settings.encoding)
        return rows.index_copy_(1, pixels, covered.flatten(0, -2)).view_as(behind)

    def _build_operator(self, camera: OrthographicCamera) -> Operator:
        built = self._operators.operators(
            self.mesh, [camera], self.settings, self.backend, self.gain, dtype=self.light.dtype
        )
        return built[0].to(self.light.device)

    def _fragments_of_mesh(self, camera: OrthographicCamera) -> tuple[Fragments, Tensor]:
        return self._fragments(camera, self.mesh.vertices)

    def _fragments(self, camera: OrthographicCamera, vertices: np.ndarray) -> tuple[Fragments, Tensor]:
        """What the camera sees of moved vertices, and the albedo there (S, 3)."""
        (fragments,) = build_fragments(
            vertices, self.mesh.faces, [camera], self.settings, self.backend, closed=self.mesh.closed
        )
        fragments = fragments.to(self.light.device)
        return fragments, (surface_albedo(self.mesh, fragments, self.settings.encoding) * self.gain).to(self.light)


def _in_order(parts: Sequence[Tensor], places: Iterable[Sequence[int]]) -> Tensor:
    """The entries of several tensors in one, each at its place."""
    if len(parts) == 1:
        return parts[0]
    order = torch.tensor([place for part in places for place in part]).argsort()
    return torch.cat(parts).index_select(0, order.to(parts[0].device))
