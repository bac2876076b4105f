"""One mesh before cameras and backgrounds, rendered under conditions that an attack may change."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.albedo import face_albedo, surface_albedo
from renderer.cache import OperatorCache
from renderer.camera import OrthographicCamera
from renderer.fragments import Fragments, build_fragments
from renderer.image import PictureSettings, behind, clamp, develop_composite
from renderer.mesh import Mesh
from renderer.shading import radiance
from renderer.transfer import Operator
from renderer.visibility import Backend

Places = Sequence[tuple[list[int], Tensor]]  # rows of a stack of pictures, and the pixels (P,) they cover


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

    Under a change of light alone nothing is rasterised after the first time: equal cameras share one operator, and what
    a background adds to each picture is kept. Where vertices move, their view is rasterised anew each time.
    light: (49, 3), where attacks begin.
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
        self._behind = cache(self._build_behind)
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
        cells = defaultdict(list)
        for row, example in enumerate(examples):
            for view, camera in enumerate(self.cameras[example]):
                cells[camera].append(row * self.views + view)
        covered = [self._relit_view(camera, conditions, examples, rows) for camera, rows in cells.items()]
        places = [(rows, self.operator(camera).pixels) for camera, rows in cells.items()]
        return self._on_backgrounds(examples, places, covered)

    def _relit_view(
        self, camera: OrthographicCamera, conditions: Conditions, examples: list[int], cells: list[int]
    ) -> Tensor:
        """(B, 3, P) picture values from one camera; cells are rows of A × V."""
        rows = [cell // self.views for cell in cells]
        seen = self.operator(camera).radiance(conditions.light.index_select(0, self._index(rows)))
        added = torch.stack([self._behind(camera, examples[row]) for row in rows])
        return develop_composite(seen + added, self.settings.encoding)

    def _reshade(self, conditions: Conditions, examples: list[int]) -> Tensor:
        """View by view."""
        views = [(row, example, camera) for row, example in enumerate(examples) for camera in self.cameras[example]]
        seen = [self._reshaded_view(camera, conditions, row, example) for row, example, camera in views]
        places = [([cell], pixels) for cell, (pixels, _) in enumerate(seen)]
        return self._on_backgrounds(examples, places, [covered[None] for _, covered in seen])

    def _reshaded_view(
        self, camera: OrthographicCamera, conditions: Conditions, row: int, example: int
    ) -> tuple[Tensor, Tensor]:
        """The covered pixels (P,) of one example and their picture values (3, P)."""
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
        composite = seen + self._background(example, fragments.coverage.to(seen), fragments.pixels)
        return fragments.pixels, develop_composite(composite, self.settings.encoding)

    def _background(self, example: int, coverage: Tensor, pixels: Tensor) -> Tensor:
        """(3, P) what an example's background adds to covered pixels."""
        return behind(coverage[None], self.backgrounds[example].index_select(1, pixels), self.settings.encoding)

    def _on_backgrounds(self, examples: list[int], places: Places, covered: Sequence[Tensor]) -> Tensor:
        """Pictures (A, V, 3, size²)."""
        canvas = self.backgrounds.index_select(0, self._index(examples).repeat_interleave(self.views))
        return _Placed.apply(canvas, places, *covered).unflatten(0, (len(examples), self.views))

    def _index(self, rows: list[int]) -> Tensor:
        return torch.tensor(rows, device=self.light.device)

    def _build_operator(self, camera: OrthographicCamera) -> Operator:
        built = self._operators.operators(
            self.mesh, [camera], self.settings, self.backend, self.gain, dtype=self.light.dtype
        )
        return built[0].to(self.light.device)

    def _build_behind(self, camera: OrthographicCamera, example: int) -> Tensor:
        operator = self.operator(camera)
        return self._background(example, operator.coverage, operator.pixels)

    def _fragments_of_mesh(self, camera: OrthographicCamera) -> tuple[Fragments, Tensor]:
        return self._fragments(camera, self.mesh.vertices)

    def _fragments(self, camera: OrthographicCamera, vertices: np.ndarray) -> tuple[Fragments, Tensor]:
        """What the camera sees of moved vertices, and the albedo there (S, 3)."""
        (fragments,) = build_fragments(
            vertices, self.mesh.faces, [camera], self.settings, self.backend, closed=self.mesh.closed
        )
        fragments = fragments.to(self.light.device)
        return fragments, (surface_albedo(self.mesh, fragments, self.settings.encoding) * self.gain).to(self.light)


class _Placed(torch.autograd.Function):
    """Covered pixels (B, 3, P) in their places on canvases (N, 3, size²), which are overwritten."""

    @staticmethod
    def forward(ctx, canvas: Tensor, places: Places, *covered: Tensor) -> Tensor:
        ctx.places = places
        for (rows, pixels), values in zip(places, covered, strict=True):
            for row, value in zip(rows, values, strict=True):
                canvas[row].index_copy_(1, pixels, value)
        return canvas

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor) -> tuple[Tensor | None, ...]:
        parts = [torch.stack([upstream[row].index_select(1, pixels) for row in rows]) for rows, pixels in ctx.places]
        return None, None, *parts
