"""Attack a classifier through a mesh's light, shape, color or pixels: pnb-attack attack=lighting"""

import re
import sys

from train import cli  # isort: skip (first, since the others take seconds to import)

from train.attack import AttackExperimentSettings, run


def as_overrides(arguments: list[str]) -> list[str]:
    """attack=lighting+geometry in Hydra's form, attack=[lighting,geometry]; a reloaded adversary is not attacked,
    unless attack= asks for it."""
    keys = {argument.partition("=")[0] for argument in arguments}
    parameters = [re.sub(r"^attack=([^\[].*)$", lambda m: f"attack=[{m[1].replace('+', ',')}]", a) for a in arguments]
    return [*parameters, *(["attack=[]"] if "reload" in keys and "attack" not in keys else [])]


def start() -> None:
    cli.command(__file__, __doc__, run, AttackExperimentSettings, as_overrides(sys.argv[1:]))


if __name__ == "__main__":
    start()
