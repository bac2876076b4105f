"""The 1,000 classes of ImageNet's challenge, in the order that every network here shares."""

from torchvision.models import SqueezeNet1_0_Weights

# torchvision's names: each occurs once, since it tells the bird (`crane bird`) from the machine (`crane`), and
# `maillot tank suit` from `maillot`.
CLASSES = tuple(SqueezeNet1_0_Weights.DEFAULT.meta["categories"])
