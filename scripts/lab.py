"""Path-trace photographs of oranges and hard negatives under a projector: python scripts/lab.py out=lab"""

from train import cli  # isort: skip (first, since the others take seconds to import)

from train.lab import LabSettings, write_laboratory


def main(settings: LabSettings) -> None:
    count = write_laboratory(settings)
    print(f"{settings.out}: {count} photographs under {settings.setups} setups")


if __name__ == "__main__":
    cli.script(main, LabSettings)
