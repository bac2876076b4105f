"""What the forked commands share: imported once, and Hydra's grammars used once, which makes them fast."""

import gc

import matplotlib.pyplot  # noqa: F401
import OpenImageIO  # noqa: F401
from hydra import compose, initialize_config_module

import train.attacks.experiment
import train.comparison
import train.experiment
import train.laboratory.folder
import train.run_classifier
import train.sweep  # noqa: F401

with initialize_config_module("conf", version_base="1.3"):
    compose("train", ["train.epochs=1", "scene.meshes=[a.obj]", "data=npz"], return_hydra_config=True)
gc.freeze()  # a collection of garbage in a fork would touch, and so copy, all that is shared
