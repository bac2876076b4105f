"""Score a network on a folder of photographs."""

from train.cli import Command

examples = [
    "pnb-evaluate run=pretrained/best photos=photos",
    "pnb-evaluate network=torchvision:resnet18 photos=photos",
]
main = Command("evaluate", "train.command_settings:EvaluateSettings", __doc__, examples)

if __name__ == "__main__":
    main()
