"""pnb-lab: path-trace renders of oranges and hard negatives under a projector."""

from train.command import Command
from train.command_settings import LabSettings
from train.help import HelpText

main = Command(
    name="lab",
    settings=LabSettings,
    body="train.commands.lab:render_laboratory",
    help=HelpText(
        about="Path-trace renders of oranges and hard negatives under a projector.",
        examples=[
            "pnb-lab out=lab",
        ],
    ),
)

if __name__ == "__main__":
    main()
