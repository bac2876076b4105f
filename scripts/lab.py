"""Path-trace renders of oranges and hard negatives under a projector."""

from train.cli import Command

main = Command(
    name="lab",
    settings="train.command_settings:LabSettings",
    about=__doc__,
    examples=["pnb-lab out=lab"],
)

if __name__ == "__main__":
    main()
