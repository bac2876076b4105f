"""Path-trace renders of oranges and hard negatives under a projector: pnb-lab out=lab"""

import sys

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

from train.lab.laboratory import write_laboratory
from train.lab.shots import LabSettings


@cli.command()
def main(settings: LabSettings) -> None:
    count = write_laboratory(settings)
    print(f"{settings.out}: {count} renders under {settings.setups} setups")


if __name__ == "__main__":
    main()
