"""Write a light as an environment map for other software: python scripts/export_light.py light=grace out=grace.hdr"""

from dataclasses import dataclass
from pathlib import Path

import train.command_line.entry_points as command
from renderer.errors import InputError, require_range
from renderer.light.environment import check_map_name, negative_fraction, to_map, write_map
from renderer.light.presets import load_light
from train.command_line.outputs import writable_file

LARGEST_HEIGHT = 8192  # of a map that fits in memory: 3 GB


@dataclass
class Settings:
    """conf/export_light.yaml."""

    light: str
    out: str
    height: int

    def __post_init__(self):
        require_range("height", self.height, 1, LARGEST_HEIGHT)


def main(settings: Settings) -> None:
    light, out = load_light(settings.light), Path(settings.out)
    writable_file(out, "out")
    try:
        check_map_name(out)
    except InputError as error:
        raise InputError(f"out: {error}") from error
    if out.exists() and Path(settings.light).exists() and out.samefile(settings.light):
        raise InputError(f"out={out} is the light itself, which would be lost: choose another file")
    radiance = to_map(light, settings.height)
    write_map(out, radiance)
    fate = "stored as 0" if out.suffix.lower() == ".hdr" else "kept"
    print(
        f"{out}: {radiance.shape[1]} × {radiance.shape[0]} texels, radiance {radiance.min():.3g} to "
        f"{radiance.max():.3g}; {negative_fraction(radiance):.2%} of it is negative and {fate}"
    )


if __name__ == "__main__":
    command.script(main, Settings)
