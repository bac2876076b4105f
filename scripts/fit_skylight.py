"""Fit the sky's coefficients with polynomials and say how far off they are: python scripts/fit_skylight.py"""

from dataclasses import dataclass

import torch
from safetensors.torch import save

import train.command_line.entry_points as command
from renderer.errors import InputError, require_range
from renderer.light.skylight import fit_error, fit_polynomials
from train.command_line.outputs import writable_file


@dataclass
class Settings:
    """conf/fit_skylight.yaml."""

    out: str
    zenith_degree: int
    turbidity_degree: int
    held_out: int

    def __post_init__(self):
        for name, least, most in [("zenith_degree", 0, 50), ("turbidity_degree", 0, 50), ("held_out", 1, 10**4)]:
            require_range(name, getattr(self, name), least, most)


def main(settings: Settings) -> None:
    out = writable_file(settings.out, "out")
    if out.suffix != ".safetensors":  # or a mistaken name would cost another file
        raise InputError(f"out={out}: name a .safetensors file")
    fit = fit_polynomials(settings.zenith_degree, settings.turbidity_degree).float()
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(save({"fit": fit}))
    error = fit_error(fit, settings.held_out, torch.Generator().manual_seed(0))
    print(f"{settings.out}: off by up to {error:.1e} of the coefficients' norm on {settings.held_out} held-out skies")


if __name__ == "__main__":
    command.script(main, Settings)
