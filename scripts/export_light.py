"""Write a light as an environment map for other software: python scripts/export_light.py light=grace out=grace.hdr"""

from pathlib import Path

from omegaconf import DictConfig

from renderer.environment import negative_share, to_map, write_map
from renderer.errors import InputError
from renderer.lights import load_light
from train.cli import script


def main(config: DictConfig) -> None:
    if not isinstance(config.height, int) or config.height < 1:
        raise InputError(f"height={config.height} is no number of rows: give a whole number, e.g. 256")
    out, radiance = Path(config.out), to_map(load_light(str(config.light)), config.height)
    write_map(out, radiance)
    fate = "stored as 0" if out.suffix.lower() == ".hdr" else "kept"
    print(
        f"{out}: {radiance.shape[1]} × {radiance.shape[0]} texels, radiance {radiance.min():.3g} to "
        f"{radiance.max():.3g}; {negative_share(radiance):.2%} of it is negative and {fate}"
    )


if __name__ == "__main__":
    script(main)
