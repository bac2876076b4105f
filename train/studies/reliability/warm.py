"""What the forked commands share: imported once, and what is slow at its first use used once, which makes them fast."""

import gc
from io import BytesIO

import matplotlib.pyplot as plt
import OpenImageIO  # noqa: F401
import torch._inductor.config  # noqa: F401  # which the first optimizer of torch imports
from hydra import compose, initialize_config_module

import train.attacks.experiment
import train.experiment
import train.laboratory.folder
import train.report.comparison
import train.run_folder.classifier
import train.sweep  # noqa: F401

with initialize_config_module("conf", version_base="1.3"):
    compose("train", ["train.epochs=1", "scene.meshes=[a.obj]", "data=npz"], return_hydra_config=True)
for kind in ("png", "svg"):
    plt.figure().savefig(BytesIO(), format=kind)
plt.close("all")
gc.freeze()  # a collection of garbage in a fork would touch, and so copy, all that is shared
