"""Fit the sky's coefficients with polynomials and say how far off they are: python scripts/fit_skylight.py"""

from dataclasses import dataclass

import hydra
import torch
from omegaconf import DictConfig
from safetensors.torch import save_file

from renderer.errors import require_range
from renderer.skylight import fit_error, fit_polynomials
from train.cli import one_sentence_errors, with_suggestions
from train.outputs import writable_file
from train.settings import read_settings


@dataclass
class Settings:
    """conf/fit_skylight.yaml."""

    out: str
    zenith_degree: int
    turbidity_degree: int
    held_out: int

    def __post_init__(self):
        for name, least, most in [("zenith_degree", 0, 50), ("turbidity_degree", 0, 50), ("held_out", 1, 10**6)]:
            require_range(name, getattr(self, name), least, most)


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="fit_skylight")
@one_sentence_errors
def main(config: DictConfig) -> None:
    config = read_settings(Settings, config)
    out = writable_file(config.out, "out")
    fit = fit_polynomials(config.zenith_degree, config.turbidity_degree).float()
    out.parent.mkdir(parents=True, exist_ok=True)
    save_file({"fit": fit}, config.out)
    error = fit_error(fit, config.held_out, torch.Generator().manual_seed(0))
    print(f"{config.out}: off by up to {error:.1e} of the coefficients' norm on {config.held_out} held-out skies")


if __name__ == "__main__":
    with_suggestions(main, "fit_skylight")
