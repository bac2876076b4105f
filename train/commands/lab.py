"""Path-trace photographs of oranges and hard negatives under a projector: pnb-lab out=lab"""

from train import cli  # isort: skip (first, since the others take seconds to import)

from train.lab import LabSettings, write_laboratory


def main(settings: LabSettings) -> None:
    count = write_laboratory(settings)
    print(f"{settings.out}: {count} photographs under {settings.setups} setups")


def start() -> None:
    cli.command(__file__, __doc__, main, LabSettings)


if __name__ == "__main__":
    start()
