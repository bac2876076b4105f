"""Transport by other numbers of rays and patches than the renderer's own."""

from collections.abc import Iterator
from contextlib import contextmanager

from renderer.transport import radiosity, rays


@contextmanager
def quadrature(
    directions: int = rays.DIRECTIONS, patches: int = radiosity.PATCHES, of_patch: int = radiosity.DIRECTIONS
) -> Iterator[None]:
    """directions: of a pixel. patches: what a mesh's area is divided into. of_patch: the directions of each."""
    chosen = rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS
    try:
        rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS = directions, patches, of_patch
        yield
    finally:
        rays.DIRECTIONS, radiosity.PATCHES, radiosity.DIRECTIONS = chosen
