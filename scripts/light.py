"""Write a light as an environment map for other software: pnb-light light=grace out=grace.hdr"""

import sys
from dataclasses import dataclass
from pathlib import Path

sys.path[0] = sys.path[0].removesuffix("/scripts")  # in a clone, packages are found in its root
from train import cli  # isort: skip (first, since the others take seconds to import)

from omegaconf import MISSING

from renderer.errors import InputError, require_range
from renderer.light.basis import Harmonics
from renderer.light.environment import to_map, write_map
from renderer.light.harmonics import degree_of, irradiance_error
from renderer.light.presets import load_light
from train.results import require_replaceable
from train.settings import keyed


@dataclass
class Settings:
    light: str = MISSING  # grace | eucalyptus | st_peters | uniform | a map (.npy, .hdr, .exr) | coefficients (.json)
    out: str = MISSING  # the map's file, .hdr, .exr or .npy, without negative radiance, of the same mean
    height: int = 256  # rows; there are twice as many columns
    overwrite: bool = False  # replace a file that exists

    def __post_init__(self) -> None:
        require_range("height", self.height, 1, 8192)  # a map of that height takes 3 GB


@cli.command()
def main(settings: Settings) -> None:
    out = Path(settings.out)
    if out.exists() and Path(settings.light).exists() and out.samefile(settings.light):
        raise InputError(f"out={out} is the light itself, which would be lost: choose another file")
    require_replaceable(out, "out", settings.overwrite)
    light = load_light(settings.light, degree=None)
    physical = Harmonics(degree_of(light)).project_nonnegative(light)
    radiance = to_map(physical, settings.height).clamp(min=0)
    with keyed("out"):
        write_map(out, radiance)  # negative light is refused where maps are read
    print(
        f"{out}: {radiance.shape[1]} × {radiance.shape[0]} texels, radiance {radiance.min():.3g} to "
        f"{radiance.max():.3g}; without negative radiance, irradiance is off by {irradiance_error(physical, light):.2%}"
    )


if __name__ == "__main__":
    main()
