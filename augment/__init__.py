"""Classifier and scenes to labeled images. Knows no OpenGL, no optimizer and no data set."""

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "attacks.adversary": ["Adversary", "reload"],
        "attacks.attack": ["AttackResult", "AttackSettings", "attack"],
        "attacks.evaluate": ["check", "success_by_radius", "transfer"],
        "attacks.files": ["save"],
        "attacks.norm_ball": ["StepSettings"],
        "build": ["LampsSettings", "ProjectorSettings", "build_scene"],
        "classifiers": ["Classifier", "load_classifier"],
        "attacks.parameters.settings": ["MaterialSettings", "PoseSettings", "SkylightSettings"],
        "objects": ["PropSettings", "ObjectSettings"],
        "scene": ["Scene"],
        "service": ["AugmentationService", "AugmentationSettings"],
        "camera_effects": ["CameraEffectSettings"],
        "variation": ["VariationSettings"],
    },
)
