"""Classifier and scenes to labelled images. Knows no OpenGL, no optimiser and no data set."""

from renderer.lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "attacks.criteria": ["LeastLikely", "Misclassification", "Targeted"],
        "attacks.run": ["Attacked", "attack"],
        "attacks.settings": ["AttackSettings"],
        "build": ["build_scene"],
        "classifiers": ["Classifier", "load_classifier"],
        "kind": ["StepSettings"],
        "objects": ["CompanionSettings", "ObjectSettings"],
        "parameters": ["SkylightSettings"],
        "placed_lights": ["LampsSettings", "ProjectorSettings"],
        "scene": ["Scene"],
        "service": ["AugmentationService"],
        "service_settings": ["AugmentationSettings"],
        "snapshot": ["SnapshotSettings"],
        "variation": ["VariationSettings"],
    },
)
