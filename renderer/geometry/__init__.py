"""The shape of objects: meshes, normals, generated solids and skins."""
