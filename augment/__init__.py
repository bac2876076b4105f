"""Classifier and scenes to labeled images. Knows no OpenGL, no optimizer and no data set."""

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "attacks.adversary": ["Adversary", "reload"],
        "attacks.attack": ["AttackResult", "attack"],
        "attacks.checks": ["check", "success_by_radius", "transfer"],
        "attacks.attack_files": ["save"],
        "attacks.settings": ["AttackSettings"],
        "attacks.parameter_settings": [
            *("MaterialSettings", "PoseSettings", "SkylightSettings", "StepSettings"),
        ],
        "scene.build": ["build_scene"],
        "classifiers": ["Classifier", "load_classifier"],
        "scene.scene": ["Scene"],
        "service": ["AugmentationService"],
        "settings": [
            *("AugmentationSettings", "CameraEffectSettings", "LampsSettings", "ObjectSettings"),
            *("ProjectorSettings", "PropSettings", "VariationSettings"),
        ],
    },
)
