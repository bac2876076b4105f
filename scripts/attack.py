"""Attack a classifier through a mesh's light, shape, color or pixels: python scripts/attack.py attack=lighting ..."""

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


if __name__ == "__main__":
    cli.script(run, AttackExperimentSettings, as_overrides(sys.argv[1:]))
