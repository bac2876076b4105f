"""pnb-light: write a light as an environment map for other software."""

from train.command import Command
from train.command_settings import LightSettings
from train.help import HelpText

main = Command(
    name="light",
    settings=LightSettings,
    body="train.commands.light:export_light",
    help=HelpText(
        about="Write a light as an environment map for other software.",
        examples=[
            "pnb-light light=grace out=grace.hdr",
        ],
    ),
)

if __name__ == "__main__":
    main()
