"""Path-trace photographs of oranges and hard negatives under a projector: python scripts/lab.py out=lab"""

from train.command_line.entry_points import script
from train.lab.folder import LabSettings, write_laboratory


def main(settings: LabSettings) -> None:
    count = write_laboratory(settings)
    print(f"{settings.out}: {count} photographs under {settings.setups} setups")


if __name__ == "__main__":
    script(main, LabSettings)
