"""Measure how safe a classifier is in unusual lighting, and what hardening costs.

Your own network: network=torchvision:NAME weights=FILE classes=FILE, a file of TorchScript, of
torch.export (.pt2) or of ONNX (.onnx), or network=python:my_network.load, a function in
my_network.py. It returns the network, the pixels per side of its images, and the names of its
classes.

An audit that was stopped continues with the same settings, and with hardened= or photos= in
addition.
"""

from train.cli import Command

examples = [
    "pnb-audit network=torchvision:resnet50 meshes=orange.glb",
    "pnb-audit network=efficientnet_lite0 unlabeled=FOLDER",
    "pnb-audit network=torchvision:mobilenet_v3_small weights=mine.pth "
    "classes=mine.txt meshes=orange.glb",
    "pnb-audit network=NAME meshes=[orange.glb] hard_negatives=[solid:lemon] out=audit",
]
main = Command("audit", "train.command_settings:AuditSettings", __doc__, examples)

if __name__ == "__main__":
    main()
