"""Other differentiable renderers on our benchmark's scene, one class each, all with one interface, `Peer`.

Each is made of a `PeerScene`, which it sets up once; InputError where the renderer is not installed.
Everything is float32 NumPy. A call returns when its result is there; the first one of each kind compiles and warms up.
The caller limits the threads of torch.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from renderer.camera import OrthographicCamera


@dataclass(frozen=True)
class PeerScene:
    """vertices (V, 3), faces (F, 3), albedo (3,), light (49, 3). samples: rays or samples per pixel."""

    vertices: np.ndarray
    faces: np.ndarray
    albedo: np.ndarray
    light: np.ndarray
    camera: OrthographicCamera
    size: int
    samples: int


class Peer(Protocol):
    """A renderer with a scene."""

    def image(self) -> np.ndarray:
        """(3, size, size) linear radiance by our conventions, black where nothing is."""

    def light_gradient(self, image_gradient: np.ndarray) -> np.ndarray:
        """(49, 3): renders, and differentiates Σ image × image_gradient (3, size, size)."""

    def vertex_gradient(self, image_gradient: np.ndarray) -> np.ndarray:
        """(V, 3): the same by the vertices' positions, through the shading alone."""
