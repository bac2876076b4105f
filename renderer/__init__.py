"""Scene to pixels, and pixel gradients to scene parameters. Knows no classifier and no data set."""

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "camera": ["OrthographicCamera", "PerspectiveCamera", "orbit_cameras"],
        "errors": ["InputError"],
        "gloss": ["Gloss"],
        "image": ["ImageSettings"],
        "light.harmonics": ["harmonics"],
        "light.presets": ["load_light", "save_light"],
        "light.skylight": ["skylight"],
        "mesh": ["Mesh", "load_mesh", "normalize", "subdivide"],
        "io.export": ["export_mesh"],
        "rendering": ["precompute_transfer", "render"],
        "shapes": ["solid"],
        "transfer": ["TransferOperator"],
        "views": ["TransferOperators"],
    },
)
