"""pnb-fit: find the camera and the lighting of a photograph."""

from train.cli import Command, HelpText
from train.command_settings import FitSettings

main = Command(
    name="fit",
    settings=FitSettings,
    body="train.commands.fit:fit",
    help=HelpText(
        about="Find the camera and the lighting of a photograph.",
        examples=["pnb-fit photograph=photo.jpg mask=mask.png mesh=orange.glb"],
    ),
)

if __name__ == "__main__":
    main()
