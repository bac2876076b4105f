"""How the cost of adversarial renders grows with their number, size, meshes and processes."""
