"""Classifier and scenes to labeled images. Knows no OpenGL, no optimizer and no data set."""

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "attacks.criteria": ["LeastLikely", "Misclassification", "Targeted"],
        "attacks.attack": ["AttackResult", "AttackSettings", "attack"],
        "build": ["LampsSettings", "ProjectorSettings", "build_scene"],
        "classifiers": ["Classifier", "load_classifier"],
        "attacks.parameters": ["SkylightSettings", "StepSettings"],
        "objects": ["PropSettings", "ObjectSettings"],
        "scene": ["Scene"],
        "service": ["AugmentationService", "AugmentationSettings"],
        "camera_effects": ["CameraEffectSettings"],
        "variation": ["VariationSettings"],
    },
)
