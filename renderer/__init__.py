"""Scene to pixels, and pixel gradients to scene parameters. Knows no classifier and no data set."""

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "camera": ["OrthographicCamera", "PerspectiveCamera", "orbit_cameras"],
        "errors": ["InputError"],
        "surface.gloss": ["Gloss"],
        "settings": ["ImageSettings"],
        "light.harmonics": ["harmonics"],
        "light.light_files": ["save_light"],
        "light.presets": ["load_light"],
        "light.skylight": ["skylight"],
        "geometry.mesh": ["Mesh", "normalize", "subdivide"],
        "io.export": ["export_mesh"],
        "io.meshes": ["load_mesh"],
        "rendering": ["precompute_transfer", "render"],
        "geometry.shapes": ["solid"],
        "transport.operators": ["TransferOperator"],
        "transport.operator_stacks": ["TransferOperators"],
    },
)
