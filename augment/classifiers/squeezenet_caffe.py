"""SqueezeNet 1.0 as its authors trained it in Caffe: another input convention, in torchvision's architecture."""

from pathlib import Path

from torch import nn
from torchvision.models import squeezenet1_0

from augment.classifiers.adapter import Classifier, Normalise
from augment.classifiers.imagenet import CLASSES
from augment.classifiers.weights import fill, read_weights
from renderer.errors import InputError

NAME = "squeezenet_caffe"
SIZE = 227
MEAN = (104, 117, 123)  # blue, green, red, of 255


def load_squeezenet_caffe(weights: Path | None) -> Classifier:
    """Takes 227 pixels, blue first, 255 x − (104, 117, 123). weights: a file with torchvision's parameter names.

    InputError without one, or for one that does not fit. (Iandola et al. 2016.)
    """
    if weights is None:
        raise InputError(f"classifier={NAME} comes without weights: give weights=FILE")
    network = squeezenet1_0()
    network.classifier[1].padding = (1, 1)  # in Caffe's definition, but not in torchvision's
    fill(network, read_weights(weights), weights, NAME)
    normalise = Normalise(mean=[value / 255 for value in MEAN], std=[1 / 255] * 3, bgr=True)
    return Classifier(nn.Sequential(normalise, network), SIZE, CLASSES, NAME)
