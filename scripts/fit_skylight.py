"""Fit the sky's coefficients with polynomials and print the largest error: python scripts/fit_skylight.py"""

from dataclasses import dataclass

from train import cli  # isort: skip (first, since the others take seconds to import)

import torch
from safetensors.torch import save

from renderer.errors import InputError, require_range
from renderer.light.skylight import fit_error, fit_polynomials
from train.errors import writable_file


@dataclass
class Settings:
    out: str = "renderer/skylight_fit.safetensors"  # the file that the renderer reads
    zenith_degree: int = 13  # of the polynomials in the sun's zenith, as in the paper
    turbidity_degree: int = 11  # of those in 1/turbidity; with the paper's 7 the error is 25 times larger
    held_out: int = 200  # random skies on which the largest error is measured

    def __post_init__(self) -> None:
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
    print(f"{out}: off by up to {error:.1e} of the coefficients' norm on {settings.held_out} held-out skies")


if __name__ == "__main__":
    cli.script(main, Settings)
