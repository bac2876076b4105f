"""Attack a classifier through a mesh's light, shape, color or pixels: pnb-attack attack=lighting"""

import re
import sys

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

from train.attack import AttackExperimentSettings, run


def as_overrides(arguments: list[str]) -> list[str]:
    """attack=lighting+geometry in Hydra's form, attack=[lighting,geometry]; a reloaded adversary is not attacked,
    unless attack= asks for it."""
    keys = {argument.partition("=")[0] for argument in arguments}
    parameters = [re.sub(r"^attack=([^\[].*)$", lambda m: f"attack=[{m[1].replace('+', ',')}]", a) for a in arguments]
    return [*parameters, *(["attack=[]"] if "reload" in keys and "attack" not in keys else [])]


@cli.command(as_overrides)
def main(settings: AttackExperimentSettings) -> None:
    run(settings)


if __name__ == "__main__":
    main()
