"""Other differentiable renderers on our benchmark's scene, one class each, all with one interface.

__init__(vertices (V, 3), faces (F, 3), albedo (3,), light (49, 3), camera, size, samples)
    sets the scene up once; InputError where the renderer is not installed. samples: rays or samples per pixel
picture() -> (3, size, size) linear radiance by our conventions, black where nothing is
light_gradient(image_gradient (3, size, size)) -> (49, 3): renders, and differentiates Σ picture × image_gradient
vertex_gradient(image_gradient) -> (V, 3): the same by the vertices' positions, through the shading alone

Everything is float32 NumPy. A call returns when its result is there; the first one of each kind compiles and warms up.
The caller limits the threads of torch.
"""
