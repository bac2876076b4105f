"""Specular materials of an object before an attack changes them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from augment.scene.objects import SceneObject

# Positions among roughness, metallic and specular factor of a face.
ROUGHNESS = 0
METALLIC = 1

# Roughness, metallic and specular factor of an object that neither reflects specularly
# nor is metallic. `initial_materials` gives it to meshes without a gloss.
MATTE = (1.0, 0.0, 0.0)
# Roughness, metallic and specular factor with which an attack on a matte object starts.
SPECULAR_LAYER = (0.5, 0.0, 1.0)


@dataclass(frozen=True)
class FaceMaterials:
    """Specular materials of the F faces of a mesh: an object, its props and its table.

    Attributes:
        face_gloss: Roughness, metallic and specular factor of each face, shape (F, 3).
        object_mask: Mask of the faces that belong to the object itself,
            shape (F,).
    """

    face_gloss: Tensor
    object_mask: Tensor

    def average(self) -> Tensor:
        """Average roughness, metallic and specular factor over the object's faces, shape (3,)."""
        return self.face_gloss[self.object_mask].mean(0)

    def is_uniform(self) -> bool:
        """Return whether all faces belong to the object and have the same material."""
        has_same_gloss = (self.face_gloss == self.face_gloss[0]).all()
        return bool(self.object_mask.all() and has_same_gloss)

    def first_face(self) -> FaceMaterials:
        """Select the first face, which stands for all faces of a uniform mesh."""
        return FaceMaterials(face_gloss=self.face_gloss[:1], object_mask=self.object_mask[:1])


def initial_materials(item: SceneObject) -> FaceMaterials:
    """Return the materials with which an attack on the material of an object starts.

    It is the material of the mesh. If the object itself is matte, which means
    that metallic and specular factor are zero on all its faces, it gets `SPECULAR_LAYER`.

    Args:
        item: The object, whose mesh has F faces.

    Returns:
        The material of all faces, and which faces are the object's own.
    """
    object_mask = torch.from_numpy(item.own_faces)
    if item.mesh.gloss is None:
        face_gloss = torch.tensor([MATTE]).expand(len(object_mask), 3)
    else:
        face_gloss = torch.from_numpy(item.mesh.gloss)
    metallic_and_specular = face_gloss[object_mask, METALLIC:]
    is_matte = not metallic_and_specular.any()
    if is_matte:
        varnish = face_gloss.new_tensor(SPECULAR_LAYER)
        face_gloss = torch.where(object_mask[:, None], varnish, face_gloss)
    return FaceMaterials(face_gloss=face_gloss, object_mask=object_mask)
