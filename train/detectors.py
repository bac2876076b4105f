"""The small detector that is published with the library: an SSD of torchvision."""

from itertools import pairwise

from torch import nn
from torchvision.models._utils import IntermediateLayerGetter
from torchvision.models.detection.anchor_utils import DefaultBoxGenerator
from torchvision.models.detection.ssd import SSD
from torchvision.models.detection.ssdlite import SSDLiteHead
from torchvision.models.resnet import BasicBlock
from torchvision.ops import Conv2dNormActivation

# Channels of the first convolution, which divides the size of images by 4, and of each stage of
# residual blocks, which halves it. The head sees the features of the last ones.
CHANNELS = (24, 48, 96, 160, 128, 128)
SEEN = 4
# Smallest and largest default box, as a fraction of the image.
BOX_SIZES = (0.15, 0.95)


def small_detector(class_count: int, size: int) -> SSD:
    """Build an SSD with random weights for images of about `size` pixels per side.

    Class 0 is the background, as in torchvision.
    """
    layers: list[nn.Module] = [Conv2dNormActivation(3, CHANNELS[0], 7, stride=4)]
    for inputs, outputs in pairwise(CHANNELS):
        shortcut = Conv2dNormActivation(inputs, outputs, 1, stride=2, activation_layer=None)
        layers.append(BasicBlock(inputs, outputs, 2, shortcut))
    # The names of the last SEEN layers, from whose features boxes are found.
    seen = {str(index): str(index) for index in range(len(layers))[-SEEN:]}
    boxes = DefaultBoxGenerator([[2, 3]] * SEEN, *BOX_SIZES)
    per_location = boxes.num_anchors_per_location()
    return SSD(
        IntermediateLayerGetter(nn.Sequential(*layers), seen),
        boxes,
        (size, size),
        class_count,
        head=SSDLiteHead([*CHANNELS[-SEEN:]], per_location, class_count, nn.BatchNorm2d),
        image_mean=[0.5] * 3,
        image_std=[0.25] * 3,
        topk_candidates=100,
        detections_per_img=50,
        nms_thresh=0.45,
    )
