"""pnb-light: write environment lighting as an environment map for other software."""

from pathlib import Path

from renderer.errors import InputError
from renderer.light.basis import Harmonics
from renderer.light.environment import to_map, write_map
from renderer.light.harmonics import degree_of, irradiance_error
from renderer.light.presets import load_light
from train.command_settings import LightSettings
from train.results.overwrite import require_replaceable
from train.system.user_errors import keyed


def export_light(settings: LightSettings) -> None:
    """Write environment lighting to an image file, without its negative radiance.

    The function prints how much the irradiance changes by this.
    """
    out = Path(settings.out)
    if out.exists() and Path(settings.light).exists() and out.samefile(settings.light):
        message = f"out={out} would overwrite the light itself: choose another file"
        raise InputError(message, "out")
    require_replaceable(out, "out", settings.overwrite)
    light = load_light(settings.light, degree=None)
    physical = Harmonics(degree_of(light)).project_nonnegative(light)
    radiance = to_map(physical, settings.height).clamp(min=0)
    with keyed("out"):
        write_map(out, radiance)
    rows, columns = radiance.shape[:2]
    darkest = float(radiance.min())
    brightest = float(radiance.max())
    error = irradiance_error(physical, light)
    print(
        f"{out}: {columns} × {rows} texels, radiance {darkest:.3g} to {brightest:.3g}; "
        f"without negative radiance, irradiance is off by {error:.2%}"
    )
