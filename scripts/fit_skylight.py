"""Fit the sky's coefficients with polynomials and say how far off they are: python scripts/fit_skylight.py"""

from pathlib import Path

import torch
from omegaconf import DictConfig
from safetensors.torch import save_file

from renderer.skylight import fit_error, fit_polynomials
from train.cli import script


def main(config: DictConfig) -> None:
    fit = fit_polynomials(config.zenith_degree, config.turbidity_degree).float()
    Path(config.out).parent.mkdir(parents=True, exist_ok=True)
    save_file({"fit": fit}, config.out)
    error = fit_error(fit, config.held_out, torch.Generator().manual_seed(0))
    print(f"{config.out}: off by up to {error:.1e} of the coefficients' norm on {config.held_out} held-out skies")


if __name__ == "__main__":
    script(main)
