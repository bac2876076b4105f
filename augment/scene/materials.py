"""Specular materials of the faces of an object before an attack changes them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.scene.objects import SceneObject

# Each face has three numbers: roughness, metallic and specular factor. These are the positions of
# the first two.
ROUGHNESS = 0
METALLIC = 1

# Roughness, metallic and specular factor of a matte surface, which is neither specular nor
# metallic.
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

    face_gloss: Float[Tensor, "F 3"]
    object_mask: Bool[Tensor, " F"]

    def average(self) -> Tensor:
        """Average roughness, metallic and specular factor over the object's faces, shape (3,)."""
        return self.face_gloss[self.object_mask].mean(0)

    def is_uniform(self) -> bool:
        """Return whether all faces belong to the object and have the same material."""
        has_same_gloss = (self.face_gloss == self.face_gloss[0]).all()
        return bool(self.object_mask.all() and has_same_gloss)

    def first_face(self) -> FaceMaterials:
        """Return the material of the first face only. In a uniform mesh, it is that of all."""
        return FaceMaterials(face_gloss=self.face_gloss[:1], object_mask=self.object_mask[:1])


def initial_materials(item: SceneObject) -> FaceMaterials:
    """Return the materials with which an attack on the material of an object starts.

    They are those of the mesh. If the object is matte (metallic and specular
    factor are zero on all its faces), its faces get the material
    `SPECULAR_LAYER`. Props and table keep their materials.
    """
    object_mask = torch.from_numpy(item.own_faces)
    if item.mesh.gloss is None:
        face_gloss = torch.tensor([MATTE]).expand(len(object_mask), 3)
    else:
        face_gloss = torch.from_numpy(item.mesh.gloss)
    metallic_and_specular = face_gloss[object_mask, METALLIC:]
    is_matte = not metallic_and_specular.any()
    if is_matte:
        specular_layer = face_gloss.new_tensor(SPECULAR_LAYER)
        face_gloss = torch.where(object_mask[:, None], specular_layer, face_gloss)
    return FaceMaterials(face_gloss=face_gloss, object_mask=object_mask)
