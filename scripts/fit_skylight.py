"""Fit the sky's coefficients with polynomials and say how far off they are: python scripts/fit_skylight.py"""

from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from safetensors.torch import save_file

from renderer.skylight import fit_error, fit_polynomials
from train.cli import one_sentence_errors, with_suggestions


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="fit_skylight")
@one_sentence_errors
def main(config: DictConfig) -> None:
    fit = fit_polynomials(config.zenith_degree, config.turbidity_degree).float()
    Path(config.out).parent.mkdir(parents=True, exist_ok=True)
    save_file({"fit": fit}, config.out)
    error = fit_error(fit, config.held_out, torch.Generator().manual_seed(0))
    print(f"{config.out}: off by up to {error:.1e} of the coefficients' norm on {config.held_out} held-out skies")


if __name__ == "__main__":
    with_suggestions(main, "fit_skylight")
