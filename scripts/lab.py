"""pnb-lab: path-trace renders of oranges and hard negatives under a projector."""

from train.cli import Command, HelpText
from train.command_settings import LabSettings

main = Command(
    name="lab",
    settings=LabSettings,
    body="train.commands.lab:render_laboratory",
    help=HelpText(
        about="Path-trace renders of oranges and hard negatives under a projector.",
        examples=["pnb-lab out=lab"],
    ),
)

if __name__ == "__main__":
    main()
