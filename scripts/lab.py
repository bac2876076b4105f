"""Path-trace renders of oranges and hard negatives under a projector."""

from train.cli import Command

main = Command("lab", "train.command_settings:LabSettings", __doc__, ["pnb-lab out=lab"])

if __name__ == "__main__":
    main()
