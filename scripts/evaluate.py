"""Score a network on a folder of photographs."""

from train.cli import Command

main = Command(
    name="evaluate",
    settings="train.command_settings:EvaluateSettings",
    about=__doc__,
    examples=[
        "pnb-evaluate run=pretrained/best photos=photos",
        "pnb-evaluate network=torchvision:resnet18 photos=photos",
    ],
)

if __name__ == "__main__":
    main()
