"""Files of meshes and images, in and out."""
