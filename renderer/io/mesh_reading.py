"""The parts of a mesh's file, as trimesh reads them, with the colors and textures that the file itself has."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image
from trimesh.visual.base import Visuals
from trimesh.visual.material import Material, PBRMaterial, empty_material

from renderer.errors import LARGEST, InputError, require_file
from renderer.image import encode
from renderer.io.images import eight_bits
from renderer.io.meshes import open_mesh
from renderer.mesh import Mesh

ARCHIVES = {"zip", "tar.gz", "tar.bz2", "bz2"}  # not read: what is in them is to be seen before


def read_parts(path: Path, linear: bool) -> list[tuple[Mesh, np.ndarray]]:
    """Every part of a file in its own coordinates, with the affine matrix (4, 4) that places it.

    linear: the file's colors, textures aside, are linear. InputError: as `renderer.mesh.load_mesh`.
    """
    require_file(path, "give the path of a mesh file")
    formats = set(trimesh.available_formats()) - ARCHIVES
    suffix = path.suffix.lower().lstrip(".")
    if suffix not in formats:
        raise InputError(f"{path} has no known mesh format: use one of {', '.join(sorted(formats))}")
    try:
        file, companions = open_mesh(path)
        scene = trimesh.load(file, file_type=suffix, resolver=companions, force="scene", process=False)
    except InputError:
        raise
    except Exception as error:  # each of trimesh's readers raises its own
        raise _unreadable(path, error) from error
    surfaces = {
        name: geometry
        for name, geometry in scene.geometry.items()
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)
    }
    try:
        parts = {name: _part(geometry, linear) for name, geometry in surfaces.items()}
    except Exception as error:  # of NumPy and Pillow
        raise _unreadable(path, error) from error
    nodes = [scene.graph[node] for node in scene.graph.nodes_geometry]
    return [(parts[name], matrix) for matrix, name in nodes if name in parts]


def _unreadable(path: Path, error: Exception) -> InputError:
    return InputError(f"{path} cannot be read as a mesh ({error}): export it again")


def _part(geometry: trimesh.Trimesh, linear: bool) -> Mesh:
    """One geometry of a file, in its own coordinates. Raises whatever its contents make numpy or Pillow raise."""
    vertices, faces, uvs = geometry.vertices, np.asarray(geometry.faces), getattr(geometry.visual, "uv", None)
    mesh = Mesh.plain(vertices, faces)
    colors, image = _corner_colors(geometry.visual, faces)
    for name, values in {"coordinates": vertices, "texture coordinates": uvs, "colors": colors}.items():
        if values is not None and not (np.abs(values) <= LARGEST).all():  # NaN is not
            raise ValueError(f"{name} are not finite or beyond {LARGEST:g}")
    colors = encode(torch.from_numpy(colors), "srgb").numpy() if linear else colors
    mesh = replace(mesh, corner_colors=colors.astype(np.float32))
    if image is None:
        return mesh
    if uvs is None:
        raise ValueError("an image has no texture coordinates")
    return replace(
        mesh,
        corner_uvs=uvs[faces, :2].astype(np.float32),
        texture_ids=np.zeros(len(faces), dtype=np.int32),
        textures=(np.array(eight_bits(image).convert("RGB")),),
    )


def _corner_colors(visual: Visuals, faces: np.ndarray) -> tuple[np.ndarray, Image.Image | None]:
    """(F, 3, 3) colors in [0, 1] as the file has them, and the texture if there is one."""
    colors, image = np.ones((len(faces), 3, 3)), None
    if visual.kind == "vertex":
        colors *= _unit_rgb(visual.vertex_colors)[faces]
    elif visual.kind == "face":
        colors *= _unit_rgb(visual.face_colors)[:, None]
    elif visual.kind == "texture":
        color, image = _material(visual.material)
        colors *= color
        if "color" in visual.vertex_attributes:
            colors *= _unit_rgb(visual.vertex_attributes["color"])[faces]
    return colors, image


def _material(material: Material) -> tuple[np.ndarray, Image.Image | None]:
    """A material's color (3,) in [0, 1], white where the file gives none, and its image."""
    if isinstance(material, PBRMaterial):
        factor, image = material.baseColorFactor, material.baseColorTexture
        return np.ones(3) if factor is None else _unit_rgb(factor), image
    # trimesh puts a gray color, or a gray image, where the file has none; what it has is under its own name.
    image = None if material.image == empty_material().image else material.image
    return np.clip(material.kwargs.get("kd", np.ones(3)), 0, 1), image


def _unit_rgb(colors: np.ndarray) -> np.ndarray:
    """Red, green and blue in [0, 1], from integers of any width or from numbers that are so already."""
    rgb = np.asarray(colors)[..., :3]
    return rgb / np.iinfo(rgb.dtype).max if rgb.dtype.kind in "ui" else rgb
